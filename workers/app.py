"""The Celery app of scaled-out mode. A message carries a job id; the job table decides whether there is work in it.

celery -A workers.app worker -Q asim.train,asim.score -c 1
"""

import argparse
import os
import signal
import sys
import threading
from functools import cache
from types import FrameType
from typing import get_args
from uuid import UUID

from billiard import active_children, current_process  # type: ignore[import-untyped]  # billiard has no types
from celery.signals import worker_process_init, worker_ready, worker_shutting_down
from celery.worker import state as celery_state
from kombu.exceptions import OperationalError as BrokerError
from sqlalchemy.exc import SQLAlchemyError

from api_schemas.jobs import RUN_JOB, Queue
from service import jobs
from service.carrier import celery_app, impatient_app, messages_in
from service.clock import utc_now
from service.log import configure_logs, get_logger
from service.settings import Settings
from workers.consumption import Consumption
from workers.dispatch import open_worker
from workers.dispatch import run_job as run_job_here
from workers.job import Worker
from workers.orphans import end_with

log = get_logger("worker")
STALLED = 4  # exit status
STOP = signal.SIGUSR2  # from the parent to its children: SIGTERM and SIGUSR1 have a meaning of their own in Celery


def served_queues(arguments: list[str]) -> tuple[str, ...]:
    """The queues of `-Q`, all where there is none; a spawned child has its parent's command line.

    A job gives way to work that waits in these queues, and not to what another worker has to do.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("-Q", "--queues", default="")
    asked = {name.split(".")[-1] for name in parser.parse_known_args(arguments)[0].queues.split(",")}
    return tuple(name for name in get_args(Queue) if name in asked) or get_args(Queue)


def settings_for(queues: tuple[str, ...]) -> Settings:
    """The environment's settings; simulator states are out of reach of a worker that does not serve `label`."""
    given = Settings()
    return given if "label" in queues else given.model_copy(update={"provenance_url": ""})


settings = settings_for(served_queues(sys.argv))
app = celery_app(settings)


@app.task(name=RUN_JOB, acks_late=True, ignore_result=True)  # type: ignore[untyped-decorator]  # celery has no types
def run_job(job_id: str) -> None:
    """Run one job, if it is still to be run."""
    run_job_here(worker(), UUID(job_id))


@cache
def worker() -> Worker:
    """This process's connections, opened at its first task."""
    return open_worker(settings, utc_now, served_queues(sys.argv), expendable=True)


@worker_process_init.connect  # type: ignore[untyped-decorator]  # celery has no types
def _prepare_child(**_: object) -> None:
    parent = current_process()._parent_pid  # not os.getppid(): the parent may be gone by now
    if parent is not None:  # None in a solo worker, which does its jobs itself
        end_with(parent)
    from workers.runner import prepare_science

    configure_logs()
    prepare_science(settings)
    signal.signal(STOP, _stop)


@worker_shutting_down.connect  # type: ignore[untyped-decorator]  # celery has no types
def _tell_children(**_: object) -> None:
    """A warm shutdown waits for running tasks, minutes for some; told, they give their jobs back."""
    worker().stopping.set()
    for child in active_children():
        os.kill(child.pid, STOP)


def _stop(number: int, frame: FrameType | None) -> None:
    worker().stopping.set()


@worker_ready.connect  # type: ignore[untyped-decorator]  # celery has no types
def _say_alive(**_: object) -> None:
    """The parent process speaks for its children."""
    threading.Thread(target=_beat, name="alive", daemon=True).start()


def _beat() -> None:
    from workers.runner import ALIVE_SECONDS

    parent, watch = worker(), _consumption(worker())
    while not parent.stopping.is_set():
        try:
            with parent.database.write() as session:
                jobs.worker_alive(session, parent.owner, parent.queues, parent.clock())
            _end_if_stalled(watch)
        except SQLAlchemyError as error:  # the next beat tries again
            log.warning("database_unreachable", error=str(error))
        parent.stopping.wait(ALIVE_SECONDS)


def _consumption(parent: Worker) -> Consumption:
    broker = impatient_app(settings)
    return Consumption(
        parent,
        taken=lambda: int(celery_state.all_total_count[0]),
        holds=lambda: bool(celery_state.reserved_requests),
        processes=lambda: [os.getpid(), *(child.pid for child in active_children())],
        messages_in=lambda queue: messages_in(broker, f"{settings.celery_prefix}.{queue}"),
    )


def _end_if_stalled(watch: Consumption) -> None:
    """Whatever supervises this worker starts it again, with connections that work; its children end with it."""
    try:
        reason = watch.stalled()
    except BrokerError as error:  # without a broker there is nothing to consume
        log.warning("broker_unreachable", error=str(error))
        return
    if reason is not None:
        log.error("worker_stalled", reason=reason)
        os._exit(STALLED)

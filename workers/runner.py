"""The embedded carrier: a process that claims jobs from the job table and runs them, one at a time.

    python -m workers.runner --queues train,score,default --parent 4711

It ends on SIGTERM and SIGINT, giving its job back, and by itself when its parent is gone.
"""

import argparse
import signal
import threading
import time
from types import FrameType

from sqlalchemy.exc import SQLAlchemyError

from service import canary, jobs, reaper
from service.clock import utc_now
from service.collector import freeze_imports
from service.errors import ServiceError
from service.log import configure_logs, get_logger
from service.settings import Settings
from workers.dispatch import open_worker, run_next
from workers.job import Worker
from workers.orphans import end_with

log = get_logger("runner")
ALIVE_SECONDS = 5.0
REAP_SECONDS = 1.0


def run(worker: Worker) -> None:
    """Claim and run jobs until the worker is told to stop."""
    threading.Thread(target=_say_alive, args=(worker,), name="alive", daemon=True).start()
    reaped = 0.0
    while not worker.stopping.is_set():
        if time.monotonic() - reaped > REAP_SECONDS:
            _reap(worker)
            reaped = time.monotonic()
        try:
            if not run_next(worker):
                worker.stopping.wait(worker.settings.poll_seconds)
        except SQLAlchemyError as error:  # a busy or restarting database; the job's lease brings it back
            log.warning("database_unreachable", error=str(error))
            worker.stopping.wait(1.0)
    worker.database.close()


def _reap(worker: Worker) -> None:
    """What fails here is tried again in a second, and keeps no job from being claimed."""
    try:
        reaper.reap(worker.database, worker.clock())
        with worker.database.write() as session:
            canary.plant(session, worker.clock(), worker.settings.canary_seconds / 4)
    except (SQLAlchemyError, ServiceError) as error:
        log.warning("reaping_failed", error=str(error))


def prepare_science(settings: Settings) -> None:
    """Get a process ready to train and score.

    Torch's threads are 1 by default, so that workers side by side do not fight for cores.
    """
    import torch

    import workers.scoring
    import workers.training  # noqa: F401  # imported now, so that freezing covers it

    torch.set_num_threads(settings.torch_threads)
    freeze_imports()


def main() -> None:
    """Entry of the process."""
    parser = argparse.ArgumentParser(prog="python -m workers.runner")
    parser.add_argument("--queues", default="train,score,default", help="comma-separated")
    parser.add_argument("--parent", type=int, default=None, help="end when the parent is no longer this process")
    options = parser.parse_args()
    configure_logs()
    settings, queues = Settings(), tuple(options.queues.split(","))
    if {"train", "score"} & set(queues):
        prepare_science(settings)
    worker = open_worker(settings, utc_now, queues, expendable=True)
    _stop_on_signals(worker)
    if options.parent is not None:
        end_with(options.parent)
    log.info("runner_started", owner=worker.owner, queues=queues)
    run(worker)


def _say_alive(worker: Worker) -> None:
    while True:
        try:
            with worker.database.write() as session:
                jobs.worker_alive(session, worker.owner, worker.queues, worker.clock())
        except SQLAlchemyError as error:
            log.warning("database_unreachable", error=str(error))
        if worker.stopping.wait(ALIVE_SECONDS):
            return


def _stop_on_signals(worker: Worker) -> None:
    def stop(number: int, frame: FrameType | None) -> None:
        log.info("runner_stopping", signal=signal.Signals(number).name)
        worker.stopping.set()

    signal.signal(signal.SIGTERM, stop)
    signal.signal(signal.SIGINT, stop)


if __name__ == "__main__":
    main()

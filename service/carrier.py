"""The carrier of scaled-out mode: it brings job ids to Celery workers.

The job table is the outbox: a job is queued in the transaction of whatever asked for it, and the relay sends what has
not been sent. A message that is lost is sent again, one that arrives twice finds the job claimed.
"""

import threading
import time
from collections.abc import Callable
from datetime import datetime, timedelta
from functools import partial
from typing import get_args
from uuid import UUID

from celery import Celery
from kombu.exceptions import OperationalError as BrokerError

from api_schemas.jobs import RUN_JOB, Queue
from service import canary, reaper
from service.log import get_logger
from service.settings import Settings
from service.store.database import Database
from service.store.queries import jobs as queries

log = get_logger("carrier")
BATCH = 100
LOOK_SECONDS = 1.0  # between two looks for silent workers and lost messages
PAUSE_SECONDS = 1.0  # after a broker or a database has failed
CONNECT_SECONDS = 2.0
ANSWER_SECONDS = 5.0
RETURN_SECONDS = 10.0  # between two looks for messages whose visibility has ended
PATIENCE = {"max_retries": 1, "interval_start": 0.0, "interval_step": 0.2, "interval_max": 0.2}


def celery_app(settings: Settings, *, current: bool = True) -> Celery:
    """A Celery app with the settings that both ends share; only workers.app adds tasks to it."""
    app = Celery("asim", broker=settings.broker_url, set_as_current=current)
    app.conf.update(
        task_ignore_result=True,  # the database is the truth
        task_acks_late=True,
        task_reject_on_worker_lost=True,
        task_default_queue=f"{settings.celery_prefix}.default",
        task_serializer="json",
        accept_content=["json"],
        worker_prefetch_multiplier=1,
        worker_pool_start_method="spawn",  # forked children hang once the parent has used torch
        worker_proc_alive_timeout=120,
        worker_soft_shutdown_timeout=30,
        worker_hijack_root_logger=False,
        # A worker that loses the broker goes on with its job: a restart of the broker shall cost no attempt. What it
        # cannot acknowledge any more comes again, finds the job claimed or done, and is dropped.
        worker_cancel_long_running_tasks_on_connection_loss=False,
        broker_connection_retry_on_startup=True,
        broker_connection_max_retries=None,  # a worker outlives a broker that is away for long
        broker_transport_options=_transport_options(settings),
        # No worker_max_memory_per_child: it looks only after a job has ended, so it does not keep a job from using up
        # the memory, and each new child loads torch again. What the kernel kills costs its job an attempt.
    )
    return app


def impatient_app(settings: Settings) -> Celery:
    """An app that gives up soon on a broker that is away: who uses it comes again, and has other things to do."""
    app = celery_app(settings, current=False)
    bounds = {"socket_connect_timeout": CONNECT_SECONDS, "socket_timeout": ANSWER_SECONDS}
    shared = app.conf.broker_transport_options
    app.conf.update(
        broker_connection_timeout=CONNECT_SECONDS,
        broker_transport_options={**shared, **PATIENCE, **(bounds if settings.redis_broker else {})},
    )
    return app


def messages_in(app: Celery, queue: str) -> int:
    """How many messages the broker holds in a queue for whoever asks next. Raises BrokerError."""
    with app.connection_for_write() as connection:
        # Passive, so that RabbitMQ makes no queue of it. On Redis declaring makes none, and kombu's passive declaration
        # looks for the key without global_keyprefix, that is never finds it.
        passive = connection.transport.driver_type != "redis"
        try:
            return int(connection.default_channel.queue_declare(queue=queue, passive=passive).message_count)
        except connection.channel_errors:  # there is no such queue; Redis forgets a queue when it is empty
            return 0
        except connection.connection_errors as error:
            raise BrokerError(f"queue {queue}: {error}") from error


def relay(database: Database, app: Celery, settings: Settings, now: datetime, *, look_for_lost: bool = True) -> int:
    """Send every job that may run and was not sent, or whose message is lost; returns how many.

    To look for what is lost takes a question to the broker; not every time is needed.
    """
    with database.read() as session:
        waiting = [(row.id, row.queue) for row in queries.unsent(session, now, BATCH)]
    if look_for_lost:
        waiting += _lost(database, app, settings, now)
    for job_id, queue in waiting:  # outside any transaction: a broker may take its time
        name = f"{settings.celery_prefix}.{queue}"
        app.send_task(RUN_JOB, [str(job_id)], queue=name, retry=True, retry_policy=PATIENCE)
        with database.write() as session:
            queries.mark_sent(session, job_id, now)
    return len(waiting)


def _lost(database: Database, app: Celery, settings: Settings, now: datetime) -> list[tuple[UUID, str]]:
    """Jobs that nobody claimed since they were sent, where the broker holds no message that could still arrive."""
    sent_before = now - timedelta(seconds=settings.resend_seconds)
    with database.read() as session:
        neglected = queries.neglected_queues(session, get_args(Queue), sent_before, now)
    empty = [queue for queue in neglected if messages_in(app, f"{settings.celery_prefix}.{queue}") == 0]
    with database.read() as session:  # queue by queue: a backlog in one hides nothing of another
        return [
            (row.id, queue) for queue in empty for row in queries.unclaimed(session, queue, now, sent_before, BATCH)
        ]


def _transport_options(settings: Settings) -> dict[str, object]:
    """What only the Redis transport knows; RabbitMQ returns the messages of a lost worker by itself, at once."""
    if not settings.redis_broker:
        return {}
    return {
        "global_keyprefix": f"{settings.celery_prefix}:",
        "visibility_timeout": settings.visibility_seconds,
        # By default every tenth look does something, and a message returns up to 100 s late.
        "unacked_restore_interval": min(RETURN_SECONDS, settings.visibility_seconds),
        "unacked_restore_throttle": 1,
    }


class Relay:
    """A thread of the API process that relays and reaps until it is stopped."""

    def __init__(self, database: Database, settings: Settings, clock: Callable[[], datetime]) -> None:
        self._database, self._settings, self._clock = database, settings, clock
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="relay", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """End, and wait for it."""
        self._stop.set()
        self._thread.join(timeout=10)

    def _run(self) -> None:
        app, looked = impatient_app(self._settings), 0.0
        while not self._stop.wait(self._settings.poll_seconds):
            due = time.monotonic() - looked >= LOOK_SECONDS
            looked = time.monotonic() if due else looked
            chores = (self._reap, self._plant) if due else ()
            send = partial(relay, self._database, app, self._settings, self._clock(), look_for_lost=due)
            went_well = [self._try(each) for each in (*chores, send)]  # each, whatever became of the one before
            if not all(went_well):
                self._stop.wait(PAUSE_SECONDS)

    def _try(self, step: Callable[[], object]) -> bool:
        """Whether the step went well."""
        try:
            step()
        except BrokerError as error:  # without its traceback: there may be one a second for an hour
            log.warning("broker_unreachable", error=str(error))
            return False
        except Exception as error:  # the thread's boundary: without it one bad moment would end all sending
            log.exception("relay_failed", error=str(error))
            return False
        return True

    def _reap(self) -> None:
        reaper.reap(self._database, self._clock())

    def _plant(self) -> None:
        with self._database.write() as session:
            canary.plant(session, self._clock(), self._settings.canary_seconds / 4)

"""The carrier of scaled-out mode: it brings job ids to Celery workers.

The job table is the outbox: a job is queued in the transaction of whatever asked for it, and the relay sends what has
not been sent. A message that is lost is sent again, one that arrives twice finds the job claimed.
"""

import threading
from collections.abc import Callable
from datetime import datetime, timedelta

from celery import Celery

from api_schemas.jobs import RUN_JOB
from service import reaper
from service.log import get_logger
from service.settings import Settings
from service.store.database import Database
from service.store.queries import jobs as queries

log = get_logger("carrier")
RESEND_AFTER = timedelta(seconds=60)
BATCH = 100


def celery_app(settings: Settings) -> Celery:
    """A Celery app with the settings that both ends share; only workers.app adds tasks to it."""
    app = Celery("asim", broker=settings.broker_url)
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
        worker_cancel_long_running_tasks_on_connection_loss=True,
        broker_connection_retry_on_startup=True,
        broker_transport_options={"visibility_timeout": 900, "global_keyprefix": f"{settings.celery_prefix}:"},
    )
    return app


def relay(database: Database, app: Celery, prefix: str, now: datetime) -> int:
    """Send every job that may run and was not sent, or was sent long ago and never claimed; returns how many."""
    with database.read() as session:
        waiting = [(row.id, row.queue) for row in queries.unsent(session, now, now - RESEND_AFTER, BATCH)]
    for job_id, queue in waiting:  # outside any transaction: a broker may take its time
        app.send_task(RUN_JOB, [str(job_id)], queue=f"{prefix}.{queue}")
        with database.write() as session:
            queries.mark_sent(session, job_id, now)
    return len(waiting)


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
        app = celery_app(self._settings)
        while not self._stop.wait(self._settings.poll_seconds):
            try:
                with self._database.write() as session:
                    reaper.reap(session, self._clock())
                relay(self._database, app, self._settings.celery_prefix, self._clock())
            except Exception as error:  # the thread's boundary: without it one bad moment would end all sending
                log.exception("relay_failed", error=str(error))
                self._stop.wait(1.0)

"""The scheduler of scaled-out mode: it sends jobs to workers and takes back those of workers that fell silent."""

import os
import signal
import socket
import threading
from types import FrameType

from sqlalchemy.exc import SQLAlchemyError

from asim.errors import AsimError
from service import jobs
from service.carrier import Relay
from service.clock import utc_now
from service.log import configure_logs, get_logger
from service.settings import Settings
from service.store.database import open_database

log = get_logger("scheduler")
ALIVE_SECONDS = 5.0


def schedule(settings: Settings) -> None:
    """Until SIGINT or SIGTERM. Several may run: rows are locked while one works on them.

    Raises AsimError without a broker: embedded runners do it themselves.
    """
    if settings.embedded:
        raise AsimError("a scheduler sends jobs to Celery workers; ASIM_BROKER_URL names no broker for them")
    configure_logs()
    stopping = threading.Event()

    def stop(number: int, frame: FrameType | None) -> None:
        stopping.set()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    database = open_database(settings.resolved_database_url(), pool_size=4)
    relay, owner = Relay(database, settings, utc_now), f"{socket.gethostname()}:{os.getpid()}:scheduler"
    relay.start()
    log.info("scheduler_started", owner=owner)
    while not stopping.wait(ALIVE_SECONDS):
        try:
            with database.write() as session:
                jobs.worker_alive(session, owner, (), utc_now())
        except SQLAlchemyError as error:  # the next beat tries again
            log.warning("database_unreachable", error=str(error))
    relay.stop()
    database.close()

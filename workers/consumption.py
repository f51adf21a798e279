"""Does a Celery worker still consume? After resets of its connection one may live on, idle, while messages wait.

Its heartbeat and the broker's own checks stay green then. What shows it is the work: a job of its queues was sent long
ago and waits, the broker holds messages of that queue, and the worker has taken none and runs nothing.
"""

import socket
from collections.abc import Callable, Sequence
from datetime import datetime, timedelta

from service.store.queries import jobs as queries
from workers.job import Worker

PATIENCE = timedelta(seconds=30)


class Consumption:
    """Watches one Celery worker from its parent process; ask it every few seconds."""

    def __init__(
        self,
        worker: Worker,
        taken: Callable[[], int],
        holds: Callable[[], bool],
        processes: Callable[[], Sequence[int]],
        messages_in: Callable[[str], int],
    ) -> None:
        """What to ask.

        taken: how many messages the worker has begun so far. holds: whether it has one that it has not finished.
        processes: ids of those that run its jobs. messages_in: how many messages the broker holds in a queue.
        """
        self._worker, self._taken, self._messages_in = worker, taken, messages_in
        self._holds, self._processes = holds, processes
        self._last_taken, self._since = taken(), worker.clock()

    def stalled(self) -> str | None:
        """Why this worker should be started anew; None while nothing speaks against it. Raises what the broker does."""
        now, taken = self._worker.clock(), self._taken()
        if taken != self._last_taken or self._holds() or self._busy(now):
            self._last_taken, self._since = taken, now
        if now - self._since < PATIENCE:
            return None
        for queue in self._neglected(now - PATIENCE, now):
            waiting = self._messages_in(queue)
            if waiting:
                idle = (now - self._since).total_seconds()
                return f"{waiting} messages wait in queue {queue}; this worker has taken none for {idle:.0f} s"
        return None

    def _busy(self, now: datetime) -> bool:
        with self._worker.database.read() as session:
            return queries.held_by_process(session, socket.gethostname(), self._processes(), now)

    def _neglected(self, sent_before: datetime, now: datetime) -> list[str]:
        """Queues of this worker with a job that was sent before then and never claimed."""
        with self._worker.database.read() as session:
            return queries.neglected_queues(session, self._worker.queues, sent_before, now)

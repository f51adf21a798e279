"""A Celery worker that lives but does not consume is found out; one that is busy, idle or without a broker is not."""

import os
import socket

import pytest
from kombu.exceptions import OperationalError

from service import jobs
from service.store.queries import jobs as queries
from tests.workers.in_process import Loop
from workers.consumption import PATIENCE, Consumption

LONG = PATIENCE.total_seconds() + 1


class Broker:
    """What the worker's parent can ask: of Celery in its own process, and of the broker."""

    def __init__(self) -> None:
        self.taken, self.holding, self.messages, self.away = 0, False, 1, False

    def messages_in(self, queue: str) -> int:
        if self.away:
            raise OperationalError("Connection refused")
        return self.messages if queue == "train" else 0


@pytest.fixture
def broker() -> Broker:
    return Broker()


@pytest.fixture
def watch(labeled: Loop, broker: Broker) -> Consumption:
    """A round was sent to the queue and waits there."""
    labeled.client.start_round(labeled.project.id)
    with labeled.worker.database.write() as session:
        for row in queries.unsent(session, labeled.clock(), 10):
            queries.mark_sent(session, row.id, labeled.clock())
    return Consumption(
        labeled.worker, lambda: broker.taken, lambda: broker.holding, lambda: [os.getpid()], broker.messages_in
    )


def test_a_worker_that_takes_nothing_for_long_is_stalled(labeled: Loop, watch: Consumption) -> None:
    assert watch.stalled() is None
    labeled.clock.advance(LONG)
    reason = watch.stalled()
    assert reason is not None
    assert "queue train" in reason


def test_a_worker_that_takes_messages_is_not(labeled: Loop, watch: Consumption, broker: Broker) -> None:
    for _ in range(3):
        labeled.clock.advance(LONG)
        broker.taken += 1
        assert watch.stalled() is None
    broker.holding = True  # its child is still starting
    labeled.clock.advance(LONG)
    assert watch.stalled() is None


@pytest.mark.parametrize("mine", [True, False])
def test_a_worker_that_runs_a_job_is_not(labeled: Loop, watch: Consumption, mine: bool) -> None:
    owner = f"{socket.gethostname()}:{os.getpid()}:0" if mine else "elsewhere:1:0"
    with labeled.worker.database.write() as session:
        assert jobs.claim_next(session, ("train",), owner, labeled.clock(), 2 * LONG) is not None
    labeled.clock.advance(LONG)
    assert (watch.stalled() is None) is mine


def test_where_no_message_waits_it_is_not(labeled: Loop, watch: Consumption, broker: Broker) -> None:
    labeled.clock.advance(LONG)
    broker.messages = 0  # the message is lost: the relay's to mend
    assert watch.stalled() is None


def test_where_no_job_waits_it_is_not(labeled: Loop, watch: Consumption) -> None:
    labeled.drain()
    labeled.clock.advance(LONG)
    assert watch.stalled() is None  # what the broker holds is old


def test_without_a_broker_nothing_is_said(labeled: Loop, watch: Consumption, broker: Broker) -> None:
    labeled.clock.advance(LONG)
    broker.away = True
    with pytest.raises(OperationalError):
        watch.stalled()

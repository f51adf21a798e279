"""What the Celery worker knows of its command line, and what is sent to it."""

from datetime import timedelta
from typing import Any

import pytest
from celery import Celery

from service.carrier import RESEND_AFTER, relay
from tests.workers.in_process import Loop
from workers import training
from workers.app import served_queues
from workers.dispatch import run_next

ALL = ("train", "score", "label", "default")


@pytest.mark.parametrize(
    ("options", "queues"),
    [
        (["-Q", "asim.train,asim.score"], ("train", "score")),
        (["--queues", "a.b.label"], ("label",)),
        (["--queues=asim.train", "-c", "1"], ("train",)),
        ([], ALL),
        (["--quiet"], ALL),
    ],
)
def test_a_worker_serves_the_queues_that_it_was_started_for(options: list[str], queues: tuple[str, ...]) -> None:
    assert served_queues(["celery", "-A", "workers.app", "worker", *options]) == queues


class Sent(Celery):  # type: ignore[misc]  # celery has no types
    """An app that notes what it is asked to send."""

    def __init__(self) -> None:
        super().__init__("noting", set_as_current=False)
        self.messages: list[tuple[str, str]] = []

    def send_task(self, name: str, args: list[str], *, queue: str, **_: Any) -> None:
        self.messages.append((queue, args[0]))


def test_a_job_is_sent_once_and_again_when_nobody_has_claimed_it(labeled: Loop) -> None:
    asked = labeled.client.start_round(labeled.project.id)
    sent, now, later = Sent(), labeled.clock(), labeled.clock() + RESEND_AFTER + timedelta(seconds=1)
    assert relay(labeled.worker.database, sent, "x", now) == 2
    assert ("x.train", str(asked.job)) in sent.messages
    assert relay(labeled.worker.database, sent, "x", now) == 0
    assert relay(labeled.worker.database, sent, "x", later) == 2


def test_a_job_that_failed_is_not_sent_before_its_pause_is_over(labeled: Loop, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(training, "train", fail)
    asked = labeled.client.start_round(labeled.project.id)
    run_next(labeled.worker)
    sent = Sent()
    relay(labeled.worker.database, sent, "x", labeled.clock())
    assert ("x.train", str(asked.job)) not in sent.messages
    labeled.clock.advance(2)
    relay(labeled.worker.database, sent, "x", labeled.clock())
    assert ("x.train", str(asked.job)) in sent.messages

"""What the Celery worker knows of its own command line."""

import pytest

from workers.app import served_queues

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

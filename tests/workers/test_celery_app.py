"""What the Celery worker knows of its command line, and what is sent to it."""

import subprocess
from datetime import timedelta
from typing import Any
from uuid import UUID

import pytest
from celery import Celery
from redis import Redis

from api_schemas.jobs import ScoreShard, TrainSubgoalGenerator
from service import canary, jobs
from service.carrier import BATCH, Relay, celery_app, impatient_app, messages_in, relay
from service.settings import Settings
from service.store.tables import JobRow
from tests.loop.processes import eventually
from tests.private_servers import free_port
from tests.servers import RedisSpace
from tests.workers.in_process import Loop
from workers.app import served_queues
from workers.dispatch import run_next
from workers.stage import Stage

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


def sent(loop: Loop, job: UUID | None) -> bool:
    """Whether the carrier was given the job."""
    with loop.worker.database.read() as session:
        row = None if job is None else session.get(JobRow, job)
        return row is not None and row.sent_at is not None


@pytest.fixture
def carried(labeled: Loop, redis_space: RedisSpace) -> Settings:
    """Settings of `labeled`, but with a broker."""
    return labeled.settings.model_copy(update={"broker_url": redis_space.url, "celery_prefix": redis_space.prefix})


def test_a_job_is_sent_again_when_nobody_claims_it_and_its_message_is_lost(
    labeled: Loop, carried: Settings, redis_space: RedisSpace
) -> None:
    labeled.client.start_round(labeled.project.id)  # and with it the first subgoal generator
    app, database, queue = impatient_app(carried), labeled.worker.database, f"{redis_space.prefix}.train"

    def relayed(seconds: float) -> int:
        return relay(database, app, carried, labeled.clock() + timedelta(seconds=seconds))

    assert (relayed(0), relayed(0)) == (2, 0)
    assert messages_in(app, queue) == 2
    assert relayed(carried.resend_seconds + 1) == 0  # the workers are busy: both messages wait
    with Redis.from_url(redis_space.url) as broker:
        assert broker.delete(f"{redis_space.prefix}:{queue}") == 1  # the broker loses what it had
    assert messages_in(app, queue) == 0
    assert relayed(carried.resend_seconds - 1) == 0
    assert relayed(carried.resend_seconds + 1) == 2
    assert messages_in(app, queue) == 2
    app.close()


def test_a_lost_message_is_found_behind_another_queues_backlog(
    labeled: Loop, carried: Settings, redis_space: RedisSpace
) -> None:
    app, database, project = impatient_app(carried), labeled.worker.database, labeled.project.id
    backlog = BATCH + 5
    with database.write() as session:
        for _ in range(backlog):
            jobs.enqueue(session, project, TrainSubgoalGenerator(project=project), project, labeled.clock())

    def relayed(seconds: float) -> int:
        return relay(database, app, carried, labeled.clock() + timedelta(seconds=seconds))

    assert relayed(0) + relayed(0) == backlog
    with database.write() as session:
        lost = jobs.enqueue(session, project, ScoreShard(scoring=project, shard=0), project, labeled.clock()).id
    assert relayed(0) == 1
    with Redis.from_url(redis_space.url) as broker:
        assert broker.delete(f"{redis_space.prefix}:{redis_space.prefix}.score") == 1
    before = labeled.clock()
    assert relayed(carried.resend_seconds + 1) == 1
    assert messages_in(app, f"{redis_space.prefix}.score") == 1
    assert messages_in(app, f"{redis_space.prefix}.train") == backlog
    with database.read() as session:
        sent_at = session.get_one(JobRow, lost).sent_at
    assert sent_at is not None
    assert sent_at > before
    app.close()


def test_messages_are_sent_and_canaries_planted_while_the_reaper_fails(
    labeled: Loop, carried: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: Any) -> None:
        raise LookupError("a row that cannot be reaped")

    monkeypatch.setattr("service.reaper.reap", broken)
    asked = labeled.client.start_round(labeled.project.id)
    running = Relay(labeled.worker.database, carried, labeled.clock)
    running.start()
    try:
        eventually(lambda: sent(labeled, asked.job), 20, "nothing is sent")
        eventually(lambda: sent(labeled, canary.job_id("train")), 20, "no canary is sent")
    finally:
        running.stop()


def test_a_relay_goes_on_when_the_broker_is_back(labeled: Loop) -> None:
    """Neither dead nor stuck: silent workers are reaped, and what waits is sent, at the first moment it can be."""
    asked, port = labeled.client.start_round(labeled.project.id), free_port()
    settings = labeled.settings.model_copy(update={"broker_url": f"redis://127.0.0.1:{port}/0"})
    with labeled.worker.database.write() as session:
        silent = jobs.claim_next(session, ("train",), "silent", labeled.clock() - timedelta(hours=1), 1.0)
        assert silent is not None
    running = Relay(labeled.worker.database, settings, labeled.clock)
    running.start()
    try:
        eventually(lambda: labeled.client.job(silent.id).state == "queued", 20, "nobody reaps")
        labeled.clock.advance(2)  # the pause after the lost attempt
        command = ["redis-server", "--port", str(port), "--bind", "127.0.0.1", "--save", ""]
        with subprocess.Popen(command, stdout=subprocess.DEVNULL) as broker:
            try:
                eventually(lambda: sent(labeled, asked.job), 20, "nothing is sent")
            finally:
                broker.terminate()
    finally:
        running.stop()


def test_only_redis_gets_the_options_of_redis(carried: Settings) -> None:
    options = celery_app(carried, current=False).conf.broker_transport_options
    assert options["visibility_timeout"] == carried.visibility_seconds == 900
    assert options["unacked_restore_interval"] * options["unacked_restore_throttle"] <= 10
    rabbit = carried.model_copy(update={"broker_url": "amqp://guest@127.0.0.1//"})
    assert celery_app(rabbit, current=False).conf.broker_transport_options == {}
    assert not {"socket_timeout", "global_keyprefix"} & set(impatient_app(rabbit).conf.broker_transport_options)


def test_a_job_that_failed_is_not_sent_before_its_pause_is_over(labeled: Loop, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Stage, "train", fail)
    asked = labeled.client.start_round(labeled.project.id)
    run_next(labeled.worker)
    app, settings = Sent(), labeled.settings.model_copy(update={"celery_prefix": "x"})
    relay(labeled.worker.database, app, settings, labeled.clock())
    assert ("x.train", str(asked.job)) not in app.messages
    labeled.clock.advance(2)
    relay(labeled.worker.database, app, settings, labeled.clock())
    assert ("x.train", str(asked.job)) in app.messages

"""A Redis that is killed, loses everything or drops its connections. Crash tests 6 and 7."""

import random
import signal
import time
from collections import Counter
from uuid import UUID

import pytest

from tests.crash.conftest import REPEAT, Deploy, Prepared
from tests.crash.deployment import Deployment
from tests.crash.hammer import Hammer
from tests.crash.pools import await_ready, start_scoring
from tests.figures import Figures
from tests.loop.processes import eventually
from tests.private_servers import PrivateRedis

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]
CANARY_SECONDS = 60.0
SCIENCE = {"train", "score"}


def test_6_what_redis_forgets_comes_back_from_the_database(
    deploy: Deploy, prepared: Prepared, redis: PrivateRedis, figures: Figures, chance: random.Random
) -> None:
    deployment = deploy(1)
    deployment.await_workers()
    names = {each.id: each.name for each in deployment.client.projects()}
    busy = next(project for project, name in names.items() if name == "busy")
    rooms = [project for project, name in names.items() if name != "busy"]
    hammer = Hammer(deployment.url, deployment.key, busy, pause=0.3)
    hammer.start()
    done: Counter[str] = Counter()
    canaries, began = list[float](), time.monotonic()
    for number in range(REPEAT):
        scoring = start_scoring(deployment, rooms[number % len(rooms)])
        time.sleep(chance.uniform(0.0, 0.7))
        done.update([_disturb(redis, chance)])
        canaries.append(_await_canary(deployment))
        await_ready(deployment, scoring)
        deployment.check_rows()
    seconds = (time.monotonic() - began) / REPEAT
    hammer.finish()
    deployment.await_rest()
    told = _told(prepared, names, {busy: hammer})
    deployment.check(told)
    figures.note(f"Redis was {', '.join(f'{what} {count} times' for what, count in sorted(done.items()))}")
    figures.add("disturbances", REPEAT, f"at {seconds:.1f} s each")
    figures.add("answers of /acquire and /labels meanwhile", len(hammer.labelers.answers), "answers")
    figures.none("requests refused or unanswered", hammer.labelers.unanswered + hammer.labelers.unavailable)
    figures.none("labels lost or doubled", deployment.lost_or_doubled(told))
    figures.add("longest time until canaries pass", max(canaries), "s", target=CANARY_SECONDS, better="below")
    figures.note(f"workers were started {sum(each.starts for each in deployment.workers)} times")


def test_7_a_worker_whose_connections_are_reset_consumes_again(
    deploy: Deploy, prepared: Prepared, redis: PrivateRedis, figures: Figures
) -> None:
    deployment = deploy(1)
    deployment.start_worker("label")
    eventually(lambda: _status(deployment) == "ok", CANARY_SECONDS, lambda: f"not ready: {deployment.last_words()}")
    with redis.client() as client:
        for _ in range(3):
            client.execute_command("CLIENT", "KILL", "TYPE", "normal")
            time.sleep(1.0)
    seconds = _await_canary(deployment)
    figures.add("canaries after three resets", seconds, "s", target=CANARY_SECONDS, better="below")
    figures.note(f"workers that had to be started again: {sum(each.starts - 1 for each in deployment.workers)}")
    eventually(lambda: _status(deployment) == "ok", CANARY_SECONDS, lambda: f"not ready: {deployment.last_words()}")
    _check_red(deployment, figures)
    names = {each.id: each.name for each in deployment.client.projects()}
    deployment.check(_told(prepared, names, {}))


def _check_red(deployment: Deployment, figures: Figures) -> None:
    """Where a queue has no worker that consumes, health is red; and green when a supervisor has started one."""
    labeler = deployment.workers[-1]
    labeler.end(signal.SIGTERM)
    red = eventually(lambda: _status(deployment) != "ok", CANARY_SECONDS, "health stays green without a worker")
    deployment.revive()
    green = eventually(lambda: _status(deployment) == "ok", CANARY_SECONDS, "health stays red with a worker")
    figures.add("health is red after a queue lost its worker", red, "s", target=CANARY_SECONDS, better="below")
    figures.add("health is green after it was started again", green, "s", target=CANARY_SECONDS, better="below")


def _disturb(redis: PrivateRedis, chance: random.Random) -> str:
    what = chance.choice(("killed", "emptied by a kill", "flushed"))
    if what == "flushed":
        with redis.client() as client:
            client.flushall()
        return what
    redis.end(signal.SIGKILL)
    time.sleep(chance.uniform(0.0, 1.0))
    if what == "emptied by a kill":
        redis.forget()
    redis.start()
    return what


def _await_canary(deployment: Deployment) -> float:
    """Seconds until canaries came through. Where none does, health must be red, and a supervisor starts workers."""
    began, moment = time.monotonic(), time.time()
    deadline = began + CANARY_SECONDS / 2
    while not deployment.canaries_since(moment) >= SCIENCE:
        if time.monotonic() > deadline:
            assert _status(deployment) != "ok", "no canary, and health is green"
            for worker in deployment.workers:
                worker.end(signal.SIGTERM)
            deployment.revive()
            deadline = began + CANARY_SECONDS
        assert time.monotonic() < began + CANARY_SECONDS, deployment.last_words()
        time.sleep(0.05)
    return time.monotonic() - began


def _status(deployment: Deployment) -> str:
    return deployment.client.health().status


def _told(prepared: Prepared, names: dict[UUID, str], hammers: dict[UUID, Hammer]) -> dict[UUID, list[tuple[str, int]]]:
    return {
        project: prepared.labeled[name] + (hammers[project].acknowledged if project in hammers else [])
        for project, name in names.items()
    }

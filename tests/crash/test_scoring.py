"""Scorers that are killed half way through the pool: no score is missing, none is there twice. Crash test 4."""

import random
import signal
import time
from collections import Counter
from uuid import UUID

import numpy as np
import pytest

from tests.crash.conftest import REPEAT, Deploy, Prepared
from tests.crash.deployment import Deployment, kill
from tests.crash.pools import (
    Scores,
    await_ready,
    jobs_of,
    read_scores,
    scored_shards,
    segments_of_pool,
    start_scoring,
)
from tests.figures import Figures
from tests.loop.processes import eventually

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]


def test_4_a_scorer_killed_half_way(
    deploy: Deploy, prepared: Prepared, figures: Figures, chance: random.Random
) -> None:
    deployment = deploy(2)
    deployment.await_workers()
    projects = list(deployment.client.projects())
    project = next(each for each in projects if each.name == "busy").id
    undisturbed = _scored(deployment, start_scoring(deployment, project))
    assert undisturbed.segments == segments_of_pool(deployment, project)
    recovered, began = list[float](), time.monotonic()
    missing = doubled = different = 0
    while len(recovered) < REPEAT:
        scoring = start_scoring(deployment, project)
        if not _killed(deployment, scoring, chance):
            continue
        killed = time.monotonic()
        scores = _scored(deployment, scoring)
        recovered.append(time.monotonic() - killed)
        counted, wanted = Counter(scores.segments), Counter(undisturbed.segments)
        missing, doubled = missing + (wanted - counted).total(), doubled + (counted - wanted).total()
        assert scores.segments == undisturbed.segments
        different += int(np.sum(scores.scores.view(np.uint32) != undisturbed.scores.view(np.uint32)))
        assert len(jobs_of(deployment, scoring, "merge_scores")) == 1
        deployment.check_rows()
    seconds = (time.monotonic() - began) / REPEAT
    deployment.await_rest()
    deployment.check({each.id: prepared.labeled[each.name] for each in projects})
    figures.add("scorers killed", REPEAT, f"at {seconds:.1f} s each")
    figures.none("scores missing", missing)
    figures.none("scores there twice", doubled)
    figures.none("scores that differ in any bit", different)
    figures.add("longest time from a kill to the merged scores", max(recovered), "s", target=60, better="below")


def _killed(deployment: Deployment, scoring: UUID, chance: random.Random) -> bool:
    """Kill one who scores a shard when about half of them are scored; False where all were scored too soon."""
    shards = len(jobs_of(deployment, scoring, "score_shard"))
    wanted = chance.randint(shards // 4, 3 * shards // 4)
    eventually(lambda: scored_shards(deployment, scoring) >= wanted, 60, deployment.last_words)
    time.sleep(chance.uniform(0.0, 0.1))
    jobs = [job for job in jobs_of(deployment, scoring, "score_shard") if job.state == "running"]
    chance.shuffle(jobs)
    holders = [holder for job in jobs if (holder := deployment.holder_of(job.id))]
    return bool(holders) and kill(holders[0], signal.SIGKILL)


def _scored(deployment: Deployment, scoring: UUID) -> Scores:
    await_ready(deployment, scoring)
    return read_scores(deployment, scoring)

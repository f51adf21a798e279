"""Collections and labelers of a robot task, killed at random moments: nothing is lost, no label is given twice."""

import os
import random
import signal
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from uuid import UUID

import pytest

from tests.crash.deployment import kill
from tests.crash.robots import LEASE_SECONDS, WORK_SECONDS, Robots, need_simulator, simulators_of
from tests.figures import Figures
from tests.loop.invariants import check_invariants, retries
from tests.loop.processes import command_of, eventually

pytestmark = [pytest.mark.robots, pytest.mark.timeout(3600)]
KILLS = int(os.environ.get("REPEAT", "10"))
LONGEST = 8.0  # seconds of an attempt before a kill
TRAJECTORIES, LABELED = 120, 1700  # of one collection, and how many of its segments are labeled
COUNT = 60  # segments of a labeler's batch


@pytest.fixture
def robots(tmp_path: Path) -> Iterator[Robots]:
    """A service; skips where ManiSkill is missing."""
    need_simulator()
    found = Robots(tmp_path)
    yield found
    found.close()


def test_a_collection_killed_again_and_again_ends_as_one_that_was_not(
    robots: Robots, figures: Figures, chance: random.Random
) -> None:
    struck, calm = robots.project("struck").id, robots.project("calm").id
    jobs, killed, began = list[UUID](), 0, time.monotonic()
    while killed < KILLS:
        if not jobs or robots.client.job(jobs[-1]).state == "done":
            jobs.append(_ask(robots, struck, len(jobs)))
        killed += _kill_collector(robots, jobs[-1], chance)
        robots.check_rows()
    for job in jobs:
        robots.await_job(job)
    seconds = (time.monotonic() - began) / KILLS
    told = [robots.await_job(_ask(robots, calm, seed)).result for seed in range(len(jobs))]
    assert [robots.client.job(job).result for job in jobs] == told
    found, wanted = robots.labels(struck), robots.labels(calm)
    events = list(robots.client.events(struck))
    resumed = [event.data["trajectories"] for event in events if event.kind == "collection.resumed"]
    check_invariants(robots.client, robots.serving.folder, {struck: found, calm: wanted})
    figures.add("collectors killed", killed, f"at {seconds:.1f} s each, in {len(jobs)} collections")
    figures.add("attempts that lost their worker", sum(retries(robots.client, job) for job in jobs), "attempts")
    figures.add("attempts that went on behind a stored batch", len(resumed), "attempts", target=KILLS // 5)
    figures.add("trajectories", len(robots.trajectories(calm)), "trajectories")
    figures.none("trajectories lost or of no other run", len(robots.trajectories(struck) ^ robots.trajectories(calm)))
    figures.add("labels", len(wanted), "labels")
    figures.none("labels lost or of no other run", len(found.keys() ^ wanted.keys()))
    figures.none("labels with another action", sum(found[each].actions != wanted[each].actions for each in found))


def test_labelers_killed_again_and_again_label_every_segment_once_with_the_true_action(
    robots: Robots, figures: Figures, chance: random.Random
) -> None:
    asked, truth = robots.project("asked").id, robots.project("truth").id
    for project, labels in ((asked, None), (truth, {"all": True})):
        robots.await_job(robots.collect(project, trajectories=60, seed=1, labels=labels).id)
    true = robots.labels(truth)
    began = time.monotonic()
    assert robots.labeler("asked", COUNT).wait(WORK_SECONDS) == 0
    undisturbed = time.monotonic() - began
    figures.add("an undisturbed labeler", undisturbed, f"s for {COUNT} segments")
    done, before = Counter[str](), robots.labels(asked)
    while done.total() < KILLS:
        done.update(_kill_labeler(robots, chance, undisturbed))
        after = robots.labels(asked)
        assert before.items() <= after.items()
        before = after
        robots.check_rows()
    time.sleep(LEASE_SECONDS)
    while robots.client.find_project("asked").counts.labeled < len(true):
        assert robots.labeler("asked", COUNT).wait(WORK_SECONDS) == 0
    found = robots.labels(asked)
    check_invariants(robots.client, robots.serving.folder, {asked: found, truth: true})
    figures.note(f"killed: {', '.join(f'{count} {what}' for what, count in sorted(done.items()))}")
    figures.add("labels while labelers were killed", len(before), f"of {len(true)}")
    figures.none("segments without a label", len(true.keys() - found.keys()))
    wrong = sum(label.actions != true[segment].actions for segment, label in found.items())
    figures.none("labels with another action than the one taken", wrong)
    figures.none("segments that are held still", robots.client.find_project("asked").budget.reserved)


def _ask(robots: Robots, project: UUID, seed: int) -> UUID:
    return robots.collect(project, trajectories=TRAJECTORIES, seed=seed, labels={"segments": LABELED}).id


def _kill_collector(robots: Robots, job: UUID, chance: random.Random) -> bool:
    """Kill whoever collects, at a random moment; False where the collection was quicker."""
    holder = robots.await_holder(job)
    time.sleep(chance.uniform(0.0, LONGEST))
    return holder != 0 and robots.holder_of(job) == holder and kill(holder, signal.SIGKILL)


def _kill_labeler(robots: Robots, chance: random.Random, seconds: float) -> list[str]:
    """Kill a labeler, or the process of its simulator, at a random moment of its life; what was killed, if it lived."""
    labeler = robots.labeler("asked", COUNT)
    time.sleep(chance.uniform(0.0, 1.1 * seconds))
    simulators = list(simulators_of(labeler.pid))
    if simulators and chance.random() < 0.5:
        struck = kill(simulators[0], signal.SIGKILL)
        labeler.wait(WORK_SECONDS)
        return ["simulator"] * struck
    struck = labeler.poll() is None
    labeler.kill()
    labeler.wait()
    eventually(lambda: not any(map(command_of, simulators)), 60, "a simulator outlives its labeler")
    return ["labeler"] * struck

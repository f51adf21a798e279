"""Trainers that are killed, stopped or ended at random moments: the round resumes, and its networks are the same.

Numbers 1, 2, 3 and 15 of the crash tests.
"""

import random
import signal
import time
from collections import Counter
from pathlib import Path

import pytest

from models.training import TrainingState
from service.store.blobs import Blobs
from tests.crash.conftest import REPEAT, Deploy, Prepared
from tests.crash.deployment import SETTINGS, kill
from tests.crash.moments import Appearances
from tests.crash.scene import RECOVERED, Scene
from tests.figures import Figures
from tests.loop.processes import command_of, eventually

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]
LONGEST = 2.0  # seconds of training before a kill
CHECKPOINT_SECONDS = float(SETTINGS["ASIM_CHECKPOINT_SECONDS"])
SLACK = 5.0  # seconds: a slice of training takes one, on a busy machine several; so does loading
PATIENT = {"ASIM_JOB_MAX_ATTEMPTS": "5"}  # a kill may come before the first checkpoint, several times in a row


@pytest.fixture
def scene(deploy: Deploy, prepared: Prepared, figures: Figures) -> Scene:
    """Two prefork workers, so that one goes on while the other starts again."""
    deployment = deploy(2, **PATIENT)
    deployment.await_workers()
    return Scene(deployment, prepared, figures)


def test_1_a_killed_child_costs_a_checkpoint_interval(scene: Scene, chance: random.Random) -> None:
    scene.begin()
    lost: list[float] = []

    def strike(holder: int) -> None:
        saved = scene.saved_at()
        assert kill(holder, signal.SIGKILL)
        lost.append(time.time() - saved)

    for _ in range(REPEAT):
        scene.strike(strike, chance.uniform(0.0, LONGEST))
    scene.finish()
    scene.figures.add("longest work lost", max(lost), "s", CHECKPOINT_SECONDS + SLACK, "below")


def test_2_a_killed_parent_a_whole_machine_and_one_that_was_only_silent(
    deploy: Deploy, prepared: Prepared, figures: Figures, chance: random.Random
) -> None:
    deployment = deploy(1, **PATIENT)
    deployment.start_solo_worker()
    deployment.await_workers()
    scene = Scene(deployment, prepared, figures)
    scene.begin()
    done: Counter[str] = Counter()
    for _ in range(REPEAT):
        scene.strike(lambda holder: done.update([_strike_parent(scene, holder, chance)]), chance.uniform(0.0, LONGEST))
    scene.finish()
    refused = sum(worker.said().count('"event": "job_lost"') for worker in deployment.workers)
    figures.note(f"struck: {', '.join(f'{count} {what}' for what, count in sorted(done.items()))}")
    figures.note(f"{refused} holders found that they had lost their job, and wrote nothing")
    assert refused >= 1 or not done["silent"]


def test_3_a_checkpoint_that_is_being_written_does_not_replace_the_one_before(
    scene: Scene, chance: random.Random
) -> None:
    scene.begin()
    blobs = Blobs(str(scene.deployment.folder / "blobs"))
    loaded: list[int] = []
    with Appearances(scene.checkpoints) as appearances:

        def strike(holder: int) -> None:
            appearances.forget()
            appearances.await_staging(2 * CHECKPOINT_SECONDS + SLACK)
            kill(holder, signal.SIGKILL)
            eventually(lambda: command_of(holder) == "", 10, "the child lives on")
            sha256 = scene.deployment.job(scene.rounds.job).checkpoint_sha256
            if sha256 is not None:
                loaded.append(TrainingState.from_bytes(blobs.get("checkpoints", sha256)).step)

        for _ in range(REPEAT):
            scene.strike(strike, chance.uniform(0.0, CHECKPOINT_SECONDS))
    scene.finish()
    scene.figures.add("checkpoints that were loaded after a kill", len(loaded), "checkpoints")
    scene.figures.add("kills in the middle of a write", len(half_written(scene.checkpoints)), "files left half written")


def test_15_a_worker_that_is_asked_to_end_gives_its_round_back(scene: Scene, chance: random.Random) -> None:
    scene.begin()
    ended: list[float] = []

    def strike(holder: int) -> None:
        (worker,) = [each for each in scene.deployment.workers if holder in each.children()]
        began, before = time.monotonic(), scene.deployment.job(scene.rounds.job)
        assert worker.end(signal.SIGTERM, 30) == 0
        ended.append(time.monotonic() - began)
        after = scene.deployment.job(scene.rounds.job)
        assert after.fence > before.fence or (after.state, after.owner, after.error) == ("queued", None, None)
        assert after.attempts <= before.attempts

    for _ in range(3):
        scene.strike(strike, chance.uniform(0.5, LONGEST))
    scene.finish()
    scene.figures.add("longest time to end", max(ended), "s", 30, "below")


def _strike_parent(scene: Scene, holder: int, chance: random.Random) -> str:
    """Kill the holder's worker, alone or with it, or freeze the holder until it has lost its job; what was done."""
    parents = [each for each in scene.deployment.workers if each.alive and holder in (each.pid, *each.children())]
    if not parents:  # its parent was killed before
        kill(holder, signal.SIGKILL)
        return "orphan"
    (worker,) = parents
    if holder == worker.pid:
        worker.end(signal.SIGKILL)
        return "solo worker"
    what = chance.choice(("parent", "parent and child", "silent"))
    if what == "silent":
        _freeze(scene, holder, chance)
        return what
    children = worker.children() if what == "parent and child" else []
    worker.end(signal.SIGKILL)
    for child in children:
        kill(child, signal.SIGKILL)
    return what


def _freeze(scene: Scene, holder: int, chance: random.Random) -> None:
    """Stop the process until another holds its job, and let it go on then."""
    fence = scene.deployment.job(scene.rounds.job).fence
    kill(holder, signal.SIGSTOP)
    try:
        taken = scene.deployment.await_holder(scene.rounds.job, RECOVERED, fence=fence)
        assert taken != holder
        time.sleep(chance.uniform(0.0, 1.0))
    finally:
        kill(holder, signal.SIGCONT)


def half_written(folder: Path) -> list[Path]:
    """What writers left that were killed before they could give it its name."""
    return [path for path in folder.rglob("*") if "#" in path.name]

"""A policy's training whose worker is killed at random moments ends with the stages of one that was left alone."""

import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import cast

import pytest

from api_schemas.jobs import Job
from api_schemas.policies import PolicyCreate
from service.clock import utc_now
from service.garbage import collect
from service.store.provenance import ProvenanceBlobs
from service.store.tables import JobRow
from tests.crash.robots import TASK, WORK_SECONDS, need_simulator
from tests.figures import Figures
from tests.loop.processes import eventually, started
from tests.workers.conftest import new_project, open_loop
from tests.workers.in_process import Loop

pytestmark = [pytest.mark.robots, pytest.mark.timeout(1800)]
KILLS = int(os.environ.get("REPEAT", "6"))
STAGES = 8
LEASE_SECONDS = 4.0
SHORTLY = 2.0  # seconds behind a stage in which every second kill comes; the others come anywhere in an attempt
OVER = ("done", "failed")


class Trainers:
    """A service in this process, and workers of their own processes, one after the other, that train policies."""

    def __init__(self, folder: Path) -> None:
        self.loop = open_loop(folder, job_lease_seconds=LEASE_SECONDS, job_max_attempts=50)
        self.log = folder / "trainers.log"
        self._settings = {"ASIM_DATA_FOLDER": str(folder), "ASIM_JOB_LEASE_SECONDS": str(LEASE_SECONDS)}
        self.process: subprocess.Popen[bytes] | None = None

    def ask(self, project: str, seed: int) -> Job:
        """The training of a policy in the project of that name, not waited for."""
        owner = self.loop.client.find_project(project).id
        asked = PolicyCreate(project=owner, demonstrations=2, stages=STAGES, seed=seed)
        return self.loop.client.train_policy(asked)

    def start(self) -> None:
        """A worker where none lives."""
        if self.process is None or self.process.poll() is not None:
            argv = [sys.executable, "-m", "tests.workers.brief_policies", "--queues", "label"]
            self.process = started([*argv, "--parent", str(os.getpid())], self._settings, self.log)

    def await_training(self, job: Job) -> bool:
        """Wait until the worker trains; False where the job is over. After two deaths without a new stage wait for one:
        the pauses between attempts grow to a minute."""

        def at_work() -> bool:
            seen = self._row(job)
            return seen.state in OVER or (seen.attempts < 3 and self.holds(job))

        eventually(at_work, WORK_SECONDS, lambda: f"no progress: {self.loop.client.job(job.id)} {self.said()[-3000:]}")
        return self._row(job).state not in OVER

    def await_stage(self, job: Job) -> None:
        """Wait until the worker has kept another stage, or has ended the training."""
        before = self._kept(job)
        eventually(lambda: self._kept(job) > before or not self.holds(job), WORK_SECONDS, self.said)

    def holds(self, job: Job) -> bool:
        """True while the living worker runs the job."""
        seen = self._row(job)
        assert self.process is not None
        return seen.state == "running" and (seen.owner or "").split(":")[1:2] == [str(self.process.pid)]

    def kill(self) -> None:
        """SIGKILL to the worker."""
        assert self.process is not None
        self.process.send_signal(signal.SIGKILL)
        self.process.wait(10)

    def finish(self, job: Job) -> list[str]:
        """Train to the end; the hashes of the stages' weights."""
        self.start()
        done = self.loop.client.wait_for_job(job.id, timeout=WORK_SECONDS)
        assert done.state == "done", done.error
        return cast(list[str], done.result["policies"])

    def said(self) -> str:
        """What the workers logged."""
        return self.log.read_text()

    def close(self) -> None:
        """End all of it."""
        if self.process is not None:
            self.kill()
        self.loop.close()

    def _kept(self, job: Job) -> int:
        assert job.project is not None
        return len(list(self.loop.client.policies(job.project)))

    def _row(self, job: Job) -> JobRow:
        with self.loop.worker.database.read() as session:
            return session.get_one(JobRow, job.id)


@pytest.fixture
def trainers(tmp_path: Path) -> Iterator[Trainers]:
    """On the projects `struck` and `calm`; skips where ManiSkill is missing."""
    need_simulator()
    found = Trainers(tmp_path)
    for found.loop.name in ("calm", "struck"):
        new_project(found.loop, environment=TASK)
    yield found
    found.close()


def test_a_training_killed_again_and_again_ends_as_one_that_was_not(
    trainers: Trainers, figures: Figures, chance: random.Random
) -> None:
    job = trainers.ask("calm", seed=0)
    trainers.start()
    assert trainers.await_training(job)
    began = time.monotonic()
    calm = [trainers.finish(job)]
    undisturbed = time.monotonic() - began
    figures.add("an undisturbed training", undisturbed, f"s, {STAGES} stages")
    struck, killed = [trainers.ask("struck", seed=0)], 0
    while killed < KILLS:
        trainers.start()
        if trainers.await_training(struck[-1]):
            killed += _kill(trainers, struck[-1], chance, undisturbed, behind_stage=killed % 2 == 1)
        else:
            struck.append(trainers.ask("struck", seed=len(struck)))
    found = [trainers.finish(each) for each in struck]
    calm += [trainers.finish(trainers.ask("calm", seed)) for seed in range(1, len(struck))]
    resumed = trainers.said().count("training_resumed")
    figures.add("workers killed", killed, f"in {len(struck)} trainings")
    figures.add("attempts that went on from a kept stage", resumed, "attempts", target=KILLS // 3)
    figures.add("stages compared", sum(map(len, calm)), "stages")
    assert found == calm
    figures.none("stages that were trained more than once", _kept_again(trainers.loop))
    assert _after_garbage(trainers.loop) == {"policies"}  # a kill leaves states that no row came to name


def _kill(trainers: Trainers, job: Job, chance: random.Random, seconds: float, *, behind_stage: bool) -> bool:
    """Kill the worker at a random moment of its attempt, or behind a stage; False where it was quicker."""
    if behind_stage:
        trainers.await_stage(job)
    time.sleep(chance.uniform(0.0, SHORTLY if behind_stage else seconds))
    if not trainers.holds(job):
        return False
    trainers.kill()
    return True


def _kept_again(loop: Loop) -> int:
    """Stages of `struck` that were kept a second time."""
    events = loop.client.events(loop.client.find_project("struck").id)
    kept = Counter(str(event.data["policy"]) for event in events if event.kind == "policy.kept")
    return kept.total() - len(kept)


def _after_garbage(loop: Loop) -> set[str]:
    """The kinds of blobs that the provenance store holds once everything of no use is in the trash."""
    store = ProvenanceBlobs(str(loop.folder / "provenance"))
    collect(loop.worker.database, [store], utc_now() + timedelta(days=2), timedelta(days=1))
    return {blob.kind for blob in store.stored()}

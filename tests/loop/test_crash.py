"""Processes that are killed in the middle of a round: it completes, and labels, leases and jobs are whole."""

import os
import random
import signal
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from uuid import UUID

import pytest

from api_schemas.jobs import Job
from api_schemas.rounds import Round
from asim.client import Client
from asim.errors import Unreachable
from service.store.database import open_database
from service.store.tables import JobRow
from tests.figures import Figures
from tests.loop.conftest import Serve
from tests.loop.invariants import check_invariants, retries
from tests.loop.labelers import PersistentLabeler
from tests.loop.processes import Serving, command_of, eventually, runners_of

ROUND_SECONDS = 120.0
END_SECONDS = 15.0
ORPHAN_SECONDS = 10.0
KILLS_EACH = 5
OPEN = ("queued", "training", "scoring")


def tell(line: str) -> None:
    """A line of the summary; pytest shows it with -s, and where the test fails."""
    sys.stdout.write(f"{line}\n")


@dataclass
class Scene:
    """A service, a client of it, and somebody who keeps on labeling."""

    serving: Serving
    client: Client
    labeler: PersistentLabeler

    def start_round(self) -> Round:
        (project,) = self.client.projects()
        return self.client.start_round(project.id)

    def seen(self, round_id: UUID) -> Round | None:
        """The round, or None while nobody answers."""
        try:
            return self.client.round(round_id)
        except Unreachable:
            return None

    def job_of(self, asked: Round) -> Job:
        assert asked.job is not None
        return self.client.job(asked.job)

    def await_current(self, round_id: UUID) -> float:
        """Seconds until the round is in use."""
        ends = ("current", "superseded", "failed")
        seconds = eventually(
            lambda: (each := self.seen(round_id)) is not None and each.status in ends,
            ROUND_SECONDS,
            lambda: f"round {self.seen(round_id)} is not done; {self.serving.log.read_text()[-3000:]}",
        )
        done = self.client.round(round_id)
        assert done.status == "current", done.error
        return seconds

    def await_rest(self, seconds: float, *, background: bool) -> None:
        """Wait until no job is open; the subgoal generator's counts only with `background`."""
        (project,) = self.client.projects()

        def rests() -> bool:
            kinds = [job.kind for job in self.client.jobs(project.id) if job.state in ("queued", "running")]
            return not [kind for kind in kinds if background or kind != "train_subgoal_generator"]

        eventually(rests, seconds, "there are still open jobs")

    def kill(self, target: str) -> str:
        """kill -9 of a science runner, or of the API, which is started again; what happened, in words."""
        if target == "runner":
            (runner,) = self.serving.runners()
            os.kill(runner, signal.SIGKILL)
            eventually(lambda: self.serving.runners() not in ([], [runner]), 30, "no new runner")
            return f"runner {runner} restarted as {self.serving.runners()[0]}"
        old, orphans = self.serving.pid, runners_of(self.serving.pid)
        assert self.serving.end(signal.SIGKILL, END_SECONDS) == -signal.SIGKILL
        self.serving.start()
        gone = eventually(lambda: not any(map(command_of, orphans)), ORPHAN_SECONDS, f"orphans {orphans} live on")
        return f"API {old} restarted as {self.serving.pid}, its {len(orphans)} runners gone after {gone:.1f} s"


@pytest.fixture
def scene(serve: Serve) -> Iterator[Scene]:
    serving = serve()
    with Client(serving.url, retries=0) as client:
        labeler = PersistentLabeler(serving.url, count=2, pause=0.7)
        yield Scene(serving, client, labeler)
        if labeler.is_alive():
            labeler.finish()


def test_a_runner_killed_in_a_round_costs_no_stage_and_no_label(scene: Scene) -> None:
    eventually(lambda: len(scene.serving.runners()) == 1, 30, "no runner")
    scene.labeler.start()
    asked = scene.start_round()
    eventually(lambda: len(scene.client.round(asked.id).stages) == 1, ROUND_SECONDS, "no stage is done")
    before = scene.client.round(asked.id)
    tell(scene.kill("runner"))
    tell(f"round done {scene.await_current(asked.id):.1f} s later")
    after = scene.client.round(asked.id)
    assert after.models["inverse_dynamics"] == before.models["inverse_dynamics"]
    assert after.stages[0] == before.stages[0]
    assert retries(scene.client, asked.job) == 1
    scene.labeler.finish()
    scene.await_rest(60, background=False)
    assert len(scene.labeler.acknowledged) > 5
    check_invariants(scene.client, scene.serving.folder, scene.labeler.acknowledged)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_all_processes_and_gives_the_round_back(scene: Scene, number: signal.Signals) -> None:
    asked = scene.start_round()
    eventually(lambda: scene.job_of(asked).progress > 0, ROUND_SECONDS, "the round does not start")
    runners = runners_of(scene.serving.pid)
    assert runners
    began = time.monotonic()
    assert scene.serving.end(number, END_SECONDS) == 0
    tell(f"ended {time.monotonic() - began:.1f} s after {number.name}")
    assert not any(map(command_of, runners))
    assert not (scene.serving.folder / "serve.json").exists()
    database = open_database(f"sqlite:///{scene.serving.folder / 'asim.db'}")
    with database.read() as session:
        job = session.get_one(JobRow, asked.job)
    database.close()
    assert (job.state, job.attempts, job.owner, job.error) == ("queued", 0, None, None)


def test_runners_end_by_themselves_when_the_service_is_killed(scene: Scene) -> None:
    asked = scene.start_round()
    eventually(lambda: scene.job_of(asked).progress > 0, ROUND_SECONDS, "the round does not start")
    orphans = runners_of(scene.serving.pid)
    assert len(orphans) == 2
    assert scene.serving.end(signal.SIGKILL, END_SECONDS) == -signal.SIGKILL
    seconds = eventually(lambda: not any(map(command_of, orphans)), ORPHAN_SECONDS, f"orphans {orphans} live on")
    tell(f"orphans gone after {seconds:.1f} s")


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_rounds_survive_kills_at_random_moments(scene: Scene, figures: Figures) -> None:
    seed = int(os.environ.get("ASIM_TEST_SEED") or random.SystemRandom().randrange(10**6))
    moments = random.Random(seed)
    targets = ["runner"] * KILLS_EACH + ["API"] * KILLS_EACH
    moments.shuffle(targets)
    scene.labeler.start()
    undisturbed = scene.await_current(scene.start_round().id)
    tell(f"\nASIM_TEST_SEED={seed}; an undisturbed round takes {undisturbed:.1f} s")
    for number, target in enumerate(targets, 1):
        status, stages, line, done = _disturbed_round(scene, target, moments.uniform(0, undisturbed))
        tell(f"kill {number}, {target}, {line}: round was {status} with {stages} stages, done {done:.1f} s later")
    scene.labeler.finish()
    scene.await_rest(600, background=True)
    check_invariants(scene.client, scene.serving.folder, scene.labeler.acknowledged)
    labels = len(scene.labeler.acknowledged)
    figures.note(f"ASIM_TEST_SEED={seed} and {len(targets)} kills of runners and of the service")
    figures.add("labels acknowledged", labels, "labels", target=1)
    figures.add("requests unanswered", scene.labeler.disturbed, "requests")
    figures.add("rounds of a service with one runner, undisturbed", undisturbed, "s")


def _disturbed_round(scene: Scene, target: str, moment: float) -> tuple[str, int, str, float]:
    """One round with a kill `moment` seconds after its start; again where the round was quicker than that."""
    while True:
        eventually(lambda: len(scene.serving.runners()) == 1, 30, "no runner")
        asked = scene.start_round()
        time.sleep(moment)
        hit = scene.client.round(asked.id)
        if hit.status in OPEN:
            line = f"{moment:.2f} s after its start, {scene.kill(target)}"
            return hit.status, len(hit.stages), line, scene.await_current(asked.id)
        moment *= 0.7

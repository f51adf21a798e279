"""A service in embedded mode with projects of a robot task: what its collector and its labelers do while they die."""

import subprocess
import sys
from pathlib import Path
from uuid import UUID

import pytest

from api_schemas.collections import CollectionCreate
from api_schemas.environments import Environment
from api_schemas.jobs import Job
from api_schemas.labels import Label
from api_schemas.projects import LabelingPolicy, Project, ProjectCreate
from asim.client import Client
from service.store.tables import JobRow
from tests.crash.deployment import children_of
from tests.loop.processes import Serving, command_of, environment, eventually
from tests.loop.rows import check_rows, snapshot
from workers.simulators.base import SimulatorUnavailable
from workers.simulators.catalog import make_simulator

PATIENT = {"ASIM_JOB_LEASE_SECONDS": "4", "ASIM_JOB_MAX_ATTEMPTS": "50"}
LEASE_SECONDS = 10.0  # of a batch: what a dead labeler held is free again then
TASK = Environment(simulator="maniskill", options={"task": "PullCube", "cameras": False, "horizon": 15})
WORK_SECONDS = 300.0


def need_simulator() -> None:
    """Skips the test, saying why, where ManiSkill is missing."""
    try:
        make_simulator("maniskill", dict(TASK.options)).close()
    except SimulatorUnavailable as error:
        pytest.skip(str(error))


class Robots:
    """An `asim serve` and its client."""

    def __init__(self, folder: Path) -> None:
        self.serving = Serving(folder, **PATIENT)
        self.serving.start()
        self.client = Client(self.serving.url, timeout=30.0)

    def close(self) -> None:
        """End it."""
        self.client.close()
        self.serving.close()

    def project(self, name: str) -> Project:
        """A new one, whose leases are short."""
        policy = LabelingPolicy(strategy="random", round_labels=0, lease_seconds=LEASE_SECONDS)
        return self.client.create_project(ProjectCreate(name=name, environment=TASK, policy=policy))

    def collect(self, project: UUID, **asked: object) -> Job:
        """Ask for a collection, without waiting."""
        return self.client.collect(CollectionCreate.model_validate({"project": project, "split": "pool", **asked}))

    def await_job(self, job: UUID) -> Job:
        """Wait until it is done."""
        return self.client.wait_for_job(job, timeout=WORK_SECONDS)

    def holder_of(self, job: UUID) -> int:
        """The living process that runs the job; 0 while there is none."""
        with snapshot(self._database) as session:
            row = session.get_one(JobRow, job)
            pid = int(row.owner.split(":")[1]) if row.state == "running" and row.owner else 0
        return pid if command_of(pid) else 0

    def await_holder(self, job: UUID) -> int:
        """Wait until somebody runs the job; 0 where it is done. After two deaths without a stored batch wait for one:
        the pauses between attempts grow to a minute."""

        def at_work() -> bool:
            seen = self.client.job(job)
            return seen.state == "done" or (seen.attempts < 3 and self.holder_of(job) != 0)

        eventually(at_work, WORK_SECONDS, lambda: f"no progress: {self.client.job(job)} {self._said()}")
        return self.holder_of(job)

    def labeler(self, project: str, count: int) -> "subprocess.Popen[bytes]":
        """`asim label` on the project."""
        argv = [sys.executable, "-m", "asim", "label", project, "--count", str(count), "--url", self.serving.url]
        with (self.serving.folder / "labelers.log").open("ab") as log:
            return subprocess.Popen(argv, env=environment(), stdout=log, stderr=log, process_group=0)

    def labels(self, project: UUID) -> dict[tuple[str, int], Label]:
        """By segment; each stands there once."""
        found = list(self.client.labels(project))
        assert len({(label.trajectory, label.start) for label in found}) == len(found)
        return {(label.trajectory, label.start): label for label in found}

    def trajectories(self, project: UUID) -> set[str]:
        """Their ids."""
        return {each.id for each in self.client.trajectories(project)}

    def check_rows(self) -> None:
        """The cheap invariants, at any moment."""
        with snapshot(self._database) as session:
            check_rows(session)

    @property
    def _database(self) -> str:
        return f"sqlite:///{self.serving.folder / 'asim.db'}"

    def _said(self) -> str:
        return self.serving.log.read_text()[-3000:]


def simulators_of(labeler: int) -> list[int]:
    """Processes below a labeler in which it runs a simulator."""
    return [pid for pid in children_of(labeler) if "spawn_main" in command_of(pid)]

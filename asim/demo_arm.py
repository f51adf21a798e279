"""One arm of the demo: a project and what is done with it, over HTTP and the labeling worker alone."""

from dataclasses import dataclass

import numpy as np

from api_schemas.acquisitions import Acquisition
from api_schemas.environments import ROBOTS
from api_schemas.labels import LabelsAccepted
from api_schemas.projects import ProjectPatch
from api_schemas.rounds import ModelErrorCurve
from api_schemas.strategies import StrategyName
from asim.client import Client
from asim.collecting import await_collection
from asim.demo_plans import Plan
from asim.errors import AsimError
from asim.report import Advance, Report
from asim.rounds import await_round
from asim.simulator_labeling import in_own_process
from workers.answering import SimulatorAnswerer
from workers.labeling import OpenAnswerer, run_labeling
from workers.simulators.base import SimulatorError
from workers.unanswerable import UnanswerableItem

QUEUE_SECONDS = 600.0  # longest wait for a ranked queue
ITEM_SECONDS = 300.0  # that a robot's simulator may take for a segment


@dataclass(frozen=True)
class Service:
    """A service that is there already, and the name that the demo's projects begin with on it."""

    url: str
    key: str | None = None
    prefix: str = "demo"


@dataclass(frozen=True)
class ArmResult:
    """One arm's learning curve, and the segments of its seed labels, which both arms must share."""

    seeds: frozenset[tuple[str, int]]
    curve: ModelErrorCurve


def run_arm(service: Service, strategy: StrategyName, seed: int, plan: Plan, report: Report) -> ArmResult:
    """One project, from nothing to its learning curve."""
    with Client(service.url, service.key) as client:
        arm = Arm(client, service, strategy, seed, plan, report)
        arm.collect()
        arm.first_round()
        seeds = frozenset((label.trajectory, label.start) for label in client.labels(arm.project.id))
        client.change_project(arm.project.id, ProjectPatch(round_labels=plan.batch_labels))
        for batch in range(1, plan.batches + 1):
            what = f"batch {batch} of {plan.batches}, {plan.batch_labels} labels by {strategy}"
            arm.label_and_train(plan.batch_labels, strategy, what)
        return ArmResult(seeds, client.model_error(arm.project.id))


class Arm:
    """One project of the demo."""

    def __init__(
        self, client: Client, service: Service, strategy: StrategyName, seed: int, plan: Plan, report: Report
    ) -> None:
        self._client, self._service, self._seed, self._plan, self._report = client, service, seed, plan, report
        self._generator = np.random.default_rng(seed)
        self.project = client.create_project(plan.project(f"{service.prefix}-{strategy}", strategy, seed))

    def collect(self) -> None:
        """The action-free pool, the labeled held-out set, and what else is in the plan."""
        for what, collection in self._plan.collections(self.project.id, self._seed).items():
            with self._report.step(f"{self.project.name}: collect {what}") as advance:
                done = await_collection(self._client, self._client.collect(collection), advance)
            if done.get("short_of"):
                raise AsimError(f"{self.project.name}: the test set lacks labels: {done['short_of']}")

    def first_round(self) -> None:
        """On labels drawn at random, or on those that came with a collection."""
        if self._plan.seed_labels:
            self.label_and_train(self._plan.seed_labels, "random", f"{self._plan.seed_labels} uniform seed labels")
            return
        started = self._client.start_round(self.project.id)
        with self._report.step(f"{self.project.name}: {started.labels} seed labels") as advance:
            await_round(self._client, started.id, advance)

    def label_and_train(self, count: int, strategy: StrategyName, what: str) -> None:
        """Acquire, label with the simulator, and wait for the round that the labels start by themselves."""
        with self._report.step(f"{self.project.name}: {what}") as advance:
            advance(0.0, "waiting for a ranked queue")
            batch = self._client.acquire(self.project.id, count, strategy=strategy, labeler="demo", wait=QUEUE_SECONDS)
            accepted = self._label(batch, advance)
            if accepted.round is None:
                raise AsimError(f"{self.project.name}: {accepted.created} new labels started no round")
            await_round(self._client, accepted.round, advance)

    def _label(self, batch: Acquisition, advance: Advance) -> LabelsAccepted:
        def tell(done: int, count: int) -> None:
            advance(done / count, "labeling")

        try:
            return run_labeling(self._client, batch, self._generator, tell, open_answerer=self._answerer())
        except (UnanswerableItem, SimulatorError) as error:
            raise AsimError(f"{self.project.name}: {error}") from error

    def _answerer(self) -> OpenAnswerer:
        """Robots in a process of their own: what they draw with is not made for two threads of one."""
        if self.project.environment.simulator in ROBOTS:
            return in_own_process(self._service.url, self._service.key, ITEM_SECONDS)
        return SimulatorAnswerer

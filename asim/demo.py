"""The loop on MiniGrid, end to end: two projects of one seed, one by the default strategy and one by random."""

import json
import tempfile
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import FIRST_EXCEPTION, Future, ThreadPoolExecutor
from concurrent.futures import wait as wait_for
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from api_schemas.acquisitions import Acquisition
from api_schemas.collections import CollectionCreate, CollectionLabels
from api_schemas.environments import Environment
from api_schemas.projects import LabelingPolicy, ProjectCreate, ProjectPatch
from api_schemas.rounds import ModelErrorCurve
from api_schemas.strategies import DEFAULT_STRATEGY, StrategyName
from asim.client import Client
from asim.errors import AsimError
from asim.figure import draw_learning_curves
from asim.report import Report
from asim.rounds import await_round
from asim.served import served
from asim.tables import error_table
from workers.labeling import run_labeling

STRATEGIES: tuple[StrategyName, ...] = (DEFAULT_STRATEGY, "random")
ENVIRONMENT = Environment(simulator="minigrid", options={"task": "any", "room_size": 6, "objects": 3})
HELD_OUT_SEED = 1_000_000  # added to the demo's seed, so that no test layout is drawn like a pool layout
QUEUE_SECONDS = 600.0  # longest wait for a ranked queue


@dataclass(frozen=True)
class DemoPlan:
    """How much the demo does; a test runs a small one."""

    pool_transitions: int = 28_000
    test_transitions: int = 60_000
    test_labels_per_action: int = 200
    seed_labels: int = 200
    batch_labels: int = 100
    batches: int = 3


@dataclass(frozen=True)
class ArmResult:
    """One arm's learning curve, and the segments of its seed labels, which both arms must share."""

    seeds: frozenset[tuple[str, int]]
    curve: ModelErrorCurve


@dataclass(frozen=True)
class Service:
    """A service that is there already, and the name that the demo's projects begin with on it."""

    url: str
    key: str | None = None
    prefix: str = "demo"


def demo(seed: int, keep: Path | None, plan: DemoPlan | None = None, service: Service | None = None) -> None:
    """Run both arms on `service`, or on an `asim serve` of the demo's own; print the table and the path of the figure.

    Raises AsimError where the service dies, a job or a round fails, or the arms did not start from the same labels.
    """
    began = time.monotonic()
    with Report() as report:
        report.tell(f"demo with seed {seed}")
        with _own_service(keep, report) if service is None else nullcontext(service) as found:
            report.tell(f"the service is {found.url} (dashboard: {found.url}/dashboard)")
            results = _run_arms(found, seed, plan or DemoPlan(), report)
        if len({result.seeds for result in results.values()}) > 1:
            raise AsimError("the arms drew different seed segments from the same pool: their curves do not compare")
        curves = {strategy: result.curve for strategy, result in results.items()}
        picture = _write_results(curves, Path("results") / f"demo-seed-{seed}.png")
        report.console.print(error_table(curves, first_column="strategy"))
        report.tell(_verdict(curves))
        report.tell(f"learning curve: {picture.absolute()}")
        report.tell(f"the demo took {(time.monotonic() - began) / 60:.1f} minutes")


def _run_arms(service: Service, seed: int, plan: DemoPlan, report: Report) -> dict[str, ArmResult]:
    """Both arms at once, a thread and a client each. The first failure is raised at once: the caller then stops the
    service, which ends the other arm."""
    pool = ThreadPoolExecutor(len(STRATEGIES))
    futures: dict[str, Future[ArmResult]] = {
        strategy: pool.submit(_run_arm, service, strategy, seed, plan, report) for strategy in STRATEGIES
    }
    try:
        ended, _ = wait_for(futures.values(), return_when=FIRST_EXCEPTION)
        for future in ended:
            future.result()
        return {strategy: future.result() for strategy, future in futures.items()}
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def _run_arm(service: Service, strategy: StrategyName, seed: int, plan: DemoPlan, report: Report) -> ArmResult:
    """One project, from nothing to its learning curve."""
    with Client(service.url, service.key) as client:
        arm = Arm(client, f"{service.prefix}-{strategy}", strategy, seed, plan, report)
        arm.collect_pool()
        arm.collect_test_set()
        seeds = arm.label_and_train(plan.seed_labels, "random", f"{plan.seed_labels} uniform seed labels")
        client.change_project(arm.project.id, ProjectPatch(round_labels=plan.batch_labels))
        for batch in range(1, plan.batches + 1):
            what = f"batch {batch} of {plan.batches}, {plan.batch_labels} labels by {strategy}"
            arm.label_and_train(plan.batch_labels, strategy, what)
        drawn = frozenset((item.trajectory, item.start) for item in seeds.items)
        return ArmResult(drawn, client.model_error(arm.project.id))


class Arm:
    """One project of the demo and what is done with it, over HTTP and the labeling worker alone."""

    def __init__(
        self, client: Client, name: str, strategy: StrategyName, seed: int, plan: DemoPlan, report: Report
    ) -> None:
        self._client, self._seed, self._plan, self._report = client, seed, plan, report
        self._generator = np.random.default_rng(seed)
        policy = LabelingPolicy(strategy=strategy, round_labels=plan.seed_labels)
        self.project = client.create_project(
            ProjectCreate(name=name, environment=ENVIRONMENT, seed=seed, policy=policy)
        )

    def collect_pool(self) -> None:
        """The action-free pool, by a noisy mixture of solvers and random play."""
        collection = CollectionCreate(
            project=self.project.id,
            behavior="mixture",
            transitions=self._plan.pool_transitions,
            seed=self._seed,
            split="pool",
        )
        self._collect(collection, f"collect {collection.transitions} transitions for the pool")

    def collect_test_set(self) -> None:
        """The labeled held-out set, balanced by action."""
        collection = CollectionCreate(
            project=self.project.id,
            behavior="balanced",
            transitions=self._plan.test_transitions,
            seed=HELD_OUT_SEED + self._seed,
            split="held_out",
            labels=CollectionLabels(per_action=self._plan.test_labels_per_action),
        )
        self._collect(collection, f"collect a test set, {self._plan.test_labels_per_action} labels an action")

    def label_and_train(self, count: int, strategy: StrategyName, what: str) -> Acquisition:
        """Acquire, label with the simulator, and wait for the round that the labels start by themselves."""
        with self._report.step(f"{self.project.name}: {what}") as advance:
            advance(0.0, "waiting for a ranked queue")
            batch = self._client.acquire(self.project.id, count, strategy=strategy, labeler="demo", wait=QUEUE_SECONDS)
            accepted = run_labeling(
                self._client, batch, self._generator, lambda done, all_: advance(done / all_, "labeling")
            )
            if accepted.round is None:
                raise AsimError(f"{self.project.name}: {accepted.created} new labels started no round")
            await_round(self._client, accepted.round, advance)
        return batch

    def _collect(self, collection: CollectionCreate, what: str) -> None:
        with self._report.step(f"{self.project.name}: {what}") as advance:
            job = self._client.collect(collection)
            done = self._client.wait_for_job(job.id, progress=lambda seen: advance(seen.progress, seen.message))
        if done.result.get("short_of"):
            raise AsimError(f"{self.project.name}: the test set lacks labels: {done.result['short_of']}")


def _write_results(curves: Mapping[str, ModelErrorCurve], picture: Path) -> Path:
    """The figure, and beside it the same numbers as JSON."""
    draw_learning_curves(curves, picture)
    numbers = {strategy: curve.model_dump(mode="json") for strategy, curve in curves.items()}
    picture.with_suffix(".json").write_text(json.dumps(numbers, indent=1))
    return picture


def _verdict(curves: Mapping[str, ModelErrorCurve]) -> str:
    ours, random = (curves[strategy].points[-1] for strategy in STRATEGIES)
    if ours.model_error.loss is None or random.model_error.loss is None:
        raise AsimError("the last round has no test loss: the held-out set holds no labeled transition")
    relation = "below" if ours.model_error.loss < random.model_error.loss else "not below"
    numbers = f"{ours.model_error.loss:.4f} is {relation} random's {random.model_error.loss:.4f}"
    return f"at {ours.labels} labels, {DEFAULT_STRATEGY}'s test loss {numbers} nats a transition"


@contextmanager
def _own_service(keep: Path | None, report: Report) -> Iterator[Service]:
    """An `asim serve` for the time of the demo."""
    with _data_folder(keep) as folder:
        report.tell(f"data in {folder}")
        with served(folder, runners=len(STRATEGIES)) as url:
            yield Service(url)


@contextmanager
def _data_folder(keep: Path | None) -> Iterator[Path]:
    if keep is None:
        with tempfile.TemporaryDirectory(prefix="asim-demo-") as folder:
            yield Path(folder)
        return
    keep.mkdir(parents=True, exist_ok=True)
    if any(keep.iterdir()):
        raise AsimError(f"folder {keep} is not empty; the demo starts from nothing")
    yield keep.absolute()

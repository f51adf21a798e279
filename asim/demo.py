"""The loop, end to end: two projects of one seed, one by the default strategy and one by random."""

import json
import tempfile
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import FIRST_EXCEPTION, Future, ThreadPoolExecutor
from concurrent.futures import wait as wait_for
from contextlib import contextmanager, nullcontext
from pathlib import Path

from api_schemas.rounds import ModelErrorCurve, ModelErrorPoint
from api_schemas.strategies import DEFAULT_STRATEGY, StrategyName
from asim.demo_arm import ArmResult, Service, run_arm
from asim.demo_plans import DemoPlan, Plan
from asim.errors import AsimError
from asim.figure import draw_learning_curves
from asim.measures import UNFORESEEN, losses
from asim.report import Report
from asim.served import served
from asim.tables import error_table

STRATEGIES: tuple[StrategyName, ...] = (DEFAULT_STRATEGY, "random")


def demo(seed: int, keep: Path | None, plan: Plan | None = None, service: Service | None = None) -> None:
    """Run both arms on `service`, or on an `asim serve` of the demo's own; print the table and the path of the figure.

    Raises AsimError where the simulator is not installed, the service dies, a job or a round fails, or the arms did not
    start from the same labels.
    """
    began, plan = time.monotonic(), plan or DemoPlan()
    plan.check()
    with Report() as report:
        report.tell(f"demo with seed {seed}")
        with _own_service(keep, report) if service is None else nullcontext(service) as found:
            report.tell(f"the service is {found.url} (dashboard: {found.url}/dashboard)")
            results = _run_arms(found, seed, plan, report)
        if len({result.seeds for result in results.values()}) > 1:
            raise AsimError("the arms drew different seed segments from the same pool: their curves do not compare")
        curves = {strategy: result.curve for strategy, result in results.items()}
        picture = _write_results(curves, Path("results") / f"{plan.name}-seed-{seed}.png")
        report.console.print(error_table(curves, first_column="strategy"))
        for line in _verdict(curves):
            report.tell(line)
        report.tell(f"learning curve: {picture.absolute()}")
        report.tell(f"the demo took {(time.monotonic() - began) / 60:.1f} minutes")


def _run_arms(service: Service, seed: int, plan: Plan, report: Report) -> dict[str, ArmResult]:
    """Both arms at once, a thread and a client each. The first failure is raised at once: the caller then stops the
    service, which ends the other arm."""
    pool = ThreadPoolExecutor(len(STRATEGIES))
    futures: dict[str, Future[ArmResult]] = {
        strategy: pool.submit(run_arm, service, strategy, seed, plan, report) for strategy in STRATEGIES
    }
    try:
        ended, _ = wait_for(futures.values(), return_when=FIRST_EXCEPTION)
        for future in ended:
            future.result()
        return {strategy: future.result() for strategy, future in futures.items()}
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def _write_results(curves: Mapping[str, ModelErrorCurve], picture: Path) -> Path:
    """The figure, and beside it the same numbers as JSON."""
    draw_learning_curves(curves, picture)
    numbers = {strategy: curve.model_dump(mode="json") for strategy, curve in curves.items()}
    picture.with_suffix(".json").write_text(json.dumps(numbers, indent=1))
    return picture


def _verdict(curves: Mapping[str, ModelErrorCurve]) -> list[str]:
    """Where both arms ended, and from where: it is the same point."""
    ours, random = (curves[strategy].points[-1] for strategy in STRATEGIES)
    relation = "below" if _loss(ours) < _loss(random) else "not below"
    first = curves[DEFAULT_STRATEGY].points[0]
    robots = UNFORESEEN in losses([ours.model_error])
    unit = "(share of what changes that is not foreseen)" if robots else "nats a transition"
    return [
        f"at {ours.labels} labels, {DEFAULT_STRATEGY}'s test loss {_loss(ours):.4f} is {relation} random's "
        f"{_loss(random):.4f} {unit}",
        f"at {first.labels} labels, from which both went on, it was {_loss(first):.4f}",
    ]


def _loss(point: ModelErrorPoint) -> float:
    if point.model_error.loss is None:
        raise AsimError(f"round {point.number} has no test loss: the held-out set holds no labeled transition")
    return point.model_error.loss


@contextmanager
def _own_service(keep: Path | None, report: Report) -> Iterator[Service]:
    """An `asim serve` for the time of the demo."""
    with _data_folder(keep) as folder:
        report.tell(f"data in {folder}")
        with served(folder, runners=len(STRATEGIES), collectors=len(STRATEGIES)) as url:
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

"""The demo on PostgreSQL and Redis, its jobs done by separate Celery processes: the table of the embedded demo."""

import json
import time
from pathlib import Path

import pytest

from asim.demo import STRATEGIES, demo
from asim.demo_arm import Service
from asim.demo_plans import DemoPlan
from tests.figures import Figures
from tests.scale.conftest import Deploy

PLAN = DemoPlan()  # that of `make demo`
SEEDS = (0, 1)
SHARD = "7000"  # four shards: both scorers have a part in every scoring
Curves = dict[str, list[dict[str, object]]]


@pytest.mark.slow
@pytest.mark.timeout(1500)
def test_the_scaled_out_demo_gives_the_table_of_the_embedded_one(
    deploy: Deploy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, figures: Figures
) -> None:
    embedded, scaled = tmp_path / "embedded", tmp_path / "scaled"
    for folder in (embedded, scaled):
        folder.mkdir()
    monkeypatch.setenv("ASIM_SHARD_TRANSITIONS", SHARD)
    for seed in SEEDS:
        _tell(figures, f"embedded, seed {seed}", _seconds(monkeypatch, embedded, seed, None))
    deployment = deploy(ASIM_SHARD_TRANSITIONS=SHARD)
    for queues in ("train,default", "score", "score", "label"):
        deployment.start_worker(queues)
    deployment.await_workers()
    for seed in SEEDS:
        service = Service(deployment.url, deployment.key, f"seed-{seed}")
        _tell(figures, f"PostgreSQL and Celery, seed {seed}", _seconds(monkeypatch, scaled, seed, service))

    for seed in SEEDS:
        expected, found = _curves(embedded, seed), _curves(scaled, seed)
        assert {name: len(points) for name, points in expected.items()} == dict.fromkeys(STRATEGIES, PLAN.batches + 1)
        differing = [
            (name, want["labels"])
            for name in expected
            for want, have in zip(expected[name], found[name], strict=True)
            if want != have
        ]
        figures.none(f"seed {seed}: points of the curves that differ", len(differing))
        assert found == expected
        for name, points in found.items():
            losses = ", ".join(f"{point['labels']}: {_loss(point):.4f}" for point in points)
            figures.note(f"seed {seed}, {name}, test loss by labels: {losses}")
    owners = _scorers(deployment.workers[1].said()), _scorers(deployment.workers[2].said())
    figures.note(f"shards scored by the two scorers: {owners[0]} and {owners[1]}")
    assert min(owners) > 0, "one scorer did all the work"


def _seconds(monkeypatch: pytest.MonkeyPatch, folder: Path, seed: int, service: Service | None) -> float:
    """Run it in `folder`, where it leaves its results."""
    began = time.monotonic()
    with monkeypatch.context() as patch:
        patch.chdir(folder)
        demo(seed, keep=None, plan=PLAN, service=service)
    return time.monotonic() - began


def _tell(figures: Figures, what: str, seconds: float) -> None:
    figures.add(f"demo, {what}", seconds, "s")


def _curves(folder: Path, seed: int) -> Curves:
    """The points of each arm without what two runs never share: ids and times."""
    told = json.loads((folder / "results" / f"demo-seed-{seed}.json").read_text())
    kept = ("number", "labels", "model_error")
    return {name: [{key: point[key] for key in kept} for point in curve["points"]] for name, curve in told.items()}


def _loss(point: dict[str, object]) -> float:
    error = point["model_error"]
    assert isinstance(error, dict)
    return float(error["loss"])


def _scorers(log: str) -> int:
    return sum("job_done" in line and "score_shard" in line for line in log.splitlines())

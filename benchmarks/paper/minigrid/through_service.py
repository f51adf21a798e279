"""Figure 4d through a running service: the same picks and the same errors as offline.

    python -m benchmarks.paper.minigrid.through_service --seed 0 --strategy cycle

`asim serve` on a folder of its own, HTTP, the labeling worker. One science runner, one torch thread, nothing batched.
"""

import argparse
import os
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from api_schemas.acquisitions import Acquisition
from api_schemas.collections import CollectionCreate, CollectionLabels
from api_schemas.environments import Environment
from api_schemas.projects import LabelingPolicy, Project, ProjectCreate, ProjectPatch
from api_schemas.rounds import GroupError, ModelError
from api_schemas.strategies import DEFAULT_BATCH_RULE, DEFAULT_STRATEGY
from asim.client import Client
from asim.served import served
from benchmarks.figures import Figure, finish
from benchmarks.paper.minigrid.arms import Arm
from benchmarks.paper.minigrid.datasets import DataSpec
from benchmarks.paper.minigrid.loop import Experiment, Plan, errors
from benchmarks.paper.minigrid.rooms import Rooms
from models.evaluation import ModelError as OfflineError
from workers.labeling import run_labeling

TOLERANCE = 1e-5
WAIT = 1800.0  # seconds for a queue
METRICS = ("loss", "exact_accuracy", "dynamics_accuracy", "inverse_accuracy")
Picks = list[tuple[str, int]]


@dataclass(frozen=True)
class Seen:
    """What one round is: its model error by group, and the batch that was then picked."""

    error: dict[str, dict[str, float | None]]
    picks: Picks


def main(argv: Sequence[str] | None = None) -> list[Figure]:
    """Both ways; how far apart they are."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--strategy", default=DEFAULT_STRATEGY)
    parser.add_argument("--rule", default=DEFAULT_BATCH_RULE)
    parser.add_argument("--out", type=Path, default=Path("results/paper/minigrid/4d"))
    parser.add_argument("--tuning", action="store_true")
    parser.add_argument("--pool-transitions", type=int, default=28_000)
    asked = parser.parse_args(argv)
    rooms = Rooms(asked.out / "data", asked.tuning, pool_transitions=asked.pool_transitions)
    arm = Arm(asked.strategy, asked.rule)
    os.environ |= {"OMP_NUM_THREADS": "1"}  # of the service's processes, which inherit it
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder, served(Path(folder)) as url, Client(url) as client:
        online = list(through_service(client, arm, asked.seed, rooms, Plan()))
    return compare(list(offline(arm, asked.seed, rooms, Plan())), online)


def through_service(client: Client, arm: Arm, seed: int, rooms: Rooms, plan: Plan) -> Iterator[Seen]:
    """The loop as a user runs it."""
    project, rng = _project(client, arm, seed, plan), np.random.default_rng(seed)
    _collect(client, project, rooms.spec(1, "mixture", rooms.pool_transitions), "pool")
    _collect(client, project, rooms.spec(2, "balanced", 200_000, rooms.per_action), "held_out")
    batch = client.acquire(project.id, plan.seed_labels, strategy="random", wait=WAIT)
    for number in range(plan.batches + 1):
        accepted = run_labeling(client, batch, rng)
        if accepted.round is None:
            raise RuntimeError(f"{accepted.created} new labels started no round")
        error = client.wait_for_round(accepted.round).model_error
        client.change_project(project.id, ProjectPatch(round_labels=plan.batch_labels))
        last = number == plan.batches
        batch = batch if last else client.acquire(project.id, plan.batch_labels, strategy=arm.strategy, wait=WAIT)
        yield Seen(_told(error), [] if last else _items(batch))


def offline(arm: Arm, seed: int, rooms: Rooms, plan: Plan) -> Iterator[Seen]:
    """The same straight on models/."""
    data = rooms.load()
    for found in Experiment(arm, seed, data.spaces, data.pool, plan=plan).rounds():
        error = errors(found.models, {"balanced": data.tests["balanced"]})["balanced"]
        names = [data.pool.segments[place] for place in found.picks.tolist()]
        yield Seen(_offline(error), [(name.trajectory, name.start) for name in names])


def compare(offline: Sequence[Seen], online: Sequence[Seen]) -> list[Figure]:
    """Picks that differ, place by place, and the largest difference of any metric of any group in any round."""
    differ = sum(
        one != other
        for left, right in zip(offline, online, strict=True)
        for one, other in zip(left.picks, right.picks, strict=True)
    )
    gaps = [
        _gap(left.error[group][metric], right.error[group][metric])
        for left, right in zip(offline, online, strict=True)
        for group in left.error
        for metric in METRICS
    ]
    picks = sum(len(seen.picks) for seen in offline)
    return [
        Figure("4d_service_picks", picks, "segments"),
        Figure("4d_service_picks_that_differ", differ, "segments", 1, "below"),
        Figure("4d_service_largest_difference", max(gaps), "of any metric", TOLERANCE, "below"),
    ]


def _gap(left: float | None, right: float | None) -> float:
    """0 where both have nothing to average over, endless where one has."""
    if left is None or right is None:
        return 0.0 if left is right else float("inf")
    return abs(left - right)


def _project(client: Client, arm: Arm, seed: int, plan: Plan) -> Project:
    options = DataSpec("mixture", 1, 2_000_000).options
    policy = LabelingPolicy.model_validate(
        {"strategy": arm.strategy, "batch_rule": arm.rule, "round_labels": plan.seed_labels}
    )
    environment = Environment(simulator="minigrid", options=options)
    return client.create_project(ProjectCreate(name="figure-4d", environment=environment, seed=seed, policy=policy))


def _collect(client: Client, project: Project, spec: DataSpec, split: str) -> None:
    labels = CollectionLabels(per_action=spec.per_action) if spec.per_action else None
    collection = CollectionCreate.model_validate(
        {
            "project": project.id,
            "behavior": spec.behavior,
            "transitions": spec.transitions,
            "seed": spec.seed,
            "split": split,
            "labels": labels,
        }
    )
    client.wait_for_job(client.collect(collection).id)


def _items(batch: Acquisition) -> Picks:
    return [(item.trajectory, item.start) for item in batch.items]


def _told(error: ModelError | None) -> dict[str, dict[str, float | None]]:
    if error is None:
        raise RuntimeError("the round has no model error")
    groups: dict[str, ModelError | GroupError] = {"overall": error, **error.by_group}
    return {name: {metric: getattr(group, metric) for metric in METRICS} for name, group in groups.items()}


def _offline(error: OfflineError) -> dict[str, dict[str, float | None]]:
    return {
        name: {
            "loss": group.next_state_loss,
            "exact_accuracy": group.exact_accuracy,
            "dynamics_accuracy": group.dynamics_accuracy,
            "inverse_accuracy": group.inverse_accuracy,
        }
        for name, group in {"overall": error.overall, **error.groups}.items()
    }


if __name__ == "__main__":
    finish(main())

"""Diffusion policies of robot tasks: how long their training takes, and how success rises over its stages.

    python -m benchmarks.simulators.policies                             Lift and PullCube, by poses
    python -m benchmarks.simulators.policies --task Lift --form images   one task, by images
    python -m benchmarks.simulators.policies --stages 6                  a quick look: the first six stages

Demonstrations, schedule and stages are those of POST /policies; the episodes begin at seeds that nothing was tuned on.
Status 1 where a target is missed.
"""

import argparse
import time
from collections.abc import Iterator
from contextlib import closing
from typing import NamedTuple

import torch

from benchmarks.figures import Figure, finish
from benchmarks.simulators.speed import TASKS, Task
from models import checkpoints
from models.policies.diffusion import DiffusionPolicyConfig
from models.rank_correlation import spearman
from models.segments import SegmentBatch
from models.training import TrainingState
from workers.demonstrations import demonstrate, segments
from workers.policy_training import begun, stage_steps, states_at, success
from workers.simulators.base import Simulator
from workers.simulators.catalog import make_simulator

STAGES, SEED = 10, 0
TRIED = 10**6  # of the episodes' generator: they are others than those by which a service tells success
SHOWN = ("Lift", "PullCube")
RISE, ORDER, MINUTES = 0.4, 0.8, 15.0


class Reached(NamedTuple):
    """A stage, after so many steps and this time of training; mean loss since the stage before; episodes solved."""

    steps: int
    wall: float
    processor: float
    loss: float
    success: float


class Watch:
    """Seconds by the clock and of processor time, while a `with` block runs; several add up."""

    def __init__(self) -> None:
        self.wall = self.processor = 0.0

    def __enter__(self) -> None:
        self._began = time.perf_counter(), time.process_time()

    def __exit__(self, *_: object) -> None:
        self.wall += time.perf_counter() - self._began[0]
        self.processor += time.process_time() - self._began[1]


def stages(batch: SegmentBatch, simulator: Simulator, last: int, episodes: int) -> list[Reached]:
    """One training up to its stage `last`, each stage tried on the same number of episodes; prints a row a stage."""
    policy, state = begun(batch, SEED)
    watch, losses, found = Watch(), list[float](), list[Reached]()
    marks = stage_steps(state.config.steps, STAGES)[:last]
    states = states_at(policy, batch, state, marks, lambda step, steps, loss: losses.append(loss))
    for reached in _timed(watch, states):
        share = success(simulator, checkpoints.save(policy), TRIED + len(found), episodes)
        found.append(Reached(reached.step, watch.wall, watch.processor, sum(losses) / len(losses), share))
        losses.clear()
        print("{:>7d} {:>7.0f} {:>10.0f} {:>7.3f} {:>8.0%}".format(*found[-1]), flush=True)
    return found


def measure(task: Task, asked: argparse.Namespace) -> list[Figure]:
    """Of one task."""
    shown = Watch()
    options = {"task": task.name, "cameras": asked.form == "images"}
    with closing(make_simulator(task.simulator, options)) as simulator:
        with shown:
            episodes = demonstrate(simulator, asked.form, asked.demonstrations, SEED)
        batch = segments(episodes, DiffusionPolicyConfig().chunk)
        print(f"{task.name}, {asked.form}: {len(episodes)} demonstrations, {batch.size} segments")
        print("  steps   clock  processor    loss  success")
        reached = stages(batch, simulator, asked.stages, asked.episodes)
    first, last = reached[0], reached[-1]
    solved, goal = f"share of {asked.episodes} episodes solved", first.success + RISE
    rising = spearman(torch.arange(len(reached)), torch.tensor([stage.success for stage in reached]))
    minutes = (shown.wall + last.wall) / 60
    return [
        Figure(f"{task.name}_demonstrations", shown.processor, "s of processor time"),
        Figure(f"{task.name}_training", last.processor, "s of processor time"),
        Figure(f"{task.name}_time", minutes, "min by the clock, demonstrations and training", MINUTES, "below"),
        Figure(f"{task.name}_first_stage", first.success, solved),
        Figure(f"{task.name}_last_stage", last.success, solved, goal),
        Figure(f"{task.name}_order", rising or 0.0, "Spearman's rho of stage and success", ORDER),
    ]


def _timed(watch: Watch, states: Iterator[TrainingState]) -> Iterator[TrainingState]:
    while True:
        with watch:
            state = next(states, None)
        if state is None:
            return
        yield state


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    names = [task.name for task in TASKS]
    parser.add_argument("--task", choices=names, action="append", help=f"repeatable; default: {', '.join(SHOWN)}")
    parser.add_argument("--form", choices=("state", "images"), default="state", help="what the policy acts by")
    parser.add_argument("--demonstrations", type=int, default=300, help="of the expert, a task")
    parser.add_argument("--stages", type=int, default=STAGES, help=f"up to which of the {STAGES} to train")
    parser.add_argument("--episodes", type=int, default=20, help="by which each stage's success is told")
    asked = parser.parse_args()
    torch.set_num_threads(1)
    tasks = [task for task in TASKS if task.name in (asked.task or SHOWN)]
    finish([figure for task in tasks for figure in measure(task, asked)])


if __name__ == "__main__":
    main()

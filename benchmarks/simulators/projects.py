"""Robot projects at size, through a running service: collected with both cameras, acquired at random, labeled.

    python -m benchmarks.simulators.projects                        100 trajectories and 200 segments of each task
    python -m benchmarks.simulators.projects --task Lift --segments 20 --trajectories 10

Each task has an `asim serve` of its own; the project is made and filled by the command line, the labels are those of
the labeling worker. They are held against the actions of the episodes run once more, live and from the seed that
provenance tells of, where the worker restores recorded states. A search labels the same segments again; what it begins
with was fitted on KNOWN other labels. Status 1 where a target is missed.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from api_schemas.labels import Label
from api_schemas.projects import Project
from asim.client import Client
from asim.served import served
from benchmarks.figures import Figure, finish
from benchmarks.simulators.labels import KNOWN, Labels, label, replay_figures, search_figures
from benchmarks.simulators.speed import TASKS, Task
from workers.answering import recording_of
from workers.explainers import ReplayOrSearch, explainer_of
from workers.labeling import run_labeling
from workers.recording import Known, Provenance
from workers.simulators.base import SearchableSimulator
from workers.simulators.catalog import make_behavior, make_simulator

TRAJECTORIES, SEGMENTS, SEED = 100, 200, 7
WAIT = 600.0  # seconds for a queue


@dataclass(frozen=True)
class Product:
    """One task's project in a running service."""

    url: str
    client: Client
    project: Project

    def command(self, *words: str) -> str:
        """What `asim` printed. Raises CalledProcessError."""
        return command(self.url, *words)

    def provenance(self, trajectory: str) -> Provenance:
        """As the labeler is told it."""
        return Provenance(*self.client.provenance(self.project.id, trajectory))

    def label(self, segments: int) -> tuple[list[Label], Labels]:
        """A batch drawn at random, labeled by the worker: as the service keeps it, and in numbers."""
        batch = self.client.acquire(self.project.id, segments, strategy="random", wait=WAIT)
        began = time.process_time()
        accepted = run_labeling(self.client, batch, np.random.default_rng(SEED))
        seconds = (time.process_time() - began) / segments
        own = {(receipt.trajectory, receipt.start) for receipt in accepted.receipts}
        kept = [each for each in self.client.labels(self.project.id) if (each.trajectory, each.start) in own]
        residuals = [np.nan if each.residual is None else each.residual for each in kept]
        return kept, Labels(np.array([each.actions[0] for each in kept]), np.array(residuals), seconds)


def command(url: str, *words: str) -> str:
    """Run `asim`; what it printed. Raises CalledProcessError."""
    argv, environment = [sys.executable, "-m", "asim", *words], os.environ | {"ASIM_URL": url}
    return subprocess.run(argv, env=environment, check=True, stdout=subprocess.PIPE, text=True).stdout


def measure(task: Task, trajectories: int, segments: int) -> list[Figure]:
    """Create, collect, acquire, label, compare."""
    with tempfile.TemporaryDirectory() as folder, served(Path(folder)) as url, Client(url) as client:
        options = ("--strategy", "random", "--round-labels", "0", "--held-out-fraction", "0")
        named = ("--simulator", task.simulator, "--option", f"task={task.name}")
        product = Product(
            url, client, client.project(command(url, "project", "create", task.name, *named, *options).strip())
        )
        began = time.perf_counter()
        transitions = collect(product, trajectories)
        seconds = time.perf_counter() - began
        kept, replayed = product.label(segments)
        known, _ = product.label(KNOWN)
        with closing(make_simulator(task.simulator, {"task": task.name, "cameras": False})) as simulator:
            true = actions_taken(product, cast(SearchableSimulator, simulator), kept)
            searched = search(product, cast(SearchableSimulator, simulator), kept, known)
        counts = client.project(product.project.id).counts
    return [
        Figure(
            f"{task.name}_collected", counts.pool_trajectories, f"trajectories, {transitions} transitions", trajectories
        ),
        Figure(f"{task.name}_collection", transitions / seconds, f"transitions/s, {seconds:.0f} s in all"),
        *replay_figures(task.name, replayed, true),
        *search_figures(task.name, searched, true),
    ]


def collect(product: Product, trajectories: int) -> int:
    """That many trajectories; returns their transitions."""
    asked = ("--trajectories", str(trajectories), "--seed", str(SEED), "--split", "pool")
    told = json.loads(product.command("collect", product.project.name, *asked).splitlines()[-1])
    return int(told["transitions"])


def actions_taken(product: Product, simulator: SearchableSimulator, labels: Sequence[Label]) -> NDArray[np.float64]:
    """(N, 7), of segments of one step."""
    last = dict[str, int]()
    for each in labels:
        last[each.trajectory] = max(each.start, last.get(each.trajectory, 0))
    lived = {name: live(simulator, product.provenance(name), steps + 1) for name, steps in last.items()}
    return np.array([lived[each.trajectory][each.start] for each in labels], np.float64)


def live(simulator: SearchableSimulator, provenance: Provenance, steps: int) -> list[Any]:
    """The first actions of an episode that runs once more from its seed on, without a state being restored. Raises
    RuntimeError where it passes through another state than the recorded ones."""
    told: dict[str, Any] = dict(provenance.told)
    rng = np.random.default_rng()
    rng.bit_generator.state = told["generator"]
    behavior, actions = make_behavior(told["behavior"], simulator), list[Any]()
    simulator.reset(told["seed"])
    behavior.reset(rng)
    for step in range(steps):
        actions.append(behavior.act(simulator, rng))
        simulator.advance(actions[-1])
        state = simulator.state()
        if any(not np.array_equal(state[name], states[step + 1]) for name, states in provenance.states.items()):
            raise RuntimeError(f"episode {told['seed']} differs from what was recorded in step {step}")
    return actions


def search(product: Product, simulator: SearchableSimulator, labels: Sequence[Label], known: Sequence[Label]) -> Labels:
    """What the worker would find if no behavior were told of."""
    recordings = [
        recording_of(product.client, product.project, each.trajectory, each.start) for each in (*labels, *known)
    ]
    others = [Known(one, each.actions) for one, each in zip(recordings[len(labels) :], known, strict=True)]
    explainer = cast(ReplayOrSearch, explainer_of(simulator, product.provenance, lambda: others))
    return label(explainer.search, recordings[: len(labels)])


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--trajectories", type=int, default=TRAJECTORIES, help="to collect, a task")
    parser.add_argument("--segments", type=int, default=SEGMENTS, help="of one step to label, a task")
    parser.add_argument("--task", choices=[task.name for task in TASKS], action="append", help="default: all")
    asked = parser.parse_args()
    os.environ |= {"OMP_NUM_THREADS": "1"}  # of the service's processes, which inherit it
    tasks = [task for task in TASKS if asked.task is None or task.name in asked.task]
    print(f"{asked.trajectories} trajectories with two cameras, {asked.segments} segments of one step a task;")
    print("cost of a label in processor time of the labeler, without the service's")
    figures = []
    for task in tasks:
        print(f"{task.name} …", flush=True)
        figures += measure(task, asked.trajectories, asked.segments)
    finish(figures)


if __name__ == "__main__":
    main()

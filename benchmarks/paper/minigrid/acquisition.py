"""Figure 4d: what an arm's labels are worth. 200 uniform labels, then batches of 100 chosen by the arm.

    python -m benchmarks.paper.minigrid.acquisition --arms cycle:kmeans_plus_plus random:top --seeds 5

An arm is `strategy:rule`. All arms get the same pool, seed labels, budgets, schedules and draws. Each finished
(arm, seed) is a JSON file in --out and is not run again. Processes share the machine's cores, one torch thread each.
"""

import argparse
import json
import multiprocessing
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.paper.minigrid.arms import Arm
from benchmarks.paper.minigrid.datasets import ACTIONS, REPORTED, TUNING, DataSpec, draw_test_labels, load
from benchmarks.paper.minigrid.loop import Experiment, Plan, Round, errors, pool_losses, strategy_scores
from models.diagnostics import explanations, true_loss
from models.evaluation import transition_errors
from models.rank_correlation import kendall, spearman
from models.segments import SegmentBatch

Json = dict[str, Any]
MOVEMENT = 3  # actions below it are movements


@dataclass(frozen=True)
class Data:
    """The pool and the two test sets. All layouts of a test are of other seeds than the pool's."""

    pool: SegmentBatch
    balanced: SegmentBatch
    natural: SegmentBatch


@dataclass(frozen=True)
class DataChoice:
    """Which rooms: the reported ones or those for tuning; `data_seed` chooses among either."""

    folder: Path
    tuning: bool = False
    data_seed: int = 0
    pool_transitions: int = 28_000
    per_action: int = 500
    natural_transitions: int = 6000

    def load(self) -> Data:
        """From files, made where they are not there yet."""
        first = (TUNING if self.tuning else REPORTED) + 10 * self.data_seed
        pool = DataSpec("mixture", self.pool_transitions, first + 1)
        balanced = DataSpec("balanced", 200_000, first + 2, per_action=self.per_action)
        natural = DataSpec("mixture", self.natural_transitions, first + 3)
        return Data(
            load(pool, self.folder),
            draw_test_labels(load(balanced, self.folder)),
            draw_test_labels(load(natural, self.folder)),
        )


def main() -> None:
    """Run what is missing and print the table."""
    from benchmarks.paper.minigrid.acquisition_table import print_table

    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--arms", nargs="+", default=["random:top", "cycle:kmeans_plus_plus"], type=Arm.parse)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--processes", type=int, default=multiprocessing.cpu_count())
    parser.add_argument("--threads", type=int, default=1, help="of torch, in each process")
    parser.add_argument("--out", type=Path, default=Path("results/paper/minigrid/4d"))
    parser.add_argument("--tuning", action="store_true", help="rooms that no table reports, to choose settings on")
    parser.add_argument("--data-seed", type=int, default=0)
    asked = parser.parse_args()
    choice = DataChoice(asked.out / "data", asked.tuning, asked.data_seed)
    run_missing(asked.arms, range(asked.seeds), choice, asked.out, asked.processes, asked.threads)
    print_table(asked.arms, range(asked.seeds), asked.out)


def run_missing(
    arms: Sequence[Arm], seeds: Sequence[int], choice: DataChoice, out: Path, processes: int, threads: int
) -> None:
    """Every (arm, seed) whose file is not there, seeds first so that an unfinished run compares all arms."""
    tasks = [(arm, seed) for seed in seeds for arm in arms if not result_file(out, arm, seed).exists()]
    if not tasks:
        return
    choice.load()  # once, before processes ask for it
    context = multiprocessing.get_context("spawn")
    began = time.monotonic()
    with ProcessPoolExecutor(processes, context, initializer=torch.set_num_threads, initargs=(threads,)) as pool:
        futures = [pool.submit(run_arm, arm, seed, choice, out) for arm, seed in tasks]
        for done, future in enumerate(as_completed(futures), 1):
            print(f"{done} of {len(tasks)}, {time.monotonic() - began:.0f} s: {future.result()}", flush=True)


def run_arm(arm: Arm, seed: int, choice: DataChoice, out: Path) -> str:
    """One arm from one seed; its result is written at its end."""
    data, began = choice.load(), time.monotonic()
    experiment = Experiment(arm, seed, DataSpec("mixture", 1, TUNING).spaces, data.pool, out / "networks", Plan())
    rounds = [_told(experiment, found, data) for found in experiment.rounds()]
    result = {"arm": arm.name, "seed": seed, "seconds": time.monotonic() - began, "threads": torch.get_num_threads()}
    path = result_file(out, arm, seed)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.with_suffix(".unfinished").write_text(json.dumps(result | {"rounds": rounds}))
    path.with_suffix(".unfinished").replace(path)
    return f"{arm.name} seed {seed}: " + ", ".join(f"{each['balanced']['overall']['loss']:.2f}" for each in rounds)


def result_file(out: Path, arm: Arm, seed: int) -> Path:
    """Where a result is kept."""
    return out / f"{arm.strategy}-{arm.rule}-{seed}.json"


def _told(experiment: Experiment, found: Round, data: Data) -> Json:
    tests = {"balanced": data.balanced, "natural": data.natural}
    told: Json = {"labels": found.labeled.size}
    for name, error in errors(found.models, tests).items():
        told[name] = {"overall": _short(asdict(error.overall))}
        told[name] |= {group: _short(asdict(each)) for group, each in error.groups.items()}
    told["inverse_by_action"] = _inverse_by_action(found, data.balanced)
    told["ranks"] = _ranks(experiment.arm, found, data.natural)
    told["picks"] = _picks(found, data.pool)
    return told


def _short(error: Json) -> Json:
    return {
        "loss": error["next_state_loss"],
        "exact": error["exact_accuracy"],
        "dynamics": error["dynamics_accuracy"],
        "inverse": error["inverse_accuracy"],
    }


def _inverse_by_action(found: Round, test: SegmentBatch) -> list[float]:
    assert found.models.world_model is not None
    assert test.actions is not None
    right = transition_errors(found.models.world_model, test, found.models.inverse_dynamics).inverse_correct
    assert right is not None
    return [float(right[test.actions[:, 0] == action].double().mean()) for action in range(ACTIONS)]


def _ranks(arm: Arm, found: Round, test: SegmentBatch) -> Json:
    """Rank correlation of the arm's score with the true loss, on data of natural frequency."""
    if arm.strategy in ("random", "no_score", "oracle_uniform", "fidelity"):
        return {}
    models, inverse = found.models, found.models.inverse_dynamics
    assert models.world_model is not None
    assert inverse is not None
    assert test.actions is not None
    with torch.inference_mode():
        loss = true_loss(models.world_model, test, explanations(inverse, test))
    score = strategy_scores(arm.strategy, models, test)
    moves = test.actions[:, 0] < MOVEMENT
    groups = {"overall": torch.ones_like(moves), "movement": moves, "interaction": ~moves}
    return {name: _correlations(score[group], loss[group]) for name, group in groups.items()}


def _correlations(score: Tensor, loss: Tensor) -> Json:
    return {"spearman": spearman(score, loss), "kendall": kendall(score, loss)}


def _picks(found: Round, pool: SegmentBatch) -> Json:
    """What was picked: segments, how many effective ones of each action, and the quantiles of their true losses."""
    if len(found.picks) == 0:
        return {}
    chosen = pool.take(found.picks)
    assert chosen.action_sets is not None
    alone = chosen.action_sets[:, 0].sum(1) == 1
    by_action = chosen.action_sets[:, 0][alone].sum(0).tolist()
    losses = pool_losses(found.models, chosen).double()
    return {
        "segments": [[name.trajectory[:12], name.start] for name in chosen.segments],
        "by_action": by_action,
        "no_ops": int((~alone).sum()),
        "true_loss": [float(losses.quantile(share)) for share in (0.1, 0.25, 0.5, 0.75, 0.9)],
    }


if __name__ == "__main__":
    main()

"""Figure 4d: what an arm's labels are worth. 200 uniform labels, then batches of 100 chosen by the arm.

    python -m benchmarks.paper.minigrid.acquisition --arms random:top confident_cycle:signatures --seeds 5

An arm is `strategy:rule`. All arms get the same pool, seed labels, budgets, schedules and draws.
"""

import argparse
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import torch
from torch import Tensor

from api_schemas.strategies import DEFAULT_BATCH_RULE, DEFAULT_STRATEGY
from benchmarks.figures import Figure, finish
from benchmarks.paper.minigrid import acquisition_table
from benchmarks.paper.minigrid.action_following import action_following
from benchmarks.paper.minigrid.arms import EXPLORERS, Arm
from benchmarks.paper.minigrid.datasets import GROUPS, load_states
from benchmarks.paper.minigrid.exploration import Exploration
from benchmarks.paper.minigrid.loop import Experiment, Round, errors, pool_losses, strategy_scores
from benchmarks.paper.minigrid.rooms import Data, Rooms, add_files
from benchmarks.paper.runs import EXPLORATION_CODE, Json, add_options, results, run_missing
from models.rank_correlation import kendall, spearman
from models.segments import SegmentBatch
from workers.simulators.minigrid_rules import ACTION_NAMES

MOST_SEEDS = 100
BY_ACTION = {name: {action} for action, name in enumerate(ACTION_NAMES)}
MOVEMENT = 3  # actions below it are movements
WITHOUT_RANKS = ("random", "no_score", "oracle_uniform", "fidelity", *EXPLORERS)
"""Their scores are draws, turn on the pool, or are of what was not observed."""
DEFAULT = Arm(DEFAULT_STRATEGY, DEFAULT_BATCH_RULE)
ARMS = (Arm("random", "top"), DEFAULT, Arm("oracle", "top"), Arm("self_inverse", DEFAULT_BATCH_RULE))


@dataclass(frozen=True)
class ArmRun:
    """One arm from one seed. networks: folder of those that all arms share."""

    arm: Arm
    seed: int
    rooms: Rooms
    networks: Path

    @property
    def name(self) -> str:
        """Of its file."""
        return "-".join((self.arm.strategy, self.arm.rule, str(self.seed), *self.rooms.words))

    @property
    def also(self) -> tuple[str, ...]:
        """Code that its results depend on beside all others'."""
        return EXPLORATION_CODE if self.arm.strategy in EXPLORERS else ()

    def results(self) -> Json:
        """After every round: model error on each test, rank correlations, what was picked."""
        data = self.rooms.load()
        rounds = [_told(self.arm, found, data) for found in self._experiment(data).rounds()]
        about = {"arm": self.arm.name, "seed": self.seed, "rooms": self.rooms.words, "also": self.also}
        return {**about, "rounds": rounds}

    def _experiment(self, data: Data) -> Experiment:
        """In explore mode with the simulator's states, at which nobody but the labeler looks."""
        plain = Experiment(
            self.arm, self.seed, data.spaces, data.pool, self.networks, seed_set=data.seed_set, video=data.video
        )
        if self.arm.strategy not in EXPLORERS:
            return plain
        if self.rooms.pool is not None:
            raise ValueError(f"Arm {self.arm.name} acts in the simulator, of which {self.rooms.pool} holds no states.")
        spec = replace(self.rooms.pool_spec, states=True)
        states = tuple(load_states(spec, self.rooms.folder))
        shared = {field.name: getattr(plain, field.name) for field in fields(plain)}
        return Exploration(**shared, spec=spec, states=states)


def main(argv: Sequence[str] | None = None) -> list[Figure]:
    """Run what is missing, print the table, draw the chart; the figures of the default arm with their targets."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    add_options(parser, "4d")
    add_files(parser)
    parser.add_argument("--arms", nargs="+", default=list(ARMS), type=Arm.parse)
    parser.add_argument("--seeds", type=int, default=5)
    asked = parser.parse_args(argv)
    rooms = Rooms.of(asked)
    # One arm first: it trains the networks that all arms share. Then by seeds: an unfinished run has all arms.
    order = [(seed, asked.arms[0]) for seed in range(asked.seeds)]
    order += [(seed, arm) for seed in range(asked.seeds) for arm in asked.arms[1:]]
    runs = [ArmRun(arm, seed, rooms, rooms.networks(asked.out)) for seed, arm in order]
    rooms.load()  # once, before processes ask for it
    run_missing(runs, asked.out, asked.processes, asked.threads)
    # Arms that have finished more seeds before are told with all of them.
    finished = [replace(run, seed=seed) for seed in range(MOST_SEEDS) for run in runs if run.seed == 0]
    return acquisition_table.tell(results(finished, asked.out), DEFAULT, asked.out)


def _told(arm: Arm, found: Round, data: Data) -> Json:
    told: Json = {"labels": found.labeled.size}
    for name, error in errors(found.models, data.tests, GROUPS | BY_ACTION).items():
        groups = {"overall": error.overall, **error.groups}
        told[name] = {group: _short(asdict(each)) for group, each in groups.items()}
    told["ranks"] = _ranks(arm, found, data.tests["natural"])
    told["picks"] = _picks(found)
    if data.outcomes is not None and found.models.world_model is not None:
        told["action_following"] = action_following(found.models.world_model, data.outcomes)
    return told


def _short(error: Json) -> Json:
    return {
        "loss": error["next_state_loss"],
        "exact": error["exact_accuracy"],
        "dynamics": error["dynamics_accuracy"],
        "inverse": error["inverse_accuracy"],
    }


def _ranks(arm: Arm, found: Round, test: SegmentBatch) -> Json:
    """Rank correlation of the arm's score with the true loss, on data of natural frequency."""
    if arm.strategy in WITHOUT_RANKS:
        return {}
    assert test.actions is not None
    loss = pool_losses(found.models, test)
    score = strategy_scores(arm.strategy, found.models, test)
    moves = test.actions[:, 0] < MOVEMENT
    groups = {"overall": torch.ones_like(moves), "movement": moves, "interaction": ~moves}
    return {name: _correlations(score[group], loss[group]) for name, group in groups.items()}


def _correlations(score: Tensor, loss: Tensor) -> Json:
    return {"spearman": spearman(score, loss), "kendall": kendall(score, loss)}


def _picks(found: Round) -> Json:
    """What was picked: segments, how many effective ones of each action, and their true losses."""
    chosen = found.chosen
    if chosen is None:
        return {}
    assert chosen.action_sets is not None
    alone = chosen.action_sets[:, 0].sum(1) == 1
    return {
        "segments": [[name.trajectory[:12], name.start] for name in chosen.segments],
        "by_action": chosen.action_sets[:, 0][alone].sum(0).tolist(),
        "no_ops": int((~alone).sum()),
        "true_losses": [round(loss, 4) for loss in pool_losses(found.models, chosen).tolist()],
    }


if __name__ == "__main__":
    finish(main())

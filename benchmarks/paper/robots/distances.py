"""Which distance of the world model ranks segments as the error does that is reported.

    python -m benchmarks.paper.robots.distances --task Lift

One world model after its warm-up, the same in every form of its distance. Of segments of the pool: Spearman of each
distance, under true and under inferred actions, with the decoded open-loop error under the true ones, and how many of
the segments that it would pick first are among the worst ones.
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import get_args

import torch
from torch import Tensor

from benchmarks.figures import Figure, finish
from benchmarks.paper.robots import loop
from benchmarks.paper.robots.acquisition import ranked_rows
from benchmarks.paper.robots.arms import DEFAULT
from benchmarks.paper.robots.errors import CHUNK, PIXELS, ranks, true_losses
from benchmarks.paper.robots.profiles import PROFILES, SMALL
from benchmarks.paper.runs import ROBOT_CODE, code_digest
from models.acquisition import Models, top
from models.cycle_consistency import cycle_error
from models.segments import SegmentBatch
from models.step_distances import rollout_error
from models.world_models.recurrent import Distance, RecurrentWorldModel


def main(argv: Sequence[str] | None = None) -> list[Figure]:
    """On recordings that the benchmark has made. No figure has a target."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--profile", choices=tuple(PROFILES), default=SMALL.name)
    parser.add_argument("--task", default="Lift")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", type=Path, default=Path("results/paper/robots"))
    asked = parser.parse_args(argv)
    torch.set_num_threads(1)
    profile, out = PROFILES[asked.profile], asked.out / asked.profile
    (task,) = [each for each in profile.tasks if each.name == asked.task]
    data, warm = loop.load(profile, task, out / "data"), profile.warm[0]
    shared = out / "networks" / code_digest(*ROBOT_CODE) / f"{profile.name}-{task.name}-{warm}-{asked.seed}"
    experiment = loop.Experiment(profile, data, DEFAULT, asked.seed, warm, shared, shared, asked.device)
    models = experiment.warmed_up()
    segments = data.pool.take(ranked_rows(data.pool, asked.seed)).to(asked.device)
    return [figure for form in get_args(Distance) for figure in compared(form, models, segments, profile.batch)]


@torch.inference_mode()
def compared(form: Distance, models: Models, segments: SegmentBatch, batch: int) -> list[Figure]:
    """Of one form of the distance."""
    world_model = with_distance(models.world_model, form)
    assert models.inverse_dynamics is not None
    losses = {name: loss for name, loss in true_losses(world_model, segments).items() if name != "own"}
    told = list[Figure]()
    true, inferred = list[Tensor](), list[Tensor]()
    for start in range(0, segments.size, CHUNK):
        part = segments.take(slice(start, start + CHUNK))
        assert part.actions is not None
        true.append(rollout_error(world_model, part, part.actions))
        inferred.append(cycle_error(world_model, models.inverse_dynamics, part.observations))
    for actions, scores in (("true", torch.cat(true).cpu()), ("inferred", torch.cat(inferred).cpu())):
        for name, value in ranks(scores, losses).items():
            told.append(Figure(f"{form}_{actions}_{name}", value or 0.0, "Spearman's rho"))
        if PIXELS in losses:
            told.append(Figure(f"{form}_{actions}_worst", worst_found(scores, losses[PIXELS], batch), "share"))
    return told


def with_distance(world_model: object, form: Distance) -> RecurrentWorldModel:
    """The same weights with another form of the distance."""
    assert isinstance(world_model, RecurrentWorldModel)
    config = replace(world_model.config, distance=form)
    other = RecurrentWorldModel(world_model.spaces, config, torch.Generator())
    other.load_state_dict(world_model.state_dict())
    return other.to(next(world_model.parameters()).device)


def worst_found(scores: Tensor, losses: Tensor, count: int) -> float:
    """Of the `count` highest scores the share that is among the `count` highest losses."""
    count = min(count, len(scores))
    found = set(top(scores, count).tolist()) & set(top(losses, count).tolist())
    return len(found) / max(1, count)


if __name__ == "__main__":
    finish(main())

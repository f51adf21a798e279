"""What a round is worth: open-loop errors on the validating stage, and how well its scores rank true losses."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from benchmarks.paper.runs import Json
from models.acquisition import Models
from models.inverse_dynamics.base import InverseDynamics
from models.open_loop import open_loop_errors, step_errors
from models.rank_correlation import spearman
from models.segments import Observations, SegmentBatch
from models.spaces import Spaces
from models.step_distances import rollout_error
from models.world_models.base import WorldModel

CHUNK = 32  # segments decoded at a time
PIXELS = "pixels"  # the mean over cameras


def open_loop(world_model: WorldModel, tests: SegmentBatch, horizons: Sequence[int]) -> Json:
    """By horizon and stream; `pixels` is the mean over all cameras. Images in [0, 1], numbers in metres, squared."""
    cameras = cameras_of(world_model.spaces)
    errors = open_loop_errors(world_model, tests, horizons, CHUNK)
    return {str(horizon): _with_pixels(found, cameras) for horizon, found in errors.items()}


def standing_still(tests: SegmentBatch, horizons: Sequence[int], spaces: Spaces) -> Json:
    """The same of who predicts that nothing happens."""
    cameras, told = cameras_of(spaces), Json()
    for horizon in horizons:
        found = {
            name: _squared(stream[:, :1], stream[:, 1 : horizon + 1]) for name, stream in tests.observations.items()
        }
        told[str(horizon)] = _with_pixels(found, cameras)
    return told


@torch.inference_mode()
def true_losses(world_model: WorldModel, batch: SegmentBatch) -> dict[str, Tensor]:
    """Of labeled segments under their true actions, (B,) each: `own`, in the world model's distance, and the decoded
    errors of every stream, over the whole segment."""
    cameras, parts = cameras_of(world_model.spaces), list[dict[str, Tensor]]()
    for start in range(0, batch.size, CHUNK):
        part = batch.take(slice(start, start + CHUNK))
        assert part.actions is not None
        found = {name: errors.mean(1) for name, errors in step_errors(world_model, part).items()}
        if cameras:
            found[PIXELS] = torch.stack([found[name] for name in cameras]).mean(0)
        parts.append(found | {"own": rollout_error(world_model, part, part.actions)})
    return {name: torch.cat([part[name].cpu() for part in parts]) for name in parts[0]}


def ranks(score: Tensor, losses: Mapping[str, Tensor]) -> dict[str, float | None]:
    """Spearman of a score with each true loss."""
    return {name: spearman(score.double(), loss.double()) for name, loss in losses.items()}


@torch.inference_mode()
def inverse_error(models: Models, tests: SegmentBatch) -> float | None:
    """Mean squared error of inferred actions, the gripper's sign aside; None where an arm infers none."""
    named = (models.inverse_dynamics, models.dense_inverse_dynamics, models.masked_inverse_dynamics)
    inverse: InverseDynamics | None = next((each for each in named if each is not None), None)
    if inverse is None:
        return None
    assert tests.actions is not None
    missed = inverse.infer(tests.observations) - tests.actions
    return float(missed[..., :-1].square().mean())


@torch.inference_mode()
def predicted(world_model: WorldModel, shown: SegmentBatch, steps: Sequence[int]) -> Observations:
    """What it decodes at some steps, from 1 on, of segments: (B, steps, ...)."""
    assert shown.actions is not None
    state = world_model.infer_state({name: stream[:, :1] for name, stream in shown.observations.items()})
    states = world_model.rollout(state, shown.actions)
    frames = [world_model.observe(states[:, step - 1]) for step in steps]
    return {name: torch.stack([frame[name].cpu() for frame in frames], 1) for name in frames[0]}


def cameras_of(spaces: Spaces) -> list[str]:
    """Streams that are images."""
    return [name for name, stream in sorted(spaces.observations.items()) if len(stream.shape) == 3]


def _with_pixels(found: dict[str, float], cameras: Sequence[str]) -> dict[str, float]:
    return found | ({PIXELS: sum(found[name] for name in cameras) / len(cameras)} if cameras else {})


def _squared(guess: Tensor, truth: Tensor) -> float:
    scale = 1.0 if truth.is_floating_point() else 255.0
    return float(((guess.float() - truth.float()) / scale).square().mean())

"""How long a profile takes: a few timed steps of every kind of network, times the steps that are missing."""

import time
from collections.abc import Sequence
from functools import cache

import torch

from benchmarks.paper.robots.acquisition import ArmRun
from benchmarks.paper.robots.datasets import LENGTH, Recording
from benchmarks.paper.robots.profiles import Profile
from benchmarks.simulators.speed import TASKS
from models.chance import training_generator
from models.network import SemiSupervised
from models.segments import SegmentBatch
from models.spaces import BoxAction, Spaces, StreamSpec
from models.training import advance, begin
from workers.simulators import maniskill, robosuite
from workers.simulators.robot_observation import ACTION_SPACE, observation_space
from workers.training import ENSEMBLE_MEMBERS

STEPS = 3  # timed, after one that is not
BESIDE = 0.2  # of training's time: scores, errors, pictures
SHORTER = 0.75  # of its horizon that an episode lasts in the mean
POLICY = 300.0  # seconds: 300 demonstrations and 3,000 steps
STEPS_OF_POLICY = 3000
HORIZONS = robosuite.HORIZONS | maniskill.HORIZONS


def told(profile: Profile, runs: Sequence[ArmRun], recordings: Sequence[Recording], device: str, processes: int) -> str:
    """In words: hours and what they are made of. runs, recordings: those that are missing."""
    training = sum(_seconds_of(run, device) for run in runs)
    training += sum(_seconds(run.profile, kind, device, first=True) for run, kind in _shared(runs))
    recording = sum(map(_recording_seconds, recordings))
    recording += POLICY * sum(_share_of_policy(each) for each in {each.policy: each for each in recordings}.values())
    clock = (training * (1 + BESIDE) + recording) / processes / 3600
    return (
        f"{profile.name}: {len(runs)} runs and {len(recordings)} recordings are missing; about {clock:.2g} hours by "
        f"the clock in {processes} processes on {device}, {training / 3600:.2g} of one process's for training and "
        f"{recording / 3600:.2g} for recordings. Timed now: a busy machine makes it more."
    )


@cache
def step_seconds(profile: Profile, kind: str, device: str) -> float:
    """Of one step of training on pictures that show nothing."""
    spaces = _spaces(profile.cameras)
    config = profile.schedule(kind, 1, first=True)
    assert config is not None
    generator = training_generator(0, 0, kind)
    network = profile.build(kind, spaces, generator)
    batch = _noise(spaces, config.batch_size)
    seen = batch.without_labels() if kind == "subgoal_generator" else batch
    beside = batch.without_labels() if isinstance(network, SemiSupervised) else None
    state = advance(network, seen, begin(network, config, generator), 1, device, action_free=beside)
    began = time.perf_counter()
    advance(network, seen, state, 1 + STEPS, device, action_free=beside)
    if device != "cpu":
        torch.cuda.synchronize(device)
    return (time.perf_counter() - began) / STEPS


def _shared(runs: Sequence[ArmRun]) -> list[tuple[ArmRun, str]]:
    """Every network of a first round once, with one of the runs that share it."""
    found = {(run.task, run.warm, run.seed, kind): (run, kind) for run in runs for kind in _kinds(run)}
    return list(found.values())


def _seconds_of(run: ArmRun, device: str) -> float:
    """Of the rounds after the first; the last one trains the world model only, none the subgoal generator."""
    batches = run.profile.batches
    rounds = {"world_model": batches, "subgoal_generator": 0}
    return sum(rounds.get(kind, batches - 1) * _seconds(run.profile, kind, device, first=False) for kind in _kinds(run))


def _seconds(profile: Profile, kind: str, device: str, first: bool) -> float:
    built, members = ("world_model", ENSEMBLE_MEMBERS) if kind == "ensemble" else (kind, 1)
    config = profile.schedule(built, 1, first) or profile.schedule(built, 1, first=True)
    assert config is not None
    return members * config.steps * step_seconds(profile, built, device)


def _kinds(run: ArmRun) -> list[str]:
    return sorted(({"world_model"} | run.arm.arm.scores.needs) - {"previous_world_model"})


def _recording_seconds(recording: Recording) -> float:
    (task,) = [each for each in TASKS if each.name == recording.policy.task]
    rate = task.images_target if recording.cameras else task.numbers_target  # steps a second, a bound from below
    return recording.trajectories * SHORTER * HORIZONS[task.name] / rate


def _share_of_policy(recording: Recording) -> float:
    return (recording.policy.steps or STEPS_OF_POLICY) / STEPS_OF_POLICY


def _spaces(cameras: bool) -> Spaces:
    space = observation_space(cameras, objects=1)
    streams = {name: StreamSpec(tuple(each.shape or ()), str(each.dtype)) for name, each in space.items()}
    return Spaces(streams, BoxAction(-1.0, 1.0, ACTION_SPACE.shape))


def _noise(spaces: Spaces, segments: int) -> SegmentBatch:
    generator = torch.Generator().manual_seed(0)
    streams = {
        name: torch.randint(256, (segments, LENGTH + 1, *spec.shape), generator=generator, dtype=torch.uint8)
        if spec.dtype == "uint8"
        else torch.randn(segments, LENGTH + 1, *spec.shape, generator=generator)
        for name, spec in spaces.observations.items()
    }
    actions = torch.rand(segments, LENGTH, *ACTION_SPACE.shape, generator=generator) * 2 - 1
    return SegmentBatch(streams, actions)

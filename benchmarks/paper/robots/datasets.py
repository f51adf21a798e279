"""Recordings of robot tasks by behaviors of known quality: the expert, and a diffusion policy at ten stages.

They are what the product's own functions make of the settings, and kept in files named by those settings and by the
code: a benchmark that was stopped records what is missing.

An episode goes on after it is solved until its last segment is full. Else all that experts show of some tasks would
be shorter than a segment.
"""

import hashlib
import io
import json
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from api_schemas.environments import GRIPPER
from benchmarks.paper.runs import Json, sources_digest, write_at_once
from models import checkpoints
from models.policies.diffusion import DiffusionPolicyConfig
from models.segments import Segment, SegmentBatch, concatenate
from models.spaces import BoxAction, Spaces, StreamSpec
from workers import demonstrations
from workers.episodes import Drawn, Episode, Extent, further_episodes
from workers.policies import rolled_out
from workers.policy_training import begun, stage_steps, states_at
from workers.simulators.base import Action, Behavior, Observation, Simulator, State, Step
from workers.simulators.catalog import make_behavior, make_simulator

CODE = (
    "workers/simulators",
    "workers/demonstrations.py",
    "workers/episodes.py",
    "workers/policies.py",
    "workers/policy_training.py",
    "workers/rollouts.py",
    "models/policies",
    "models/training.py",
    "benchmarks/paper/robots/datasets.py",
)
EXPERT = 0  # in the place of a stage
LENGTH = 25  # transitions of a segment: every task's horizon is a multiple of it
FIRST_SEED = 3_000_000  # of the episodes; demonstrations that policies learn from are drawn otherwise
SOLVED = "solved"


@dataclass(frozen=True)
class PolicySpec:
    """Which policy: trained as one of POST /policies is, by poses. steps None: the product's own schedule."""

    simulator: str
    task: str
    demonstrations: int = 300
    steps: int | None = None
    stages: int = 10
    seed: int = 0

    def file(self, folder: Path, stage: int) -> Path:
        """Where the weights at a stage, from 1 on, are kept."""
        return folder / f"{self.task}-policy-{_digest(asdict(self))}-{stage}.safetensors"


@dataclass(frozen=True)
class Recording:
    """So many episodes of a policy's stage, or of the expert, seen through cameras or in numbers."""

    policy: PolicySpec
    stage: int
    trajectories: int
    cameras: bool = True
    length: int = LENGTH

    @property
    def source(self) -> str:
        """Who acted."""
        return "expert" if self.stage == EXPERT else f"stage {self.stage}"

    @property
    def name(self) -> str:
        """Unlike any other's."""
        return f"{self.policy.task}-{self.source.replace(' ', '-')}-{_digest(asdict(self))}"

    def file(self, folder: Path) -> Path:
        """Where it is kept."""
        return folder / f"{self.name}.npz"


@dataclass(frozen=True)
class PolicyTraining:
    """A run that leaves the weights of every stage."""

    spec: PolicySpec
    folder: Path

    @property
    def name(self) -> str:
        """Of its file."""
        return self.spec.file(self.folder, self.spec.stages).stem

    def results(self) -> Json:
        """After how many steps each stage is."""
        stages = range(1, self.spec.stages + 1)
        if not all(self.spec.file(self.folder, stage).exists() for stage in stages):
            for stage, weights in _stages(self.spec):
                write_at_once(self.spec.file(self.folder, stage), weights)
        return {"stages": self.spec.stages}


@dataclass(frozen=True)
class RecordingRun:
    """A run that leaves a recording."""

    recording: Recording
    folder: Path

    @property
    def name(self) -> str:
        """Of its file."""
        return self.recording.name

    def results(self) -> Json:
        """How long its episodes are, and how many are solved."""
        path = self.recording.file(self.folder)
        if not path.exists():
            packed = io.BytesIO()
            np.savez_compressed(packed, **_packed(list(_episodes(self.recording, self.folder))))
            write_at_once(path, packed.getvalue())
        with np.load(path) as arrays:
            lengths, solved = arrays["lengths"].tolist(), int(arrays[SOLVED].sum())
        return {"source": self.recording.source, "lengths": lengths, "solved": solved}


def load(recordings: Sequence[Recording], folder: Path) -> SegmentBatch:
    """All whole segments of recordings that were made, labeled, in order. They are named by source and episode."""
    return concatenate([_segments(each, folder) for each in recordings])


def spaces_of(batch: SegmentBatch) -> Spaces:
    """Of robots' observations and actions."""
    assert batch.actions is not None
    streams = {name: StreamSpec(tuple(s.shape[2:]), str(s.numpy().dtype)) for name, s in batch.observations.items()}
    return Spaces(streams, BoxAction(-1.0, 1.0, tuple(batch.actions.shape[2:]), (GRIPPER,)))


def windows(recordings: Sequence[Recording], folder: Path, length: int) -> SegmentBatch:
    """Of every episode that is long enough its first and its last `length` transitions, labeled, to test on."""
    return concatenate([_cut(each, folder, length, lambda total: sorted({0, total - length})) for each in recordings])


def _segments(recording: Recording, folder: Path) -> SegmentBatch:
    length = recording.length
    return _cut(recording, folder, length, lambda total: list(range(0, total - length + 1, length)))


def _cut(recording: Recording, folder: Path, length: int, starts_of: Any) -> SegmentBatch:
    """Segments of `length` that begin where `starts_of` an episode's transitions says."""
    with np.load(recording.file(folder)) as arrays:
        streams = {name: arrays[name] for name in arrays.files}
    lengths, actions = streams.pop("lengths").tolist(), streams.pop("actions")
    streams.pop(SOLVED)
    frames, steps, names = list[int](), list[int](), list[Segment]()
    frame = step = 0
    for number, total in enumerate(lengths):
        for start in starts_of(total) if total >= length else ():
            frames.append(frame + start)
            steps.append(step + start)
            names.append(Segment(f"{recording.source}/{number}", start))
        frame, step = frame + total + 1, step + total
    seen = np.asarray(frames, np.int64)[:, None] + np.arange(length + 1)  # (S, L+1)
    taken = np.asarray(steps, np.int64)[:, None] + np.arange(length)  # (S, L)
    observations = {name: torch.from_numpy(stream[seen]) for name, stream in streams.items()}
    return SegmentBatch(observations, torch.from_numpy(actions[taken]), segments=tuple(names))


def _stages(spec: PolicySpec) -> Iterator[tuple[int, bytes]]:
    """Every stage's number and weights, in order."""
    options = {"task": spec.task, "cameras": False}
    with closing(make_simulator(spec.simulator, options)) as simulator:
        shown = demonstrations.demonstrate(simulator, "state", spec.demonstrations, spec.seed)
    batch = demonstrations.segments(shown, DiffusionPolicyConfig().chunk)
    policy, state = begun(batch, spec.seed)
    state = replace(state, config=replace(state.config, steps=spec.steps or state.config.steps))
    marks = stage_steps(state.config.steps, spec.stages)
    for number, _ in enumerate(states_at(policy, batch, state, marks, lambda step, steps, loss: None), 1):
        yield number, checkpoints.save(policy)


def _episodes(recording: Recording, folder: Path) -> Iterator[tuple[Episode, bool]]:
    """Each with whether it was solved."""
    spec = recording.policy
    options = {"task": spec.task, "cameras": recording.cameras}
    with closing(make_simulator(spec.simulator, options)) as simulator:
        if recording.stage == EXPERT:
            behavior = make_behavior(demonstrations.EXPERT, simulator)
        else:
            behavior = rolled_out(spec.file(folder, recording.stage).read_bytes())
        filled = Filled(simulator, recording.length)
        rng = np.random.default_rng((FIRST_SEED, recording.stage))
        extent = Extent(trajectories=recording.trajectories)
        for episode in further_episodes(filled, Within(behavior, simulator), extent, Drawn(rng)):
            yield episode, filled.is_solved


class Filled:
    """A simulator whose episodes, once solved, end where a whole number of segments is over."""

    def __init__(self, simulator: Simulator, length: int) -> None:
        self._simulator, self._length, self._steps = simulator, length, 0
        self.is_solved = False
        self.observation_space, self.action_space = simulator.observation_space, simulator.action_space

    def reset(self, seed: int) -> Observation:
        """Begins an episode."""
        self._steps, self.is_solved = 0, False
        return self._simulator.reset(seed)

    def state(self) -> State:
        """Of the other simulator."""
        return self._simulator.state()

    def restore(self, state: State) -> None:
        """Of the other simulator; how far the episode is stays as it was."""
        self._simulator.restore(state)

    def step(self, action: Action) -> Step:
        """After its end nothing is stepped before a restore: so it is restored to where it is."""
        step = self._simulator.step(action)
        self._steps += 1
        self.is_solved |= step.terminated
        if step.terminated:
            self._simulator.restore(self._simulator.state())
        return Step(step.observation, self.is_solved and self._steps % self._length == 0, step.truncated)

    def observe(self) -> Observation:
        """Of the other simulator."""
        return self._simulator.observe()

    def render(self) -> NDArray[np.uint8]:
        """Of the other simulator."""
        return self._simulator.render()

    def close(self) -> None:
        """Of the other simulator."""
        self._simulator.close()


class Within:
    """A behavior that acts in the simulator that another one goes round."""

    def __init__(self, behavior: Behavior, simulator: Simulator) -> None:
        self._behavior, self._simulator = behavior, simulator

    def reset(self, rng: np.random.Generator) -> None:
        """Of the other behavior."""
        self._behavior.reset(rng)

    def act(self, simulator: Simulator, rng: np.random.Generator) -> Action:
        """Of the other behavior."""
        del simulator
        return self._behavior.act(self._simulator, rng)


def _packed(episodes: Sequence[tuple[Episode, bool]]) -> dict[str, NDArray[Any]]:
    """Frames of all episodes in a row, likewise actions (float32); how long each is, and whether it was solved."""
    streams = {
        name: np.concatenate([episode.observations[name] for episode, _ in episodes])
        for name in episodes[0][0].observations
    }
    return {
        **streams,
        "actions": np.concatenate([np.stack(episode.actions).astype(np.float32) for episode, _ in episodes]),
        "lengths": np.array([episode.transitions for episode, _ in episodes], np.int64),
        SOLVED: np.array([solved for _, solved in episodes]),
    }


def _digest(told: Json) -> str:
    """Of settings and of the code that recordings are made by."""
    text = json.dumps(told | {"code": sources_digest(*CODE)}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]

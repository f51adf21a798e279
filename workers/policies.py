"""Policies at work: a diffusion policy acts in a simulator, as any behavior does."""

from collections import deque
from typing import Literal, cast

import numpy as np
import torch
from numpy.typing import NDArray

from models import checkpoints
from models.policies.diffusion import HISTORY, DiffusionPolicy
from models.policies.noise import DiffusersMissing, training_scheduler
from models.segments import Observations
from workers.recording import stacked
from workers.simulators.base import (
    ArrangedSimulator,
    Behavior,
    Observation,
    Simulator,
    SimulatorError,
    SimulatorUnavailable,
)
from workers.simulators.robot_behaviors import NoisyBehavior

Form = Literal["state", "images"]
SEEDS = 2**63
LOUDEST = 0.2  # noise of a policy that is rolled out; its stages are good and bad already


def policy_of(weights: bytes) -> DiffusionPolicy:
    """The policy of a checkpoint. Raises CheckpointError."""
    return cast(DiffusionPolicy, checkpoints.load(weights, expect_kind=DiffusionPolicy.kind))


def check_installed() -> None:
    """Raises SimulatorUnavailable, with the command to run, where policies lack a package."""
    try:
        training_scheduler(1, "sample")
    except DiffusersMissing as error:
        raise SimulatorUnavailable(str(error)) from error


def rolled_out(weights: bytes) -> Behavior:
    """What a collection does with a policy. Raises CheckpointError, SimulatorUnavailable."""
    check_installed()
    return NoisyBehavior(PolicyBehavior(policy_of(weights)), LOUDEST)


def look(simulator: Simulator, form: Form) -> Observation:
    """What a policy of that form sees of the simulator's current state: where everything is, whether or not there are
    cameras; or what is observed. Raises SimulatorError for a simulator that cannot tell where everything is."""
    if form == "images":
        return simulator.observe()
    if not isinstance(simulator, ArrangedSimulator):
        raise SimulatorError(f"A {type(simulator).__name__} does not tell where everything is, as policies need.")
    return simulator.arrangement()


class PolicyBehavior:
    """Takes the first actions of a chunk, then looks again and has the next one made.

    It computes in double precision and rounds the actions to float32: how many threads a process has changes the last
    bits of a sum, and labels by replay compare whole runs bit for bit.
    """

    def __init__(self, policy: DiffusionPolicy) -> None:
        self._policy = policy.double()
        self._form: Form = "images" if policy.images else "state"
        self._chance = torch.Generator()
        self._seen: deque[Observation] = deque(maxlen=HISTORY)
        self._plan: list[NDArray[np.float32]] = []

    def reset(self, rng: np.random.Generator) -> None:
        """Forgets what was seen and planned; the episode's chance is drawn here."""
        self._chance.manual_seed(int(rng.integers(SEEDS)))
        self._seen.clear()
        self._plan = []

    def act(self, simulator: Simulator, rng: np.random.Generator) -> NDArray[np.float32]:
        """The next action, (D,)."""
        del rng
        if len(self._plan) <= 1:  # what comes before the next plan is the last but one that it is made of
            self._seen.append(look(simulator, self._form))
        if not self._plan:
            chunk = self._policy.sample(self._history(), self._chance)[0]  # (1, chunk, D) -> (chunk, D)
            self._plan = list(chunk[: self._policy.config.executed].numpy().astype(np.float32))
        return self._plan.pop(0)

    def _history(self) -> Observations:
        """What was seen last, (1, HISTORY, ...): before the first action the same twice."""
        steps = [self._seen[0]] * (HISTORY - len(self._seen)) + list(self._seen)
        return {name: torch.from_numpy(stream)[None] for name, stream in stacked(steps).items()}

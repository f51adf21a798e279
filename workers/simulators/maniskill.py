"""The ManiSkill simulator: PullCube, PokeCube and LiftPegUpright with a Panda arm, behind the simulator protocol."""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from workers.simulators import maniskill_experts, robot_behaviors, robot_observation
from workers.simulators.base import (
    Action,
    Behavior,
    Observation,
    Simulator,
    SimulatorError,
    State,
    StateError,
    Step,
)
from workers.simulators.maniskill_env import TASKS, make_env
from workers.simulators.robot_observation import ACTION_SPACE, checked_action
from workers.simulators.robot_options import RobotOptions
from workers.simulators.robot_progress import Progress
from workers.simulators.search_settings import SearchSettings

SEARCH = SearchSettings(continuous=7, grips=(0.0,))
NAME = "maniskill"
BEHAVIORS = robot_behaviors.BEHAVIORS
HORIZONS = {name: task.horizon for name, task in TASKS.items()}


class ManiSkillSimulator:
    """A ManiSkill task. Observations are those of `robot_observation`. An action moves the grip point by up to 10 cm in
    x, y and z and turns it by up to 0.1 rad about the negative x, y and z axes of the world, in 50 ms; its last number
    is where the gripper goes, from closed (-1) to open (1). `terminated` means that the task is solved. Replay is
    exact: see `StateAccess`."""

    def __init__(self, options: RobotOptions) -> None:
        self.options, self.env = options, make_env(options.task)
        from workers.simulators.maniskill_state import StateAccess  # these need SAPIEN as soon as they are imported
        from workers.simulators.maniskill_view import View

        self._progress = Progress(options.horizon)
        self._access = StateAccess(self.env, options.task, self._progress)
        self.view = View(self.env, options.task)

    @property
    def observation_space(self) -> gym.spaces.Dict:
        """See `robot_observation`."""
        return robot_observation.observation_space(self.options.cameras, len(TASKS[self.options.task].objects))

    @property
    def action_space(self) -> gym.Space[Any]:
        """Box(-1, 1, (7,), float32)."""
        return ACTION_SPACE

    def reset(self, seed: int) -> Observation:
        """Draws where the objects lie, and the arm's posture."""
        self._access.begin(seed)
        return self.observe()

    def state(self) -> State:
        """See `StateAccess`."""
        return self._access.read()

    def restore(self, state: State) -> None:
        """Raises StateError for a state of another task or of another version of ManiSkill or SAPIEN."""
        self._access.write(state)

    def step(self, action: Action) -> Step:
        """Raises SimulatorError for an action outside the space, and where the simulation breaks down."""
        self.advance(action)
        return Step(self.observe(), self._progress.terminated, self._progress.truncated)

    def advance(self, action: Action) -> None:
        """`step` without an observation."""
        told = self.env.step(checked_action(action))[4]
        self._progress.advance(bool(told["success"]))
        try:
            self._access.follow()
        except StateError as error:
            raise SimulatorError(
                f"Simulator {NAME!r}, task {self.options.task!r}, broke down in step {self._progress.steps} of an "
                f"episode: {error}"
            ) from error

    def observe(self) -> Observation:
        """The current observation, in new arrays."""
        return {**self.view.images(), **self.numbers()} if self.options.cameras else self.numbers()

    def numbers(self) -> Observation:
        """The current observation but for its images."""
        seen = self.arrangement()
        return {"proprioception": seen["proprioception"]} if self.options.cameras else seen

    def arrangement(self) -> Observation:
        """What is observed without cameras."""
        arm = robot_observation.proprioception(self.view.grip(), self.view.fingers())
        objects = map(self.view.body, TASKS[self.options.task].objects)
        return {"proprioception": arm, "objects": robot_observation.objects(objects)}

    @property
    def search(self) -> SearchSettings:
        """SEARCH."""
        return SEARCH

    def motion(self) -> NDArray[np.float64]:
        """See `search_settings.motion`: (18,)."""
        return self._access.motion()

    def render(self) -> NDArray[np.uint8]:
        """What the front camera sees, (256, 256, 3)."""
        return self.view.picture()

    def close(self) -> None:
        """Frees the renderer."""
        self.view.close()


def make_simulator(options: Mapping[str, object]) -> Simulator:
    """A task with the given options. Raises OptionError for an unknown option or a value out of range, and
    SimulatorUnavailable where ManiSkill is not installed."""
    return ManiSkillSimulator(RobotOptions.parse(NAME, HORIZONS, options))


def make_behavior(name: str, simulator: Simulator) -> Behavior:
    """The named behavior. Raises OptionError for an unknown name."""
    del simulator
    return robot_behaviors.make_behavior(name, NAME, maniskill_experts.plan)

"""The robosuite simulator: Lift, PickPlaceCan and NutAssemblySquare with a Panda arm, behind the simulator protocol."""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from workers.simulators import robosuite_experts, robot_behaviors, robot_observation
from workers.simulators.base import Action, Behavior, Observation, Simulator, SimulatorError, State, Step
from workers.simulators.robosuite_env import TASKS, make_env
from workers.simulators.robot_observation import ACTION_SPACE, checked_action
from workers.simulators.robot_options import RobotOptions
from workers.simulators.robot_progress import Progress
from workers.simulators.search_settings import SearchSettings

SEARCH = SearchSettings(continuous=6, grips=(-1.0, 1.0))  # of the gripper's number only the sign counts
NAME = "robosuite"
BEHAVIORS = robot_behaviors.BEHAVIORS
HORIZONS = {name: task.horizon for name, task in TASKS.items()}


class RobosuiteSimulator:
    """A robosuite task. Observations are those of `robot_observation`. An action moves the grip point by up to 5 cm and
    0.5 rad in each coordinate (x, y, z, then a rotation vector; axes of the world) in 50 ms, and closes (> 0) or opens
    the gripper, of which only the sign counts. `terminated` means that the task is solved. Replay is exact."""

    def __init__(self, options: RobotOptions) -> None:
        self.options, self.env = options, make_env(options.task)
        from workers.simulators.robosuite_state import StateAccess  # these need MuJoCo as soon as they are imported
        from workers.simulators.robosuite_view import View

        self._progress = Progress(options.horizon)
        self._access = StateAccess(self.env, options.task, self._progress)
        self.view = View(self.env)

    @property
    def observation_space(self) -> gym.spaces.Dict:
        """See `robot_observation`."""
        return robot_observation.observation_space(self.options.cameras, len(TASKS[self.options.task].bodies))

    @property
    def action_space(self) -> gym.Space[Any]:
        """Box(-1, 1, (7,), float32)."""
        return ACTION_SPACE

    def reset(self, seed: int) -> Observation:
        """Draws where the objects lie, and the arm's posture."""
        self._access.begin(seed)
        self.view.update()
        return self.observe()

    def state(self) -> State:
        """See `StateAccess`."""
        return self._access.read()

    def restore(self, state: State) -> None:
        """Raises StateError for a state of another task or of another version of robosuite or MuJoCo."""
        self._access.write(state)
        self.view.update()

    def step(self, action: Action) -> Step:
        """Raises SimulatorError for an action outside the space, and where the simulation breaks down."""
        self.advance(action)
        return Step(self.observe(), self._progress.terminated, self._progress.truncated)

    def advance(self, action: Action) -> None:
        """`step` without an observation."""
        self.env.step(checked_action(action).astype(np.float64))
        self._progress.advance(bool(self.env._check_success()))
        if self._access.broke_down():
            raise SimulatorError(
                f"Simulator {NAME!r}, task {self.options.task!r}, computed a number that is not finite in step "
                f"{self._progress.steps} of an episode."
            )
        self.view.update()

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
        objects = map(self.view.body, TASKS[self.options.task].bodies)
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
    SimulatorUnavailable where robosuite is not installed."""
    return RobosuiteSimulator(RobotOptions.parse(NAME, HORIZONS, options))


def make_behavior(name: str, simulator: Simulator) -> Behavior:
    """The named behavior. Raises OptionError for an unknown name."""
    del simulator
    return robot_behaviors.make_behavior(name, NAME, robosuite_experts.plan)

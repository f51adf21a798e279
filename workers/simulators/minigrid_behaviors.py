"""Behaviors that collect MiniGrid data: random, expert, their mixture, and one that balances the actions."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from workers.simulators.base import Behavior, OptionError, Simulator
from workers.simulators.minigrid_experts import expert_action
from workers.simulators.minigrid_paths import approach
from workers.simulators.minigrid_room import Room
from workers.simulators.minigrid_rules import ACTION_NAMES, FORWARD, INTERACTION, LEFT, MOVEMENT, RIGHT, is_effective

ACTIONS = len(ACTION_NAMES)


def random_movement(rng: np.random.Generator) -> int:
    """Left, right, forward with probabilities 0.25, 0.25, 0.5."""
    return (LEFT, RIGHT, FORWARD, FORWARD)[int(rng.integers(4))]


class RandomBehavior:
    """A random movement nine times in ten, else one of the four interactions, all equally likely."""

    def reset(self, rng: np.random.Generator) -> None:
        """Nothing is remembered."""

    def act(self, simulator: Simulator, rng: np.random.Generator) -> int:
        """Reads nothing of the simulator."""
        del simulator
        if rng.random() < 0.9:
            return random_movement(rng)
        return INTERACTION[int(rng.integers(len(INTERACTION)))]


class ExpertBehavior:
    """The solver of the episode's task."""

    def reset(self, rng: np.random.Generator) -> None:
        """Nothing is remembered: the solver plans from the current state."""

    def act(self, simulator: Simulator, rng: np.random.Generator) -> int:
        """The solver's next action."""
        return expert_action(Room.from_state(simulator.state()), rng)


@dataclass(frozen=True)
class MixtureConfig:
    """Shares of random episodes and, of the steps of the other episodes, of random movements and of uniform actions."""

    random_episodes: float = 0.35
    random_movements: float = 0.5
    uniform_actions: float = 0.05


class MixtureBehavior:
    """Random episodes, and episodes of the solver with noise mixed in, so that effective interactions are rare (about
    5 % of all steps at room size 6) and all four occur."""

    def __init__(self, config: MixtureConfig | None = None) -> None:
        self.config = config or MixtureConfig()
        self._random, self._expert = RandomBehavior(), ExpertBehavior()
        self._is_random_episode = False

    def reset(self, rng: np.random.Generator) -> None:
        """Draws whether this is a random episode."""
        self._is_random_episode = bool(rng.random() < self.config.random_episodes)

    def act(self, simulator: Simulator, rng: np.random.Generator) -> int:
        """The random or the solver's action, or one of the mixed-in noise."""
        if self._is_random_episode:
            return self._random.act(simulator, rng)
        draw = rng.random()
        if draw < self.config.random_movements:
            return random_movement(rng)
        if draw < self.config.random_movements + self.config.uniform_actions:
            return int(rng.integers(ACTIONS))
        return self._expert.act(simulator, rng)


class BalancedBehavior:
    """Makes all seven actions effective often, to collect sets with as many steps of each action.

    It counts the effective steps n_a of each action a over its life, draws the next action to make effective with
    probability proportional to 1 / (n_a + 1), walks to a random place where it is, and does it.
    """

    def __init__(self) -> None:
        self.counts = np.zeros(ACTIONS, np.int64)
        self._aim: tuple[int, int] | None = None

    @property
    def memory(self) -> list[int]:
        """The counts."""
        return [int(count) for count in self.counts]

    def recall(self, memory: list[int]) -> None:
        """Goes on counting from there."""
        self.counts = np.array(memory, np.int64)

    def reset(self, rng: np.random.Generator) -> None:
        """Forgets where it was going; the counts go on."""
        self._aim = None

    def act(self, simulator: Simulator, rng: np.random.Generator) -> int:
        """The next action on the way to making the chosen one effective."""
        room = Room.from_state(simulator.state())
        action = self._pursue(room)
        if action is None:
            self._aim = self._choose_aim(room, rng)
            action = self._pursue(room)
        if action is None:  # out of reach: objects are in the way
            self._aim, action = None, int(rng.integers(ACTIONS))
        if room.is_effective(action):
            self.counts[action] += 1
        if self._aim is not None and action == self._aim[0] and room.front == self._aim[1]:
            self._aim = None
        return action

    def _pursue(self, room: Room) -> int | None:
        if self._aim is None:
            return None
        wanted, place = self._aim
        if not is_effective(wanted, room.cells[place], room.carried):
            return None
        return approach(room, lambda front: front == place, wanted)

    def _choose_aim(self, room: Room, rng: np.random.Generator) -> tuple[int, int] | None:
        weights = 1 / (self.counts + 1)
        wanted = int(rng.choice(ACTIONS, p=weights / weights.sum()))
        if wanted in MOVEMENT or (room.is_effective(wanted) and rng.random() < 0.5):
            return wanted, room.front
        places = [place for place, code in enumerate(room.cells) if is_effective(wanted, code, room.carried)]
        places = [place for place in places if place != room.position]
        return (wanted, int(rng.choice(places))) if places else None


_FACTORIES: dict[str, Callable[[], Behavior]] = {
    "balanced": BalancedBehavior,
    "expert": ExpertBehavior,
    "mixture": MixtureBehavior,
    "random": RandomBehavior,
}
BEHAVIORS = tuple(_FACTORIES)


def make_behavior(name: str, simulator: Simulator) -> Behavior:
    """The named behavior. Raises OptionError for an unknown name."""
    del simulator  # every behavior fits every room
    if name not in _FACTORIES:
        raise OptionError(f"Simulator 'minigrid' has no behavior {name!r}; its behaviors are {', '.join(BEHAVIORS)}.")
    return _FACTORIES[name]()

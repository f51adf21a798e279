"""The simulators and behaviors by name. A simulator's packages are imported only when it is made."""

from collections.abc import Mapping
from importlib import import_module
from typing import cast

from workers.simulators.base import Behavior, OptionError, Simulator

# Each module offers make_simulator(options), make_behavior(name, simulator) and the tuple BEHAVIORS.
SIMULATORS: dict[str, str] = {
    "maniskill": "workers.simulators.maniskill",
    "minigrid": "workers.simulators.minigrid",
    "robosuite": "workers.simulators.robosuite",
}


def make_simulator(name: str, options: Mapping[str, object]) -> Simulator:
    """The named simulator. Raises OptionError for an unknown name, an unknown option or a value out of range."""
    if name not in SIMULATORS:
        raise OptionError(f"There is no simulator {name!r}; the simulators are {', '.join(sorted(SIMULATORS))}.")
    return cast(Simulator, import_module(SIMULATORS[name]).make_simulator(options))


def make_behavior(name: str, simulator: Simulator) -> Behavior:
    """The named behavior for a simulator made here. Raises OptionError for a name the simulator has no behavior of."""
    module = type(simulator).__module__
    if module not in SIMULATORS.values():
        raise OptionError(f"Behavior {name!r} needs a simulator of the catalog, not a {type(simulator).__qualname__}.")
    return cast(Behavior, import_module(module).make_behavior(name, simulator))


def behavior_names(name: str) -> tuple[str, ...]:
    """The behaviors of the named simulator. Raises OptionError for an unknown simulator."""
    if name not in SIMULATORS:
        raise OptionError(f"There is no simulator {name!r}; the simulators are {', '.join(sorted(SIMULATORS))}.")
    return cast(tuple[str, ...], import_module(SIMULATORS[name]).BEHAVIORS)

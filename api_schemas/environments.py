"""Observation and action spaces of a project, and the spaces of the simulators that we ship."""

from collections.abc import Callable, Mapping
from math import prod
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, StrictBool, ValidationError, model_validator

from api_schemas.base import AS_JSON, Integer, Number, Schema

MOST_AXES = 8  # of one array, time not counted
MOST_NUMBERS = 2**24  # of one observation in one stream
MOST_COORDINATES = 1_000  # of an action
MOST_HIGHS = 10_000  # places along the last axis that have a largest value of their own
MOST_ACTIONS = 1_000  # of a discrete space
MOST_ENTRIES = 64  # streams of an observation, groups of actions, options of a simulator
DType = Literal["uint8", "int32", "int64", "float32", "float64"]


def _not_reserved(name: str) -> str:
    if name == "__metadata__":
        raise ValueError("is what files of arrays call something else")
    return name


# A slash would name a chunk of another stream.
StreamName = Annotated[str, Field(pattern="^[A-Za-z0-9_.-]{1,80}$"), AfterValidator(_not_reserved)]


def _at_most(most: int) -> AfterValidator:
    """Of all axes together."""

    def check(shape: tuple[int, ...]) -> tuple[int, ...]:
        if prod(shape) > most:
            raise ValueError(f"holds {prod(shape)} numbers, {most} are allowed")
        return shape

    return AfterValidator(check)


Name = Annotated[str, Field(max_length=200)]
Axis = Annotated[int, Field(gt=0, le=MOST_NUMBERS), AS_JSON]
Shape = Annotated[tuple[Axis, ...], Field(max_length=MOST_AXES, fail_fast=True)]


class Stream(Schema):
    """One named array of an observation; `shape` has no time axis.

    high: the largest value allowed, one number for all or one for each place along the last axis.
    """

    dtype: DType
    shape: Annotated[Shape, _at_most(MOST_NUMBERS)]
    high: Integer | Annotated[tuple[Integer, ...], Field(max_length=MOST_HIGHS, fail_fast=True)] | None = None

    @model_validator(mode="after")
    def _high_fits_the_last_axis(self) -> "Stream":
        if isinstance(self.high, tuple) and (not self.shape or len(self.high) != self.shape[-1]):
            count = len(self.high)
            raise ValueError(f"high: has {count} numbers, needs one for each place of the last axis of {self.shape}")
        return self


class DiscreteActions(Schema):
    """The integers 0 to n - 1. `groups` names disjoint sets of them for which model error is reported apart."""

    kind: Literal["discrete"] = "discrete"
    n: Annotated[int, Field(ge=2, le=MOST_ACTIONS), AS_JSON]
    names: Annotated[tuple[Name, ...], Field(max_length=MOST_ACTIONS, fail_fast=True)] = ()
    groups: Annotated[
        dict[Name, Annotated[tuple[Integer, ...], Field(max_length=MOST_ACTIONS, fail_fast=True)]],
        Field(max_length=MOST_ENTRIES),
    ] = {}


class BoxActions(Schema):
    """Vectors of `shape` between `low` and `high`, in every coordinate.

    signs: coordinates of a vector of which only the side of the middle counts, as of a gripper that opens or closes.
    """

    kind: Literal["box"] = "box"
    shape: Annotated[Shape, _at_most(MOST_COORDINATES)]
    low: Number = -1.0
    high: Number = 1.0
    signs: Annotated[tuple[Integer, ...], Field(max_length=MOST_COORDINATES, fail_fast=True)] = ()

    @model_validator(mode="after")
    def _signs_are_coordinates(self) -> "BoxActions":
        wrong = [place for place in self.signs if len(self.shape) != 1 or not 0 <= place < self.shape[0]]
        if wrong:
            raise ValueError(f"signs: {wrong[0]} is no coordinate of a vector of shape {self.shape}")
        return self


Actions = Annotated[DiscreteActions | BoxActions, Field(discriminator="kind")]


class Spaces(Schema):
    """What an observation and an action of a project look like."""

    observations: dict[StreamName, Stream] = Field(
        min_length=1, max_length=MOST_ENTRIES, json_schema_extra={"additionalProperties": False}
    )
    actions: Actions


class MiniGridOptions(Schema):
    """Options of the MiniGrid simulator; room sizes count the walls."""

    task: Literal["key_delivery", "ball_delivery", "object_matching", "any"] = "any"
    room_size: Literal[6, 8] = 6
    objects: Annotated[int, Field(ge=3, le=14, strict=True)] = 3
    noisy_tiles: Annotated[int, Field(ge=0, le=4, strict=True)] = 0
    max_steps: Annotated[int, Field(ge=1, strict=True)] = 120

    @model_validator(mode="after")
    def _room_for_the_objects(self) -> "MiniGridOptions":
        if self.objects > 3 and self.room_size < 8:
            raise ValueError(f"objects: {self.objects} objects need room_size 8, got room_size {self.room_size}")
        return self


SMALLEST_PICTURE = 16  # pixels a side: what is smaller shows nothing to a person, such as a grid's code


def is_picture(stream: Stream) -> bool:
    """Whether people can look at it: (H, W, 3) bytes that may have any value."""
    is_rgb = stream.dtype == "uint8" and len(stream.shape) == 3 and stream.shape[2] == 3
    return is_rgb and min(stream.shape[:2]) >= SMALLEST_PICTURE and stream.high is None


GRID_HIGH = (10, 5, 4)  # the last object, colour and state that the grid family knows


def takes_grid(spaces: Spaces) -> bool:
    """Whether the grid family takes the spaces: a square grid and a hand in its code, discrete actions."""
    grid, carried = spaces.observations.get("grid"), spaces.observations.get("carried")
    if len(spaces.observations) != 2 or grid is None or carried is None:
        return False
    square = len(grid.shape) == 3 and grid.shape[0] == grid.shape[1] >= 3 and grid.shape[2] == 3
    bytes_only = grid.dtype == carried.dtype == "uint8" and carried.shape == (3,)
    return square and bytes_only and isinstance(spaces.actions, DiscreteActions)


def takes_robot(spaces: Spaces) -> bool:
    """Whether the robot family takes the spaces: square images of one size, vectors of floats, a bounded box of
    vectors as actions. A contract test holds it equal to what the family says itself."""
    action, streams = spaces.actions, spaces.observations.values()
    images = {(stream.dtype, stream.shape) for stream in streams if len(stream.shape) == 3}
    vectors = all(
        len(stream.shape) == 1 and stream.dtype.startswith("float") for stream in streams if len(stream.shape) != 3
    )
    box = isinstance(action, BoxActions) and len(action.shape) == 1 and action.low < action.high
    return box and vectors and len(images) <= 1 and all(_is_camera(*image) for image in images)


def _is_camera(dtype: str, shape: tuple[int, ...]) -> bool:
    """Bytes of three colours whose side is a power of two, 8 or more."""
    side = shape[0]
    return dtype == "uint8" and shape == (side, side, 3) and side >= 8 and side & (side - 1) == 0


def bounded_grid(spaces: Spaces) -> Spaces:
    """The same spaces with the grid family's largest values on every stream."""
    streams = {name: stream.model_copy(update={"high": GRID_HIGH}) for name, stream in spaces.observations.items()}
    return spaces.model_copy(update={"observations": streams})


def minigrid_spaces(options: Mapping[str, object]) -> Spaces:
    """Spaces of the MiniGrid simulator. A contract test holds them equal to the simulator's own."""
    size = MiniGridOptions.model_validate(dict(options)).room_size
    names = ("left", "right", "forward", "pickup", "drop", "toggle", "swap")
    return Spaces(
        observations={
            "grid": Stream(dtype="uint8", shape=(size, size, 3), high=GRID_HIGH),
            "carried": Stream(dtype="uint8", shape=(3,), high=GRID_HIGH),
        },
        actions=DiscreteActions(n=7, names=names, groups={"movement": (0, 1, 2), "interaction": (3, 4, 5, 6)}),
    )


class RobotOptions(Schema):
    """Options that all robot simulators have. Without cameras an observation holds the poses of the task's objects in
    their place; `horizon` is in steps and that of the task where it is left out."""

    cameras: StrictBool = True
    horizon: Annotated[int, Field(ge=1, le=10**6, strict=True)] | None = None


class RobosuiteOptions(RobotOptions):
    """Options of the robosuite simulator."""

    task: Literal["Lift", "PickPlaceCan", "NutAssemblySquare"] = "Lift"


class ManiSkillOptions(RobotOptions):
    """Options of the ManiSkill simulator."""

    task: Literal["PullCube", "PokeCube", "LiftPegUpright"] = "PullCube"


IMAGE_SHAPE = (64, 64, 3)
POSE = 9  # numbers: a position, and two columns of a rotation matrix
GRIPPER = 6  # the coordinate of an action that opens or closes it
ROBOT_OBJECTS = {
    "Lift": 1,
    "PickPlaceCan": 1,
    "NutAssemblySquare": 1,
    "PullCube": 2,
    "PokeCube": 3,
    "LiftPegUpright": 1,
}


def robosuite_spaces(options: Mapping[str, object]) -> Spaces:
    """Spaces of the robosuite simulator. A contract test holds them equal to the simulator's own."""
    chosen = RobosuiteOptions.model_validate(dict(options))
    return _robot_spaces(chosen.task, chosen.cameras)


def maniskill_spaces(options: Mapping[str, object]) -> Spaces:
    """Spaces of the ManiSkill simulator. A contract test holds them equal to the simulator's own."""
    chosen = ManiSkillOptions.model_validate(dict(options))
    return _robot_spaces(chosen.task, chosen.cameras)


def _robot_spaces(task: str, cameras: bool) -> Spaces:
    arm = Stream(dtype="float32", shape=(POSE + 2,))
    seen: dict[StreamName, Stream]
    if cameras:
        seen = {name: Stream(dtype="uint8", shape=IMAGE_SHAPE) for name in ("front", "wrist")}
    else:
        seen = {"objects": Stream(dtype="float32", shape=(POSE * ROBOT_OBJECTS[task],))}
    return Spaces(observations={**seen, "proprioception": arm}, actions=BoxActions(shape=(7,), signs=(GRIPPER,)))


SIMULATOR_BEHAVIORS: dict[str, tuple[str, ...]] = {
    "maniskill": ("expert", "noisy_expert", "random"),
    "minigrid": ("balanced", "expert", "mixture", "random"),
    "robosuite": ("expert", "noisy_expert", "random"),
}
DEFAULT_BEHAVIORS = {"maniskill": "noisy_expert", "minigrid": "mixture", "robosuite": "noisy_expert"}
SIMULATOR_SPACES: dict[str, Callable[[Mapping[str, object]], Spaces]] = {
    "maniskill": maniskill_spaces,
    "minigrid": minigrid_spaces,
    "robosuite": robosuite_spaces,
}
ROBOTS: dict[str, type[RobosuiteOptions] | type[ManiSkillOptions]] = {
    "maniskill": ManiSkillOptions,
    "robosuite": RobosuiteOptions,
}


def takes_images(spaces: Spaces) -> bool:
    """Whether an observation holds camera images."""
    return any(stream.dtype == "uint8" and len(stream.shape) == 3 for stream in spaces.observations.values())


class Environment(Schema):
    """A simulator that we ship (its spaces follow), or the spaces of the user's own robot."""

    simulator: Name | None = None
    options: Annotated[dict[Name, Name | int | float | bool], Field(max_length=MOST_ENTRIES)] = {}
    spaces: Spaces | None = None

    @model_validator(mode="after")
    def _spaces_are_known(self) -> "Environment":
        if self.simulator is None:
            if self.spaces is None:
                raise ValueError("spaces: needed where no simulator is named")
            return self
        if self.simulator not in SIMULATOR_SPACES:
            raise ValueError(f"simulator: {self.simulator!r} is not one of {sorted(SIMULATOR_SPACES)}")
        try:
            derived = SIMULATOR_SPACES[self.simulator](self.options)
        except ValidationError as error:
            problems = "; ".join(f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors())
            raise ValueError(f"options: {problems}") from error
        if self.spaces is not None and self.spaces != derived:
            raise ValueError(f"spaces: differ from those of simulator {self.simulator!r}; leave them out")
        return self

    def resolved_spaces(self) -> Spaces:
        """The project's spaces, whichever way they were given."""
        if self.spaces is not None:
            return self.spaces
        if self.simulator is None:  # the validator refuses this; the check is for the type
            raise ValueError("spaces: needed where no simulator is named")
        return SIMULATOR_SPACES[self.simulator](self.options)

    def task(self) -> str | None:
        """The robot task, also where it is the simulator's first one; None where there are no robots."""
        if self.simulator not in ROBOTS:
            return None
        return ROBOTS[self.simulator].model_validate(dict(self.options)).task

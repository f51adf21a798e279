"""The common ground of all schemas."""

from typing import Annotated, Generic, Literal, TypeVar

from pydantic import AwareDatetime, BaseModel, BeforeValidator, ConfigDict, Field, Strict

Timestamp = AwareDatetime
TrajectoryId = Annotated[str, Field(pattern="^[0-9a-f]{64}$", description="sha256 of the trajectory's decoded arrays")]
Split = Literal["pool", "held_out"]


def _number(value: object) -> object:
    """In a body true is no 1, and "5" no 5; 5.0 is 5, as JSON has it."""
    if isinstance(value, bool | str | bytes):
        raise ValueError("must be a number")
    return value


Integer = Annotated[int, BeforeValidator(_number)]
Number = Annotated[float, Strict()]
Item = TypeVar("Item")


class Schema(BaseModel):
    """Unknown fields are refused, so that a misspelt setting is an error and not a silence."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Page(Schema, Generic[Item]):
    """One page of a listing; pass `next` back as `cursor` for the page that follows."""

    items: list[Item]
    next: str | None = None


__all__ = ["Integer", "Number", "Page", "Schema", "Split", "Timestamp", "TrajectoryId"]

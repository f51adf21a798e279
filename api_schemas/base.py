"""The common ground of all schemas."""

from datetime import UTC, datetime
from itertools import islice
from typing import Annotated, Any, Generic, Literal, TypeVar

from pydantic import (
    AfterValidator,
    AwareDatetime,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    Strict,
    model_validator,
)

TrajectoryId = Annotated[str, Field(pattern="^[0-9a-f]{64}$", description="sha256 of the trajectory's decoded arrays")]
Split = Literal["pool", "held_out"]


def _number(value: object) -> object:
    """In a body true is no 1, and "5" no 5; 5.0 is 5, as JSON has it."""
    if isinstance(value, bool | str | bytes):
        raise ValueError("must be a number")
    return value


def _in_utc(value: datetime) -> datetime:
    """A time near the ends of the calendar may have none."""
    try:
        return value.astimezone(UTC)
    except OverflowError:
        raise ValueError("is no time of the years 1 to 9999 in UTC") from None


Timestamp = Annotated[AwareDatetime, AfterValidator(_in_utc)]
# Bounds stand here and not in a field's own Field(): pydantic lets the outer of two replace the inner, and describes a
# bound behind AS_JSON wrongly where the field may be null.
AS_JSON = BeforeValidator(_number)
MOST = 2**53 - 1  # up to there every reader of JSON has the same integer; a database's holds more
Integer = Annotated[int, Field(ge=-MOST, le=MOST), AS_JSON]
Natural = Annotated[int, Field(ge=0, le=MOST), AS_JSON]
Positive = Annotated[int, Field(ge=1, le=MOST), AS_JSON]
Seed = Annotated[int, Field(ge=0, lt=2**31), AS_JSON]
Number = Annotated[float, Strict()]
Item = TypeVar("Item")
MOST_UNKNOWN = 20  # fields that are named one by one


class Schema(BaseModel):
    """Unknown fields are refused, so that a misspelt setting is an error and not a silence."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _few_unknown_fields(cls, data: Any) -> Any:
        """One error for all: pydantic makes one for each, which takes a thousand times what a short name does."""
        if isinstance(data, dict) and len(data) > len(cls.model_fields) + MOST_UNKNOWN:
            named = ", ".join(str(name)[:80] for name in islice(data.keys() - cls.model_fields.keys(), 3))
            raise ValueError(f"has {len(data)} fields, {len(cls.model_fields)} are known; {named} are not")
        return data


class Page(Schema, Generic[Item]):
    """One page of a listing; pass `next` back as `cursor` for the page that follows."""

    items: list[Item]
    next: str | None = None


__all__ = [
    "AS_JSON",
    "Integer",
    "Natural",
    "Number",
    "Page",
    "Positive",
    "Schema",
    "Seed",
    "Split",
    "Timestamp",
    "TrajectoryId",
]

"""What the commands share: options, the client, sentences for errors."""

from typing import TYPE_CHECKING, Annotated, Literal

import typer

from asim.errors import AsimError

if TYPE_CHECKING:
    from asim.client import Client

RETRIES = 3  # a person at a terminal would rather know soon
DEFAULT_URL = "http://127.0.0.1:8000"
Url = Annotated[str, typer.Option("--url", envvar="ASIM_URL", help="Where the service listens.")]
Key = Annotated[str | None, typer.Option("--key", envvar="ASIM_KEY", help="API key; embedded mode needs none.")]
ProjectName = Annotated[str, typer.Argument(metavar="PROJECT", help="Name or id of the project.")]
Strategy = Annotated[str | None, typer.Option(help="How segments are scored; GET /strategies lists them.")]
Mode = Annotated[
    Literal["pool", "explore"],
    typer.Option(help="Segments of the pool to label, or states to explore from and the actions to execute there."),
]
Purpose = Annotated[Literal["pool", "held_out"], typer.Option(help="Label the pool, or the held-out set.")]
Split = Annotated[
    Literal["auto", "pool", "held_out"], typer.Option(help="Where the trajectories go; auto decides by content hash.")
]
Count = Annotated[int, typer.Option(min=1, help="Segments.")]
Json = Annotated[bool, typer.Option("--json", help="Print the service's answer as JSON.")]
JsonLines = Annotated[bool, typer.Option("--json", help="Print what the service answered as JSON, one line each.")]


def connect(url: str, key: str | None) -> "Client":
    """A client of the service at `url`."""
    from asim.client import Client

    return Client(url, key, retries=RETRIES)


def explain(error: Exception) -> str | None:
    """One sentence for a person, or None where the error is a defect of ours and its traceback is needed."""
    if isinstance(error, AsimError):
        return str(error)
    from pydantic import ValidationError
    from sqlalchemy.exc import SQLAlchemyError

    from service.errors import ServiceError as Refused  # of commands that work on the database itself

    if isinstance(error, ValidationError):
        return "; ".join(_refused(".".join(map(str, each["loc"])), each["msg"]) for each in error.errors())
    if isinstance(error, Refused):
        return error.detail
    if isinstance(error, SQLAlchemyError):
        return f"the database: {str(error).partition(chr(10))[0]}"
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    return None


def _refused(field: str, message: str) -> str:
    reason = message.removeprefix("Value error, ")  # pydantic's words before a sentence of ours
    return f"{field}: {reason}" if field else reason

"""The face of ASIM: the client, the command line, the demo. `import asim` is cheap: parts load when they are named."""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from asim.client import Client
    from asim.errors import (
        AsimError,
        Conflict,
        Forbidden,
        Invalid,
        JobCancelled,
        JobFailed,
        LeaseLost,
        NotFound,
        NotReady,
        RoundCancelled,
        RoundFailed,
        ServiceError,
        Unavailable,
        Unreachable,
    )

__all__ = [
    "AsimError",
    "Client",
    "Conflict",
    "Forbidden",
    "Invalid",
    "JobCancelled",
    "JobFailed",
    "LeaseLost",
    "NotFound",
    "NotReady",
    "RoundCancelled",
    "RoundFailed",
    "ServiceError",
    "Unavailable",
    "Unreachable",
]


def __getattr__(name: str) -> object:
    if name not in __all__:
        raise AttributeError(f"module 'asim' has no attribute {name!r}")
    return getattr(import_module("asim.client" if name == "Client" else "asim.errors"), name)

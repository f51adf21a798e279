"""What ends a training, told to who can do something about it: which round, which network, which setting to change."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from models.training import NonFiniteError
from service.store.tables import ProjectRow

NO_MEMORY = "can't allocate memory"  # in what torch says of a processor's; of a device's there is a class


class OutOfMemory(MemoryError):
    """A training that needs more memory than there is."""


@contextmanager
def explained(project: ProjectRow, what: str) -> Iterator[None]:
    """what: "round 3, world_model". Raises OutOfMemory and NonFiniteError with what to do; other errors as they are."""
    try:
        yield
    except NonFiniteError as error:
        advice = "Look at the numbers of these segments."
        if project.preset is not None:
            advice += (
                f" If they are right, another preset of the project may learn from them (this one's: {project.preset})."
            )
        raise NonFiniteError(f"{what}: {error} {advice}") from error
    except (MemoryError, RuntimeError) as error:
        if not (isinstance(error, MemoryError | torch.OutOfMemoryError) or NO_MEMORY in str(error)):
            raise
        smaller = " or make the project with preset small," if project.preset == "paper" else ""
        found = f" ({error})" if str(error) else ""
        raise OutOfMemory(
            f"{what}: out of memory{found}. Lower ASIM_TRAINING_BYTES,{smaller} or give the training more memory."
        ) from error

"""Answering acquisitions with our labeling worker."""

from collections.abc import Iterable, Iterator

import numpy as np

from api_schemas.acquisitions import Acquisition, Purpose
from api_schemas.projects import Project
from asim.client import Client
from asim.errors import AsimError
from asim.report import Report
from workers.labeling import run_labeling

LARGEST_BATCH = 500  # labels that one request carries


def taken(
    client: Client, project: Project, count: int, strategy: str | None, purpose: Purpose, wait: float
) -> Iterator[Acquisition]:
    """Acquire `count` segments, in batches that one request can answer; each is taken when it is asked for."""
    for first in range(0, count, LARGEST_BATCH):
        size = min(LARGEST_BATCH, count - first)
        yield client.acquire(project.id, size, strategy=strategy, purpose=purpose, labeler="asim label", wait=wait)


def given(client: Client, project: Project, acquisition: str, token: int | None) -> list[Acquisition]:
    """The acquisition of that id, with the token that its taker was told. Raises AsimError where it is another's."""
    if token is None:
        raise AsimError(f"acquisition {acquisition}: --token is needed; POST /acquire told it")
    found = client.acquisition(acquisition)
    if found.project != project.id:
        raise AsimError(f"acquisition {acquisition} is not of project {project.name}")
    return [found.model_copy(update={"token": token})]


def answer(client: Client, batches: Iterable[Acquisition], seed: int, report: Report) -> None:
    """Label every batch with the project's simulator, telling what became of it."""
    generator = np.random.default_rng(seed)
    for batch in batches:
        with report.step(f"label {len(batch.items)} segments ranked by {batch.strategy}") as advance:
            accepted = run_labeling(client, batch, generator, lambda done, all_: advance(done / all_, ""))
        report.tell(f"{accepted.created} labels accepted, {accepted.duplicates} known before")
        if accepted.round is not None:
            report.tell(f"round {accepted.round} started")

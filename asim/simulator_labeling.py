"""Answering an acquisition with our labeling worker."""

from functools import cache, partial
from uuid import UUID

import numpy as np

from api_schemas.acquisitions import Acquisition
from api_schemas.projects import Project
from asim.client import Client
from asim.errors import AsimError, NotFound
from asim.report import Report
from workers.behaviors import behavior_named
from workers.labeling import run_labeling
from workers.replay import Behaviors
from workers.simulators.base import OptionError
from workers.unanswerable import UnanswerableItem


def given(client: Client, project: Project, acquisition: str, token: int | None) -> Acquisition:
    """The acquisition of that id, with the token that its taker was told. Raises AsimError where it is another's."""
    if token is None:
        raise AsimError(f"acquisition {acquisition}: --token is needed; POST /acquire told it")
    found = client.acquisition(acquisition)
    if found.project != project.id:
        raise AsimError(f"acquisition {acquisition} is not of project {project.name}")
    return found.model_copy(update={"token": token})


def answer(client: Client, batch: Acquisition, seed: int, report: Report) -> None:
    """Label the batch with the project's simulator, telling what became of it. Raises AsimError where it cannot."""
    generator = np.random.default_rng(seed)
    if batch.reason is not None:
        report.tell(f"a smaller batch: {batch.reason}")
    what = "explore from {} states drawn by {}" if batch.mode == "explore" else "label {} segments ranked by {}"
    with report.step(what.format(len(batch.items), batch.strategy)) as advance:

        def tell(done: int, count: int) -> None:
            advance(done / count, "")

        try:
            accepted = run_labeling(client, batch, generator, tell, behaviors=behaviors_of(client, batch.project))
        except UnanswerableItem as error:
            raise AsimError(str(error)) from error
    report.tell(f"{accepted.created} labels accepted, {accepted.duplicates} known before")
    if accepted.round is not None:
        report.tell(f"round {accepted.round} started")


def behaviors_of(client: Client, project: UUID) -> Behaviors:
    """The simulator's own and the project's policies, each of which is fetched once."""

    @cache
    def weights(sha256: str) -> bytes:
        try:
            return client.policy_weights(project, sha256)
        except NotFound as error:
            raise OptionError(str(error)) from error

    return partial(behavior_named, weights=weights)

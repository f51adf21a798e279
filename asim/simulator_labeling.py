"""Answering an acquisition with our labeling worker."""

import numpy as np

from api_schemas.acquisitions import Acquisition
from api_schemas.projects import Project
from asim.client import Client
from asim.errors import AsimError
from asim.report import Report
from workers.answering_process import AnsweringProcess
from workers.labeling import OpenAnswerer, run_labeling
from workers.simulators.base import SimulatorError
from workers.unanswerable import UnanswerableItem


def given(client: Client, project: Project, acquisition: str, token: int | None) -> Acquisition:
    """The acquisition of that id, with the token that its taker was told. Raises AsimError where it is another's."""
    if token is None:
        raise AsimError(f"acquisition {acquisition}: --token is needed; POST /acquire told it")
    found = client.acquisition(acquisition)
    if found.project != project.id:
        raise AsimError(f"acquisition {acquisition} is not of project {project.name}")
    return found.model_copy(update={"token": token})


def in_own_process(url: str, key: str | None, seconds: float) -> OpenAnswerer:
    """The simulator in a process of its own, where an item may take so many seconds."""
    return lambda _, project: AnsweringProcess(url, key, seconds, project)


def answer(client: Client, batch: Acquisition, seed: int, report: Report, open_answerer: OpenAnswerer) -> None:
    """Label the batch with the project's simulator, telling what became of it. Raises AsimError where it cannot."""
    generator = np.random.default_rng(seed)
    if batch.reason is not None:
        report.tell(f"a smaller batch: {batch.reason}")
    what = "explore from {} states drawn by {}" if batch.mode == "explore" else "label {} segments ranked by {}"
    with report.step(what.format(len(batch.items), batch.strategy)) as advance:

        def tell(done: int, count: int) -> None:
            advance(done / count, "")

        try:
            accepted = run_labeling(client, batch, generator, tell, open_answerer=open_answerer)
        except (UnanswerableItem, SimulatorError) as error:
            raise AsimError(str(error)) from error
    report.tell(f"{accepted.created} labels accepted, {accepted.duplicates} known before")
    if accepted.round is not None:
        report.tell(f"round {accepted.round} started")

"""The labeling worker: a simulator answers an acquisition, over HTTP like any other labeler.

It restores the state in which a segment was observed and steps the simulator to find which actions reproduce what was
observed next (how: `explainers`); or, to explore, executes there the actions that it is told. No stored action is read:
none is stored.
"""

from collections.abc import Callable, Sequence
from contextlib import closing
from datetime import UTC, datetime

import numpy as np

from api_schemas.acquisitions import Acquisition
from api_schemas.labels import LabelsAccepted, LabelSource
from api_schemas.projects import Project
from asim.client import Client
from asim.errors import ServiceError, Unavailable
from workers.answering import Answerer, SimulatorAnswerer
from workers.delivery import Answer, Delivery
from workers.lease import Clock, Lease, lost
from workers.simulators.base import SimulatorError
from workers.unanswerable import UnanswerableItem

Progress = Callable[[int, int], None]
OpenAnswerer = Callable[[Client, Project], Answerer]
NOTES = 10  # of what was refused, told besides the first


def run_labeling(
    client: Client,
    acquisition: Acquisition,
    generator: np.random.Generator,
    progress: Progress | None = None,
    clock: Clock = lambda: datetime.now(UTC),
    open_answerer: OpenAnswerer = SimulatorAnswerer,
) -> LabelsAccepted:
    """Label the items of an acquisition and post them under its token; a lease that runs short is extended.

    generator: where several actions explain a step, draws the one that the label names beside the whole set.
    open_answerer: the simulator, of this process or in another one.
    Where an item cannot be labeled, or its answer is refused, the others are posted all the same and it is given back
    before the error is raised. Raises UnanswerableItem and the client's errors, LeaseLost among them;
    where several items were refused, that of the first, which bears the others as notes. Raises SimulatorError where
    there is no simulator to ask, with all items given back.
    """
    if not acquisition.items:
        raise ValueError(f"acquisition {acquisition.id} holds no items")
    lease, answers = Lease(client, acquisition, clock), list[Answer]()
    refused: list[UnanswerableItem | ServiceError] = []
    with closing(_opened(client, acquisition, open_answerer, lease)) as answerer:
        for done, item in enumerate(acquisition.items, 1):
            lease.keep()
            try:
                answers.append(answerer.answer(item, generator))
            except Unavailable:
                raise  # that is not the item's fault: all of them can be answered later
            except (UnanswerableItem, ServiceError) as error:
                refused.append(error)
            if progress is not None:
                progress(done, len(acquisition.items))
        source = LabelSource(kind="simulator", name=answerer.name)
    delivery = Delivery(client, acquisition, source, lease.holds)
    delivery.hand_in(answers)
    refused += delivery.refused
    if refused:
        lease.give_back()
        raise lost(refused, len(acquisition.items)) or _first(refused)
    return delivery.receipt()


def _opened(client: Client, acquisition: Acquisition, open_answerer: OpenAnswerer, lease: Lease) -> Answerer:
    try:
        return open_answerer(client, client.project(acquisition.project))
    except SimulatorError:
        lease.give_back()
        raise


def _first(refused: Sequence[Exception]) -> Exception:
    for other in refused[1:NOTES]:
        refused[0].add_note(f"and {other}")
    if len(refused) > NOTES:
        refused[0].add_note(f"and {len(refused) - NOTES} more")
    return refused[0]

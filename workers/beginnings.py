"""What the training of a network begins with: weights of its own, or those of the round before."""

from dataclasses import asdict, dataclass
from uuid import UUID

import torch

from models.checkpoints import CheckpointError
from models.families import Family, family_named
from models.network import Network
from models.training import TrainingConfig
from service import events, projects
from service.errors import NoModelFamily
from service.log import get_logger
from service.store.errors import CorruptBlob, MissingBlob
from service.store.queries import rounds as queries
from service.store.tables import ModelVersionRow, ProjectRow, RoundRow
from workers import data
from workers.evaluation import load_network
from workers.job import RunningJob

log = get_logger("worker")


@dataclass(frozen=True)
class Beginning:
    """A network, its schedule, and the model version whose weights it goes on from, if any."""

    network: Network
    config: TrainingConfig
    parent: UUID | None = None


def family_of(project: ProjectRow) -> Family:
    """The project's model family in its preset. Raises NoModelFamily."""
    if project.family is None:
        raise NoModelFamily(project.id)
    return family_named(project.family, project.preset)


def beginning(
    job: RunningJob,
    project: ProjectRow,
    row: RoundRow | None,
    kind: str,
    member: int,
    segments: int,
    generator: torch.Generator,
) -> Beginning:
    """Of a network of a round, or of none, on that many segments; the generator draws its weights.

    It goes on from those of the round before where the family has a schedule that does, and their config is what the
    preset says now: else from scratch, and an event tells why.
    """
    family, network_kind = family_of(project), "world_model" if kind == "ensemble" else kind
    fresh = family.build(network_kind, data.model_spaces(projects.spaces_of(project)), {}, generator)
    further = family.further_config(network_kind, segments)
    before = _before(job, project, row, kind, member) if further is not None else None
    if further is not None and before is not None:
        network = _network_of(job, project, before, fresh)
        if network is not None:
            return Beginning(network, further, before.id)
    return Beginning(fresh, family.training_config(network_kind, segments))


def _before(
    job: RunningJob, project: ProjectRow, row: RoundRow | None, kind: str, member: int
) -> ModelVersionRow | None:
    with job.worker.database.read() as session:
        if row is None:
            return queries.newest_model(session, project.id, kind)
        return queries.model_before(session, row, kind, member)


def _network_of(job: RunningJob, project: ProjectRow, before: ModelVersionRow, fresh: Network) -> Network | None:
    """None where the weights cannot be gone on from: they are of another preset, or of no use at all."""
    try:
        network = load_network(job.worker.blobs, before, project)
    except (CheckpointError, CorruptBlob, MissingBlob) as error:
        _tell(job, before, str(error))
        return None
    if asdict(network.config) != asdict(fresh.config):
        _tell(job, before, f"Expected a checkpoint of {fresh.config}, found {network.config}.")
        return None
    return network


def _tell(job: RunningJob, before: ModelVersionRow, reason: str) -> None:
    """Training begins from scratch, although there are weights."""
    told: dict[str, object] = {"model": str(before.id), "kind": before.kind, "reason": reason}
    with job.transaction() as session:
        events.record(session, before.project_id, "training.from_scratch", told, job.now())
    log.warning("training_from_scratch", **told)

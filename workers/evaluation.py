"""Model error of a round on the project's labeled held-out segments."""

from collections.abc import Callable
from dataclasses import asdict

from api_schemas.rounds import GroupError, ModelError
from models import checkpoints
from models.evaluation import GroupError as GroupFigures
from models.evaluation import evaluate
from models.network import Network
from models.segments import SegmentBatch
from service import projects
from service.store.blobs import Blobs
from service.store.tables import ModelVersionRow, ProjectRow
from workers import data


def model_error(
    blobs: Blobs,
    project: ProjectRow,
    world_model: ModelVersionRow,
    inverse_dynamics: ModelVersionRow,
    held_out: SegmentBatch | None,
    after_each: Callable[[], None] = lambda: None,
) -> ModelError:
    """Figures are None where the held-out set is empty. after_each: called after each chunk; may raise to stop."""
    if held_out is None:
        return ModelError(transitions=0, loss=None, dynamics_accuracy=None, inverse_accuracy=None)
    groups = data.groups(projects.spaces_of(project).actions)
    figures = evaluate(
        load_network(blobs, world_model, project),  # type: ignore[arg-type]  # the checkpoint's kind was checked
        held_out,
        {name: set(members) for name, members in groups.items()},
        load_network(blobs, inverse_dynamics, project),  # type: ignore[arg-type]  # the checkpoint's kind was checked
        after_each=after_each,
    )
    overall = _group(figures.overall).model_dump() | {"loss": figures.loss}
    by_group = {name: _group(group) for name, group in figures.groups.items()}
    open_loop = [asdict(each) for each in figures.open_loop]
    return ModelError.model_validate({**overall, "by_group": by_group, "open_loop": open_loop})


def load_network(blobs: Blobs, row: ModelVersionRow, project: ProjectRow) -> Network:
    """A registered network, checked against its kind and the project's family. Raises CheckpointError."""
    kind = "world_model" if row.kind == "ensemble" else row.kind
    return checkpoints.load(blobs.get("weights", row.sha256), expect_kind=kind, expect_family=project.family)


def _group(figures: GroupFigures) -> GroupError:
    return GroupError(
        transitions=figures.transitions,
        loss=figures.next_state_loss,
        exact_accuracy=figures.exact_accuracy,
        dynamics_accuracy=figures.dynamics_accuracy,
        inverse_accuracy=figures.inverse_accuracy,
    )

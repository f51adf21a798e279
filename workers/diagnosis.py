"""The diagnostics of a round, stored once after its evaluation. They read labels, held-out ones too; nothing trains."""

import time
from collections.abc import Sequence
from dataclasses import asdict

import torch
from sqlalchemy.orm import Session

from api_schemas.environments import Actions, DiscreteActions
from api_schemas.rounds import Diagnostics
from models.chance import training_generator
from models.diagnostic_warnings import warnings
from models.diagnostics import Diagnostics as Figures
from models.diagnostics import diagnose
from models.segments import SegmentBatch
from service import projects, registry, rounds
from service.store.queries import pool as pool_queries
from service.store.tables import ProjectRow, RoundRow
from workers import data
from workers.evaluation import load_network
from workers.job import RunningJob

PROGRESS = 0.97  # of the round's job: all that is left is to ask for the scoring
SAMPLE = 2000  # pool segments, if they fit: a share of a half is known to 1.1 % then (one standard error)
SAMPLE_BYTES = 2**28


def diagnose_round(job: RunningJob, project: ProjectRow, row: RoundRow, labeled: SegmentBatch) -> None:
    """Diagnose a round that has its models, unless an earlier attempt did. `labeled`: what they trained on."""
    actions = projects.spaces_of(project).actions
    with job.worker.database.read() as session:
        if rounds.find(session, row.id).diagnostics is not None:
            return
        (world_model,) = registry.of_round(session, row.id, "world_model")
        (inverse,) = registry.of_round(session, row.id, "inverse_dynamics")
        windows = _sampled(session, project, labeled, training_generator(project.seed, row.number, "diagnostics"))
    started = time.monotonic()
    job.report(PROGRESS, f"round {row.number}: diagnostics")
    worker, length = job.worker, project.segment_length
    figures = diagnose(
        load_network(worker.blobs, world_model, project),  # type: ignore[arg-type]  # the checkpoint's kind was checked
        load_network(worker.blobs, inverse, project),  # type: ignore[arg-type]  # the checkpoint's kind was checked
        labeled,
        data.load(worker.blobs, windows, length, job.go_on) if windows else None,
        data.labeled_batch(worker.database, worker.blobs, project, "held_out", row.watermark, job.go_on),
        {name: set(members) for name, members in data.groups(actions).items()},
        job.go_on,
    )
    with job.transaction() as session:
        rounds.record_diagnostics(session, row.id, _described(figures, actions), job.now())
        rounds.stage_done(session, row.id, "diagnostics", time.monotonic() - started)


def _described(figures: Figures, actions: Actions) -> Diagnostics:
    """As the API shows them."""
    given = actions.names if isinstance(actions, DiscreteActions) else ()
    names = [given[i] if i < len(given) else f"action {i}" for i in range(len(figures.actions))]
    known = [
        {**asdict(each), "action": i, "name": name}
        for i, (each, name) in enumerate(zip(figures.actions, names, strict=True))
    ]
    return Diagnostics.model_validate({**asdict(figures), "actions": known, "warnings": warnings(figures, names)})


def _sampled(
    session: Session, project: ProjectRow, labeled: SegmentBatch, generator: torch.Generator
) -> list[data.Windows]:
    """Unlabeled segments of the pool by chance, all where there are no more than SAMPLE."""
    members = pool_queries.members(session, project.id, "pool")
    ends = torch.tensor([0, *(member.segments for member in members)]).cumsum(0)
    first = {member.trajectory_id: int(end) for member, end in zip(members, ends[:-1], strict=True)}
    taken = [first[name] + start // project.stride for name, start in labeled.segments]
    places = draw_places(int(ends[-1]), taken, data.fitting(project, SAMPLE, SAMPLE_BYTES), generator)
    starts: dict[str, list[int]] = {}
    for place, number in zip(places, torch.searchsorted(ends, torch.tensor(places), right=True).tolist(), strict=True):
        name = members[number - 1].trajectory_id
        starts.setdefault(name, []).append((place - first[name]) * project.stride)
    contents = pool_queries.contents(session, list(starts))
    return [data.Windows(name, contents[name].blob_sha256, tuple(chosen)) for name, chosen in starts.items()]


def draw_places(total: int, labeled: Sequence[int], count: int, generator: torch.Generator) -> list[int]:
    """At most `count` of the places 0 .. total - 1 that are not `labeled`, without repetition, in order.

    The free places are cut into `count` runs of equal length, give or take one, and one of each is drawn uniformly:
    costs neither a permutation of a large pool nor a draw for what is thrown away.
    """
    taken = torch.tensor(sorted(labeled), dtype=torch.int64)
    free = total - len(taken)
    edges = torch.arange(min(count, free) + 1) * free // max(1, min(count, free))
    draws = torch.rand(len(edges) - 1, generator=generator, dtype=torch.float64)
    ranks = edges[:-1] + (draws * edges.diff()).long()  # among the free ones
    before = torch.searchsorted(taken - torch.arange(len(taken)), ranks, right=True)
    places: list[int] = (ranks + before).tolist()
    return places

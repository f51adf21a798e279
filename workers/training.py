"""Rounds: train, evaluate, diagnose, ask for scoring. Each stage is stored before the next; no stored one is redone."""

import time
from collections.abc import Sequence
from dataclasses import dataclass

from api_schemas.jobs import TrainRound, TrainSubgoalGenerator
from models import checkpoints
from models.chance import training_generator
from models.network import SemiSupervised
from models.segments import SegmentBatch
from models.training import TrainingState
from service import jobs, projects, registry, rounds, scorings
from service.errors import NothingToLearn
from service.registry import TrainedModel
from service.store.queries import acquisitions as scoring_queries
from service.store.queries import pool as pool_queries
from service.store.queries import rounds as round_queries
from service.store.tables import ProjectRow, RoundRow
from workers import data
from workers.beginnings import Beginning, beginning
from workers.diagnosis import diagnose_round
from workers.evaluation import model_error
from workers.job import RunningJob
from workers.stage import Stage
from workers.training_errors import explained

ENSEMBLE_MEMBERS = 3
BASE = frozenset({"inverse_dynamics", "world_model"})  # every round has these; model error is theirs
ORDER = (
    "inverse_dynamics",
    "dense_inverse_dynamics",
    "masked_inverse_dynamics",
    "world_model",
    "ensemble",
    "subgoal_generator",
)
ACTION_FREE_SEGMENTS = 50_000  # a larger pool is thinned out evenly


@dataclass(frozen=True)
class Plan:
    """What a round trains on, and which networks. memberships: of the pool up to this id; None: all."""

    project: ProjectRow
    round: RoundRow
    strategy: str
    stages: tuple[tuple[str, int], ...]
    memberships: int | None


def run_round(job: RunningJob, payload: TrainRound) -> dict[str, object]:
    """Bring a round to where its scoring begins. May run twice, and after a crash at any line."""
    plan = _plan(job, payload)
    if plan.round.status in ("superseded", "failed", "cancelled"):
        return {"round": str(plan.round.id), "status": plan.round.status}
    with job.transaction() as session:
        rounds.begin_training(session, plan.round.id, job.now())
    labeled = _labels(job, plan, "pool")
    if labeled is None:
        raise NothingToLearn(plan.project.id)
    for number, (kind, member) in enumerate(plan.stages):
        if kind == "subgoal_generator":
            _subgoal_stage(job, plan)
        else:
            _train_stage(job, plan, kind, member, labeled, number)
    _evaluate_stage(job, plan)
    diagnose_round(job, plan.project, plan.round, labeled)
    return _request_scoring(job, plan)


def run_subgoal_generator(job: RunningJob, payload: TrainSubgoalGenerator) -> dict[str, object]:
    """Train the subgoal generator on the pool's observations, giving way to any other work.

    The pool is the one that there was when the job was queued, by the members' ids and not by the clocks of several
    machines: a job that resumes goes on with the same segments.
    """
    with job.worker.database.read() as session:
        project = projects.find(session, payload.project)
        members = pool_queries.memberships(session, project.id, "pool", last=payload.memberships)
        trained = round_queries.newest_model(session, project.id, "subgoal_generator")
        if trained is not None and trained.watermark >= len(members):  # an attempt ended before its job was done
            return {"model": str(trained.id)}
        windows = data.windows_of(session, project, members, None)
    stage = Stage(job, "subgoal_generator", None)
    model = _trained_subgoal_generator(job, project, windows, stage)
    with stage.finished() as session:
        row = registry.register(session, project.id, None, model, len(members), job.now())
    return {"model": str(row.id), "trajectories": len(members)}


def _trained_subgoal_generator(
    job: RunningJob, project: ProjectRow, windows: Sequence[data.Windows], stage: Stage
) -> TrainedModel:
    batch = _action_free(job, project, windows)
    generator = training_generator(project.seed, 0, "subgoal_generator")
    begun = beginning(job, project, None, "subgoal_generator", 0, batch.size, generator)

    def tell(step: int, steps: int, loss: float) -> None:
        job.report(step / steps, f"subgoal generator, step {step} of {steps}, loss {loss:.3f}")

    with explained(project, "subgoal generator"):
        state = stage.train(begun.network, batch, begun.config, generator, tell)
    return _trained(job, "subgoal_generator", 0, begun, state)


def _action_free(job: RunningJob, project: ProjectRow, windows: Sequence[data.Windows]) -> SegmentBatch:
    """The pool's segments without labels, evenly thinned out to what fits."""
    thinned = data.thinned(project, windows, ACTION_FREE_SEGMENTS, job.worker.settings.training_bytes)
    return data.load(job.worker.blobs, thinned, project.segment_length, job.go_on)


def _subgoal_stage(job: RunningJob, plan: Plan) -> None:
    """The round's subgoal generator: the project's newest, noted as the round's own so that its scores keep to it.

    Where there is none yet it is trained here, on the pool as it is.
    """
    started = time.monotonic()
    with job.worker.database.read() as session:
        if registry.of_round(session, plan.round.id, "subgoal_generator"):
            return
        newest = round_queries.newest_model(session, plan.project.id, "subgoal_generator")
        members = [] if newest else pool_queries.memberships(session, plan.project.id, "pool")
        windows = data.windows_of(session, plan.project, members, None)
    stage = Stage(job, "subgoal_generator", plan.round.id)
    model = registry.trained(newest) if newest else _trained_subgoal_generator(job, plan.project, windows, stage)
    watermark = newest.watermark if newest else len(members)
    with stage.finished() as session:
        registry.register(session, plan.project.id, plan.round.id, model, watermark, job.now())
        jobs.made_progress(session, job.lease)
        rounds.stage_done(session, plan.round.id, "subgoal_generator", time.monotonic() - started)


def _plan(job: RunningJob, payload: TrainRound) -> Plan:
    kinds = BASE | scorings.NEEDS[payload.strategy]
    members = {"ensemble": ENSEMBLE_MEMBERS}
    stages = tuple((kind, member) for kind in ORDER if kind in kinds for member in range(members.get(kind, 1)))
    with job.worker.database.read() as session:
        round_row = rounds.find(session, payload.round)
        project = projects.find(session, round_row.project_id)
        return Plan(project, round_row, payload.strategy, stages, payload.memberships)


def _labels(job: RunningJob, plan: Plan, split: str) -> SegmentBatch | None:
    worker = job.worker
    return data.labeled_batch(worker.database, worker.blobs, plan.project, split, plan.round.watermark, job.go_on)


def _train_stage(job: RunningJob, plan: Plan, kind: str, member: int, labeled: SegmentBatch, number: int) -> None:
    """Train one network and register it, unless an earlier attempt did."""
    with job.worker.database.read() as session:
        if any(row.member == member for row in registry.of_round(session, plan.round.id, kind)):
            return
    started = time.monotonic()
    generator = training_generator(plan.project.seed, plan.round.number, kind, member)
    begun = beginning(job, plan.project, plan.round, kind, member, labeled.size, generator)
    beside = _pool(job, plan) if isinstance(begun.network, SemiSupervised) else None

    def tell(step: int, steps: int, loss: float) -> None:
        share = (number + step / steps) / (len(plan.stages) + 1)
        job.report(share, f"round {plan.round.number}: {kind}, step {step} of {steps}, loss {loss:.3f}")

    name = f"{kind}-{member}" if kind == "ensemble" else kind
    stage = Stage(job, name, plan.round.id)
    with explained(plan.project, f"round {plan.round.number}, {name}"):
        state = stage.train(begun.network, labeled, begun.config, generator, tell, beside)
    trained = _trained(job, kind, member, begun, state)
    with stage.finished() as session:
        registry.register(session, plan.project.id, plan.round.id, trained, plan.round.watermark, job.now())
        jobs.made_progress(session, job.lease)
        rounds.stage_done(session, plan.round.id, name, time.monotonic() - started)


def _pool(job: RunningJob, plan: Plan) -> SegmentBatch:
    """What a network learns from that reads action-free segments beside the labels."""
    with job.worker.database.read() as session:
        members = pool_queries.memberships(session, plan.project.id, "pool", last=plan.memberships)
        windows = data.windows_of(session, plan.project, members, None)
    return _action_free(job, plan.project, windows)


def _evaluate_stage(job: RunningJob, plan: Plan) -> None:
    """Model error on the labeled held-out segments, unless an earlier attempt stored it."""
    with job.worker.database.read() as session:
        if rounds.find(session, plan.round.id).model_error is not None:
            return
        (world_model,) = registry.of_round(session, plan.round.id, "world_model")
        (inverse,) = registry.of_round(session, plan.round.id, "inverse_dynamics")
    started = time.monotonic()
    job.report(len(plan.stages) / (len(plan.stages) + 1), f"round {plan.round.number}: evaluation")
    held_out = _labels(job, plan, "held_out")
    error = model_error(job.worker.blobs, plan.project, world_model, inverse, held_out, job.go_on)
    with job.transaction() as session:
        rounds.record_error(session, plan.round.id, error, job.now())
        rounds.stage_done(session, plan.round.id, "evaluation", time.monotonic() - started)


def _request_scoring(job: RunningJob, plan: Plan) -> dict[str, object]:
    """A strategy that needs models is scored under this round's; the others have nothing to wait for."""
    limits = scorings.limits_of(job.worker.settings)
    with job.transaction() as session:
        project = projects.find(session, plan.project.id, lock=True)  # the project always comes before its round
        rounds.begin_scoring(session, plan.round.id, job.now())
        round_row = rounds.find(session, plan.round.id, lock=True)
        if round_row.status not in ("scoring", "current"):  # it ended while this job was at work
            return {"round": str(round_row.id), "status": round_row.status}
        if not scorings.NEEDS[plan.strategy]:
            rounds.make_current(session, plan.round.id, job.now())
        elif scoring_queries.newest_scoring(session, plan.project.id, plan.strategy, plan.round.id) is None:
            scorings.start(session, project, plan.strategy, round_row, job.now(), limits)
        models = round_queries.models_of(session, plan.round.id)
    return {"round": str(plan.round.id), "models": len(models)}


def _trained(job: RunningJob, kind: str, member: int, begun: Beginning, state: TrainingState) -> TrainedModel:
    metrics, blob = {"loss": sum(state.recent) / len(state.recent)}, checkpoints.save(begun.network)
    description = checkpoints.describe(blob)
    sha256 = job.worker.blobs.put("weights", blob)
    fields = (kind, member, description["family"], description["config"], sha256, len(blob), metrics)
    return TrainedModel(*fields, parent=begun.parent)

"""Proposals: explorations that a strategy chooses under the current round's models, kept ready in a queue of their own.

They come of a scoring in mode `explore`: one job draws states of the pool, imagines futures there and queues what is
most worth executing. Each is given out once; when all are, the job runs again, draws other states and leaves out what
was given out under the round's models, or came back labeled under any.
"""

from collections.abc import Sequence
from datetime import datetime
from uuid import UUID

from sqlalchemy.orm import Session

from api_schemas.jobs import ProposeExplorations, TrainRound
from api_schemas.strategies import CATALOG
from service import draws, jobs, projects, scorings
from service.errors import ServiceError
from service.scorings import NEEDS, PREVIOUS, Limits
from service.store.queries import acquisitions as queries
from service.store.queries import jobs as job_queries
from service.store.queries import rounds as round_queries
from service.store.tables import JobRow, ModelVersionRow, ProjectRow, QueueRow, RoundRow, ScoringRow

EXPLORING = frozenset(strategy.name for strategy in CATALOG if strategy.explores)
GENERATOR = "subgoal_generator"


class NothingToExplore(ServiceError):
    """The pool holds no state to explore from."""

    status_code = 409

    def __init__(self, project: UUID, simulator: str | None) -> None:
        missing = "trajectory" if simulator is None else f"trajectory whose states in {simulator} are kept"
        super().__init__(f"mode: project {project} has no {missing} in its pool that an exploration could start from")


class AllExplored(ServiceError):
    """What a strategy can propose under a round's models has all been given out."""

    status_code = 409

    def __init__(self, project: UUID, strategy: str, round_number: int) -> None:
        super().__init__(
            f"mode: all that {strategy} finds to explore in the pool of project {project} under the models of round "
            f"{round_number} has been given out; more comes with the next round or with more trajectories"
        )


def proposing(session: Session, project: ProjectRow, strategy: str) -> RoundRow | None:
    """The round under whose models the strategy proposes; None where there is only chance.

    That is so for a strategy that does not explore, before the first round, and until a subgoal generator is trained.
    """
    current = round_queries.current_round(session, project.id) if strategy in EXPLORING else None
    return current if current is not None and generator_of(session, current) is not None else None


def generator_of(session: Session, round_row: RoundRow) -> ModelVersionRow | None:
    """The subgoal generator that proposes in a round: its own where its strategy has one, else the project's newest."""
    own = (model for model in round_queries.models_of(session, round_row.id) if model.kind == GENERATOR)
    return next(own, None) or round_queries.newest_model(session, round_row.project_id, GENERATOR)


def take(
    session: Session, project: ProjectRow, strategy: str, round_row: RoundRow, count: int, now: datetime, limits: Limits
) -> tuple[ScoringRow, Sequence[QueueRow]] | JobRow:
    """The best `count` proposals, or as many as are left, which are then nobody else's; or the job that makes some.

    Call it under the project's lock. Raises NothingToExplore where no state of the pool can be gone back to,
    AllExplored where all that can be proposed has been given out.
    """
    scoring = queries.newest_scoring(session, project.id, strategy, round_row.id, mode="explore")
    if scoring is None:
        return _request(session, project, strategy, round_row, count, now, limits)
    scoring = scorings.find(session, scoring.id, lock=True)  # no job replaces the queue between reading and dropping
    found = queries.explorations(session, scoring, count) if scoring.status == "ready" else []
    if not found:
        return _propose(session, project, scoring, round_row, count, now, limits)
    queries.drop_explorations(session, project.id, [(row.trajectory_id, row.start) for row in found])
    return scoring, found


def _request(
    session: Session, project: ProjectRow, strategy: str, round_row: RoundRow, count: int, now: datetime, limits: Limits
) -> JobRow:
    """The first proposals of a round; networks that only this strategy needs are trained before."""
    have = {model.kind for model in round_queries.models_of(session, round_row.id)}
    if not NEEDS[strategy] - {PREVIOUS, GENERATOR} <= have:
        waiting = job_queries.unfinished(session, round_row.id)
        training = TrainRound.model_validate({"round": round_row.id, "strategy": strategy})
        return waiting or jobs.enqueue(session, project.id, training, round_row.id, now, limits.max_attempts)
    scoring = ScoringRow(
        project_id=project.id,
        round_id=round_row.id,
        mode="explore",
        strategy=strategy,
        status="scoring",
        memberships=draws.newest_explorable(session, project),
        shards=0,
        created_at=now,
    )
    session.add(scoring)
    session.flush()
    scorings.tell(session, scoring, "started", now)
    return _propose(session, project, scoring, round_row, count, now, limits)


def _propose(
    session: Session,
    project: ProjectRow,
    scoring: ScoringRow,
    round_row: RoundRow,
    count: int,
    now: datetime,
    limits: Limits,
) -> JobRow:
    waiting = job_queries.unfinished(session, scoring.id)
    if waiting is not None:
        return waiting
    newest = draws.newest_explorable(session, project)
    if not newest:
        raise NothingToExplore(project.id, projects.environment_of(project).simulator)
    last = job_queries.newest(session, scoring.id)
    if last is not None and last.result.get("exhausted") and newest == scoring.memberships:
        raise AllExplored(project.id, scoring.strategy, round_row.number)
    scoring.memberships = newest  # the pool that the job draws from, however often it runs
    payload = ProposeExplorations(scoring=scoring.id, length=max(limits.queue_length, count))
    return jobs.enqueue(session, project.id, payload, scoring.id, now, limits.max_attempts)

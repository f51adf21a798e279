"""A labeling policy names its batch rule, where it said only whether batches are diverse.

Revision ID: 0005
Revises: 0004
"""

import json
from typing import Any

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None

OLDER = ("random", "cycle", "vanilla_cycle", "uncertainty")  # strategies before there were batch rules
INSTEAD = "cycle"
ENDED = "ended by a downgrade of the service, which cannot read its networks: start another round"
PROJECT = sa.table(
    "project", sa.column("id", sa.Uuid()), sa.column("policy", sa.JSON()), sa.column("labels_at_round", sa.Integer())
)
ROUND = sa.table(
    "round", sa.column("id", sa.Uuid()), sa.column("project_id", sa.Uuid()), sa.column("status"), sa.column("error")
)
MODEL = sa.table("model_version", sa.column("round_id", sa.Uuid()), sa.column("kind"), sa.column("config", sa.JSON()))
SCORING = sa.table(
    "scoring", sa.column("id", sa.Uuid()), sa.column("round_id", sa.Uuid()), sa.column("strategy", sa.String())
)
PARTS = [sa.table(name, sa.column("scoring_id", sa.Uuid())) for name in ("queue", "shard")]
JOB = sa.table(
    "job",
    sa.column("id", sa.Uuid()),
    sa.column("kind"),
    sa.column("state"),
    sa.column("subject_id", sa.Uuid()),
    sa.column("payload", sa.JSON()),
)
ANSWER = sa.table("idempotency", *map(sa.column, ("caller", "route", "key", "body")))


def upgrade() -> None:
    for project, policy in _policies():
        if "diversify" in policy:
            diverse = policy.pop("diversify")
            _write(project, policy | {"batch_rule": "kmeans_plus_plus" if diverse else "top"})


def downgrade() -> None:
    """Where a strategy is named that older services do not know, `cycle` takes its place; what it ranked goes.

    So does what came of networks that they cannot read: rounds that trained such ones end, and their labels are due for
    another. Weights stay in the blob store.
    """
    _end_newer_rounds()
    _forget_scorings(SCORING.c.strategy.not_in(OLDER))
    _execute(sa.delete(MODEL).where(MODEL.c.kind == "masked_inverse_dynamics"))
    _execute(sa.delete(MODEL).where(MODEL.c.kind == "subgoal_generator", MODEL.c.round_id.is_not(None)))
    for name in ("strategy", "requested_strategy"):
        op.execute(f"UPDATE acquisition SET {name} = '{INSTEAD}' WHERE {name} NOT IN {OLDER}")  # noqa: S608  # our names
    _rewrite_policies()
    _rewrite_jobs()
    _rewrite_answers()


def _end_newer_rounds() -> None:
    """Those with inverse dynamics that hides channels in training, which none did before."""
    models = _execute(sa.select(MODEL.c.round_id, MODEL.c.config).where(MODEL.c.kind == "inverse_dynamics")).all()
    newer = [round_id for round_id, config in models if round_id is not None and "dropout" in config]
    for i in range(0, len(newer), 500):
        rounds = newer[i : i + 500]
        current = sa.and_(ROUND.c.id.in_(rounds), ROUND.c.status == "current")
        unfinished = sa.and_(ROUND.c.id.in_(rounds), ROUND.c.status.in_(("queued", "training", "scoring")))
        due = sa.select(ROUND.c.project_id).where(sa.or_(current, unfinished))
        _execute(sa.update(PROJECT).where(PROJECT.c.id.in_(due)).values(labels_at_round=0))
        _execute(sa.update(ROUND).where(unfinished).values(status="failed", error=ENDED))
        _execute(sa.update(ROUND).where(current).values(status="superseded"))
        _execute(sa.delete(JOB).where(JOB.c.subject_id.in_(rounds), JOB.c.state.in_(("queued", "running"))))
        _forget_scorings(SCORING.c.round_id.in_(rounds))


def _forget_scorings(where: sa.ColumnElement[bool]) -> None:
    """With their queues, and with the jobs that are to do or have done something for them."""
    gone = sa.select(SCORING.c.id).where(where)
    _execute(sa.delete(JOB).where(JOB.c.subject_id.in_(gone)))
    for table in PARTS:
        _execute(sa.delete(table).where(table.c.scoring_id.in_(gone)))
    _execute(sa.delete(SCORING).where(where))


def _rewrite_policies() -> None:
    for project, policy in _policies():
        if "batch_rule" in policy:
            rule = policy.pop("batch_rule")
            _write(project, policy | {"diversify": rule != "top", "strategy": _older(policy["strategy"])})


def _rewrite_jobs() -> None:
    for job, payload in _execute(sa.select(JOB.c.id, JOB.c.payload).where(JOB.c.kind == "train_round")).all():
        older = payload | {"strategy": _older(payload["strategy"])}
        _execute(sa.update(JOB).where(JOB.c.id == job).values(payload=older))


def _rewrite_answers() -> None:
    """Kept answers to POST /acquire are sent again as they stand."""
    answers = _execute(sa.select(ANSWER).where(ANSWER.c.route == "POST /acquire", ANSWER.c.body.is_not(None))).all()
    for caller, route, key, body in answers:
        answer = json.loads(body)
        named = {name: _older(answer[name]) for name in ("strategy", "requested_strategy") if name in answer}
        this = (ANSWER.c.caller == caller, ANSWER.c.route == route, ANSWER.c.key == key)
        _execute(sa.update(ANSWER).where(*this).values(body=json.dumps(answer | named)))


def _execute(statement: sa.Executable) -> Any:
    """The rows found, if any; whoever asks knows their columns."""
    return op.get_bind().execute(statement)


def _older(strategy: str) -> str:
    return strategy if strategy in OLDER else INSTEAD


def _policies() -> list[tuple[Any, dict[str, Any]]]:
    rows = op.get_bind().execute(sa.select(PROJECT.c.id, PROJECT.c.policy)).all()
    return [(project, dict(policy)) for project, policy in rows]


def _write(project: Any, policy: dict[str, Any]) -> None:
    op.get_bind().execute(sa.update(PROJECT).where(PROJECT.c.id == project).values(policy=policy))

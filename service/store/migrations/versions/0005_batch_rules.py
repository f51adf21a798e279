"""A labeling policy names its batch rule, where it said only whether batches are diverse.

Revision ID: 0005
Revises: 0004
"""

import json
from typing import Any

import sqlalchemy as sa
from alembic import op

from service.store.migrations.rounds import MODEL, SCORING, end_rounds, execute, forget_scorings

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None

OLDER = ("random", "cycle", "vanilla_cycle", "uncertainty")  # strategies before there were batch rules
INSTEAD = "cycle"
PROJECT = sa.table(
    "project", sa.column("id", sa.Uuid()), sa.column("policy", sa.JSON()), sa.column("labels_at_round", sa.Integer())
)
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
    # Inverse dynamics hides channels in training, which none did before.
    end_rounds("inverse_dynamics", lambda config: "dropout" in config, "a downgrade")
    forget_scorings(SCORING.c.strategy.not_in(OLDER))
    execute(sa.delete(MODEL).where(MODEL.c.kind == "masked_inverse_dynamics"))
    execute(sa.delete(MODEL).where(MODEL.c.kind == "subgoal_generator", MODEL.c.round_id.is_not(None)))
    for name in ("strategy", "requested_strategy"):
        op.execute(f"UPDATE acquisition SET {name} = '{INSTEAD}' WHERE {name} NOT IN {OLDER}")  # noqa: S608  # our names
    _rewrite_policies()
    _rewrite_jobs()
    _rewrite_answers()


def _rewrite_policies() -> None:
    for project, policy in _policies():
        if "batch_rule" in policy:
            rule = policy.pop("batch_rule")
            _write(project, policy | {"diversify": rule != "top", "strategy": _older(policy["strategy"])})


def _rewrite_jobs() -> None:
    for job, payload in execute(sa.select(JOB.c.id, JOB.c.payload).where(JOB.c.kind == "train_round")).all():
        older = payload | {"strategy": _older(payload["strategy"])}
        execute(sa.update(JOB).where(JOB.c.id == job).values(payload=older))


def _rewrite_answers() -> None:
    """Kept answers to POST /acquire are sent again as they stand."""
    answers = execute(sa.select(ANSWER).where(ANSWER.c.route == "POST /acquire", ANSWER.c.body.is_not(None))).all()
    for caller, route, key, body in answers:
        answer = json.loads(body)
        named = {name: _older(answer[name]) for name in ("strategy", "requested_strategy") if name in answer}
        this = (ANSWER.c.caller == caller, ANSWER.c.route == route, ANSWER.c.key == key)
        execute(sa.update(ANSWER).where(*this).values(body=json.dumps(answer | named)))


def _older(strategy: str) -> str:
    return strategy if strategy in OLDER else INSTEAD


def _policies() -> list[tuple[Any, dict[str, Any]]]:
    rows = op.get_bind().execute(sa.select(PROJECT.c.id, PROJECT.c.policy)).all()
    return [(project, dict(policy)) for project, policy in rows]


def _write(project: Any, policy: dict[str, Any]) -> None:
    op.get_bind().execute(sa.update(PROJECT).where(PROJECT.c.id == project).values(policy=policy))

"""A database as the first schema left it: two projects with members in both splits, labels, leases, a round, and jobs;
and one project with nothing. Written by reflection, for today's tables know columns that it had not."""

from datetime import UTC, datetime, timedelta
from typing import Any
from uuid import UUID

from sqlalchemy import Connection, MetaData, create_engine, pool

from api_schemas.environments import Environment

Json = dict[str, Any]
Rows = dict[str, list[Json]]
THEN = datetime(2025, 6, 1, tzinfo=UTC)
LATER = THEN + timedelta(days=3650)
FIRST, SECOND, EMPTY = (UUID(int=1000 * number) for number in (1, 2, 3))
NAMES = tuple(letter * 64 for letter in "abc")
POLICY: Json = {"strategy": "cycle", "round_labels": 0, "label_budget": 10, "lease_seconds": 3600.0}
# project: by trajectory its split, its segments, and the starts that are labeled
MEMBERS: dict[UUID, dict[str, tuple[str, int, list[int]]]] = {
    FIRST: {"a": ("pool", 5, [0, 3]), "b": ("pool", 7, []), "c": ("held_out", 4, [2])},
    SECOND: {"a": ("held_out", 3, [0]), "b": ("pool", 9, [8]), "c": ("held_out", 2, [1])},
    EMPTY: {},
}


def first_rows() -> Rows:
    """All rows by table; what may be absent is left out in places, and None nowhere."""
    rows: Rows = {
        "api_key": [{"id": UUID(int=1), "name": "ada", "secret_sha256": "0" * 64, "scopes": ["read"]} | _at()],
        "worker": [{"owner": "host:1:a", "queues": ["train", "score"], "heartbeat_at": THEN}],
        "trajectory": [
            {"id": name, "blob_sha256": name, "transitions": 9, "streams": {"grid": {}}, "bytes": 10} | _at()
            for name in NAMES
        ],
    }
    for number, project in enumerate(MEMBERS):
        for table, added in (_of_project(project, number) if MEMBERS[project] else _project(project, number)).items():
            rows[table] = rows.get(table, []) + added
    return rows


def fill(url: str) -> Rows:
    """Write the rows; returns them as `read` shows them."""
    with _connected(url) as connection:
        tables = _reflected(connection).sorted_tables
        rows = first_rows()
        assert {table.name for table in tables} == {*rows, "alembic_version"}
        for table in tables:
            for row in rows.get(table.name, []):
                assert set(row) <= set(table.columns.keys())
                connection.execute(table.insert().values(_stored(connection, row)))
        connection.commit()
    return read(url)


def read(url: str) -> Rows:
    """All rows of all tables but the version, in one form for both databases."""
    with _connected(url) as connection:
        tables = [table for table in _reflected(connection).sorted_tables if table.name != "alembic_version"]
        found = {table.name: [dict(row) for row in connection.execute(table.select()).mappings()] for table in tables}
    return {name: sorted((_shown(row) for row in rows), key=repr) for name, rows in found.items()}


def write(url: str, *statements: str) -> None:
    """Execute the statements."""
    with _connected(url) as connection:
        for statement in statements:
            connection.exec_driver_sql(statement)
        connection.commit()


def narrowed(rows: Rows, to: Rows) -> Rows:
    """The tables and columns of `to` alone."""
    columns = {name: set(kept[0]) for name, kept in to.items()}
    return {
        name: sorted(({key: row[key] for key in row if key in columns[name]} for row in rows[name]), key=repr)
        for name in to
    }


def _connected(url: str) -> Connection:
    return create_engine(url, poolclass=pool.NullPool).connect()


def _reflected(connection: Connection) -> MetaData:
    metadata = MetaData()
    metadata.reflect(connection)
    return metadata


def _stored(connection: Connection, row: Json) -> Json:
    if connection.dialect.name == "postgresql":
        return row
    return {name: value.hex if isinstance(value, UUID) else value for name, value in row.items()}


def _shown(row: Json) -> Json:
    """UUIDs as SQLite keeps them, times without their zone."""
    shown = {name: value.hex if isinstance(value, UUID) else value for name, value in row.items()}
    times = {name: value for name, value in shown.items() if isinstance(value, datetime)}
    naive = {
        name: value.astimezone(UTC).replace(tzinfo=None) if value.tzinfo else value for name, value in times.items()
    }
    return dict(sorted((shown | naive | _policy(row)).items()))


def _policy(row: Json) -> Json:
    """A labeling policy in the first schema's words: batches were diverse or not."""
    policy = dict(row.get("policy", {}))
    if "batch_rule" in policy:
        policy["diversify"] = policy.pop("batch_rule") != "top"
    return {"policy": dict(sorted(policy.items()))} if policy else {}


def _at(time: datetime = THEN) -> Json:
    return {"created_at": time}


def _project(project: UUID, number: int) -> Rows:
    environment = Environment(simulator="minigrid")
    labeled = [(split, start) for split, _, starts in MEMBERS[project].values() for start in starts]
    row: Json = {
        "id": project,
        "name": f"project {number}",
        "environment": environment.model_dump(mode="json"),
        "spaces": environment.resolved_spaces().model_dump(mode="json"),
        "family": "grid",
        "segment_length": 1,
        "stride": 1,
        "held_out_fraction": 0.1,
        "seed": number,
        "policy": POLICY | {"diversify": number == 0},
        "label_watermark": len(labeled),
        "labels_at_round": 1,
        "pool_labels": sum(split == "pool" for split, _ in labeled),
        "token": 2,
    }
    return {"project": [row | _at(THEN + timedelta(seconds=number))]}


def _of_project(project: UUID, number: int) -> Rows:
    """A project with everything. Its ids are the project's, and a little more."""
    own = {"project_id": project}
    leased, labeled, rounded, scored, worked = (UUID(int=project.int + more) for more in range(1, 6))
    segment = {"trajectory_id": NAMES[1], "start": 1}
    lease = {"purpose": "pool", "strategy": "random", "requested_strategy": "cycle", "labeler": "ada"}
    ends = {"lease_expires_at": LATER, "created_at": THEN}
    return _project(project, number) | {
        "membership": [
            own | {"trajectory_id": name * 64, "split": split, "segments": segments} | _at()
            for name, (split, segments, _) in MEMBERS[project].items()
        ],
        "label": _labels(project, labeled),
        "acquisition": [
            own | {"id": leased, "status": "leased", "token": 1} | lease | ends,
            own | {"id": labeled, "status": "labeled", "token": 2, "round_id": rounded} | lease | ends,
        ],
        "acquisition_item": [
            {"acquisition_id": leased, "rank": 0, "score": 0.5} | segment,
            {"acquisition_id": labeled, "rank": 0, "trajectory_id": NAMES[0], "start": 0},
        ],
        "claim": [own | segment | {"acquisition_id": leased, "purpose": "pool", "token": 1, "expires_at": LATER}],
        "round": [
            own
            | {"id": rounded, "number": 1, "watermark": 1, "labels": 1, "status": "current", "job_id": worked}
            | {"stages": [{"name": "world_model", "seconds": 1.5}], "finished_at": THEN}
            | _at()
        ],
        "model_version": [
            own
            | {"id": UUID(int=project.int + 9), "round_id": rounded, "kind": "world_model", "member": 0}
            | {"family": "grid", "config": {"width": 8}, "sha256": "d" * 64, "bytes": 4, "watermark": 1}
            | {"metrics": {"loss": 0.25}}
            | _at()
        ],
        "scoring": [
            own
            | {"id": scored, "round_id": rounded, "strategy": "cycle", "status": "ready"}
            | {"memberships": 3, "shards": 1, "selections": 1}
            | _at()
        ],
        "shard": [{"scoring_id": scored, "number": 0, "first": 1, "last": 3, "blob_sha256": "e" * 64}],
        "queue": [own | {"scoring_id": scored, "rank": 0, "score": 0.5} | segment],
        "job": [_job(project, worked, "done", rounded), _job(project, UUID(int=worked.int + 1), "queued", rounded)],
        "event": [own | {"kind": kind, "data": {"n": number}} | _at() for kind in ("project.created", "lease.given")],
    }


def _labels(project: UUID, acquisition: UUID) -> list[Json]:
    places = [(name, split, start) for name, (split, _, starts) in MEMBERS[project].items() for start in starts]
    return [
        {
            "id": UUID(int=project.int + 100 + mark),
            "project_id": project,
            "trajectory_id": name * 64,
            "start": start,
            "split": split,
            "actions": [mark],
            "content_sha256": "f" * 64,
            "source": {"kind": "import", "name": ""},
            "acquisition_id": acquisition,
            "watermark": mark,
            "created_at": THEN,
        }
        for mark, (name, split, start) in enumerate(places, 1)
    ]


def _job(project: UUID, name: UUID, state: str, subject: UUID) -> Json:
    payload = {"kind": "train_round", "round": str(subject), "strategy": "cycle"}
    return {
        "id": name,
        "project_id": project,
        "kind": "train_round",
        "queue": "train",
        "priority": 0,
        "payload": payload,
        "subject_id": subject,
        "state": state,
        "fence": 1,
        "attempts": 1,
        "max_attempts": 5,
        "progress": 0.5,
        "message": "",
        "result": {},
        "created_at": THEN,
    }

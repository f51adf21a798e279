"""Migrations since the third schema: what each adds, and what an older service finds after going back."""

import json
from uuid import UUID

import pytest
from sqlalchemy import select

from service.store.database import migrate, open_database
from service.store.tables import ProjectRow
from tests.service.first_schema import EMPTY, FIRST, SECOND, fill, narrowed, read, write
from tests.service.migrating import check_references, differences, downgrade, quoted, schema_of, version


def test_going_back_before_the_diagnostics_forgets_them_alone(url: str) -> None:
    migrate(url, "0001")
    fill(url)
    migrate(url, "0003")
    before, schema = read(url), schema_of(url)
    migrate(url, "0004")
    filled = {name: rows for name, rows in before.items() if rows}
    assert narrowed(read(url), filled) == filled
    write(url, """UPDATE round SET diagnostics = '{"sampled": 7}'""")
    assert [row["diagnostics"] for row in read(url)["round"]] == 2 * [{"sampled": 7}]
    downgrade(url, "0003")
    assert (version(url), schema_of(url), read(url)) == ("0003", schema, before)
    check_references(url)
    migrate(url)
    assert differences(url) == []


def test_going_back_before_explorations_forgets_what_was_only_proposed(url: str) -> None:
    migrate(url, "0001")
    fill(url)
    migrate(url, "0005")
    before, schema = read(url), schema_of(url)
    migrate(url, "0006")
    assert {row["mode"] for row in read(url)["scoring"]} == {"pool"}
    assert {row["actions"] for row in read(url)["queue"]} == {None}
    scored, proposed = (quoted(url, UUID(int=FIRST.int + more)) for more in (4, 40))
    columns = "project_id, round_id, strategy, status, memberships, shards, selections, created_at"
    places = "rank, project_id, trajectory_id, start, score"
    scoring = f"INSERT INTO scoring (id, mode, {columns}) SELECT '{proposed}', 'explore', {columns} FROM scoring"
    queue = f"INSERT INTO queue (scoring_id, actions, {places}) SELECT '{proposed}', '[6]', {places} FROM queue"
    write(
        url,
        f"{scoring} WHERE id = '{scored}'",
        f"{queue} WHERE scoring_id = '{scored}'",
        "UPDATE job SET kind = 'propose_explorations' WHERE state = 'queued'",
    )
    assert len(read(url)["queue"]) == len(before["queue"]) + 1
    downgrade(url, "0005")
    after = read(url)
    assert (version(url), schema_of(url)) == ("0005", schema)
    assert [row["kind"] for row in after.pop("job")] == ["train_round", "train_round"]  # those that were done
    assert after == {name: rows for name, rows in before.items() if name != "job"}
    check_references(url)
    migrate(url)
    assert differences(url) == []


def test_confidence_comes_and_goes_with_its_migration(url: str) -> None:
    migrate(url, "0001")
    fill(url)
    migrate(url, "0006")
    before, schema = read(url), schema_of(url)
    migrate(url, "0007")
    for table in ("queue", "acquisition_item"):
        assert {row["confidence"] for row in read(url)[table]} == {None}
        write(url, f"UPDATE {table} SET confidence = 0.5")
    downgrade(url, "0006")
    assert (version(url), schema_of(url), read(url)) == ("0006", schema, before)
    check_references(url)
    migrate(url)
    assert differences(url) == []


OLD_ERROR = {"transitions", "loss", "dynamics_accuracy", "inverse_accuracy", "by_group"}
"""What a service of the third schema knows of a model error; it refuses anything else."""


def test_going_back_to_the_third_schema_leaves_nothing_that_its_service_does_not_know(url: str) -> None:
    migrate(url, "0001")
    fill(url)
    migrate(url)
    group = {"transitions": 4, "loss": 0.5, "exact_accuracy": 0.25, "dynamics_accuracy": 0.5, "inverse_accuracy": None}
    error = json.dumps(group | {"by_group": {"movement": group, "interaction": group}})
    payload = json.dumps({"kind": "train_round", "round": str(UUID(int=FIRST.int + 3)), "strategy": "self_inverse"})
    scored = quoted(url, UUID(int=FIRST.int + 4))
    answer = {"strategy": "confident_cycle", "requested_strategy": "cycle", "items": [{"rank": 0, "confidence": 0.5}]}
    write(
        url,
        f"UPDATE round SET model_error = '{error}' WHERE project_id = '{quoted(url, FIRST)}'",
        f"UPDATE scoring SET strategy = 'confident_cycle' WHERE id = '{scored}'",
        f"UPDATE job SET payload = '{payload}' WHERE state = 'done'",
        f"UPDATE job SET subject_id = '{scored}', kind = 'select_queue' WHERE state = 'queued'",
        "UPDATE acquisition SET strategy = 'fidelity', requested_strategy = 'confident_cycle' WHERE status = 'labeled'",
        f"UPDATE model_version SET kind = 'masked_inverse_dynamics' WHERE project_id = '{quoted(url, FIRST)}'",
        "INSERT INTO idempotency (caller, route, key, request_sha256, status, body, expires_at) "
        f"VALUES ('local', 'POST /acquire', 'k', 'x', 201, '{json.dumps(answer)}', '2030-01-01 00:00:00')",
    )
    _set_policies(url, {"strategy": "confident_cycle", "batch_rule": "signatures"})
    downgrade(url, "0003")
    after = read(url)
    policies = [row["policy"] for row in after["project"]]
    assert [(each["strategy"], each["diversify"]) for each in policies] == 3 * [("cycle", True)]
    assert not any("batch_rule" in each for each in policies)
    assert {row["strategy"] for row in after["scoring"]} == {"cycle"}
    assert {row["project_id"] for row in after["queue"]} == {row["project_id"] for row in after["scoring"]}
    assert len(after["scoring"]) == len(after["shard"]) == len(after["queue"]) == 1  # the other project's
    assert {row["requested_strategy"] for row in after["acquisition"]} == {"cycle"}
    assert {row["strategy"] for row in after["acquisition"]} == {"random", "cycle"}
    assert [row["kind"] for row in after["model_version"]] == ["world_model"]  # the other project's
    assert {row["payload"]["strategy"] for row in after["job"]} == {"cycle"}
    assert {row["state"] for row in after["job"]} == {"done"}  # what was to select from the forgotten scores is gone
    known = [row["model_error"] for row in after["round"] if row["model_error"]]
    assert len(known) == 1
    assert set(known[0]) == OLD_ERROR
    assert all(set(each) == OLD_ERROR - {"by_group"} for each in known[0]["by_group"].values())
    assert known[0]["by_group"]["movement"]["loss"] == 0.5
    assert {row["status"] for row in after["round"]} == {"current"}  # their networks are old ones
    older = {"strategy": "cycle", "requested_strategy": "cycle", "items": [{"rank": 0}]}
    assert [json.loads(row["body"]) for row in after["idempotency"]] == [older]
    check_references(url)
    migrate(url)
    assert differences(url) == []


def test_going_back_ends_rounds_whose_networks_an_older_service_cannot_read(url: str) -> None:
    """One is current, the other has just trained its networks and waits for its scores."""
    migrate(url, "0001")
    before = fill(url)
    migrate(url)
    trained, waiting = (quoted(url, UUID(int=project.int + 3)) for project in (FIRST, SECOND))
    kept = "project_id, round_id, 1, family, config, sha256, bytes, watermark, metrics, created_at"
    columns = "project_id, round_id, member, family, config, sha256, bytes, watermark, metrics, created_at"
    copies = {
        "inverse_dynamics": kept.replace("config", """'{"hidden": 256, "dropout": 0.2}'"""),
        "subgoal_generator": kept,
    }
    names = {
        (kind, owner): quoted(url, UUID(int=20_000 + number))
        for number, (kind, owner) in enumerate((kind, owner) for kind in copies for owner in (trained, waiting))
    }
    write(
        url,
        *(
            f"INSERT INTO model_version (id, kind, {columns}) SELECT '{name}', '{kind}', {copies[kind]} "
            f"FROM model_version WHERE round_id = '{owner}' AND kind = 'world_model'"
            for (kind, owner), name in names.items()
        ),
        f"UPDATE round SET status = 'scoring' WHERE id = '{waiting}'",
    )
    downgrade(url, "0003")
    after = read(url)
    assert {row["id"]: row["status"] for row in after["round"]} == {
        UUID(int=FIRST.int + 3).hex: "superseded",
        UUID(int=SECOND.int + 3).hex: "failed",
    }
    assert all(row["error"].startswith("ended by a downgrade") for row in after["round"])
    assert (after["scoring"], after["queue"], after["shard"]) == ([], [], [])
    assert {row["labels_at_round"] for row in after["project"] if row["id"] != EMPTY.hex} == {0}
    assert {row["labels_at_round"] for row in after["project"] if row["id"] == EMPTY.hex} == {1}
    assert {row["kind"] for row in after["model_version"]} == {"world_model", "inverse_dynamics"}
    assert {row["state"] for row in after["job"]} == {"done", "cancelled"}
    assert after["label"] == narrowed(read(url), before)["label"] == before["label"]
    check_references(url)
    migrate(url)
    assert differences(url) == []


def _set_policies(url: str, changed: dict[str, str]) -> None:
    database = open_database(url)
    with database.write() as session:
        for row in session.scalars(select(ProjectRow)):
            row.policy = row.policy | changed
    database.close()


@pytest.mark.parametrize("forth", [True, False])
def test_rounds_of_the_other_kind_of_world_model_end(url: str, forth: bool) -> None:
    """One is current, the other trains; what they ranked is gone, and their labels are due for another round."""
    migrate(url, "0001")
    before = fill(url)
    migrate(url, "0007" if forth else "0008")
    config = '{"channels": 32, "reconstruction": 0.1}' if forth else '{"channels": 32, "floor": 0.0003}'
    unfinished = quoted(url, UUID(int=SECOND.int + 3))
    write(
        url,
        f"UPDATE model_version SET config = '{config}' WHERE kind = 'world_model'",
        f"UPDATE round SET status = 'scoring' WHERE id = '{unfinished}'",
    )
    if forth:
        migrate(url)
    else:
        downgrade(url, "0007")
    after = read(url)
    assert sorted(row["status"] for row in after["round"]) == ["failed", "superseded"]
    ended = f"ended by {'an upgrade' if forth else 'a downgrade'} of the service"
    assert all(row["error"].startswith(ended) and row["finished_at"] for row in after["round"])
    assert {row["state"]: row["owner"] for row in after["job"]} == {"done": None, "cancelled": None}
    assert (after["scoring"], after["queue"], after["shard"]) == ([], [], [])
    assert {row["labels_at_round"] for row in after["project"] if row["id"] != EMPTY.hex} == {0}
    assert after["label"] == narrowed(read(url), before)["label"] == before["label"]
    check_references(url)
    migrate(url)
    assert differences(url) == []


def test_going_back_before_policies_forgets_them_and_their_trainings(url: str) -> None:
    migrate(url, "0001")
    fill(url)
    migrate(url, "0009")
    before, schema = read(url), schema_of(url)
    migrate(url, "0010")
    project = quoted(url, FIRST)
    columns = "project_id, sha256, training_id, observations, stage, stages, steps, success, episodes, bytes"
    values = f"'{project}', '{'0' * 64}', '{project}', 'state', 0, 10, 30, 0.5, 10, 1000"
    write(
        url,
        f"INSERT INTO policy ({columns}, created_at) SELECT {values}, created_at FROM project WHERE id = '{project}'",
        "UPDATE job SET kind = 'train_policy' WHERE state = 'queued'",
    )
    assert [row["state_sha256"] for row in read(url)["policy"]] == [None]
    downgrade(url, "0009")
    after = read(url)
    assert (version(url), schema_of(url)) == ("0009", schema)
    assert after.pop("job") == [row for row in before["job"] if row["state"] != "queued"]
    assert after == {name: rows for name, rows in before.items() if name != "job"}
    check_references(url)
    migrate(url)
    assert differences(url) == []


def test_going_back_before_robots_train_leaves_documents_that_an_older_service_reads(url: str) -> None:
    migrate(url, "0001")
    fill(url)
    migrate(url, "0010")
    robot = quoted(url, FIRST)
    actions = {"kind": "box", "shape": [2], "low": -1.0, "high": 1.0}
    spaces = {"observations": {"arm": {"dtype": "float32", "shape": [3], "high": None}}, "actions": actions}
    environment: dict[str, object] = {"simulator": None, "options": {}}
    documents = [json.dumps(spaces), json.dumps(environment | {"spaces": spaces})]
    write(url, f"UPDATE project SET spaces = '{documents[0]}', environment = '{documents[1]}' WHERE id = '{robot}'")
    write(url, f"UPDATE project SET family = NULL WHERE id = '{robot}'")
    before, schema = read(url), schema_of(url)
    migrate(url)
    told = [text.replace('"high": 1.0}', '"high": 1.0, "signs": [1]}') for text in documents]
    values = f"family = 'robot', preset = 'small', spaces = '{told[0]}', environment = '{told[1]}'"
    write(
        url,
        f"UPDATE project SET {values} WHERE id = '{robot}'",
        "UPDATE model_version SET parent_id = id",
        *(
            f"UPDATE round SET model_error = '{json.dumps(row['model_error'] | {'open_loop': []})}' "
            f"WHERE id = '{quoted(url, UUID(str(row['id'])))}'"
            for row in before["round"]
            if row["model_error"]
        ),
        *(
            f"UPDATE job SET payload = '{json.dumps(row['payload'] | {'memberships': 3})}' "
            f"WHERE id = '{quoted(url, UUID(str(row['id'])))}'"
            for row in before["job"]
            if row["kind"] == "train_round"
        ),
    )
    downgrade(url, "0010")
    after = read(url)
    assert (version(url), schema_of(url)) == ("0010", schema)
    assert {row["status"] for row in after["round"] if UUID(str(row["project_id"])) == FIRST} == {"superseded"}
    rounds = [row | {"status": "current"} for row in after.pop("round")]
    assert rounds == before["round"]
    assert after == {name: rows for name, rows in before.items() if name != "round"}
    check_references(url)
    migrate(url)
    assert differences(url) == []

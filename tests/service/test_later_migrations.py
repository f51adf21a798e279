"""Migrations since the third schema: what each adds, and what an older service finds after going back."""

import json
from uuid import UUID

from sqlalchemy import select

from service.store.database import migrate, open_database
from service.store.tables import ProjectRow
from tests.service.first_schema import FIRST, fill, narrowed, read, write
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
    scoring = f"INSERT INTO scoring (id, mode, {columns}) SELECT '{proposed}', 'explore', {columns} FROM scoring"  # noqa: S608
    queue = f"INSERT INTO queue (scoring_id, actions, {places}) SELECT '{proposed}', '[6]', {places} FROM queue"  # noqa: S608
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
        write(url, f"UPDATE {table} SET confidence = 0.5")  # noqa: S608
    downgrade(url, "0006")
    assert (version(url), schema_of(url), read(url)) == ("0006", schema, before)
    check_references(url)
    migrate(url)
    assert differences(url) == []


OLD_STRATEGIES = {"random", "cycle", "vanilla_cycle", "uncertainty"}
OLD_MODELS = {"world_model", "inverse_dynamics", "dense_inverse_dynamics", "ensemble", "subgoal_generator"}
OLD_ERROR = {"transitions", "loss", "dynamics_accuracy", "inverse_accuracy", "by_group"}
"""What a service of the third schema knows; it refuses anything else."""


def test_going_back_to_the_third_schema_leaves_nothing_that_its_service_does_not_know(url: str) -> None:
    migrate(url, "0001")
    fill(url)
    migrate(url)
    group = {"transitions": 4, "loss": 0.5, "exact_accuracy": 0.25, "dynamics_accuracy": 0.5, "inverse_accuracy": None}
    error = json.dumps(group | {"by_group": {"movement": group, "interaction": group}})
    payload = json.dumps({"kind": "train_round", "round": str(UUID(int=FIRST.int + 3)), "strategy": "self_inverse"})
    scored = quoted(url, UUID(int=FIRST.int + 4))
    write(
        url,
        f"UPDATE round SET model_error = '{error}' WHERE project_id = '{quoted(url, FIRST)}'",  # noqa: S608
        f"UPDATE scoring SET strategy = 'confident_cycle' WHERE id = '{scored}'",  # noqa: S608
        f"UPDATE job SET payload = '{payload}' WHERE state = 'done'",  # noqa: S608
        f"UPDATE job SET subject_id = '{scored}', kind = 'select_queue' WHERE state = 'queued'",  # noqa: S608
        "UPDATE acquisition SET strategy = 'fidelity', requested_strategy = 'confident_cycle' WHERE status = 'labeled'",
        "UPDATE model_version SET kind = 'masked_inverse_dynamics'",
    )
    _set_policies(url, {"strategy": "confident_cycle", "batch_rule": "signatures"})
    downgrade(url, "0003")
    after = read(url)
    policies = [row["policy"] for row in after["project"]]
    assert [(each["strategy"], each["diversify"]) for each in policies] == 3 * [("cycle", True)]
    assert not any("batch_rule" in each for each in policies)
    assert {row["strategy"] for row in after["scoring"]} <= OLD_STRATEGIES
    assert {row["project_id"] for row in after["queue"]} == {row["project_id"] for row in after["scoring"]}
    assert len(after["scoring"]) == len(after["shard"]) == len(after["queue"]) == 1  # the other project's
    for name in ("strategy", "requested_strategy"):
        assert {row[name] for row in after["acquisition"]} == {"random", "cycle"} if name == "strategy" else {"cycle"}
    assert {row["kind"] for row in after["model_version"]} <= OLD_MODELS
    assert {row["payload"]["strategy"] for row in after["job"]} == {"cycle"}
    assert {row["state"] for row in after["job"]} == {"done"}  # what was to select from the forgotten scores is gone
    known = [row["model_error"] for row in after["round"] if row["model_error"]]
    assert len(known) == 1
    assert set(known[0]) == OLD_ERROR
    assert all(set(each) == OLD_ERROR - {"by_group"} for each in known[0]["by_group"].values())
    assert known[0]["by_group"]["movement"]["loss"] == 0.5
    check_references(url)
    migrate(url)
    assert differences(url) == []


def _set_policies(url: str, changed: dict[str, str]) -> None:
    database = open_database(url)
    with database.write() as session:
        for row in session.scalars(select(ProjectRow)):
            row.policy = row.policy | changed
    database.close()

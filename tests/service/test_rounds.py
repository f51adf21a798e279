"""Rounds: asked for by hand or by the labels, shown as they stand, and the learning curve that they draw."""

from uuid import UUID

from api_schemas.rounds import GroupError, ModelError
from service import registry, rounds
from service.registry import TrainedModel
from service.store.tables import ProjectRow
from tests.service.kit import UNKNOWN, Served, answers, refused, room

ERROR = ModelError(
    transitions=20,
    loss=3.5,
    dynamics_accuracy=0.75,
    inverse_accuracy=None,
    by_group={"movement": GroupError(transitions=20, loss=3.5, dynamics_accuracy=0.75, inverse_accuracy=None)},
)


def labeled(served: Served, count: int = 3) -> str:
    project = served.project()
    served.upload(project, room(0), room(1))
    batch = served.acquire(project, count)
    assert served.label(project, answers(batch), batch).status_code == 201
    return project


def requested(served: Served, project: str) -> UUID:
    answer = served.client.post("/rounds", json={"project": project})
    assert answer.status_code == 202, answer.text
    return UUID(answer.json()["id"])


def test_a_round_needs_labels_of_the_pool(served: Served) -> None:
    project = served.project()
    refused(served.client.post("/rounds", json={"project": project}), 409, "nothing-to-learn", project)
    served.upload(project, room(0), split="held_out")
    batch = served.acquire(project, 2, purpose="held_out")
    served.label(project, answers(batch), batch)
    refused(served.client.post("/rounds", json={"project": project}), 409, "nothing-to-learn", project)
    refused(served.client.post("/rounds", json={"project": UNKNOWN}), 404, "unknown-resource", UNKNOWN)
    assert served.get("/rounds", project=project)["items"] == []


def test_a_round_asked_for_is_queued_on_all_labels_so_far(on_both: Served) -> None:
    project = labeled(on_both)
    answer = on_both.client.post("/rounds", json={"project": project})
    assert answer.status_code == 202
    row = answer.json()
    assert answer.headers["location"] == f"/rounds/{row['id']}"
    assert on_both.get(answer.headers["location"]) == row
    assert (row["number"], row["labels"], row["watermark"], row["status"]) == (1, 3, 3, "queued")
    assert (row["stages"], row["models"], row["model_error"], row["error"]) == ([], {}, None, None)
    job = on_both.get(f"/jobs/{row['job']}")
    assert (job["kind"], job["queue"], job["state"]) == ("train_round", "train", "queued")
    assert on_both.show(project)["current_round"] is None
    refused(on_both.client.get(f"/rounds/{UNKNOWN}"), 404, "unknown-resource", UNKNOWN)


def test_a_round_is_shown_as_it_goes_and_the_next_takes_its_place(on_both: Served) -> None:
    project = labeled(on_both)
    first = requested(on_both, project)
    with on_both.services.database.write() as session:
        rounds.begin_training(session, first, on_both.clock())
    second = requested(on_both, project)
    with on_both.services.database.write() as session:
        now = on_both.clock()
        for number, one in enumerate((first, second)):
            rounds.begin_training(session, one, now)
            for member, kind in enumerate(("world_model", "ensemble")):
                model = TrainedModel(kind, member, "grid", {"width": 8}, "ab" * 32, 10, {"loss": 1.0})
                registry.register(session, UUID(project), one, model, 3, now)
            rounds.stage_done(session, one, "world_model", 1.23456)
            rounds.record_error(session, one, ERROR.model_copy(update={"loss": 3.5 - number}), now)
            rounds.begin_scoring(session, one, now)
        rounds.make_current(session, second, now)
        rounds.make_current(session, first, now)  # it was overtaken
    shown = on_both.get(f"/rounds/{second}")
    assert shown["stages"] == [{"name": "world_model", "seconds": 1.235}]
    assert set(shown["models"]) == {"world_model", "ensemble-1"}
    assert ModelError.model_validate(shown["model_error"]).loss == 2.5
    assert (shown["status"], on_both.get(f"/rounds/{first}")["status"]) == ("current", "superseded")
    assert on_both.show(project)["current_round"] == str(second)
    with on_both.services.database.write() as session:
        rounds.fail(session, second, "too late to fail", on_both.clock())
    assert on_both.get(f"/rounds/{second}")["status"] == "current"
    version = on_both.get(f"/models/{shown['models']['world_model']}")
    assert (version["kind"], version["round"], version["config"]) == ("world_model", str(second), {"width": 8})


def test_the_learning_curve_is_sent_only_when_it_has_changed(served: Served) -> None:
    project = labeled(served)
    empty = served.client.get("/model-error", params={"project": project})
    assert empty.json() == {"project": project, "points": []}
    one = requested(served, project)
    with served.services.database.write() as session:
        rounds.record_error(session, one, ERROR, served.clock())
    tag = {"If-None-Match": empty.headers["etag"]}
    curve = served.client.get("/model-error", params={"project": project}, headers=tag)
    assert curve.status_code == 200
    (point,) = curve.json()["points"]
    assert (point["round"], point["number"], point["labels"]) == (str(one), 1, 3)
    assert ModelError.model_validate(point["model_error"]) == ERROR
    tag = {"If-None-Match": curve.headers["etag"]}
    unchanged = served.client.get("/model-error", params={"project": project}, headers=tag)
    assert (unchanged.status_code, unchanged.content) == (304, b"")
    assert unchanged.headers["etag"] == curve.headers["etag"]
    refused(served.client.get("/model-error", params={"project": UNKNOWN}), 404, "unknown-resource", UNKNOWN)


def test_weights_are_served_by_the_hash_of_their_row(served: Served) -> None:
    project = labeled(served)
    sha256 = served.services.blobs.put("weights", b"eight bytes of weights")
    with served.services.database.write() as session:
        row = session.get_one(ProjectRow, UUID(project))
        model = TrainedModel("subgoal_generator", 0, "grid", {}, sha256, 22, {})
        version = registry.register(session, row.id, None, model, 1, served.clock()).id
    answer = served.client.get(f"/models/{version}/weights")
    assert (answer.content, answer.headers["etag"]) == (b"eight bytes of weights", f'"{sha256}"')
    for path in (f"/models/{UNKNOWN}", f"/models/{UNKNOWN}/weights"):
        refused(served.client.get(path), 404, "unknown-resource", UNKNOWN)

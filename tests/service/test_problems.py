"""Every error is a problem detail, whoever raises it, and each kind of bad input has a name of its own."""

from collections.abc import Iterator

import pytest
from fastapi.testclient import TestClient
from sqlalchemy.exc import OperationalError

from api_schemas.errors import PROBLEM_JSON, Problem
from service.errors import ServiceError
from tests.service.kit import UNKNOWN, Served, refused, room


def test_the_frameworks_own_errors_are_problems(served: Served) -> None:
    json_type = {"Content-Type": "application/json"}
    refused(served.client.get("/nowhere"), 404, "not-found")
    wrong = served.client.put("/projects")
    refused(wrong, 405, "method-not-allowed")
    assert wrong.headers["allow"] == "GET, POST"
    assert served.client.put(f"/jobs/{UNKNOWN}").headers["allow"] == "DELETE, GET"
    assert served.client.put("/dashboard").headers["allow"] == "GET"
    for body in (b"{", b"", b"\xff", b"[]", b"1", b"null"):
        answer = served.client.post("/projects", content=body, headers=json_type)
        assert answer.status_code in (400, 422)
        refused(answer, answer.status_code, "malformed-request" if answer.status_code == 422 else "bad-request")
    refused(
        served.client.post("/projects", content=b"{}", headers={"Content-Type": "text/plain"}), 422, "malformed-request"
    )
    refused(served.client.get("/jobs", params={"project": "seven"}), 422, "malformed-request", "project", "seven")


def test_a_malformed_request_names_each_field_reason_and_value(served: Served) -> None:
    body = {"name": "a/b", "environment": {"simulator": "minigrid"}, "seed": -3, "colour": "red"}
    problem = refused(served.client.post("/projects", json=body), 422, "malformed-request")
    found = {param["name"]: param["value"] for param in problem["invalid_params"]}
    assert found == {"name": "a/b", "seed": "-3", "colour": "red"}
    assert problem["instance"] == "/projects"
    for name, value in found.items():
        assert name in problem["detail"]
        assert value in problem["detail"]


@pytest.mark.parametrize("value", ['"\\ud800"', "1e400", "NaN", '"' + "x" * 5000 + '"'])
@pytest.mark.parametrize("field", ["name", "environment", "seed"])
def test_a_value_that_cannot_be_shown_is_refused_all_the_same(served: Served, field: str, value: str) -> None:
    fields = {"name": '"a"', "environment": '{"simulator": "minigrid"}', "seed": "0"} | {field: value}
    body = "{" + ", ".join(f'"{name}": {text}' for name, text in fields.items()) + "}"
    answer = served.client.post("/projects", content=body, headers={"Content-Type": "application/json"})
    refused(answer, 422, "malformed-request", field)


def test_a_value_that_postgresql_cannot_hold_is_refused(on_postgres: Served) -> None:
    project = on_postgres.project()
    on_postgres.upload(project, room(0))
    on_postgres.acquire(project)
    refused(on_postgres.ask(project, labeler="a\0b"), 422, "unstorable-value", "NUL")
    answer = on_postgres.client.get("/trajectories/a%00b", params={"project": project})
    refused(answer, 422, "unstorable-value", "NUL")
    assert on_postgres.show(project)["counts"]["leased"] == 1


def test_a_failure_of_ours_is_a_problem_that_tells_nothing(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError("secret of the house")

    monkeypatch.setattr("service.projects.find", broken)
    client = TestClient(
        served.app, base_url="http://127.0.0.1", client=("127.0.0.1", 50000), raise_server_exceptions=False
    )
    answer = client.get(f"/projects/{UNKNOWN}")
    refused(answer, 500, "internal-error")
    assert "secret" not in answer.text


def test_a_database_that_does_not_answer_is_a_problem_to_try_again(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    def busy(*_: object) -> None:
        raise OperationalError("select secret", {}, Exception("database is locked"))

    monkeypatch.setattr("service.projects.find", busy)
    answer = served.client.get(f"/projects/{UNKNOWN}")
    refused(answer, 503, "database-unavailable")
    assert answer.headers["retry-after"] == "1"
    assert "secret" not in answer.text


def test_each_kind_of_bad_input_has_a_type_of_its_own() -> None:
    classes = [kind for kind in _below(ServiceError) if kind.__module__.startswith("service.")]
    types = {_problem(kind).type for kind in classes}
    assert len(types) == len(classes)
    bad_input = {  # the cases of issue 2
        "unknown-resource",
        "unknown-strategy",
        "pool-exhausted",
        "invalid-label",
        "invalid-lease-token",
        "segment-leased",
        "label-conflict",
        "invalid-trajectory",
        "foreign-file",
        "corrupt-blob",
    }
    assert {f"urn:asim:error:{name}" for name in bad_input} <= types


def _below(kind: type[ServiceError]) -> Iterator[type[ServiceError]]:
    for each in kind.__subclasses__():
        yield each
        yield from _below(each)


def _problem(kind: type[ServiceError]) -> Problem:
    error = kind.__new__(kind)
    ServiceError.__init__(error, "a sentence")
    problem = error.problem()
    assert problem.title
    assert 400 <= problem.status < 600
    return problem


def test_the_schema_tells_the_truth_about_its_media_type(served: Served) -> None:
    assert served.client.get("/openapi.json").status_code == 200
    assert served.client.get(f"/projects/{UNKNOWN}").headers["content-type"] == PROBLEM_JSON

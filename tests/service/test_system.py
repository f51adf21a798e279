"""Health, metrics, the catalog of strategies, and what stays out of the API process."""

import json
import shutil
import subprocess
import sys
from typing import Any
from uuid import UUID

from prometheus_client.parser import text_string_to_metric_families

from api_schemas.jobs import TrainSubgoalGenerator
from api_schemas.rounds import ModelError
from api_schemas.strategies import STRATEGY_NAMES
from service import canary, jobs, rounds
from service.store.tables import ProjectRow
from tests.service.conftest import Serve
from tests.service.kit import UNKNOWN, Served, answers, room
from workers.dispatch import run_next

NAME = 'a "quoted" \\ name'


def metrics(served: Served) -> dict[tuple[str, ...], float]:
    """Samples by name and labels."""
    answer = served.client.get("/metrics")
    assert answer.status_code == 200
    return {
        (sample.name, *(value for _, value in sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(answer.text)
        for sample in family.samples
    }


QUEUES = ("train", "score", "label")


def alive(served: Served, *queues: str, owner: str = "ada:1") -> None:
    with served.services.database.write() as session:
        jobs.worker_alive(session, owner, queues, served.clock())


def plant(served: Served) -> None:
    with served.services.database.write() as session:
        canary.plant(session, served.clock(), served.settings.canary_seconds / 4)


def do_canaries(served: Served, *queues: str) -> None:
    plant(served)
    for queue in queues:
        assert run_next(served.worker(queue))


def readiness(served: Served) -> tuple[int, dict[str, Any]]:
    answer = served.client.get("/health/ready")
    return answer.status_code, dict(answer.json())


def test_the_service_is_ready_while_the_canaries_of_all_queues_are_done(served: Served) -> None:
    assert served.client.get("/health/live").json() == {"status": "ok"}
    status, silent = readiness(served)
    assert (status, silent["status"], silent["workers_alive"]) == (503, "unavailable", 0)
    assert (silent["database"], silent["blobs"], silent["canaries"]) == (True, True, dict.fromkeys(QUEUES))
    alive(served, *QUEUES)
    assert readiness(served)[0] == 503  # a worker that says that it is there has not worked yet
    do_canaries(served, "train", "score")
    assert readiness(served)[0] == 503
    do_canaries(served, "label")
    status, ready = readiness(served)
    assert (status, ready["status"], ready["workers_alive"]) == (200, "ok", 1)
    served.clock.advance(served.settings.canary_seconds - 1)
    status, late = readiness(served)
    assert (status, late["workers_alive"]) == (200, 0)
    assert all(age is not None and 59 <= age < 60 for age in late["canaries"].values())
    served.clock.advance(2)
    assert readiness(served)[0] == 503


def test_planting_or_failing_anew_does_not_make_a_canary_younger(served: Served) -> None:
    do_canaries(served, *QUEUES)
    served.clock.advance(40)
    plant(served)
    assert {round(age) for age in readiness(served)[1]["canaries"].values()} == {40}
    with served.services.database.write() as session:
        row = jobs.claim_next(session, ("label",), "ada:1", served.clock(), 15.0)
        assert row is not None
        jobs.fail(session, jobs.lease_of(row), "it fell over", served.clock(), retry=False)
    assert {round(age) for age in readiness(served)[1]["canaries"].values()} == {40}


def test_a_queue_whose_worker_is_at_work_is_served(served: Served) -> None:
    do_canaries(served, *QUEUES)
    served.clock.advance(61)
    project = served.project()
    payload = TrainSubgoalGenerator(project=UUID(project))
    with served.services.database.write() as session:
        jobs.enqueue(session, UUID(project), payload, UUID(project), served.clock())
        row = jobs.claim_next(session, ("train",), "ada:1", served.clock(), 15.0)
        assert row is not None
    do_canaries(served, "score", "label")
    assert readiness(served)[0] == 503  # nobody knows which queues the holder serves
    alive(served, "train")
    assert readiness(served)[0] == 200
    served.clock.advance(16)  # its lease ends
    assert readiness(served)[0] == 503


def test_a_queue_that_works_off_jobs_is_served_though_its_canary_is_late(served: Served) -> None:
    do_canaries(served, *QUEUES)
    served.clock.advance(61)
    project = served.project()
    served.upload(project, room(0))
    served.acquire(project)  # jobs of the queue `score`
    do_canaries(served, "train", "label")
    status, ready = readiness(served)
    assert ready["canaries"]["score"] > 60
    assert status == 200
    served.clock.advance(61)
    do_canaries(served, "train", "label")
    assert readiness(served)[0] == 503


def test_readiness_says_which_store_is_gone(start: Serve) -> None:
    served = start()
    do_canaries(served, *QUEUES)
    shutil.rmtree(served.settings.data_folder / "blobs")
    gone = served.client.get("/health/ready")
    assert (gone.status_code, gone.json()["blobs"], gone.json()["database"]) == (503, False, True)
    served.services.database.close()
    for path in served.settings.data_folder.glob("asim.db*"):
        path.unlink()
    gone = served.client.get("/health/ready")
    assert (gone.status_code, gone.json()["database"]) == (503, False)


def test_metrics_count_segments_jobs_and_the_newest_error(served: Served) -> None:
    project = served.project(name=NAME)
    served.upload(project, room(0))
    batch = served.acquire(project, 3)
    served.label(project, answers(batch)[:2], batch)
    with served.services.database.write() as session:
        row = rounds.request(session, session.get_one(ProjectRow, UUID(project)), served.clock())
        error = ModelError(transitions=1, loss=2.5, dynamics_accuracy=None, inverse_accuracy=None)
        rounds.record_error(session, row.id, error, served.clock())
    found = metrics(served)
    assert found["asim_segments", NAME, "unlabeled"] == 2
    assert found["asim_segments", NAME, "leased"] == 1
    assert found["asim_segments", NAME, "labeled"] == 2
    assert found["asim_jobs", "score", "done"] == 2
    assert found["asim_jobs", "train", "queued"] == 2
    assert found["asim_model_error_loss", NAME] == 2.5
    assert found["asim_model_labels", NAME] == 2
    assert found["asim_rounds", NAME, "queued"] == 1
    assert found["asim_leases", NAME] == 1
    assert 0 < found["asim_lease_age_seconds", NAME] < 1
    assert found["asim_ranked_segments", NAME] == 2
    assert found["asim_queue_depth", "train"] == 2
    assert found["asim_queue_depth", "score"] == 0
    assert found["asim_scoring_rate", NAME] > 0
    served.clock.advance(60)
    found = metrics(served)
    assert 60 < found["asim_lease_age_seconds", NAME] < 61
    assert 60 < found["asim_queue_age_seconds", "train"] < 61
    assert found["asim_queue_age_seconds", "score"] == 0


def test_answers_are_counted_by_route_and_status(start: Serve) -> None:
    served = start()
    project = served.project()
    for _ in range(3):
        served.show(project)
    served.client.get(f"/projects/{UNKNOWN}")
    served.client.get("/no/such/path")
    served.client.request("PURGE", "/nowhere")
    served.client.get("/projects", headers={"Host": "evil.example"})
    found = metrics(served)
    assert found["asim_requests_total", "GET", "/projects/{project_id}", "200"] == 3
    assert found["asim_requests_total", "GET", "/projects/{project_id}", "404"] == 1
    assert found["asim_requests_total", "POST", "/projects", "201"] == 1
    assert found["asim_requests_total", "unknown", "unknown", "404"] == 2
    assert found["asim_requests_total", "unknown", "unknown", "403"] == 1
    assert found["asim_request_seconds_count", "GET", "/projects/{project_id}"] == 4


def test_strategies_are_listed_with_what_they_need(served: Served) -> None:
    listed = {row["name"]: row for row in served.client.get("/strategies").json()}
    assert tuple(listed) == STRATEGY_NAMES
    oracles = {"oracle", "oracle_easy", "oracle_uniform", "true_progress"}
    assert {name for name, row in listed.items() if row["privileged"]} == oracles
    assert listed["random"]["needs"] == []
    assert "world_model" in listed["cycle"]["needs"]


def test_the_root_leads_to_the_dashboard(served: Served) -> None:
    answer = served.client.get("/", follow_redirects=False)
    assert (answer.status_code, answer.headers["location"]) == (307, "/dashboard")


def test_the_api_process_loads_no_network_and_no_simulator() -> None:
    script = "import service.app, sys, json; print(json.dumps(list(sys.modules)))"
    printed = subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True).stdout
    loaded = {name.partition(".")[0] for name in json.loads(printed)}
    assert "service" in loaded
    assert not loaded & {"torch", "gymnasium", "minigrid", "models", "workers", "matplotlib", "asim"}

"""Health, metrics, the catalog of strategies, and what stays out of the API process."""

import json
import shutil
import subprocess
import sys
from uuid import UUID

from prometheus_client.parser import text_string_to_metric_families

from api_schemas.rounds import ModelError
from api_schemas.strategies import STRATEGY_NAMES
from service import jobs, rounds
from service.store.tables import ProjectRow
from tests.service.conftest import Serve
from tests.service.kit import Served, answers, room

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


def alive(served: Served) -> None:
    with served.services.database.write() as session:
        jobs.worker_alive(session, "ada:1", ["score"], served.clock())


def test_the_service_is_ready_while_a_worker_is_heard_of(served: Served) -> None:
    assert served.client.get("/health/live").json() == {"status": "ok"}
    silent = served.client.get("/health/ready")
    assert (silent.status_code, silent.json()["status"], silent.json()["workers_alive"]) == (503, "unavailable", 0)
    assert (silent.json()["database"], silent.json()["blobs"]) == (True, True)
    alive(served)
    alive(served)
    ready = served.client.get("/health/ready")
    assert (ready.status_code, ready.json()["status"], ready.json()["workers_alive"]) == (200, "ok", 1)
    served.clock.advance(31)
    assert served.client.get("/health/ready").status_code == 503


def test_readiness_says_which_store_is_gone(start: Serve) -> None:
    served = start()
    alive(served)
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


def test_strategies_are_listed_with_what_they_need(served: Served) -> None:
    listed = {row["name"]: row for row in served.client.get("/strategies").json()}
    assert tuple(listed) == STRATEGY_NAMES
    assert not any(row["privileged"] for row in listed.values())
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

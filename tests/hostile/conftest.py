"""A service process that is asked over the network, with a project of one of everything and a key of every kind."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import httpx
import pytest

from service.settings import Settings
from service.store.database import migrate
from tests.crash.deployment import Deployed
from tests.loop.processes import eventually, free_port
from tests.servers import RedisSpace
from tests.service.access_table import SCOPES, fill, holder
from tests.service.kit import ROBOT, Json, serve

FOLDER = Path(__file__).parent
ROOT = FOLDER.parents[1]
KEPT = "use_after_free"  # nothing is gone after its DELETE: a job is listed as cancelled, and no key can be asked for


@dataclass(frozen=True)
class Exposed:
    """keys: headers by who shows them. things: ids of one thing of each kind, as paths, queries and bodies name it.

    robot: a project of cameras and proprioception.
    """

    api: Deployed
    url: str
    keys: dict[str, dict[str, str]]
    things: Json
    robot: str
    database_url: str
    folder: Path


@pytest.fixture
def exposed(tmp_path: Path, postgres_url: str, redis_space: RedisSpace) -> Iterator[Exposed]:
    """A scaled-out service on PostgreSQL without workers: what is asked of them waits."""
    migrate(postgres_url)
    keys, things, robot = _filled(Settings(data_folder=tmp_path, database_url=postgres_url))
    settings = {
        "ASIM_DATA_FOLDER": str(tmp_path),
        "ASIM_DATABASE_URL": postgres_url,
        "ASIM_BROKER_URL": redis_space.url,
        "ASIM_CELERY_PREFIX": redis_space.prefix,
        "ASIM_RELAY": "false",
        "ASIM_FAILURES_PER_KEY": "1000000",
        "ASIM_FAILED_KEYS_PER_MINUTE": "1000000",  # schemathesis shows wrong keys at every endpoint
    }
    port = free_port()
    argv = ["uvicorn", "service.app:create_app", "--factory", "--port", str(port), "--log-level", "warning"]
    api = Deployed("api", [sys.executable, "-m", *argv], settings, tmp_path)
    api.start()
    made = Exposed(api, f"http://127.0.0.1:{port}", keys, things, robot, postgres_url, tmp_path)
    eventually(lambda: _answers(made.url), 60, lambda: api.said()[-3000:])
    yield made
    api.end(signal.SIGTERM)


def _filled(settings: Settings) -> tuple[dict[str, dict[str, str]], Json, str]:
    served = serve(settings)
    try:
        made, robot = fill(served, "rooms", 0), served.project(environment=ROBOT)
        batch = served.acquire(made.project, 2, strategy="random")
        keys: dict[str, dict[str, str]] = {scope: holder(served, scope) for scope in SCOPES}
        keys |= {"admin of one project": holder(served, "admin", project=made.project), "nobody": {}}
    finally:
        served.close()
    ids = dict(made.ids) | {"acquisition_id": batch["id"]}
    body = {"project": made.project, "acquisition": batch["id"], "token": batch["token"]}
    return keys, ids | body | {"trajectory": ids["trajectory_id"]}, robot


def _answers(url: str) -> bool:
    try:
        return httpx.get(f"{url}/health/live").is_success
    except httpx.TransportError:
        return False


def schemathesis(exposed: Exposed, who: str, *options: str) -> int:
    """Run it with this key; fails with what it found. Returns how many cases it made."""
    report, things = exposed.folder / "report.json", exposed.folder / "things.json"
    things.write_text(json.dumps(exposed.things))
    argv = [sys.executable, "-m", "schemathesis.cli", "--config-file", str(FOLDER / "schemathesis.toml")]
    argv += ["run", f"{exposed.url}/openapi.json", "--checks", "all", "--exclude-checks", KEPT, *options]
    argv += ["--report", "json", "--report-json-path", str(report)]
    argv += ["--continue-on-failure", "--warnings", "off", "--request-timeout", "20"]
    for name, value in exposed.keys[who].items():
        argv += ["--header", f"{name}: {value}"]
    own = {"SCHEMATHESIS_HOOKS": "tests.hostile.hooks", "ASIM_THINGS": str(things), "PYTHONPATH": str(ROOT)}
    done = subprocess.run(argv, env=os.environ | own, cwd=exposed.folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{who}:\n{done.stdout[-12000:]}\n{done.stderr[-2000:]}"
    return int(json.loads(report.read_text())["test_cases"]["generated"])

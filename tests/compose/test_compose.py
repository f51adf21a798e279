"""docker-compose.yml: whole by its specification, careful, and a working loop when its commands run on this machine."""

import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import make_url

from asim.client import Client
from service.store.provenance import ProvenanceBlobs
from tests.compose.compose_file import (
    DOCKERFILE,
    FILE,
    OURS,
    ROOT,
    Json,
    Machine,
    compose,
    make_secrets,
    service,
    stages,
)
from tests.compose.story import check_same_story, scraped
from tests.loop.first_round import START_SECONDS, collected, first_round
from tests.loop.processes import environment, eventually, free_port, started, stop
from tests.servers import RedisSpace

BIN = Path(sys.executable).parent


def checked(*argv: str) -> None:
    done = subprocess.run([str(BIN / argv[0]), *argv[1:]], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_file_is_what_the_compose_specification_says() -> None:
    checked("check-jsonschema", "--builtin-schema", "vendor.compose-spec", str(FILE))


def test_the_image_is_built_as_a_linter_likes_it() -> None:
    checked("hadolint", str(DOCKERFILE))


def test_each_image_is_built_from_a_stage_and_has_a_name_of_its_own() -> None:
    targets = {name: service(name)["build"]["target"] for name in OURS}
    assert targets == dict.fromkeys(OURS, "asim") | {"labeler": "labeler"}
    assert set(targets.values()) <= set(stages())
    assert len({(service(name)["image"], target) for name, target in targets.items()}) == 2
    for target in targets.values():
        assert stages()[target].rpartition("USER ")[2].startswith("10001:10001")


def test_the_labelers_image_has_the_robot_simulators_as_make_installs_them() -> None:
    recipe = (ROOT / "Makefile").read_text().partition("$(VENV)/.robots:")[2].partition("touch")[0]
    groups = re.findall(r"-e '\.\[([\w,]+)\]'", recipe)
    (bare,) = re.findall(r"--no-deps -c constraints\.txt (.+)", recipe)
    assert groups == ["robosuite,maniskill"]
    for word in (f",{groups[0]}]", f"--no-deps -c constraints.txt {bare}", "system-packages robots"):
        assert word in stages()["labeler"]
        assert word not in stages()["asim"]


@pytest.mark.parametrize("name", compose()["services"])
def test_a_service_is_careful(name: str) -> None:
    told: Json = service(name)
    assert re.search(r":\d+\.\d+", told["image"]), "an image is pinned to a version"
    assert told["read_only"] is True
    assert told["cap_drop"] == ["ALL"]
    assert told["security_opt"] == ["no-new-privileges:true"]
    assert "healthcheck" in told
    assert told["restart"] == "unless-stopped"
    assert "privileged" not in told
    if name != "db":  # PostgreSQL's own entry point gives up root once it owns its folder
        assert int(told["user"].split(":")[0]) > 0
    assert not [value for value in told["environment"].values() if "://" in value] if name in OURS else True
    assert all(port.startswith("127.0.0.1:") for port in told.get("ports", []))


def test_training_and_scoring_have_no_way_to_provenance() -> None:
    for name in ("trainer", "scorer", "scheduler"):
        assert service(name)["environment"]["ASIM_PROVENANCE_URL"] == ""
        assert not any("provenance" in volume for volume in service(name).get("volumes", []))
    for name in ("service", "labeler"):
        assert "provenance:/provenance" in service(name)["volumes"]


TRY = """
import sys
from service.store.errors import MissingBlob
from service.settings import Settings
from service.store.provenance import ProvenanceBlobs, open_provenance
settings, sha256 = Settings(), sys.argv[1]
store = open_provenance(settings)
print("store:", "none" if store is None else store.get("provenance", sha256).decode())
try:
    print("blobs:", ProvenanceBlobs(settings.resolved_blobs_url()).get("provenance", sha256).decode())
except MissingBlob:
    print("blobs: none")
print("named:", sorted(value for value in map(str, vars(settings).values()) if "provenance" in value))
"""


@pytest.mark.parametrize("name", OURS)
def test_a_process_with_a_services_settings_tries_to_read_provenance(machine: Machine, name: str) -> None:
    """Those that train and score cannot, by the store, by the other store, or by a path that their settings know."""
    kept = ProvenanceBlobs(str(machine.path("/provenance")))
    sha256 = kept.put("provenance", b"where the agent was")
    own = environment(**machine.environment(name))
    argv = [sys.executable, "-c", TRY, sha256]
    told = subprocess.run(argv, env=own, capture_output=True, text=True, check=True).stdout.splitlines()
    if name in ("service", "labeler"):
        assert told == ["store: where the agent was", "blobs: none", f"named: ['{machine.path('/provenance')}']"]
    else:
        assert told == ["store: none", "blobs: none", "named: []"]


def test_secrets_fit_together_and_are_made_once(tmp_path: Path) -> None:
    secrets = make_secrets(tmp_path)
    database, broker = make_url(secrets["ASIM_DATABASE_URL"]), make_url(secrets["ASIM_BROKER_URL"])
    given = service("db")["environment"]
    assert (database.host, database.username, database.database) == ("db", given["POSTGRES_USER"], given["POSTGRES_DB"])
    assert database.password == secrets["postgres_password"]
    assert (broker.host, broker.password) == ("redis", secrets["redis_password"])
    assert len(set(secrets.values())) == len(secrets)
    assert min(len(secrets["postgres_password"]), len(secrets["redis_password"])) >= 40
    assert (tmp_path / "docker" / "secrets").stat().st_mode & 0o077 == 0
    subprocess.run([str(tmp_path / "docker" / "make-secrets")], check=True)
    assert (tmp_path / "docker" / "secrets" / "postgres_password").read_text() == secrets["postgres_password"]


@pytest.fixture
def machine(tmp_path: Path, postgres_url: str, redis_space: RedisSpace) -> Machine:
    """Folders and secrets; the URLs among these lead to servers of this machine."""
    (tmp_path / "made").mkdir()
    made = make_secrets(tmp_path / "made")
    machine = Machine(tmp_path / "machine", free_port())
    machine.prepare(made | {"ASIM_DATABASE_URL": postgres_url, "ASIM_BROKER_URL": redis_space.url})
    return machine


@pytest.fixture
def running(machine: Machine, redis_space: RedisSpace) -> Iterator[dict[str, "subprocess.Popen[bytes]"]]:
    """All of our services, the API first, which brings the schema up to date."""
    own = {"ASIM_CELERY_PREFIX": redis_space.prefix}  # others use this Redis too
    with ExitStack() as stack:
        processes = {}
        for name in OURS:
            log = machine.folder / f"{name}.log"
            processes[name] = started(machine.argv(name), machine.environment(name) | own, log)
            stack.callback(stop, processes[name])
            if name == "service":
                await_health(machine, name)
        yield processes


def await_health(machine: Machine, name: str) -> None:
    argv, log = health_of(machine, name), machine.folder / f"{name}.log"
    eventually(lambda: healthy(machine, name, argv), START_SECONDS, lambda: tail(log))


def health_of(machine: Machine, name: str) -> list[str]:
    word, program, *options = service(name)["healthcheck"]["test"]
    assert (word, program) == ("CMD", "asim")
    return machine.entered(options)


def healthy(machine: Machine, name: str, argv: list[str]) -> bool:
    own = environment(**machine.environment(name))
    return subprocess.run(argv, env=own, capture_output=True, timeout=60, check=False).returncode == 0


def tail(log: Path) -> str:
    return log.read_text(errors="replace")[-3000:]


def test_the_services_run_the_loop_and_metrics_tell_its_story(
    machine: Machine, running: dict[str, "subprocess.Popen[bytes]"], postgres_url: str
) -> None:
    own = environment(**machine.environment("service"))
    make_key = machine.entered(["key", "create", "admin", "--scope", "admin"])
    secret = subprocess.run(make_key, env=own, capture_output=True, text=True, check=True).stdout.strip()
    with Client(machine.url, secret) as client:
        logs = "\n".join(tail(machine.folder / f"{name}.log") for name in OURS)
        eventually(lambda: client.health().status == "ok", START_SECONDS, lambda: logs)
        project = collected(client, 1200)
        story = check_same_story(machine.url, secret, postgres_url)
        assert story["asim_segments", "scaled", "unlabeled"] == 1200
        done, labels = first_round(client, project, np.random.default_rng(0))
        assert len(labels) == 60
        point = client.model_error(project.id).points[0]
        assert point.round == done.id
        story = check_same_story(machine.url, secret, postgres_url)
        assert story["asim_rounds", "scaled", "current"] == 1
        assert story["asim_model_error_loss", "scaled"] == point.model_error.loss
        assert client.acquire(project.id, 5, wait=START_SECONDS).strategy == "confident_cycle"
        story = check_same_story(machine.url, secret, postgres_url)
        assert (story["asim_leases", "scaled"], story["asim_segments", "scaled", "leased"]) == (1, 5)
        told = scraped(machine.url, secret)
        assert told["asim_requests_total", "POST", "/labels", "201"] == 1
        assert told["asim_scoring_rate", "scaled"] > 0
    for name in OURS:
        assert healthy(machine, name, health_of(machine, name)), name
    assert not list(machine.folder.glob("not-mounted-in-*/provenance"))
    for name in reversed(OURS):
        running[name].terminate()
        assert running[name].wait(40) == 0, tail(machine.folder / f"{name}.log")

"""asim key: keys made, listed and revoked on the service's own database; and a service that others reach with them."""

import socket
from pathlib import Path
from uuid import uuid4

import httpx
import pytest

from asim.client import Client
from asim.errors import NotFound, ServiceError
from asim.served import served
from service.settings import Settings
from tests.command import Command
from tests.service.kit import ROOM, Served, serve

FIRST = {"name": "first", "environment": ROOM}


@pytest.fixture
def holding(tmp_path: Path) -> Served:
    """A service with one project, on the test's folder."""
    made = serve(Settings(data_folder=tmp_path))
    assert made.client.post("/projects", json=FIRST).status_code == 201
    made.close()
    return made


def test_a_key_is_made_listed_and_revoked(command: Command, holding: Served, tmp_path: Path) -> None:
    data = ("--data", str(tmp_path))
    secret = command("key", "create", "ada", "--scope", "read", "--scope", "label", *data).strip()
    bound = command("key", "create", "bob", "--scope", "admin", "--project", "first", "--days", "90", *data).strip()
    assert secret.startswith("asim_")
    listed = command("key", "list", *data).splitlines()
    ada, bob = (next(line for line in listed if line.startswith(name)) for name in ("ada", "bob"))
    assert all(word in ada for word in ("read, label", "all", "never"))
    assert all(word in bob for word in ("admin", "first", "Z"))
    assert secret not in "".join(listed)
    named = bob.split()[1]
    assert bound.split("_")[1] == named.replace("-", "")
    assert command("key", "revoke", named, *data) == f"key {named} is revoked\n"
    assert not any(line.startswith("bob") for line in command("key", "list", *data).splitlines())


def test_mistakes_are_one_sentence(command: Command, holding: Served, tmp_path: Path) -> None:
    data, unknown = ("--data", str(tmp_path)), str(uuid4())
    cases = {
        ("create", "ada", "--scope", "root"): "asim: --scope root: must be one of admin, acquire, label, read\n",
        ("create", "ada", "--scope", "read", "--project", "second"): "asim: there is no project 'second'\n",
        ("create", "ada", "--scope", "read", "--days", "0"): "must be in the future",
        ("create", "", "--scope", "read"): "asim: name: ",
        ("revoke", unknown): f"asim: there is no key '{unknown}'\n",
        ("revoke", "ada"): "asim: key 'ada' is not an id",
    }
    for arguments, sentence in cases.items():
        said = command("key", *arguments, *data, status=1)
        assert sentence in said
        assert said.count("\n") == 1
    assert len(command("key", "list", *data).splitlines()) == 1


def test_with_a_key_the_service_listens_to_other_machines(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    secret = command("key", "create", "ada", "--scope", "admin", "--data", str(tmp_path)).strip()
    name = _own_address()
    monkeypatch.setenv("ASIM_ALLOWED_HOSTS", f'["127.0.0.1", "{name}"]')
    with served(tmp_path, host="0.0.0.0") as url:
        outside = url.replace("0.0.0.0", name)
        assert httpx.get(f"{outside}/projects").status_code == 401
        with Client(outside, secret) as client:
            assert list(client.projects()) == []
            keys = list(client.keys())
            client.delete_key(keys[0].id)
            with pytest.raises(ServiceError, match="not known or was revoked"):
                client.create_key(keys[0])  # type: ignore[arg-type]  # whatever is sent, nobody looks at it
        with Client(url.replace("0.0.0.0", "127.0.0.1")) as client, pytest.raises(NotFound):
            client.delete_key(keys[0].id)


def _own_address() -> str:
    """One of this machine's that is not loopback; the datagram is never sent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))
        except OSError:
            pytest.skip("this machine has no address but loopback")
        return str(probe.getsockname()[0])

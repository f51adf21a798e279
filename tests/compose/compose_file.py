"""docker-compose.yml, and what its services run, as processes of this machine.

There need be no Docker engine: commands, variables and secrets are the file's, paths and hosts are mapped.
"""

import re
import shutil
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).parents[2]
FILE = ROOT / "docker-compose.yml"
SCRIPT = ROOT / "docker" / "make-secrets"
DOCKERFILE = ROOT / "docker" / "Dockerfile"
OURS = ("service", "scheduler", "trainer", "scorer", "labeler")
SECRETS = "/run/secrets"
MOUNTS = ("/data", "/blobs", "/provenance", SECRETS)
Json = dict[str, Any]


@cache
def compose() -> Json:
    """The file, its anchors merged."""
    read: Json = yaml.safe_load(FILE.read_text())
    return read


def service(name: str) -> Json:
    """One service of it."""
    found: Json = compose()["services"][name]
    return found


@cache
def stages() -> dict[str, str]:
    """The stages of the Dockerfile by name, each with those that it is made from before it."""
    made = dict[str, str]()
    for stage in re.split(r"^FROM ", DOCKERFILE.read_text(), flags=re.MULTILINE)[1:]:
        source, _, name = stage.partition("\n")[0].partition(" AS ")
        copied = "".join(made.get(each, "") for each in re.findall(r"--from=(\S+)", stage))
        made[name] = made.get(source, "") + copied + stage
    return made


def make_secrets(folder: Path) -> dict[str, str]:
    """What docker/make-secrets writes, by the names under which the file mounts it."""
    script = folder / "docker" / SCRIPT.name
    script.parent.mkdir()
    shutil.copy(SCRIPT, script)
    subprocess.run([str(script)], check=True, cwd=folder)
    files = {name: folder / secret["file"] for name, secret in compose()["secrets"].items()}
    return {name: path.read_text() for name, path in files.items()}


@dataclass(frozen=True)
class Machine:
    """Where containers' paths lie here, and the port of the API."""

    folder: Path
    port: int

    def prepare(self, secrets: Mapping[str, str]) -> None:
        """Make the folders of all mounts, and the files of the secrets."""
        for mount in MOUNTS:
            self.path(mount).mkdir(parents=True)
        for name, content in secrets.items():
            (self.path(SECRETS) / name).write_text(content)

    def path(self, inside: str) -> Path:
        """What a container finds there."""
        return self.folder / inside.lstrip("/")

    def argv(self, name: str) -> list[str]:
        """The command of a service; the image's entry point is `asim`."""
        return self.entered(service(name)["command"])

    def entered(self, command: list[str]) -> list[str]:
        """A command inside the image."""
        here = {"0.0.0.0": "127.0.0.1", "8000": str(self.port), "http://127.0.0.1:8000": self.url}
        return [sys.executable, "-m", "asim", *(here.get(word, word) for word in command)]

    def environment(self, name: str) -> dict[str, str]:
        """A service's variables; a path that it does not mount is not there for it."""
        mounted = {volume.split(":")[1] for volume in service(name).get("volumes", [])}
        given: dict[str, str] = service(name)["environment"]
        return {key: self._mapped(value, mounted, name) for key, value in given.items()}

    @property
    def url(self) -> str:
        """Where the API listens."""
        return f"http://127.0.0.1:{self.port}"

    def _declared(self, name: str) -> Path:
        """A folder with the secrets that the service declares, and no others."""
        folder = self.folder / f"secrets-of-{name}"
        folder.mkdir(exist_ok=True)
        for secret in service(name).get("secrets", []):
            shutil.copy(self.path(SECRETS) / secret, folder)
        return folder

    def _mapped(self, value: str, mounted: set[str], name: str) -> str:
        if value == SECRETS:
            return str(self._declared(name))
        if value not in MOUNTS:
            return value
        if value in mounted:
            return str(self.path(value))
        return str(self.folder / f"not-mounted-in-{name}" / value.lstrip("/"))

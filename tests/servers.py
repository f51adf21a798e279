"""Real PostgreSQL and Redis for tests: the server that a variable names, the one on its usual port, or a private one.

Where none can be had a test is skipped and says so; with CI set it fails instead.
"""

import os
import pwd
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn
from uuid import uuid4

import pytest
from redis import Redis
from redis.exceptions import RedisError
from sqlalchemy import Engine, create_engine, make_url, text
from sqlalchemy.exc import OperationalError

POSTGRES_URLS = (
    "postgresql+psycopg://postgres@127.0.0.1:5432/test",
    "postgresql+psycopg://postgres@127.0.0.1:5432/postgres",
)
REDIS_URL = "redis://127.0.0.1:6379/0"
START_SECONDS = 20.0


@dataclass(frozen=True)
class RedisSpace:
    """A Redis server, and the prefix of the keys that a test may write; they are removed after it."""

    url: str
    prefix: str


@pytest.fixture(scope="session")
def postgres_server() -> Iterator[str]:
    """URL of a PostgreSQL server in which databases may be made."""
    asked = os.environ.get("ASIM_TEST_DATABASE_URL")
    for url in (asked,) if asked else POSTGRES_URLS:
        if _postgres_answers(url):
            yield url
            return
    if asked or _postgres_folder() is None:
        _missing(f"PostgreSQL: {asked or POSTGRES_URLS[0]} does not answer, and no server is installed")
    with private_postgres() as url:
        yield url


@pytest.fixture
def postgres_url(postgres_server: str) -> Iterator[str]:
    """URL of an empty database of the test's own."""
    with postgres_database(postgres_server) as url:
        yield url


@contextmanager
def postgres_database(server: str) -> Iterator[str]:
    """An empty database with a random name, dropped at the end."""
    name = f"asim_test_{uuid4().hex[:12]}"
    _in_server(server, f'CREATE DATABASE "{name}"')
    try:
        yield make_url(server).set(database=name).render_as_string(hide_password=False)
    finally:
        _in_server(server, f'DROP DATABASE "{name}" WITH (FORCE)')


@pytest.fixture(scope="session")
def redis_server() -> Iterator[str]:
    """URL of a Redis server."""
    asked = os.environ.get("ASIM_TEST_REDIS_URL")
    if _redis_answers(asked or REDIS_URL):
        yield asked or REDIS_URL
        return
    if asked or shutil.which("redis-server") is None:
        _missing(f"Redis: {asked or REDIS_URL} does not answer, and no server is installed")
    with private_redis() as url:
        yield url


@pytest.fixture
def redis_space(redis_server: str) -> Iterator[RedisSpace]:
    """Keys under a random prefix, gone after the test."""
    space = RedisSpace(redis_server, f"asim-test-{uuid4().hex[:12]}")
    yield space
    with Redis.from_url(space.url) as client:
        for key in client.scan_iter(f"{space.prefix}*"):
            client.delete(key)


@contextmanager
def private_redis() -> Iterator[str]:
    """A Redis server on a free port that keeps nothing, for the time of the block."""
    port = _free_port()
    with tempfile.TemporaryDirectory() as folder:
        command = ["redis-server", "--port", str(port), "--bind", "127.0.0.1", "--save", "", "--dir", folder]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        url = f"redis://127.0.0.1:{port}/0"
        try:
            _wait_for(lambda: _redis_answers(url), "Redis")
            yield url
        finally:
            process.terminate()
            process.wait(timeout=START_SECONDS)


@contextmanager
def private_postgres() -> Iterator[str]:
    """A PostgreSQL server on a free port with an empty data folder, for the time of the block."""
    programs, port, user = _postgres_folder(), _free_port(), _unprivileged_user()
    if programs is None:
        raise FileNotFoundError("PostgreSQL: initdb is not installed")
    folder = tempfile.mkdtemp()
    if user is not None:
        shutil.chown(folder, user)
    data = f"{folder}/data"
    try:
        initialise = [str(programs / "initdb"), "-D", data, "-U", "postgres", "-A", "trust", "--no-sync"]
        subprocess.run(initialise, check=True, user=user, cwd=folder, stdout=subprocess.DEVNULL)
        serve = [str(programs / "postgres"), "-D", data, "-p", str(port), "-h", "127.0.0.1", "-k", folder, "-F"]
        with Path(folder, "log").open("wb") as log:
            process = subprocess.Popen(serve, user=user, cwd=folder, stdout=log, stderr=log)
        url = f"postgresql+psycopg://postgres@127.0.0.1:{port}/postgres"
        try:
            _wait_for(lambda: _postgres_answers(url), "PostgreSQL")
            yield url
        finally:
            process.terminate()
            process.wait(timeout=START_SECONDS)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _postgres_answers(url: str) -> bool:
    engine = create_engine(url, connect_args={"connect_timeout": 2})
    try:
        with engine.connect():
            return True
    except OperationalError:
        return False
    finally:
        engine.dispose()


def _redis_answers(url: str) -> bool:
    try:
        with Redis.from_url(url, socket_connect_timeout=2) as client:
            return bool(client.ping())
    except (RedisError, OSError):
        return False


def _in_server(url: str, statement: str) -> None:
    engine: Engine = create_engine(url, isolation_level="AUTOCOMMIT")
    try:
        with engine.connect() as connection:
            connection.execute(text(statement))
    finally:
        engine.dispose()


def _postgres_folder() -> Path | None:
    """Where initdb is; Debian keeps it out of the path."""
    found = shutil.which("initdb")
    places = [Path(found)] if found else sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
    return places[-1].resolve().parent if places else None


def _unprivileged_user() -> str | None:
    """PostgreSQL refuses to run as root; the user that its package made, or nobody, runs it then."""
    if os.geteuid() != 0:
        return None
    known = {entry.pw_name for entry in pwd.getpwall()}
    return "postgres" if "postgres" in known else "nobody"


def _free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


def _wait_for(answers: Callable[[], bool], name: str) -> None:
    deadline = time.monotonic() + START_SECONDS
    while not answers():
        if time.monotonic() > deadline:
            raise TimeoutError(f"{name} did not answer within {START_SECONDS:.0f} s of its start")
        time.sleep(0.1)


def _missing(reason: str) -> NoReturn:
    if os.environ.get("CI"):
        pytest.fail(reason)
    pytest.skip(reason)

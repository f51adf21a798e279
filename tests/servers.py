"""Real PostgreSQL and Redis for tests: the server that a variable names, the one on its usual port, or a private one.

Where none can be had a test is skipped and says so; with CI set it fails instead.
"""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import NoReturn
from uuid import uuid4

import pytest
from redis import Redis
from sqlalchemy import Engine, create_engine, make_url, text

from tests.private_servers import (
    PrivatePostgres,
    PrivateRedis,
    postgres_answers,
    postgres_folder,
    redis_answers,
)

POSTGRES_URLS = (
    "postgresql+psycopg://postgres@127.0.0.1:5432/test",
    "postgresql+psycopg://postgres@127.0.0.1:5432/postgres",
)
REDIS_URL = "redis://127.0.0.1:6379/0"


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
        if postgres_answers(url):
            yield url
            return
    if asked or postgres_folder() is None:
        _missing(f"PostgreSQL: {asked or POSTGRES_URLS[0]} does not answer, and no server is installed")
    with PrivatePostgres() as server:
        yield server.url


@pytest.fixture
def postgres_url(postgres_server: str) -> Iterator[str]:
    """URL of an empty database of the test's own."""
    with shared_database(postgres_server) as url:
        yield url


@contextmanager
def postgres_database(server: str, template: str | None = None) -> Iterator[str]:
    """A database with a random name, empty or a copy of `template`, which nobody uses now; dropped at the end."""
    name = f"asim_test_{uuid4().hex[:12]}"
    _in_server(server, f'CREATE DATABASE "{name}"' + (f' TEMPLATE "{template}"' if template else ""))
    if template:  # PostgreSQL copies how far a sequence is logged; before a checkpoint a crash would set the copy back
        _in_server(server, "CHECKPOINT")
    try:
        yield make_url(server).set(database=name).render_as_string(hide_password=False)
    finally:
        _in_server(server, f'DROP DATABASE "{name}" WITH (FORCE)')


@contextmanager
def shared_database(server: str, template: str | None = None) -> Iterator[str]:
    """The same on a server that no test crashes: no commit waits for its disk."""
    with postgres_database(server, template) as url:
        _in_server(server, f'ALTER DATABASE "{make_url(url).database}" SET synchronous_commit TO off')
        yield url


@pytest.fixture(scope="session")
def redis_server() -> Iterator[str]:
    """URL of a Redis server."""
    asked = os.environ.get("ASIM_TEST_REDIS_URL")
    if redis_answers(asked or REDIS_URL):
        yield asked or REDIS_URL
        return
    if asked or shutil.which("redis-server") is None:
        _missing(f"Redis: {asked or REDIS_URL} does not answer, and no server is installed")
    with PrivateRedis() as server:
        yield server.url


@pytest.fixture
def redis_space(redis_server: str) -> Iterator[RedisSpace]:
    """Keys under a random prefix, gone after the test."""
    space = RedisSpace(redis_server, f"asim-test-{uuid4().hex[:12]}")
    yield space
    with Redis.from_url(space.url) as client:
        for key in client.scan_iter(f"{space.prefix}*"):
            client.delete(key)


def _in_server(url: str, statement: str) -> None:
    engine: Engine = create_engine(url, isolation_level="AUTOCOMMIT")
    try:
        with engine.connect() as connection:
            connection.execute(text(statement))
    finally:
        engine.dispose()


def _missing(reason: str) -> NoReturn:
    if os.environ.get("CI"):
        pytest.fail(reason)
    pytest.skip(reason)

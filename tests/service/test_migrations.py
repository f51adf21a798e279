"""Migrations: what they build is what the tables say, on both databases, and they can be taken back."""

from pathlib import Path

import pytest
from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.config import Config
from alembic.migration import MigrationContext
from sqlalchemy import create_engine, inspect, pool

from service.store.database import migrate
from service.store.tables import Row


@pytest.fixture(params=["sqlite", "postgresql"])
def url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    if request.param == "sqlite":
        return f"sqlite:///{tmp_path / 'fresh.db'}"
    return str(request.getfixturevalue("postgres_url"))


def _differences(url: str) -> list[object]:
    engine = create_engine(url, poolclass=pool.NullPool)
    with engine.connect() as connection:
        options = {"compare_type": True, "compare_server_default": True}
        return list(compare_metadata(MigrationContext.configure(connection, opts=options), Row.metadata))


def _tables(url: str) -> set[str]:
    return set(inspect(create_engine(url, poolclass=pool.NullPool)).get_table_names())


def test_up_down_and_up_again_is_what_the_tables_say(url: str) -> None:
    migrate(url)
    assert _differences(url) == []
    assert _tables(url) == {*Row.metadata.tables, "alembic_version"}
    migrate(url)  # the newest already
    config = Config()
    config.set_main_option("script_location", "service.store:migrations")
    config.set_main_option("path_separator", "os")
    config.attributes["url"] = url
    command.downgrade(config, "base")
    assert _tables(url) == {"alembic_version"}
    migrate(url)
    assert _differences(url) == []

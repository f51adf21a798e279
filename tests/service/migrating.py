"""What tests of migrations ask of a database, and how they take it back to an older schema."""

from typing import Any
from uuid import UUID

from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.config import Config
from alembic.migration import MigrationContext
from sqlalchemy import Engine, create_engine, inspect, pool

from service.store.columns import Row


def engine_of(url: str) -> Engine:
    """That keeps no connection open."""
    return create_engine(url, poolclass=pool.NullPool)


def differences(url: str) -> list[object]:
    """Between the database and the tables of today."""
    with engine_of(url).connect() as connection:
        options = {"compare_type": True, "compare_server_default": True}
        return list(compare_metadata(MigrationContext.configure(connection, opts=options), Row.metadata))


def tables(url: str) -> set[str]:
    """Names of those that are there."""
    return set(inspect(engine_of(url)).get_table_names())


def version(url: str) -> str | None:
    """The revision of the schema."""
    with engine_of(url).connect() as connection:
        return MigrationContext.configure(connection).get_current_revision()


def schema_of(url: str) -> dict[str, Any]:
    """Columns, keys and indexes of all tables, to be compared."""
    looked = inspect(engine_of(url))

    def told(table: str) -> list[Any]:
        columns = [f"{each['name']} {each['type']} {each['nullable']}" for each in looked.get_columns(table)]
        indexes = [f"{each['name']} {each['column_names']} {each['unique']}" for each in looked.get_indexes(table)]
        keys = [f"{each['constrained_columns']} {each['referred_table']}" for each in looked.get_foreign_keys(table)]
        return [sorted(columns), sorted(indexes), sorted(keys), list(looked.get_pk_constraint(table).values())[:1]]

    return {table: told(table) for table in sorted(looked.get_table_names())}


def downgrade(url: str, revision: str) -> None:
    """Go back to the revision."""
    config = Config()
    config.set_main_option("script_location", "service.store:migrations")
    config.set_main_option("path_separator", "os")
    config.attributes["url"] = url
    command.downgrade(config, revision)


def check_references(url: str) -> None:
    """SQLite does not look while tables are made anew."""
    if url.startswith("sqlite"):
        with engine_of(url).connect() as connection:
            assert connection.exec_driver_sql("PRAGMA foreign_key_check").all() == []
            assert connection.exec_driver_sql("PRAGMA integrity_check").scalar() == "ok"


def quoted(url: str, name: UUID) -> str:
    """As the database writes it."""
    return str(name) if "postgresql" in url else name.hex

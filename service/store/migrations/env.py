"""Alembic's entry: the URL comes from the caller, never from a file.

All steps run in one transaction, one process at a time: killed in the middle, a migration has changed nothing.
"""

from alembic import context
from sqlalchemy import Connection, create_engine, event, pool

import service.store.tables  # noqa: F401  # its rows are what the metadata holds
from service.store.columns import Row

MIGRATION_LOCK = 4711  # of PostgreSQL's advisory locks in this database


def _begin_alone(connection: Connection) -> None:
    if connection.dialect.name == "sqlite":
        connection.exec_driver_sql("BEGIN IMMEDIATE")


engine = create_engine(context.config.attributes["url"], poolclass=pool.NullPool)
if engine.dialect.name == "sqlite":  # the driver would commit before each change of a table
    event.listen(engine, "connect", lambda connection, _: setattr(connection, "isolation_level", None))
    event.listen(engine, "begin", _begin_alone)
with engine.connect() as connection:
    context.configure(
        connection=connection,
        target_metadata=Row.metadata,
        render_as_batch=True,
        compare_type=True,
        transactional_ddl=True,
    )
    with context.begin_transaction():
        if engine.dialect.name == "postgresql":
            connection.exec_driver_sql(f"SELECT pg_advisory_xact_lock({MIGRATION_LOCK})")
        context.run_migrations()
engine.dispose()

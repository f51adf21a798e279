"""Alembic's entry: the URL comes from the caller, never from a file."""

from alembic import context
from sqlalchemy import create_engine, pool

from service.store.tables import Row

engine = create_engine(context.config.attributes["url"], poolclass=pool.NullPool)
with engine.connect() as connection:
    context.configure(connection=connection, target_metadata=Row.metadata, render_as_batch=True, compare_type=True)
    with context.begin_transaction():
        context.run_migrations()
engine.dispose()

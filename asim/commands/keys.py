"""asim key: API keys, made on the service's own database, so that there is a first one."""

from collections.abc import Iterator
from contextlib import closing, contextmanager
from datetime import timedelta
from typing import TYPE_CHECKING, Annotated, get_args

import typer

from asim.commands.processes import Data, settings_of

if TYPE_CHECKING:
    from pathlib import Path

    from service.store.database import Database

app = typer.Typer(no_args_is_help=True)


@app.command()
def create(
    name: Annotated[str, typer.Argument(help="Whose key it is.")],
    scope: Annotated[list[str], typer.Option(help="admin, acquire, label or read; may be repeated.")],
    project: Annotated[str | None, typer.Option(help="Name or id of the only project that it reaches.")] = None,
    days: Annotated[
        float | None, typer.Option(min=0, max=36500, help="After so many it opens nothing; default never.")
    ] = None,
    data: Data = None,
) -> None:
    """Make an API key and print its secret, once. Needs the database (ASIM_DATABASE_URL or the data folder)."""
    from api_schemas.keys import KeyCreate, Scope
    from asim.errors import AsimError
    from service import keys, projects
    from service.clock import utc_now

    unknown = sorted(set(scope) - set(get_args(Scope)))
    if unknown:
        raise AsimError(f"--scope {unknown[0]}: must be one of {', '.join(get_args(Scope))}")
    now = utc_now()
    expires_at = None if days is None else now + timedelta(days=days)
    with _database(data) as database, database.write() as session:
        of = None if project is None else projects.named(session, project).id
        asked = {"name": name, "scopes": scope, "project": of, "expires_at": expires_at}
        created = keys.create(session, KeyCreate.model_validate(asked), now)
    typer.echo(created.secret)


@app.command("list")
def show(data: Data = None) -> None:
    """All keys, without their secrets."""
    from asim.tables import key_table
    from asim.tables import show as show_table
    from service import keys, projects
    from service.clock import utc_now

    with _database(data) as database, database.read() as session:
        found = keys.everyone(session)
        names = {key.project: projects.find(session, key.project).name for key in found if key.project}
    show_table(key_table(found, names, utc_now()))


@app.command()
def revoke(
    key: Annotated[str, typer.Argument(help="Id of the key, as asim key list shows it.")], data: Data = None
) -> None:
    """Delete a key; from now on it opens nothing."""
    from uuid import UUID

    from asim.errors import AsimError
    from service import keys
    from service.clock import utc_now

    try:
        named = UUID(key)
    except ValueError:
        raise AsimError(f"key {key!r} is not an id as asim key list shows them") from None
    with _database(data) as database, database.write() as session:
        keys.revoke(session, named, utc_now())
    typer.echo(f"key {named} is revoked")


@contextmanager
def _database(data: "Path | None") -> "Iterator[Database]":
    """The service's own, of the newest schema."""
    from service.store.database import migrate, open_database

    settings = settings_of(data)
    settings.make_data_folder()
    url = settings.resolved_database_url()
    migrate(url)
    with closing(open_database(url, pool_size=1)) as database:
        yield database

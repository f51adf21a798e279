"""asim key: API keys, made on the service's own database, so that there is a first one."""

from typing import Annotated, get_args

import typer

from asim.commands.processes import Data, settings_of


def create(
    name: Annotated[str, typer.Argument(help="Whose key it is.")],
    scope: Annotated[list[str], typer.Option(help="admin, acquire, label or read; may be repeated.")],
    data: Data = None,
) -> None:
    """Make an API key and print its secret, once. Needs the database (ASIM_DATABASE_URL or the data folder)."""
    from api_schemas.keys import KeyCreate, Scope
    from asim.errors import AsimError
    from service import keys
    from service.clock import utc_now
    from service.store.database import migrate, open_database

    unknown = sorted(set(scope) - set(get_args(Scope)))
    if unknown:
        raise AsimError(f"--scope {unknown[0]}: must be one of {', '.join(get_args(Scope))}")
    settings = settings_of(data)
    settings.data_folder.mkdir(parents=True, exist_ok=True)
    url = settings.resolved_database_url()
    migrate(url)
    database = open_database(url)
    with database.write() as session:
        created = keys.create(session, KeyCreate.model_validate({"name": name, "scopes": scope}), utc_now())
    database.close()
    typer.echo(created.secret)

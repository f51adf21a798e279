"""asim doctor, backup, restore, gc and db: what keeps an installation well. They work on its database and stores."""

from contextlib import closing
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from asim.commands.processes import Data, settings_of

if TYPE_CHECKING:
    from service.backup import Manifest
    from service.settings import Settings
    from service.store.blobs import Blobs

db = typer.Typer(no_args_is_help=True)
Folder = Annotated[Path, typer.Argument(help="Folder of the backup.")]


def doctor(
    data: Data = None,
    *,
    quick: Annotated[bool, typer.Option("--quick", help="Look whether blobs are there, do not read them.")] = False,
) -> None:
    """Say what is wrong with this installation and what to do. Changes nothing; status 1 where something is wrong."""
    from asim.doctor import examine, report
    from service.clock import utc_now

    found = []
    for each in examine(settings_of(data), utc_now, thorough=not quick):
        found.append(each)
        typer.echo("\n".join(report([each])))
    if any(faults for _, faults in found):
        raise typer.Exit(1)


def backup(folder: Folder, data: Data = None) -> None:
    """Write all rows of this moment and the blobs that they refer to, while the service works."""
    from service.backup import backup as make
    from service.clock import utc_now

    settings = _installed(data)
    manifest = make(settings.resolved_database_url(), _stores(settings), folder, utc_now())
    rows = sum(table.rows for table in manifest.tables.values())
    typer.echo(f"{folder}: {rows} rows, {sum(manifest.blobs.values())} blobs, schema {manifest.revision}")
    _tell_missing(manifest, "are missing or damaged and not in it")


def restore(folder: Folder, data: Data = None) -> None:
    """Write a backup into an empty database (of either kind) and its stores."""
    from service.backup import restore as bring_back

    settings = settings_of(data)
    settings.make_data_folder()
    manifest = bring_back(folder, settings.resolved_database_url(), _stores(settings))
    rows = sum(table.rows for table in manifest.tables.values())
    typer.echo(f"{rows} rows and {sum(manifest.blobs.values())} blobs of {manifest.created_at:%Y-%m-%d %H:%M:%S}Z")
    _tell_missing(manifest, "were not in it when it was made")


def gc(
    data: Data = None,
    *,
    grace_hours: Annotated[float, typer.Option(min=0, help="What is younger stays.")] = 24.0,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only say what would be done.")] = False,
) -> None:
    """Move blobs that nothing refers to into the trash, and empty the trash of what stayed there as long."""
    from service.clock import utc_now
    from service.garbage import collect
    from service.store.database import open_database

    settings = _installed(data)
    with closing(open_database(settings.resolved_database_url(), pool_size=1)) as database:
        found = collect(database, _stores(settings), utc_now(), timedelta(hours=grace_hours), dry_run=dry_run)
    for what, blobs in (
        ("moved to the trash", found.discarded),
        ("removed for good", found.forgotten),
        ("taken back from the trash", found.taken_back),
    ):
        would = "would be " if dry_run else ""
        typer.echo(f"{len(blobs)} blobs ({sum(blob.bytes for blob in blobs)} bytes) {would}{what}")


@db.command()
def upgrade(data: Data = None) -> None:
    """Bring the database's schema up to date. Embedded mode does so by itself."""
    from service.store.database import migrate, newest_revision

    settings = settings_of(data)
    settings.make_data_folder()
    migrate(settings.resolved_database_url())
    typer.echo(f"the schema is {newest_revision()}")


@db.command()
def copy(
    source: Annotated[str, typer.Argument(metavar="FROM", help="URL of the database to read.")],
    target: Annotated[str, typer.Argument(metavar="TO", help="URL of an empty database, of either kind.")],
) -> None:
    """Copy all rows from one database into another, say from SQLite to PostgreSQL. Blobs stay where they are."""
    from service.store.transfer import copy as copy_rows

    counts = copy_rows(source, target)
    typer.echo(f"{sum(counts.values())} rows of {len(counts)} tables")


def _installed(data: Path | None) -> "Settings":
    """Settings of an installation that is there: to open what is not would make it."""
    from service.store.database import check_newest

    settings = settings_of(data)
    check_newest(settings.resolved_database_url())
    return settings


def _tell_missing(manifest: "Manifest", what: str) -> None:
    if manifest.missing:
        typer.echo(f"{len(manifest.missing)} blobs {what}: {', '.join(manifest.missing[:3])}", err=True)
        raise typer.Exit(1)


def _stores(settings: "Settings") -> "list[Blobs]":
    from service.store.blobs import Blobs
    from service.store.provenance import open_provenance

    provenance = open_provenance(settings)
    return [Blobs(settings.resolved_blobs_url()), *([provenance] if provenance else [])]

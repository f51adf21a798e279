"""asim jobs, asim cancel, asim events: what the service does, and did."""

from contextlib import suppress
from itertools import islice
from typing import Annotated

import typer

from asim.commands.console import DEFAULT_URL, JsonLines, Key, ProjectName, Url, connect


def jobs(
    project: ProjectName,
    *,
    count: Annotated[int, typer.Option(min=1, help="The newest so many.")] = 20,
    as_json: JsonLines = False,
    url: Url = DEFAULT_URL,
    key: Key = None,
) -> None:
    """The jobs of a project, newest first: how far they are, and what went wrong."""
    from asim.tables import job_table, show

    with connect(url, key) as client:
        found = list(islice(client.jobs(client.find_project(project).id), count))
    if not as_json:
        show(job_table(found))
        return
    for job in found:
        typer.echo(job.model_dump_json())


def cancel(
    job: Annotated[str, typer.Argument(metavar="JOB", help="Id of the job, as asim jobs shows it.")],
    url: Url = DEFAULT_URL,
    key: Key = None,
) -> None:
    """Cancel a job that waits or runs: nothing that it still does is stored. Its round is cancelled with it."""
    with connect(url, key) as client:
        cancelled = client.cancel_job(job)
    typer.echo(f"job {cancelled.id} ({cancelled.kind}) is {cancelled.state}")


def events(
    project: ProjectName,
    *,
    follow: Annotated[bool, typer.Option("--follow", help="Go on with what happens, until Ctrl-C.")] = False,
    as_json: JsonLines = False,
    url: Url = DEFAULT_URL,
    key: Key = None,
) -> None:
    """What happened in a project, oldest first: time, who, what."""
    from asim.tables import event_line

    with connect(url, key) as client, suppress(KeyboardInterrupt):
        found = client.find_project(project).id
        for event in client.follow_events(found) if follow else client.events(found):
            typer.echo(event.model_dump_json() if as_json else event_line(event))

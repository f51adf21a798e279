"""asim acquire, asim label, asim round, asim error: the loop by hand."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from asim.commands.console import DEFAULT_URL, Count, Json, Key, Mode, ProjectName, Purpose, Strategy, Url, connect
from asim.errors import AsimError

if TYPE_CHECKING:
    from collections.abc import Iterable

    from api_schemas.acquisitions import Acquisition
    from api_schemas.projects import Project

Wait = Annotated[float, typer.Option(min=0, help="Seconds to wait for a ranked queue.")]


def acquire(
    project: ProjectName,
    *,
    count: Count = 16,
    mode: Mode = "pool",
    strategy: Strategy = None,
    purpose: Purpose = "pool",
    lease_seconds: Annotated[float | None, typer.Option(help="Default: the project's.")] = None,
    labeler: Annotated[str, typer.Option(help="Who will answer.")] = "",
    wait: Wait = 600.0,
    as_json: Json = False,
    url: Url = DEFAULT_URL,
    key: Key = None,
) -> None:
    """Take a batch of segments to label, under a lease."""
    from asim.tables import acquisition_table, show

    with connect(url, key) as client:
        found = client.find_project(project)
        batch = client.acquire(
            found.id,
            count,
            mode=mode,
            strategy=strategy,
            purpose=purpose,
            lease_seconds=lease_seconds,
            labeler=labeler,
            wait=wait,
        )
    if as_json:
        typer.echo(batch.model_dump_json(indent=2))
        return
    show(acquisition_table(batch))
    if batch.reason is not None:
        typer.echo(f"a smaller batch: {batch.reason}", err=True)
    if batch.strategy != batch.requested_strategy:
        typer.echo(f"by {batch.strategy} and not by {batch.requested_strategy}: {_why(batch, found)}", err=True)
    what = "states to explore from" if batch.mode == "explore" else "segments"
    typer.echo(f"acquisition {batch.id}, token {batch.token}: {len(batch.items)} {what} by {batch.strategy}")
    typer.echo(f"labels are due by {batch.lease_expires_at:%Y-%m-%d %H:%M:%S %Z} through POST {url}/labels")


def label(
    project: ProjectName,
    *,
    count: Count = 100,
    mode: Mode = "pool",
    strategy: Strategy = None,
    purpose: Purpose = "pool",
    acquisition: Annotated[str | None, typer.Option(help="Answer this one, taken elsewhere; needs --token.")] = None,
    token: Annotated[int | None, typer.Option(help="Of --acquisition.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the draw among actions that explain a step alike.")] = 0,
    item_seconds: Annotated[
        float, typer.Option(min=0.1, help="That the simulator may take for one of them; then it is ended.")
    ] = 300.0,
    wait: Wait = 600.0,
    url: Url = DEFAULT_URL,
    key: Key = None,
) -> None:
    """Acquire segments, or explorations, and answer them with the project's simulator."""
    from asim.report import Report
    from asim.simulator_labeling import answer, given, in_own_process

    with connect(url, key) as client, Report() as report:
        found = client.find_project(project)
        if found.environment.simulator is None:
            raise AsimError(f"project {found.name} names no simulator: its labels come from elsewhere")
        if acquisition is not None:
            batch = given(client, found, acquisition, token)
        else:
            batch = client.acquire(
                found.id, count, mode=mode, strategy=strategy, purpose=purpose, labeler="asim label", wait=wait
            )
        answer(client, batch, seed, report, in_own_process(url, key, item_seconds))


def _why(batch: "Acquisition", project: "Project") -> str:
    """Why another strategy than the requested one gave the batch."""
    if batch.mode == "explore":
        return "explorations are drawn by chance, no model proposes any yet"
    if batch.purpose == "held_out":
        return "held-out segments are drawn by chance"
    return "no model family takes its spaces" if project.family is None else "no round has trained a model yet"


def start_round(project: ProjectName, url: Url = DEFAULT_URL, key: Key = None) -> None:
    """Retrain on all labels that are there now; wait until the round is current."""
    from asim.report import Report
    from asim.rounds import await_round
    from asim.tables import error_table, show, warning_lines

    with connect(url, key) as client, Report() as report:
        found = client.find_project(project)
        started = client.start_round(found.id)
        with report.step(f"round {started.number} of {found.name} on {started.labels} labels") as advance:
            done = await_round(client, started.id, advance)
        curve = client.model_error(found.id)
    show(error_table({found.name: curve}))
    _warn(warning_lines(found.name, done))


def _warn(lines: "Iterable[str]") -> None:
    for line in lines:
        typer.echo(f"warning: {line}", err=True)


def model_error(
    projects: Annotated[list[str], typer.Argument(metavar="PROJECT...", help="Names or ids.")],
    plot: Annotated[Path | None, typer.Option(help="Write the learning curves to this PNG file.")] = None,
    as_json: Json = False,
    url: Url = DEFAULT_URL,
    key: Key = None,
) -> None:
    """The learning curves of projects: model error on held-out data after each round; what the current one warns of."""
    from asim.tables import error_table, show, warning_lines

    with connect(url, key) as client:
        found = [client.find_project(name) for name in projects]
        curves = {project.name: client.model_error(project.id) for project in found}
        current = {project.name: client.round(project.current_round) for project in found if project.current_round}
    if as_json:
        for curve in curves.values():
            typer.echo(curve.model_dump_json())
    else:
        show(error_table(curves))
    if any(point.model_error.loss is None for curve in curves.values() for point in curve.points):
        typer.echo("-: there were no held-out labels; collect or import some with --split held_out", err=True)
    _warn(line for name, shown in current.items() for line in warning_lines(name, shown))
    if plot is not None:
        from asim.figure import draw_learning_curves

        draw_learning_curves(curves, plot)
        typer.echo(f"wrote {plot}", err=True)

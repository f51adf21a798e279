"""asim project, asim collect: what is known of an environment, and trajectories from its simulator."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from asim.commands.console import DEFAULT_URL, Key, ProjectName, Split, Strategy, Url, connect
from asim.errors import AsimError

if TYPE_CHECKING:
    from api_schemas.collections import CollectionLabels
    from api_schemas.environments import Environment

app = typer.Typer(no_args_is_help=True)
RoundLabels = Annotated[int | None, typer.Option(min=0, help="New pool labels that start a round; 0: none does.")]
LabelBudget = Annotated[int | None, typer.Option(min=1, help="Pool labels that may be spent in all.")]


@app.command("create")
def create(
    name: str,
    *,
    simulator: Annotated[str | None, typer.Option(help="One that we ship: maniskill, minigrid, robosuite.")] = None,
    option: Annotated[list[str] | None, typer.Option(help="Of the simulator, as name=value; repeatable.")] = None,
    spaces: Annotated[Path | None, typer.Option(help="JSON file with the spaces of your own environment.")] = None,
    preset: Annotated[
        str | None, typer.Option(help="Size of the robots' networks and of their training, small (default) or paper.")
    ] = None,
    strategy: Strategy = None,
    round_labels: RoundLabels = None,
    label_budget: LabelBudget = None,
    segment_length: Annotated[int, typer.Option(min=1, help="Transitions of a segment.")] = 1,
    stride: Annotated[int | None, typer.Option(help="Between segments; default the segment's length.")] = None,
    held_out_fraction: Annotated[float, typer.Option(help="Of trajectories that never train.")] = 0.1,
    seed: Annotated[int, typer.Option(help="Of all its random draws.")] = 0,
    url: Url = DEFAULT_URL,
    key: Key = None,
) -> None:
    """Create a project and print its id."""
    from api_schemas.projects import LabelingPolicy, ProjectCreate

    policy = {"strategy": strategy, "round_labels": round_labels, "label_budget": label_budget}
    project = ProjectCreate(
        name=name,
        environment=_environment(simulator, option or [], spaces),
        preset=preset,  # type: ignore[arg-type]  # the schema says which there are
        segment_length=segment_length,
        stride=stride,
        held_out_fraction=held_out_fraction,
        seed=seed,
        policy=LabelingPolicy.model_validate({field: value for field, value in policy.items() if value is not None}),
    )
    with connect(url, key) as client:
        created = client.create_project(project)
    typer.echo(created.id)
    if created.family is None:
        typer.echo("no model family takes these spaces: the project keeps data and labels, trains nothing", err=True)


@app.command("list")
def list_projects(url: Url = DEFAULT_URL, key: Key = None) -> None:
    """All projects."""
    from asim.tables import project_table, show

    with connect(url, key) as client:
        show(project_table(list(client.projects())))


@app.command("show")
def show_project(project: ProjectName, url: Url = DEFAULT_URL, key: Key = None) -> None:
    """One project as it stands, as JSON."""
    with connect(url, key) as client:
        typer.echo(client.find_project(project).model_dump_json(indent=2))


@app.command("set")
def change(
    project: ProjectName,
    *,
    strategy: Strategy = None,
    batch_rule: Annotated[str | None, typer.Option(help="How scored segments become a batch, top or another.")] = None,
    round_labels: RoundLabels = None,
    label_budget: LabelBudget = None,
    lease_seconds: Annotated[float | None, typer.Option(help="Of a batch, unless it is asked otherwise.")] = None,
    url: Url = DEFAULT_URL,
    key: Key = None,
) -> None:
    """Change the labeling policy; what is left out stays."""
    from api_schemas.projects import ProjectPatch

    given = {
        "strategy": strategy,
        "batch_rule": batch_rule,
        "round_labels": round_labels,
        "label_budget": label_budget,
        "lease_seconds": lease_seconds,
    }
    patch = ProjectPatch.model_validate({field: value for field, value in given.items() if value is not None})
    with connect(url, key) as client:
        changed = client.change_project(client.find_project(project).id, patch)
    typer.echo(changed.policy.model_dump_json(indent=2))


def collect(
    project: ProjectName,
    *,
    transitions: Annotated[int | None, typer.Option(min=1, help="Transitions to collect.")] = None,
    trajectories: Annotated[int | None, typer.Option(min=1, help="Or whole trajectories.")] = None,
    behavior: Annotated[str | None, typer.Option(help="random, expert, policy:ID; default the simulator's.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of layouts and actions.")] = 0,
    split: Split = "auto",
    labels_per_action: Annotated[
        int | None,
        typer.Option(min=1, help="Record labels of so many effective transitions of each action (discrete ones)."),
    ] = None,
    labels: Annotated[
        str | None, typer.Option(metavar="all|NUMBER", help="Record labels of all, or so many, segments (boxes).")
    ] = None,
    jobs: Annotated[int, typer.Option(min=1, help="Share it among so many jobs, for as many collectors.")] = 1,
    url: Url = DEFAULT_URL,
    key: Key = None,
) -> None:
    """Run a behavior in the project's simulator and add its trajectories; wait until they are there."""
    from api_schemas.collections import CollectionCreate
    from asim.collecting import await_collection
    from asim.report import Report

    with connect(url, key) as client, Report() as report, report.step(f"collect into {project}") as advance:
        collection = CollectionCreate(
            project=client.find_project(project).id,
            behavior=behavior,
            transitions=transitions,
            trajectories=trajectories,
            seed=seed,
            split=split,
            labels=_labels(labels_per_action, labels),
            shards=jobs,
        )
        done = await_collection(client, client.collect(collection), advance)
    typer.echo(json.dumps(done))


def _labels(per_action: int | None, segments: str | None) -> "CollectionLabels | None":
    from api_schemas.collections import CollectionLabels

    if per_action is None and segments is None:
        return None
    if segments not in (None, "all") and not segments.isdecimal():
        raise AsimError(f"--labels {segments}: must be all, or a number of segments")
    number = None if segments in (None, "all") else int(segments)
    return CollectionLabels(per_action=per_action, segments=number, all=segments == "all")


def _environment(simulator: str | None, options: list[str], spaces: Path | None) -> "Environment":
    from api_schemas.environments import Environment, Spaces

    known = None if spaces is None else Spaces.model_validate_json(spaces.read_bytes())
    return Environment(simulator=simulator, options=dict(map(_option, options)), spaces=known)


def _option(text: str) -> tuple[str, str | int | float | bool]:
    name, equals, value = text.partition("=")
    if not equals:
        raise AsimError(f"option {text!r} is not of the form name=value")
    try:
        parsed = json.loads(value)
    except ValueError:  # a plain word, such as key_delivery
        return name, value
    return name, parsed if isinstance(parsed, int | float | bool) else value

"""asim policy: what robots do at stages of learning, to be rolled out by asim collect."""

import json
from typing import Annotated

import typer

from asim.commands.console import DEFAULT_URL, JsonLines, Key, ProjectName, Url, connect

app = typer.Typer(no_args_is_help=True)


@app.command("train")
def train(
    project: ProjectName,
    *,
    demonstrations: Annotated[int, typer.Option(min=1, max=1000, help="Episodes of the expert to learn from.")] = 300,
    stages: Annotated[int, typer.Option(min=1, max=20, help="Of training, each kept as a policy.")] = 10,
    observations: Annotated[str, typer.Option(help="What it acts by: state or images.")] = "state",
    seed: Annotated[int, typer.Option(min=0, help="Of demonstrations and training.")] = 0,
    url: Url = DEFAULT_URL,
    key: Key = None,
) -> None:
    """Train a diffusion policy on demonstrations of the project's task; wait until its stages are there.

    asim collect --behavior policy:ID rolls one out.
    """
    from api_schemas.policies import PolicyCreate
    from asim.report import Report

    with connect(url, key) as client, Report() as report, report.step(f"train a policy of {project}") as advance:
        fields = {"demonstrations": demonstrations, "stages": stages, "observations": observations, "seed": seed}
        asked = PolicyCreate.model_validate({"project": client.find_project(project).id, **fields})
        job = client.train_policy(asked)
        done = client.wait_for_job(job.id, progress=lambda seen: advance(seen.progress, seen.message))
    typer.echo(json.dumps(done.result))


@app.command("collect")
def collect(
    project: ProjectName,
    *,
    trajectories: Annotated[int, typer.Option(min=4, help="In all, shared evenly among expert and stages.")] = 1500,
    seed: Annotated[int, typer.Option(min=0, help="Of layouts and actions.")] = 0,
    jobs: Annotated[int, typer.Option(min=1, max=64, help="Share each part among so many jobs.")] = 1,
    url: Url = DEFAULT_URL,
    key: Key = None,
) -> None:
    """Roll out what was trained last, as in the paper: warm-up, pool and validation; wait until they are there.

    The expert and the best stage are the warm-up, labeled; one imperfect stage validates, labeled and held out; the
    other stages are the pool.
    """
    from asim.collecting import await_collection
    from asim.policy_parts import parts_of
    from asim.report import Report

    with connect(url, key) as client, Report() as report:
        found = client.find_project(project)
        for number, part in enumerate(parts_of(list(client.policies(found.id)), trajectories)):
            asked = part.collection(found.id, seed, number, jobs)
            with report.step(f"{part.name}: {part.trajectories} trajectories of {part.behavior[:15]}") as advance:
                done = await_collection(client, client.collect(asked), advance)
            typer.echo(json.dumps({"part": part.name, "behavior": part.behavior, **done}))


@app.command("list")
def list_policies(project: ProjectName, *, as_json: JsonLines = False, url: Url = DEFAULT_URL, key: Key = None) -> None:
    """The policies of a project, oldest first: at which stage of training each is, and how often it succeeds."""
    from asim.tables import policy_table, show

    with connect(url, key) as client:
        found = list(client.policies(client.find_project(project).id))
    if not as_json:
        show(policy_table(found))
        return
    for policy in found:
        typer.echo(policy.model_dump_json())

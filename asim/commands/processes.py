"""asim serve, asim worker, asim demo: the commands that start processes."""

from contextlib import closing, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from asim.commands.console import Key

if TYPE_CHECKING:
    from service.settings import Settings

Data = Annotated[
    Path | None,
    typer.Option("--data", envvar="ASIM_DATA_FOLDER", help="Folder that holds everything; default asim-data."),
]


def serve(
    data: Data = None,
    host: Annotated[
        str, typer.Option(help="Address to listen on; one that others reach needs an API key.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="0 takes a free port.")] = 8000,
    runners: Annotated[int, typer.Option(min=1, help="Processes that train and score.")] = 1,
    collectors: Annotated[int, typer.Option(min=1, help="Processes that run simulators for collections.")] = 1,
) -> None:
    """Serve the API and the dashboard, with the runners that do the jobs, until Ctrl-C."""
    from asim.serve import serve as serve_until_signal

    serve_until_signal(settings_of(data), host, port, runners, tell=_tell, collectors=collectors)


def worker(
    data: Data = None,
    queues: Annotated[
        str, typer.Option(help="Comma-separated, of train, score, default; or label alone.")
    ] = "train,score,default",
) -> None:
    """Do jobs in this process: as a Celery worker where ASIM_BROKER_URL is set, else on the data folder's database."""
    from asim.worker import work

    work(settings_of(data), queues)


def scheduler(data: Data = None) -> None:
    """Send jobs to Celery workers and take back those of silent ones, where ASIM_RELAY=false keeps the API from it."""
    from asim.schedule import schedule

    schedule(settings_of(data))


def alive(
    data: Data = None,
    url: Annotated[str | None, typer.Option(help="Ask whether the API there lives, instead.")] = None,
) -> None:
    """Status 0 where a worker or scheduler of this machine was heard of lately: a health check for containers."""
    from asim.alive import api_answers, heard_of
    from asim.errors import AsimError
    from service.clock import utc_now
    from service.store.database import open_database

    if url is not None:
        if not api_answers(url):
            raise AsimError(f"{url} does not answer")
        return
    with closing(open_database(settings_of(data).resolved_database_url(), pool_size=1)) as database:
        if not heard_of(database, utc_now()):
            raise AsimError("no worker or scheduler of this machine was heard of lately")


def demo(
    *,
    simulator: Annotated[str, typer.Option(help="minigrid; or of robots: maniskill, robosuite.")] = "minigrid",
    task: Annotated[str | None, typer.Option(help="Of a robot simulator; default its first.")] = None,
    seed: Annotated[int, typer.Option(min=0, envvar="SEED", help="Of data, labels and networks.")] = 0,
    keep: Annotated[Path | None, typer.Option(help="Keep the service's data in this folder.")] = None,
    url: Annotated[
        str | None, typer.Option(help="A service that runs already; without it the demo starts one of its own.")
    ] = None,
    key: Key = None,
) -> None:
    """Run the loop with the default strategy and random side by side, and compare their model errors."""
    from asim.demo import demo as run_demo
    from asim.demo_arm import Service
    from asim.demo_plans import plan_of
    from asim.errors import AsimError

    if url is not None and keep is not None:
        raise AsimError(f"--keep {keep}: the service at --url {url} keeps its data itself; give one of the two")
    service = None if url is None else Service(url, key, f"demo-{datetime.now(UTC):%Y%m%d-%H%M%S}")
    run_demo(seed, keep, plan_of(simulator, task), service)


def settings_of(data: Path | None) -> "Settings":
    """The environment's settings, on this data folder if one is named."""
    from service.settings import Settings

    return Settings() if data is None else Settings(data_folder=data)


def _tell(line: str) -> None:
    with suppress(BrokenPipeError):  # `asim serve | head`: nobody reads on, and the service goes on
        typer.echo(line)

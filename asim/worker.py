"""`asim worker`: one process that does jobs, by whichever carrier the settings name."""

import os
import sys

from asim.errors import AsimError
from asim.runners import COLLECTOR_QUEUES, runner_argv, runner_environment
from service.settings import Settings

QUEUE_NAMES = ("train", "score", "label", "default")


def work(settings: Settings, queues: str) -> None:
    """Do jobs of `queues` until SIGTERM; this process becomes the worker and does not return.

    Raises AsimError for an unknown queue, for collections, which need simulator states, together with training and
    scoring, which must not reach them, and for a data folder that was never served.
    """
    names = [name.strip() for name in queues.split(",") if name.strip()]
    _check(names)
    _check_database(settings)
    environment = runner_environment(settings, ",".join(names))
    argv = _celery_argv(settings, names) if settings.broker_url else runner_argv(",".join(names))
    sys.stdout.flush()
    os.execve(sys.executable, argv, environment)  # noqa: S606  (no shell: our own module, by the same interpreter)


def _check(names: list[str]) -> None:
    unknown = sorted(set(names) - set(QUEUE_NAMES))
    if unknown or not names:
        raise AsimError(f"queues: {', '.join(unknown) or 'none'} given; known are {', '.join(QUEUE_NAMES)}")
    if COLLECTOR_QUEUES in names and len(names) > 1:
        raise AsimError(
            f"queues: {','.join(names)} mixes label, which reaches simulator states, with training and scoring, "
            "which must not; start a worker for --queues label by itself"
        )


def _check_database(settings: Settings) -> None:
    if not settings.database_url and not (settings.data_folder / "asim.db").exists():
        raise AsimError(f"data folder {settings.data_folder.absolute()} holds no database; asim serve makes one")


def _celery_argv(settings: Settings, names: list[str]) -> list[str]:
    """A prefork worker of one child; that it is spawned, not forked, stands in workers.app."""
    queues = ",".join(f"{settings.celery_prefix}.{name}" for name in names)
    name = f"asim-{os.getpid()}@%h"  # workers of one machine must not share a name
    options = ["--hostname", name, "--queues", queues, "--pool", "prefork", "--concurrency", "1", "--loglevel", "INFO"]
    return [sys.executable, "-m", "celery", "--app", "workers.app", "worker", *options]

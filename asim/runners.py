"""Which processes do the jobs, and what each of them may reach."""

import os
import sys

from asim.supervision import Supervised
from service.settings import Settings

SCIENCE_QUEUES = "train,score,default"
COLLECTOR_QUEUES = "label"


def runner_processes(settings: Settings, runners: int, collectors: int = 1) -> list[Supervised]:
    """The science runners, who cannot reach simulator states, and the collectors, who can. None with a broker."""
    if not settings.embedded:
        return []
    science = [_runner(f"runner {number}", settings, SCIENCE_QUEUES) for number in range(1, runners + 1)]
    names = ["collector", *(f"collector {number}" for number in range(2, collectors + 1))]
    return [*science, *(_runner(name, settings, COLLECTOR_QUEUES) for name in names)]


def runner_environment(settings: Settings, queues: str) -> dict[str, str]:
    """The environment of a runner for `queues`: threads bounded, and no way to provenance unless it collects."""
    threads = str(settings.torch_threads)
    environment = {
        **os.environ,
        "ASIM_DATA_FOLDER": str(settings.data_folder.absolute()),
        "OMP_NUM_THREADS": threads,
        "MKL_NUM_THREADS": threads,
    }
    if queues != COLLECTOR_QUEUES:
        environment["ASIM_PROVENANCE_URL"] = ""
    return environment


def runner_argv(queues: str) -> list[str]:
    """The command of an embedded runner."""
    return [sys.executable, "-m", "workers.runner", "--queues", queues]


def _runner(name: str, settings: Settings, queues: str) -> Supervised:
    argv = [*runner_argv(queues), "--parent", str(os.getpid())]
    return Supervised(name, argv, runner_environment(settings, queues))

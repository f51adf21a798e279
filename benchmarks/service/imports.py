"""Import of image trajectories through the running service, beside the store's own codec on the same bytes.

    python -m benchmarks.service.imports                         5,000 trajectories, or as many as ten minutes allow
    python -m benchmarks.service.imports --trajectories 1000

Two cameras of 64 x 64 and proprioception, 100 transitions, pictures of a simulator (see `recordings`). The files are
written by a process of their own, which also times the codec; this one imports them as `asim import` does, into an
`asim serve` of its own, and holds nothing else. Both take turns, CHUNK files each; the ratio is the median over the
turns, by the clock: the codec has one processor, client and service have what there is. What the codec does to a
trajectory is its name by content and its bytes in the store.
"""

import argparse
import json
import multiprocessing
import os
import statistics
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache
from operator import truediv
from pathlib import Path
from uuid import UUID

from api_schemas.environments import Environment
from api_schemas.projects import LabelingPolicy, ProjectCreate
from asim.client import Client
from asim.importing import add_plain
from asim.served import served
from benchmarks.figures import Figure, finish
from benchmarks.service.recordings import SIMULATOR, TASK, Recordings, Written

TRAJECTORIES, CHUNK, MINUTES = 5000, 100, 10.0
SHARE = 0.8  # of the codec's speed
GROWTH = 32.0  # MiB from the first quarter to the end, of either process
MEBIBYTE = 2**20


@dataclass(frozen=True)
class Turn:
    """Of CHUNK files: what was written, seconds of the import, seconds of processor time of client and service for it,
    and the MiB that each holds afterwards."""

    written: Written
    seconds: float
    processor: tuple[float, float]
    memory: tuple[float, float]


@dataclass(frozen=True)
class Process:
    """One that is watched."""

    pid: int

    def memory(self) -> float:
        """MiB resident."""
        told = Path(f"/proc/{self.pid}/status").read_text().partition("VmRSS:")[2].split()[0]
        return int(told) / 1024

    def seconds(self) -> float:
        """Of processor time so far."""
        told = Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(told[11]) + int(told[12])) / os.sysconf("SC_CLK_TCK")


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--trajectories", type=int, default=TRAJECTORIES)
    parser.add_argument("--minutes", type=float, default=MINUTES, help="after them no further files are written")
    asked = parser.parse_args()
    os.environ |= {"OMP_NUM_THREADS": "1"}  # of the service's processes, which inherit it
    finish(_figures(measure(asked.trajectories, asked.minutes)))


def measure(trajectories: int, minutes: float) -> list[Turn]:
    """Write, encode and import, CHUNK files a turn."""
    spawn, turns = multiprocessing.get_context("spawn"), list[Turn]()
    deadline = time.monotonic() + 60 * minutes
    with (
        ProcessPoolExecutor(1, spawn) as writer,
        tempfile.TemporaryDirectory() as folder,
        served(Path(folder)) as url,
        Client(url) as client,
    ):
        service = Process(int(json.loads((Path(folder) / "serve.json").read_text())["pid"]))
        project = client.create_project(_project()).id
        for first in range(0, trajectories, CHUNK):
            if time.monotonic() > deadline:
                break
            written = writer.submit(write, Path(folder), first, min(CHUNK, trajectories - first)).result()
            turns.append(_imported(client, project, written, service))
        counts = client.project(project).counts
        if counts.pool_trajectories != sum(len(turn.written.files) for turn in turns):
            raise RuntimeError(f"of the files that were imported {counts.pool_trajectories} are in the pool")
    return turns


@cache
def recordings() -> Recordings:
    """Rendered once in a process."""
    return Recordings()


def write(folder: Path, first: int, count: int) -> Written:
    """In the process that writes."""
    return recordings().write(folder, first, count)


def _imported(client: Client, project: UUID, written: Written, service: Process) -> Turn:
    own = Process(os.getpid())
    before, began = (own.seconds(), service.seconds()), time.perf_counter()
    added = list(add_plain(client, project, written.files, "pool"))
    seconds = time.perf_counter() - began
    processor = (own.seconds() - before[0], service.seconds() - before[1])
    if any(receipt.status != "created" for receipt in added):
        raise RuntimeError("a trajectory was there before")
    for file in written.files:
        file.unlink()
    return Turn(written, seconds, processor, (own.memory(), service.memory()))


def _project() -> ProjectCreate:
    environment = Environment(simulator=SIMULATOR, options={"task": TASK})
    return ProjectCreate(name="bench", environment=environment, policy=LabelingPolicy(round_labels=0))


def _figures(turns: list[Turn]) -> list[Figure]:
    files, size = sum(len(turn.written.files) for turn in turns), sum(turn.written.bytes for turn in turns)
    rates = [turn.written.bytes / turn.seconds / MEBIBYTE for turn in turns]
    codec = [turn.written.bytes / turn.written.seconds / MEBIBYTE for turn in turns]
    packed = size / sum(turn.written.encoded for turn in turns)
    each = f"{size / files / MEBIBYTE:.2f} MiB each, stored at 1/{packed:.1f} of it"
    print(f"{files} trajectories of two cameras, {each}")
    for name, place in zip(("start", "a quarter", "half", "end"), (0, 1, 2, 4), strict=True):
        client, service = turns[min(place * len(turns) // 4, len(turns) - 1)].memory
        print(f"memory at {name}: client {client:.0f} MiB, service {service:.0f} MiB")
    growth = [turns[-1].memory[which] - turns[len(turns) // 4].memory[which] for which in (0, 1)]
    spent = [1e3 * sum(turn.processor[which] for turn in turns) / files for which in (0, 1)]
    unit = "ms of processor time a trajectory"
    return [
        Figure("codec", statistics.median(codec), "MiB/s"),
        Figure("import", statistics.median(rates), "MiB/s"),
        Figure("codec_cost", 1e3 * sum(turn.written.processor for turn in turns) / files, unit),
        Figure("client_cost", spent[0], unit),
        Figure("service_cost", spent[1], unit),
        Figure("client_memory_growth", growth[0], "MiB from a quarter to the end", GROWTH, "below"),
        Figure("service_memory_growth", growth[1], "MiB from a quarter to the end", GROWTH, "below"),
        Figure("import_to_codec", statistics.median(map(truediv, rates, codec)), "ratio", SHARE),
    ]


if __name__ == "__main__":
    main()

"""Latency of POST /acquire over HTTP: 16 segments a call, 5 runs of 200 calls, a ready queue, a pool of any size.

    python -m benchmarks.service.acquire                                      28,000 segments on SQLite
    python -m benchmarks.service.acquire --pool 1000000 --database postgresql+psycopg://…

The service is an `asim serve` of its own; the client asks one call after another over one connection, so the figures
are latencies without waiting for other clients; its garbage collector rests meanwhile. The queue is selected once, long
enough for all calls of a run; after each its batches are given back. What was filled is on the disk before the first.
Percentiles are medians over the runs, as the machine may be another's too. --database is the URL of an empty database
(of a user who may CHECKPOINT); without it the service keeps its own file.
"""

import argparse
import gc
import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from sqlalchemy import create_engine

from api_schemas.acquisitions import Acquisition
from api_schemas.projects import Project
from asim.client import Client
from asim.served import served
from benchmarks.figures import Figure, finish
from benchmarks.service.filling import fill, project_of

RUNS, CALLS, COUNT, WARM_UP = 5, 200, 16, 5
ASKED = (CALLS + WARM_UP) * COUNT  # segments in a run
SMALL_POOL = 28_000
TARGETS = {SMALL_POOL: 30.0}  # milliseconds; a larger pool has LARGE_TARGET
LARGE_TARGET = 50.0
QUEUE_SECONDS = 300.0
ENVIRONMENT = {"ASIM_QUEUE_LENGTH": str(ASKED)}


@dataclass(frozen=True)
class Measured:
    """Seconds: of filling the pool, of the first queue, of each call of each run."""

    filling: float
    ranking: float
    runs: Sequence[Sequence[float]]

    def figures(self, pool: int) -> list[Figure]:
        """What is printed."""
        milliseconds = np.array(self.runs) * 1000  # (RUNS, CALLS)
        p50, p99 = np.median(np.percentile(milliseconds, (50, 99), axis=1), axis=1)
        target = TARGETS.get(pool, LARGE_TARGET)
        return [
            Figure("filling", pool / self.filling, "segments/s"),
            Figure("first_queue", self.ranking, "s"),
            Figure("acquire_p50", float(p50), "ms"),
            Figure("acquire_max", float(milliseconds.max()), "ms"),
            Figure("acquire_p99", float(p99), "ms", target, "below"),
        ]


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--pool", type=int, default=SMALL_POOL, help="segments")
    parser.add_argument("--transitions", type=int, default=50, help="of each trajectory")
    parser.add_argument("--database", default="", help="URL of an empty database; default a SQLite file")
    asked = parser.parse_args()
    os.environ |= ENVIRONMENT | {"ASIM_DATABASE_URL": asked.database}
    with tempfile.TemporaryDirectory() as folder, served(Path(folder)) as url, Client(url) as client:
        measured = measure(client, asked.pool, asked.transitions)
    kind = asked.database.partition(":")[0] or "sqlite"
    print(f"{RUNS} runs of {CALLS} calls of POST /acquire, {COUNT} segments each, a pool of {asked.pool}, {kind}, HTTP")
    finish(measured.figures(asked.pool))


def measure(client: Client, pool: int, transitions: int = 50) -> Measured:
    """Fill a pool and acquire from it."""
    project = project_of(client, "bench")
    began = time.perf_counter()
    fill(client, project, pool, transitions)
    filled = time.perf_counter()
    client.acquire(project.id, COUNT, wait=QUEUE_SECONDS)  # the first call waits for the queue
    ranked = time.perf_counter()
    for _ in range(WARM_UP - 1):
        client.acquire(project.id, COUNT, wait=0)
    _settle(os.environ.get("ASIM_DATABASE_URL", ""))
    runs = [_run(client, project, pool) for _ in range(RUNS)]
    return Measured(filled - began, ranked - filled, runs)


def _run(client: Client, project: Project, pool: int) -> list[float]:
    with _collector_at_rest():
        calls = [_call(client, project) for _ in range(CALLS)]
    given = client.project(project.id).counts
    if (given.pool_segments, given.leased) != (pool, ASKED):
        raise RuntimeError(f"a pool of {pool} segments was asked for and {ASKED} leased: {given}")
    for _, batch in calls:
        client.release(batch.id, batch.token or 0)
    return [seconds for seconds, _ in calls]


def _settle(database: str) -> None:
    """Have what was filled on the disk: else the commits of the calls wait for the rest of it."""
    if database.startswith("postgresql"):
        engine = create_engine(database, isolation_level="AUTOCOMMIT")
        with engine.connect() as connection:
            connection.exec_driver_sql("CHECKPOINT")
        engine.dispose()
    os.sync()


@contextmanager
def _collector_at_rest() -> Iterator[None]:
    """Of this process: it is the service that is measured."""
    gc.collect()
    gc.disable()
    yield
    gc.enable()


def _call(client: Client, project: Project) -> tuple[float, Acquisition]:
    began = time.perf_counter()
    batch = client.acquire(project.id, COUNT, wait=0)
    seconds = time.perf_counter() - began
    if len(batch.items) != COUNT:
        raise RuntimeError(f"asked for {COUNT} segments, got {len(batch.items)}")
    return seconds, batch


if __name__ == "__main__":
    main()

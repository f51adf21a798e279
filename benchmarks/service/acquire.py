"""Latency of POST /acquire over HTTP: 16 segments a call, 200 calls, a ready queue, a pool of 28,000 segments.

The service is an `asim serve` of its own on SQLite; the client asks one call after another over one connection, so the
figures are latencies without waiting for other clients. The queue is selected once, long enough for all calls.
"""

import os
import tempfile
import time
from pathlib import Path

import numpy as np

from api_schemas.collections import CollectionCreate
from api_schemas.environments import Environment
from api_schemas.projects import LabelingPolicy, ProjectCreate
from asim.client import Client
from asim.served import served
from benchmarks.figures import Figure, finish

CALLS, COUNT, WARM_UP, TRANSITIONS = 200, 16, 5, 28_000


def main() -> None:
    """Run and print."""
    os.environ["ASIM_QUEUE_LENGTH"] = str((CALLS + WARM_UP) * COUNT)
    with tempfile.TemporaryDirectory() as folder, served(Path(folder)) as url, Client(url) as client:
        seconds = _latencies(client)
    milliseconds = np.array(seconds) * 1000
    print(f"{CALLS} calls of POST /acquire, {COUNT} segments each, a pool of {TRANSITIONS} segments, SQLite, HTTP")
    finish(
        [
            Figure("acquire_p50", float(np.percentile(milliseconds, 50)), "ms"),
            Figure("acquire_max", float(milliseconds.max()), "ms"),
            Figure("acquire_p99", float(np.percentile(milliseconds, 99)), "ms", 30.0, "below"),
        ]
    )


def _latencies(client: Client) -> list[float]:
    """Seconds of each call; the pool's order is random, which needs no round and takes the same path as any other."""
    policy = LabelingPolicy(strategy="random", round_labels=0)
    project = client.create_project(
        ProjectCreate(name="bench", environment=Environment(simulator="minigrid"), policy=policy)
    )
    job = client.collect(CollectionCreate(project=project.id, transitions=TRANSITIONS, split="pool"))
    client.wait_for_job(job.id)
    for _ in range(WARM_UP):  # the first call waits for the queue
        client.acquire(project.id, COUNT)
    seconds = []
    for _ in range(CALLS):
        began = time.perf_counter()
        batch = client.acquire(project.id, COUNT, wait=0)
        seconds.append(time.perf_counter() - began)
        if len(batch.items) != COUNT:
            raise RuntimeError(f"asked for {COUNT} segments, got {len(batch.items)}")
    return seconds


if __name__ == "__main__":
    main()

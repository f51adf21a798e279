"""Labels over HTTP from several client processes: bodies are written beforehand, so that clients cost next to nothing.

Each client has one connection and sends one batch after another, paced or as fast as it is answered. Every REPLAY-th
batch is sent a second time under its Idempotency-Key, as a client does that did not hear the answer.
"""

import http.client
import json
import multiprocessing
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from urllib.parse import urlsplit
from uuid import UUID, uuid4

import numpy as np

Segment = tuple[str, int]
REPLAY = 25


@dataclass(frozen=True)
class Load:
    """What one client sends: batches of segments of a project, `rate` labels a second (None: unpaced), from `begin` on
    by the clock of all processes (time.time), for at most `seconds`."""

    url: str
    key: str
    project: UUID
    batches: Sequence[Sequence[Segment]]
    rate: float | None
    begin: float
    seconds: float


@dataclass
class Sent:
    """What came of it. `acknowledged`: segments whose labels were answered with 201; `latencies` in seconds; `late`: by
    how much the latest batch was sent behind its time; `replayed`: batches that were sent twice."""

    acknowledged: list[Segment] = field(default_factory=list)
    latencies: list[float] = field(default_factory=list)
    late: float = 0.0
    ended: float = 0.0
    replayed: int = 0


def send_all(loads: Sequence[Load]) -> list[Sent]:
    """A process for each load, all at once; the first failure is raised."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(len(loads), mp_context=context) as processes:
        return list(processes.map(send, loads))


def send(load: Load) -> Sent:
    """One client. Raises RuntimeError where a batch is refused, or a replay is answered otherwise than its original."""
    bodies = [_body(load.project, batch) for batch in load.batches]
    address = urlsplit(load.url)
    connection = http.client.HTTPConnection(address.hostname or "", address.port, timeout=60)
    connection.connect()
    if time.time() > load.begin:
        raise RuntimeError(f"the client was ready {time.time() - load.begin:.1f} s after the others had begun")
    sent = Sent()
    time.sleep(max(0.0, load.begin - time.time()))
    for number, (batch, body) in enumerate(zip(load.batches, bodies, strict=True)):
        due = load.begin if load.rate is None else load.begin + number * len(batch) / load.rate
        time.sleep(max(0.0, due - time.time()))
        if time.time() > load.begin + load.seconds:
            break
        sent.late = max(sent.late, time.time() - due) if load.rate is not None else 0.0
        _send_batch(connection, load, body, sent, replay=number % REPLAY == REPLAY - 1)
        sent.acknowledged.extend(batch)
        sent.ended = time.time()
    connection.close()
    return sent


def shares(batches: Sequence[Sequence[Segment]], clients: int) -> list[Sequence[Sequence[Segment]]]:
    """The batches dealt out to clients."""
    return [batches[number::clients] for number in range(clients)]


def batches_of(segments: Sequence[Segment], size: int, seed: int = 0) -> list[list[Segment]]:
    """All segments in a random order, as an acquisition gives them from all over the pool, `size` a batch."""
    order = np.random.default_rng(seed).permutation(len(segments))
    shuffled = [segments[place] for place in order]
    return [shuffled[start : start + size] for start in range(0, len(shuffled) - size + 1, size)]


def _send_batch(connection: http.client.HTTPConnection, load: Load, body: bytes, sent: Sent, *, replay: bool) -> None:
    key = uuid4().hex
    began = time.perf_counter()
    first, _ = _post(connection, load.key, body, key)
    sent.latencies.append(time.perf_counter() - began)
    if not replay:
        return
    second, replayed = _post(connection, load.key, body, key)
    if second != first or not replayed:
        raise RuntimeError(f"a batch that was sent again was answered {second[:300]!r}, at first {first[:300]!r}")
    sent.replayed += 1


def _post(connection: http.client.HTTPConnection, api_key: str, body: bytes, key: str) -> tuple[bytes, bool]:
    headers = {"Authorization": f"Bearer {api_key}", "Content-Type": "application/json", "Idempotency-Key": key}
    connection.request("POST", "/labels", body, headers)
    answer = connection.getresponse()
    content = answer.read()
    if answer.status != 201:
        raise RuntimeError(f"POST /labels was answered {answer.status}: {content[:500]!r}")
    return content, answer.getheader("Idempotency-Replayed") == "true"


def _body(project: UUID, batch: Sequence[Segment]) -> bytes:
    """Actions of seven by chance of the segment's name, so that the same segment always gets the same."""
    items = [
        {"trajectory": trajectory, "start": start, "actions": [(int(trajectory[:8], 16) + start) % 7]}
        for trajectory, start in batch
    ]
    source = {"kind": "robot", "name": "benchmark"}
    return json.dumps({"project": str(project), "source": source, "items": items}).encode()

"""POST /acquire under many clients, and from a large pool."""

import threading
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from asim.client import Client
from asim.errors import Conflict, NotReady
from asim.served import served
from benchmarks.service import acquire
from benchmarks.service.filling import fill, project_of
from tests.figures import Figures
from tests.scale.conftest import Deploy

CLIENTS, SEGMENTS, COUNT = 16, 1000, 4
DRAIN_SECONDS = 120.0
LARGE_POOL = 1_000_000
Segment = tuple[str, int]


class Drainer(threading.Thread):
    """Acquires batches until nothing is left. `seconds` of every call that gave something; `failure` ended it early."""

    def __init__(self, url: str, key: str, project: str, gate: threading.Barrier) -> None:
        super().__init__(name="drainer", daemon=True)
        self._client, self._project, self._gate = Client(url, key), project, gate
        self.given: list[Segment] = []
        self.seconds: list[float] = []
        self.failure: Exception | None = None

    def run(self) -> None:
        """Begin with all others; end where the pool does."""
        try:
            self._client.project(self._project)  # connected
            self._gate.wait(60)
            while self._acquired():
                pass
        except Exception as error:  # the test's thread reports it
            self.failure = error
        finally:
            self._client.close()

    def _acquired(self) -> bool:
        began = time.perf_counter()
        try:
            batch = self._client.acquire(self._project, COUNT, labeler=self.name, wait=DRAIN_SECONDS)
        except Conflict:  # pool-exhausted
            return False
        self.seconds.append(time.perf_counter() - began)
        self.given.extend((item.trajectory, item.start) for item in batch.items)
        return True


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_sixteen_clients_drain_a_thousand_segments_without_an_overlap(deploy: Deploy, figures: Figures) -> None:
    deployment = deploy()
    deployment.start_worker("score")
    client = deployment.client
    project = project_of(client, "drained")
    fill(client, project, SEGMENTS, transitions=10)
    _rank(client, str(project.id))
    gate = threading.Barrier(CLIENTS)
    drainers = [Drainer(deployment.url, deployment.key, str(project.id), gate) for _ in range(CLIENTS)]
    began = time.perf_counter()
    for drainer in drainers:
        drainer.start()
    for drainer in drainers:
        drainer.join(DRAIN_SECONDS)
        assert not drainer.is_alive(), "a client is still waiting"
        if drainer.failure is not None:
            raise drainer.failure
    wall = time.perf_counter() - began

    given = Counter(segment for drainer in drainers for segment in drainer.given)
    seconds = np.array([value for drainer in drainers for value in drainer.seconds])
    figures.none("segments given twice", sum(count - 1 for count in given.values()))
    figures.none("segments not served", SEGMENTS - len(given))
    figures.none("clients that got nothing", sum(not drainer.given for drainer in drainers))
    figures.add(f"{CLIENTS} clients, {COUNT} segments a call: p50 of POST /acquire", _ms(seconds, 50), "ms")
    figures.add(f"{CLIENTS} clients, {COUNT} segments a call: p95 of POST /acquire", _ms(seconds, 95), "ms")
    figures.add("drained", SEGMENTS / wall, "segments/s")
    counts = client.project(project.id).counts
    assert (counts.unlabeled, counts.leased) == (0, SEGMENTS)
    deployment.check_rows()


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("kind", ["sqlite", "postgresql"])
def test_a_million_segments_are_acquired_from_as_quickly_as_a_few(
    kind: str, tmp_path: Path, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, figures: Figures
) -> None:
    for name, value in acquire.ENVIRONMENT.items():
        monkeypatch.setenv(name, value)
    if kind == "postgresql":
        monkeypatch.setenv("ASIM_DATABASE_URL", request.getfixturevalue("postgres_url"))
    with served(tmp_path / "data") as url, Client(url, timeout=300.0) as client:
        measured = acquire.measure(client, LARGE_POOL)
    for figure in measured.figures(LARGE_POOL):
        figures.add(f"{kind}, {LARGE_POOL} segments: {figure.name}", figure.value, figure.unit, figure.target, "below")


def _rank(client: Client, project: str) -> None:
    """Have the queue ranked, giving back what that took."""
    deadline = time.monotonic() + DRAIN_SECONDS
    while time.monotonic() < deadline:
        try:
            batch = client.acquire(project, 1, wait=DRAIN_SECONDS)
        except NotReady:
            continue
        assert batch.token is not None
        client.release(batch.id, batch.token)
        return
    raise TimeoutError(f"project {project} has no ranked queue after {DRAIN_SECONDS:.0f} s")


def _ms(seconds: "np.ndarray[tuple[int], np.dtype[np.float64]]", percentile: float) -> float:
    return float(np.percentile(seconds, percentile)) * 1000

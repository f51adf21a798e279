"""POST /labels at a sustained rate from eight clients: nothing acknowledged is lost, nothing is there twice."""

import threading
import time
from collections import Counter
from collections.abc import Sequence
from uuid import UUID

import numpy as np
import pytest
from sqlalchemy import create_engine, text

from api_schemas.projects import Project
from asim.client import Client
from benchmarks.service.filling import fill, project_of
from benchmarks.service.labels import Load, Segment, Sent, batches_of, send_all, shares
from tests.crash.deployment import Deployment
from tests.figures import Figures
from tests.scale.conftest import Deploy

CLIENTS, BATCH = 8, 100
TARGET, RATE, SECONDS = 2000, 2080, 60.0  # labels a second: wanted, sent
BURST_SECONDS, BURST_LABELS = 10.0, 48_000
LABELS = int(RATE * SECONDS)
START_SECONDS = 8.0  # until all client processes are there
SKIPPED = text(
    "SELECT p.label_watermark, (SELECT count(*) FROM label l WHERE l.project_id = p.id"
    " AND l.watermark <= p.label_watermark) FROM project p WHERE p.id = :project"
)


class WatermarkReader(threading.Thread):
    """What a round would read at any moment: under a committed watermark W there are W labels, neither more nor less.

    One statement sees one moment. `seen`: the watermarks that it looked at; `skipped`: those under which labels lacked.
    """

    def __init__(self, url: str, project: UUID, pause: float = 0.5) -> None:
        super().__init__(name="watermarks", daemon=True)
        self._engine, self._project, self._pause = create_engine(url), project, pause
        self._stop_asked = threading.Event()
        self.seen: list[int] = []
        self.skipped: list[tuple[int, int]] = []
        self.failure: Exception | None = None

    def run(self) -> None:
        """Look again and again."""
        try:
            with self._engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
                while not self._stop_asked.wait(self._pause):
                    watermark, labels = connection.execute(SKIPPED, {"project": self._project}).one()
                    self.seen.append(watermark)
                    if labels != watermark:
                        self.skipped.append((watermark, labels))
        except Exception as error:  # the test's thread reports it
            self.failure = error

    def finish(self) -> None:
        """Stop, and raise what went wrong."""
        self._stop_asked.set()
        self.join(60)
        self._engine.dispose()
        if self.failure is not None:
            raise self.failure


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_labels_at_two_thousand_a_second_are_all_kept_and_none_twice(deploy: Deploy, figures: Figures) -> None:
    deployment = deploy()
    project = project_of(deployment.client, "labeled")
    fill(deployment.client, project, LABELS + BURST_LABELS, transitions=120)
    batches = batches_of(_segments(deployment.client, project), BATCH)
    reader = WatermarkReader(deployment.database_url, project.id)
    reader.start()
    paced = _send(deployment, project, batches[: LABELS // BATCH], RATE / CLIENTS, SECONDS + 30)
    burst = _send(deployment, project, batches[LABELS // BATCH :], None, BURST_SECONDS)
    reader.finish()

    _tell(figures, f"{CLIENTS} clients, {BATCH} a batch, {RATE} a second sent", paced, TARGET)
    _tell(figures, f"{CLIENTS} clients, {BATCH} a batch, unpaced for {BURST_SECONDS:.0f} s", burst, None)
    acknowledged = [segment for sent in (*paced.sent, *burst.sent) for segment in sent.acknowledged]
    stored = Counter(_stored(deployment.database_url, project.id))
    figures.add("labels acknowledged", len(acknowledged), "labels", LABELS)
    figures.none("acknowledged labels that are not in the database", len(set(acknowledged) - set(stored)))
    figures.none("labels that nobody was told of", len(set(stored) - set(acknowledged)))
    figures.none("labels twice in the database", sum(count - 1 for count in stored.values()))
    figures.none("watermarks that skipped a label", len(reader.skipped))
    figures.add("watermarks looked at while labels came", len(set(reader.seen)), "watermarks", 50)
    deployment.check_rows()


class _Result:
    """What all clients sent, and when they began."""

    def __init__(self, sent: Sequence[Sent], begin: float) -> None:
        self.sent = sent
        self.labels = sum(len(one.acknowledged) for one in sent)
        self.seconds = max(one.ended for one in sent) - begin


def _send(
    deployment: Deployment, project: Project, batches: Sequence[Sequence[Segment]], rate: float | None, seconds: float
) -> _Result:
    begin = time.time() + START_SECONDS
    loads = [
        Load(deployment.url, deployment.key, project.id, share, rate, begin, seconds)
        for share in shares(batches, CLIENTS)
    ]
    return _Result(send_all(loads), begin)


def _tell(figures: Figures, what: str, result: _Result, target: float | None) -> None:
    latencies = np.array([value for sent in result.sent for value in sent.latencies]) * 1000
    figures.add(f"{what}: accepted over {result.seconds:.1f} s", result.labels / result.seconds, "labels/s", target)
    for percentile in (50, 95, 99):
        figures.add(f"{what}: p{percentile} of a batch", float(np.percentile(latencies, percentile)), "ms")
    late = max(sent.late for sent in result.sent)
    figures.note(f"{what}: {sum(sent.replayed for sent in result.sent)} batches sent twice, latest {late:.2f} s late")


def _segments(client: Client, project: Project) -> list[Segment]:
    return [(each.id, start) for each in client.trajectories(project.id) for start in range(each.segments)]


def _stored(url: str, project: UUID) -> list[Segment]:
    """Rows as they are, by a connection of the test's own."""
    engine = create_engine(url)
    with engine.connect() as connection:
        statement = text("SELECT trajectory_id, start FROM label WHERE project_id = :project")
        rows = [(name, start) for name, start in connection.execute(statement, {"project": project})]
    engine.dispose()
    return rows

"""Rounds under attack, while somebody labels: what the tests of trainers share."""

import time
from collections.abc import Callable
from pathlib import Path

from sqlalchemy import select

from service.store.tables import ModelVersionRow
from tests.crash.conftest import Prepared
from tests.crash.deployment import Deployment
from tests.crash.hammer import Hammer
from tests.crash.rounds import Rounds
from tests.figures import Figures
from tests.loop.processes import eventually

ATTEMPTS = 3  # without progress, after which a kill waits for some
RECOVERED = 90.0  # seconds until another has the job, at most


class Scene:
    """A deployment whose rounds are disturbed while somebody labels another project."""

    def __init__(self, deployment: Deployment, prepared: Prepared, figures: Figures) -> None:
        self.deployment, self.rounds, self.figures = deployment, Rounds(deployment), figures
        self._prepared = prepared
        self._busy = deployment.client.find_project("busy").id
        self._hammer = Hammer(deployment.url, deployment.key, self._busy, pause=0.5)
        self.recovered: list[float] = []
        self._holder, self._taken = 0, time.time()
        self._began = time.monotonic()

    def begin(self) -> None:
        """One round without any incident, and the labeler."""
        self._hammer.start()
        self.rounds.start()
        self.rounds.finish()
        self._began = time.monotonic()

    def strike(self, strike: Callable[[int], None], pause: float) -> None:
        """Do it to the process that trains, after `pause` seconds of training; then somebody else has the job."""
        while True:
            holder = self._see(self.rounds.await_training())
            self._await_progress(holder)
            time.sleep(pause)
            before = self.deployment.job(self.rounds.job)
            if self.deployment.holder_of(self.rounds.job) == holder:
                break
            pause *= 0.7  # the round was quicker than that
        strike(holder)
        struck = time.monotonic()
        self.deployment.revive()
        self._see(self.deployment.await_holder(self.rounds.job, RECOVERED + 10, fence=before.fence))
        self.recovered.append(time.monotonic() - struck)
        self.deployment.check_rows()

    def saved_at(self) -> float:
        """When the newest stage or checkpoint of the round was stored, or its holder began; seconds since the epoch."""
        row = self.deployment.job(self.rounds.job)
        moments = [self._taken]
        with self.deployment.database.read() as session:
            stages = select(ModelVersionRow.created_at).where(ModelVersionRow.round_id == row.subject_id)
            moments += [moment.timestamp() for moment in session.scalars(stages)]
        if row.checkpoint_sha256 is not None:
            path = self.checkpoints / row.checkpoint_sha256[:2] / row.checkpoint_sha256
            moments += [path.stat().st_mtime] if path.exists() else []
        return max(moments)

    @property
    def checkpoints(self) -> Path:
        """Where checkpoints lie."""
        return self.deployment.folder / "blobs" / "checkpoints"

    def resumed(self) -> int:
        """How often a training went on from a checkpoint."""
        return sum(event.kind == "training.resumed" for event in self.deployment.client.events())

    def finish(self) -> None:
        """Let everything come to rest, check all of it, and tell."""
        seconds = (time.monotonic() - self._began) / max(1, len(self.recovered))
        self.rounds.finish()
        self._hammer.finish()
        self.deployment.await_rest()
        labeled = {each.id: self._prepared.labeled[each.name] for each in self.deployment.client.projects()}
        labeled |= {self._busy: [*labeled[self._busy], *self._hammer.acknowledged]}
        self.deployment.check(labeled)
        compared = self.rounds.check_networks()
        self.figures.add("strikes", len(self.recovered), f"at {seconds:.1f} s each")
        self.figures.add("rounds with the same networks, bit for bit", compared, "rounds")
        self.figures.add("labels acknowledged meanwhile", len(self._hammer.acknowledged), "labels")
        self.figures.none("labels lost or doubled", self.deployment.lost_or_doubled(labeled))
        self.figures.add("trainings resumed from a checkpoint", self.resumed(), "times")
        self.figures.add("longest time until another has the job", max(self.recovered), "s", RECOVERED, "below")

    def _await_progress(self, holder: int) -> None:
        """After two kills before any checkpoint wait for one: the pauses between attempts grow to a minute."""

        def progressed() -> bool:
            job = self.deployment.job(self.rounds.job)
            return job.attempts < ATTEMPTS or self.deployment.holder_of(job.id) != holder

        eventually(progressed, RECOVERED, lambda: f"no progress: {self.deployment.last_words()}")

    def _see(self, holder: int) -> int:
        """Remember since when this process has the job."""
        if holder != self._holder:
            self._holder, self._taken = holder, time.time()
        return holder

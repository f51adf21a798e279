"""Labelers that keep on whatever happens to the service: they acquire, label by the simulator, and send again."""

import threading
import time

import httpx
import numpy as np

from api_schemas.acquisitions import Acquisition
from asim.client import Client
from asim.errors import NotReady, Unavailable, Unreachable
from workers.labeling import run_labeling

NOT_NOW = (Unreachable, Unavailable, NotReady, httpx.TransportError)


class PersistentLabeler(threading.Thread):
    """Labels small batches until it is told to stop.

    acknowledged: segments whose labels were answered with 2xx. batches: what acquire answered. disturbed: how many
    requests went unanswered. failure: what ended the thread early.
    """

    def __init__(self, url: str, count: int = 3, pause: float = 0.3, seed: int = 0) -> None:
        super().__init__(name="labeler", daemon=True)
        self._client = Client(url, timeout=20.0, retries=0)
        self._count, self._pause, self._generator = count, pause, np.random.default_rng(seed)
        self._stop_asked = threading.Event()
        self.acknowledged: list[tuple[str, int]] = []
        self.batches: list[Acquisition] = []
        self.disturbed = 0
        self.failure: BaseException | None = None

    def run(self) -> None:
        """Acquire and label, over and over."""
        try:
            while not self._stop_asked.wait(self._pause):
                batch = self._acquired()
                if batch is not None:
                    self.batches.append(batch)
                    self._label(batch)
        except BaseException as failure:  # the test's thread reports it
            self.failure = failure

    def finish(self) -> None:
        """Answer what is open, stop, and raise what went wrong."""
        self._stop_asked.set()
        self.join(120)
        self._client.close()
        assert not self.is_alive(), "the labeler is still waiting for an answer"
        if self.failure is not None:
            raise self.failure
        given = [(item.trajectory, item.start) for batch in self.batches for item in batch.items]
        assert len(given) == len(set(given)), "a segment was given to the labeler twice"

    def _acquired(self) -> Acquisition | None:
        try:
            (project,) = self._client.projects()
            return self._client.acquire(project.id, self._count, labeler="persistent", wait=0)
        except NOT_NOW:
            self.disturbed += 1
            return None

    def _label(self, batch: Acquisition) -> None:
        """Send until it is answered: an answer that was stored and not heard of is a duplicate the next time."""
        deadline = time.monotonic() + 120
        while time.monotonic() < deadline:
            try:
                accepted = run_labeling(self._client, batch, self._generator)
            except NOT_NOW:
                self.disturbed += 1
                time.sleep(0.1)
            else:
                self.acknowledged.extend((receipt.trajectory, receipt.start) for receipt in accepted.receipts)
                return
        raise TimeoutError(f"no answer to the labels of acquisition {batch.id}")

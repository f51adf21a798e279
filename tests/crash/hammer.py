"""Labelers that never give up: every request goes under an Idempotency-Key and is sent again until it is answered."""

import random
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from uuid import UUID, uuid4

import httpx

from tests.loop.rows import Segment

ANSWER_SECONDS = 120.0
ACTIONS = 7  # of a grid room


@dataclass(frozen=True)
class Answered:
    """A request and what was answered to it."""

    path: str
    key: str
    request: dict[str, object]
    status: int
    body: str
    replayed: bool


class Labelers:
    """HTTP requests of one thread that insist on an answer."""

    def __init__(self, url: str, key: str) -> None:
        self._http = httpx.Client(base_url=url, headers={"Authorization": f"Bearer {key}"}, timeout=20.0)
        self.silences: list[str] = []
        self.unavailable = 0
        self.answers: list[Answered] = []

    @property
    def unanswered(self) -> int:
        """How many requests got no answer."""
        return len(self.silences)

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def insist(self, path: str, request: dict[str, object], key: str | None = None) -> Answered:
        """Send until it is answered by other than "not now"; the same key all the while."""
        key, deadline = key or uuid4().hex, time.monotonic() + ANSWER_SECONDS
        while time.monotonic() < deadline:
            try:
                answer = self._http.post(path, json=request, headers={"Idempotency-Key": key})
            except httpx.TransportError as error:
                self.silences.append(f"{type(error).__name__} at {path}")
                time.sleep(0.2)
                continue
            if answer.status_code == 503:
                self._check_unavailable(answer)
            if answer.status_code not in (202, 503):
                replayed = answer.headers.get("Idempotency-Replayed") == "true"
                self.answers.append(Answered(path, key, request, answer.status_code, answer.text, replayed))
                return self.answers[-1]
            time.sleep(0.1)
        raise TimeoutError(f"no answer to {path} under key {key} within {ANSWER_SECONDS:.0f} s")

    def ask_again(self, answered: Sequence[Answered]) -> None:
        """The same keys are answered alike, and as replays."""

    def _check_unavailable(self, answer: httpx.Response) -> None:
        self.unavailable += 1
        assert answer.headers["Content-Type"].startswith("application/problem+json"), answer.headers
        assert int(answer.headers["Retry-After"]) >= 1


class Hammer(threading.Thread):
    """Acquires and labels segments of one project until it is told to stop.

    acknowledged: segments whose labels were answered with 201. failure: what ended the thread early.
    """

    def __init__(self, url: str, key: str, project: UUID, *, count: int = 1, pause: float = 0.1, seed: int = 0) -> None:
        super().__init__(name=f"hammer {seed}", daemon=True)
        self.labelers = Labelers(url, key)
        self.project, self._count, self._pause = project, count, pause
        self._chance = random.Random(seed)
        self._stop_asked = threading.Event()
        self.acknowledged: list[Segment] = []
        self.given: list[Segment] = []
        self.failure: BaseException | None = None

    def run(self) -> None:
        """Acquire and label, over and over."""
        try:
            while not self._stop_asked.wait(self._pause):
                self._label_a_batch()
        except BaseException as failure:  # the test's thread reports it
            self.failure = failure

    def finish(self) -> None:
        """Answer what is open, stop, and raise what went wrong."""
        self._stop_asked.set()
        self.join(ANSWER_SECONDS + 30)
        assert not self.is_alive(), "a labeler still waits for an answer"
        self.labelers.close()
        if self.failure is not None:
            raise self.failure
        assert len(self.given) == len(set(self.given)), "a segment was given out twice"

    @property
    def replays(self) -> int:
        """Answers that the service had kept: it had done what was asked, and was killed before it said so."""
        return sum(answer.replayed for answer in self.labelers.answers)

    def _label_a_batch(self) -> None:
        request = {"project": str(self.project), "count": self._count, "lease_seconds": 600}
        batch = httpx.Response(201, text=self._created("/acquire", request).body).json()
        segments = [(item["trajectory"], item["start"]) for item in batch["items"]]
        self.given += segments
        items = [{"trajectory": name, "start": start, "actions": [self._action()]} for name, start in segments]
        body = {"project": str(self.project), "acquisition": batch["id"], "token": batch["token"], "items": items}
        self._created("/labels", body)
        self.acknowledged += segments

    def _created(self, path: str, request: dict[str, object]) -> Answered:
        answered = self.labelers.insist(path, request)
        assert answered.status == 201, f"{path}: {answered.status} {answered.body}"
        return answered

    def _action(self) -> int:
        return self._chance.randrange(ACTIONS)


def ask_again(url: str, key: str, answered: Sequence[Answered]) -> None:
    """The same keys are answered alike, and as replays."""
    with httpx.Client(base_url=url, headers={"Authorization": f"Bearer {key}"}, timeout=20.0) as http:
        for before in answered:
            answer = http.post(before.path, json=before.request, headers={"Idempotency-Key": before.key})
            assert (answer.status_code, answer.text) == (before.status, before.body), before
            assert answer.headers["Idempotency-Replayed"] == "true", before

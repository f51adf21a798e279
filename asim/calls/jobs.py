"""Jobs, events and the rest."""

import time
from collections.abc import Callable, Iterator

from pydantic import TypeAdapter

from api_schemas.events import Event
from api_schemas.jobs import Job
from api_schemas.keys import Health, Key, KeyCreate, KeyCreated
from api_schemas.strategies import Strategy
from asim.calls.base import Calls, Id
from asim.calls.waiting import is_done, poll

FOLLOW_SECONDS, FOLLOW_PAGE = 1.0, 100  # while events are followed: the last page is asked for again and again


class JobCalls(Calls):
    """/jobs, /events, /strategies, /keys, /health."""

    def job(self, job: Id) -> Job:
        """GET /jobs/{id}."""
        return self._get(f"/jobs/{job}", Job)

    def jobs(self, project: Id) -> Iterator[Job]:
        """GET /jobs, newest first, all pages."""
        return self._pages("/jobs", Job, project=project)

    def wait_for_job(self, job: Id, timeout: float | None = None, progress: Callable[[Job], None] | None = None) -> Job:
        """Poll until the job is done.

        Raises JobFailed, also for one that was cancelled, or NotReady after `timeout` seconds.
        """

        def done(seen: Job) -> bool:
            if progress is not None:
                progress(seen)
            return is_done(seen)

        return poll(lambda: self.job(job), done, timeout, f"job {job}")

    def cancel_job(self, job: Id) -> Job:
        """DELETE /jobs/{id}: it is not run any more. Raises Conflict where it is done or has failed."""
        return Job.model_validate_json(self._transport.request("DELETE", f"/jobs/{job}").content)

    def events(self, project: Id | None = None, cursor: str | None = None) -> Iterator[Event]:
        """GET /events from `cursor` on, oldest first, until there are no more for now."""
        return self._pages("/events", Event, project=project, cursor=cursor)

    def follow_events(self, project: Id | None = None) -> Iterator[Event]:
        """GET /events, oldest first and each once; then those that come, for ever."""
        cursor, seen = None, set[int]()
        while True:
            page = self._page("/events", Event, project=project, cursor=cursor, limit=FOLLOW_PAGE)
            for event in page.items:
                if event.id not in seen:
                    seen.add(event.id)
                    yield event
            if page.next is None:  # the last page says no cursor: it is read again until it is full
                time.sleep(FOLLOW_SECONDS)
            else:
                cursor, seen = page.next, set[int]()

    def strategies(self) -> list[Strategy]:
        """GET /strategies."""
        answer = self._transport.request("GET", "/strategies")
        return TypeAdapter(list[Strategy]).validate_json(answer.content)

    def create_key(self, key: KeyCreate) -> KeyCreated:
        """POST /keys; the secret is told this once."""
        return self._post("/keys", key, KeyCreated)

    def keys(self) -> Iterator[Key]:
        """GET /keys, all pages: without their secrets."""
        return self._pages("/keys", Key)

    def delete_key(self, key: Id) -> None:
        """DELETE /keys/{id}."""
        self._transport.request("DELETE", f"/keys/{key}")

    def health(self) -> Health:
        """GET /health/ready, also where it answers 503."""
        answer = self._transport.request("GET", "/health/ready", accept=(503,))
        return Health.model_validate_json(answer.content)

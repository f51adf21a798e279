"""Acquisitions and labels."""

import time
from collections.abc import Iterator
from uuid import UUID, uuid4

from api_schemas.acquisitions import (
    AcquireRequest,
    Acquisition,
    AcquisitionPending,
    ExtendRequest,
    Mode,
    Purpose,
    ReleaseRequest,
)
from api_schemas.jobs import Job
from api_schemas.labels import Label, LabelsAccepted, LabelsRequest
from asim.calls.base import Calls, Id
from asim.calls.waiting import POLL_SECONDS, is_done
from asim.errors import NotReady
from asim.transport import IDEMPOTENCY_KEY


class LabelCalls(Calls):
    """/acquire, /acquisitions, /labels."""

    def acquire(
        self,
        project: Id,
        count: int,
        *,
        mode: Mode = "pool",
        strategy: str | None = None,
        purpose: Purpose = "pool",
        lease_seconds: float | None = None,
        labeler: str = "",
        wait: float = 60.0,
        idempotency_key: str | None = None,
    ) -> Acquisition:
        """POST /acquire, for at most `wait` seconds: where the queue is not ranked yet, its job is awaited.

        idempotency_key: the same key gives the same batch, also where an answer was lost; by default one a call.

        Raises:
            NotReady: there was still no ranked queue after `wait` seconds.
            JobFailed: the job that ranks it failed, or was cancelled.
        """
        request = AcquireRequest(
            project=UUID(str(project)),
            count=count,
            mode=mode,
            strategy=strategy,
            purpose=purpose,
            lease_seconds=lease_seconds,
            labeler=labeler,
        )
        return self._acquired(request, idempotency_key or str(uuid4()), wait)

    def acquisition(self, acquisition: Id) -> Acquisition:
        """GET /acquisitions/{id}; its token is not told again."""
        return self._get(f"/acquisitions/{acquisition}", Acquisition)

    def extend(self, acquisition: Id, token: int, lease_seconds: float | None = None) -> Acquisition:
        """POST /acquisitions/{id}/extend: the lease ends `lease_seconds` from now."""
        return self._post(
            f"/acquisitions/{acquisition}/extend", ExtendRequest(token=token, lease_seconds=lease_seconds), Acquisition
        )

    def release(self, acquisition: Id, token: int) -> Acquisition:
        """POST /acquisitions/{id}/release: give back what is not labeled yet."""
        return self._post(f"/acquisitions/{acquisition}/release", ReleaseRequest(token=token), Acquisition)

    def label(self, labels: LabelsRequest, *, idempotency_key: str | None = None) -> LabelsAccepted:
        """POST /labels: all of them, or none. The same key gives the same receipts; by default one a call."""
        headers = {IDEMPOTENCY_KEY: idempotency_key or str(uuid4())}
        answer = self._transport.request("POST", "/labels", body=labels, headers=headers)
        return LabelsAccepted.model_validate_json(answer.content)

    def labels(self, project: Id) -> Iterator[Label]:
        """GET /labels, all pages."""
        return self._pages("/labels", Label, project=project)

    def _acquired(self, request: AcquireRequest, key: str, wait: float) -> Acquisition:
        """Ask under one key until there is a batch: of an answer that is not ready the service keeps nothing.

        The first answer is not held back: it names the job, so that its failure is seen.
        """
        deadline, awaited, headers = time.monotonic() + wait, None, {IDEMPOTENCY_KEY: key}
        while True:
            left = deadline - time.monotonic()
            hold = 0 if awaited is None else max(0, int(min(left, self._hold)))
            preferred = {"Prefer": f"wait={hold}"} if hold else {}
            answer = self._transport.request("POST", "/acquire", body=request, headers=headers | preferred)
            if answer.status_code != 202:
                return Acquisition.model_validate_json(answer.content)
            pending = AcquisitionPending.model_validate_json(answer.content)
            if awaited is not None:
                is_done(self._get(f"/jobs/{awaited}", Job))
            if left <= 0:
                raise NotReady(f"{pending.detail} (waited {wait:g} s for job {pending.job})")
            if awaited is not None and "Preference-Applied" not in answer.headers:
                time.sleep(min(POLL_SECONDS, max(0.0, deadline - time.monotonic())))
            awaited = pending.job

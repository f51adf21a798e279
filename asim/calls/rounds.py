"""Rounds, models, model error."""

from collections.abc import Callable, Iterator
from uuid import UUID

from api_schemas.models import ModelVersion
from api_schemas.rounds import ModelErrorCurve, Round, RoundCreate
from asim.calls.base import Calls, Id
from asim.calls.waiting import poll
from asim.errors import RoundCancelled, RoundFailed


class RoundCalls(Calls):
    """/rounds, /models, /model-error."""

    def start_round(self, project: Id) -> Round:
        """POST /rounds: retrain on all labels that are there now."""
        return self._post("/rounds", RoundCreate(project=UUID(str(project))), Round)

    def round(self, round: Id) -> Round:  # noqa: A002  (the word of the API)
        """GET /rounds/{id}."""
        return self._get(f"/rounds/{round}", Round)

    def rounds(self, project: Id) -> Iterator[Round]:
        """GET /rounds, all pages."""
        return self._pages("/rounds", Round, project=project)

    def wait_for_round(
        self,
        round: Id,  # noqa: A002
        timeout: float | None = None,
        progress: Callable[[Round], None] | None = None,
    ) -> Round:
        """Poll until the round is current or superseded.

        Raises RoundFailed, also for one that was cancelled, or NotReady after `timeout` seconds.
        """

        def done(seen: Round) -> bool:
            if progress is not None:
                progress(seen)
            if seen.status in ("failed", "cancelled"):
                raise RoundCancelled(seen) if seen.status == "cancelled" else RoundFailed(seen)
            return seen.status in ("current", "superseded")

        return poll(lambda: self.round(round), done, timeout, f"round {round}")

    def models(self, project: Id) -> Iterator[ModelVersion]:
        """GET /models, all pages."""
        return self._pages("/models", ModelVersion, project=project)

    def model(self, model: Id) -> ModelVersion:
        """GET /models/{id}."""
        return self._get(f"/models/{model}", ModelVersion)

    def weights(self, model: Id) -> bytes:
        """GET /models/{id}/weights: a safetensors file."""
        return self._bytes(f"/models/{model}/weights")

    def model_error(self, project: Id) -> ModelErrorCurve:
        """GET /model-error: the learning curve, oldest round first."""
        return self._get("/model-error", ModelErrorCurve, project=project)

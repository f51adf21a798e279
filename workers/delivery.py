"""Delivery: handing in the answers to an acquisition, all that the service takes of them."""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from api_schemas.acquisitions import Acquisition
from api_schemas.labels import LabeledTrajectory, LabelItem, LabelsAccepted, LabelSource, LabelsRequest
from asim.batches import batches
from asim.client import Client
from asim.errors import Conflict, Invalid, LeaseLost

BATCH, BATCH_BYTES = 500, 16 * 2**20  # of one request: what the service takes, and well below it
BUDGET_EXHAUSTED = "urn:asim:error:budget-exhausted"
FAULTS = 20  # answers refused as wrong, and none taken, after which the others are not tried one by one
Answer = LabelItem | LabeledTrajectory


@dataclass
class Delivery:
    """What became of the answers: `accepted` by request, `refused` by answer or, where that says all, by request.

    Refused are those that others got ahead of (Conflict) and those that are wrong (Invalid).
    holds: asks whether the lease still holds anything.
    """

    client: Client
    acquisition: Acquisition
    source: LabelSource
    holds: Callable[[], bool]
    accepted: list[LabelsAccepted] = field(default_factory=list)
    refused: list[Conflict | Invalid] = field(default_factory=list)
    _hopeless: set[str] = field(default_factory=set)  # types of refusals
    _asked: bool = False

    def hand_in(self, answers: Sequence[Answer]) -> None:
        """Post the answers under the acquisition's token, in as few requests as it takes. Raises the client's errors,
        but for Conflict and Invalid, which are an answer's own."""
        for batch in batches(answers, _bytes, BATCH, BATCH_BYTES):
            self._send(batch)

    def receipt(self) -> LabelsAccepted:
        """All that was accepted, as one."""
        return functools.reduce(_joined, self.accepted)

    def _send(self, answers: Sequence[Answer]) -> None:
        """A request is taken whole or not at all: what is refused is halved until the refused ones stand alone.

        That may take two requests for each answer, so it ends where no part can fare better: see `_is_hopeless`.
        """
        try:
            self.accepted.append(self.client.label(self._request(answers)))
        except (Conflict, Invalid) as error:
            alone = len(answers) == 1
            if self._is_hopeless(error, alone=alone) or alone:
                self.refused.append(_of(error, answers[0]) if alone else error)
                return
            middle = len(answers) // 2
            self._send(answers[:middle])
            self._send(answers[middle:])

    def _is_hopeless(self, error: Conflict | Invalid, *, alone: bool) -> bool:
        """Whether this refusal meets all that is left, whatever it is sent with.

        The lease holds nothing any more, the budget has no room for a single answer, or the service finds fault with
        one answer after another and has not taken any: then it does not speak this labeler's language.
        """
        if isinstance(error, LeaseLost) and not self._asked:
            self._asked = True  # once: what the lease still holds is extended by this, and nobody else can take it
            if not self.holds():
                self._hopeless.add(error.problem.type)
        if alone and error.problem.type == BUDGET_EXHAUSTED:
            self._hopeless.add(error.problem.type)
        faulty = isinstance(error, Invalid) and not self.accepted and len(self.refused) >= FAULTS
        return faulty or error.problem.type in self._hopeless

    def _request(self, answers: Sequence[Answer]) -> LabelsRequest:
        return LabelsRequest(
            project=self.acquisition.project,
            acquisition=self.acquisition.id,
            token=self.acquisition.token,
            source=self.source,
            items=[answer for answer in answers if isinstance(answer, LabelItem)],
            trajectories=[answer for answer in answers if isinstance(answer, LabeledTrajectory)],
        )


def _of(error: Conflict | Invalid, answer: Answer) -> Conflict | Invalid:
    """The refusal of an answer that stood alone, which it names."""
    problem, name = error.problem, _name(answer)
    if name in problem.detail:
        return error
    return type(error)(problem.model_copy(update={"detail": f"{name}: {problem.detail}"}))


def _name(answer: Answer) -> str:
    if isinstance(answer, LabelItem):
        return f"segment {answer.trajectory}:{answer.start}"
    return f"item {answer.rank}"


def _bytes(answer: Answer) -> int:
    return len(answer.model_dump_json())


def _joined(before: LabelsAccepted, after: LabelsAccepted) -> LabelsAccepted:
    return LabelsAccepted(
        receipts=[*before.receipts, *after.receipts],
        created=before.created + after.created,
        duplicates=before.duplicates + after.duplicates,
        watermark=after.watermark,
        round=after.round or before.round,
    )

"""Delivery: handing in the answers to an acquisition, all that the service takes of them."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field

from api_schemas.acquisitions import Acquisition
from api_schemas.labels import LabeledTrajectory, LabelItem, LabelsAccepted, LabelSource, LabelsRequest
from asim.batches import batches
from asim.client import Client
from asim.errors import Conflict

BATCH, BATCH_BYTES = 500, 16 * 2**20  # of one request: what the service takes, and well below it
Answer = LabelItem | LabeledTrajectory


@dataclass
class Delivery:
    """What became of the answers: `accepted` by request, `refused` by answer, because of what others did meanwhile."""

    client: Client
    acquisition: Acquisition
    source: LabelSource
    accepted: list[LabelsAccepted] = field(default_factory=list)
    refused: list[Conflict] = field(default_factory=list)

    def hand_in(self, answers: Sequence[Answer]) -> None:
        """Post the answers under the acquisition's token, in as few requests as it takes. Raises the client's errors,
        but for a Conflict, which is an answer's own."""
        for batch in batches(answers, _bytes, BATCH, BATCH_BYTES):
            self._send(batch)

    def receipt(self) -> LabelsAccepted:
        """All that was accepted, as one."""
        return functools.reduce(_joined, self.accepted)

    def _send(self, answers: Sequence[Answer]) -> None:
        """A request is taken whole or not at all: what is refused is halved until the refused ones stand alone."""
        try:
            self.accepted.append(self.client.label(self._request(answers)))
        except Conflict as error:
            if len(answers) == 1:
                self.refused.append(error)
                return
            middle = len(answers) // 2
            self._send(answers[:middle])
            self._send(answers[middle:])

    def _request(self, answers: Sequence[Answer]) -> LabelsRequest:
        return LabelsRequest(
            project=self.acquisition.project,
            acquisition=self.acquisition.id,
            token=self.acquisition.token,
            source=self.source,
            items=[answer for answer in answers if isinstance(answer, LabelItem)],
            trajectories=[answer for answer in answers if isinstance(answer, LabeledTrajectory)],
        )


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

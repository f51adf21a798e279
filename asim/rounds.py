"""Waiting for a round, telling how far it is."""

from uuid import UUID

from api_schemas.rounds import Round
from asim.client import Client
from asim.report import Advance


def await_round(client: Client, round_id: UUID, advance: Advance) -> Round:
    """The round once it is current; raises RoundFailed. Progress is that of the job which is at work on it."""

    def tell(seen: Round) -> None:
        if seen.job is not None and seen.status in ("queued", "training"):
            job = client.job(seen.job)
            advance(job.progress, job.message or seen.status)
        else:
            advance(1.0, seen.status)

    return client.wait_for_round(round_id, progress=tell)

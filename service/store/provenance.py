"""Simulator states and behavior provenance: a store of its own, handed to labelers and collectors only.

Training and scoring processes are started without its URL, and an import contract keeps their modules off this one.
"""

from service.settings import Settings
from service.store.blobs import Blobs


class ProvenanceBlobs(Blobs):
    """Immutable bytes. `provenance`, one object a trajectory: every array of the simulator's state, time first.
    `policies`: weights of policies, which would give away what a trajectory's actions were. `trainings`: the states
    that trainings of policies go on from.
    """

    kinds = ("provenance", "policies", "trainings")


def open_provenance(settings: Settings) -> ProvenanceBlobs | None:
    """The store, or None in a process that may not reach it."""
    url = settings.resolved_provenance_url()
    return ProvenanceBlobs(url) if url else None

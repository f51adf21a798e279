"""Blobs that nothing refers to go in two steps, and none that somebody needs is lost."""

import hashlib
from datetime import UTC, datetime, timedelta

import pytest

from service.garbage import Collected, collect
from service.store.blobs import Blobs
from service.store.errors import MissingBlob
from tests.service.conftest import Serve
from tests.service.kit import Served, room

DAY = timedelta(days=1)
NOTHING = Collected((), (), ())


@pytest.fixture
def holding(start: Serve) -> Served:
    """A service with one trajectory."""
    served = start()
    served.upload(served.project(), room(0))
    return served


def collected(served: Served, after: timedelta, *, dry_run: bool = False) -> Collected:
    """What a run at that time from now does, with a grace of a day."""
    held = served.services
    assert held.provenance is not None
    now = datetime.now(UTC) + after  # blobs bear the time of the file system
    return collect(held.database, [held.blobs, held.provenance], now, DAY, dry_run=dry_run)


def names(blobs: Blobs) -> set[str]:
    return {blob.sha256 for blob in blobs.stored()}


def test_what_nothing_refers_to_goes_in_two_steps(holding: Served) -> None:
    blobs, (kept,) = holding.services.blobs, names(holding.services.blobs)
    lost = blobs.put("weights", b"of a round that was refused")
    assert collected(holding, timedelta()) == NOTHING  # it may belong to a transaction that is not committed yet
    told = collected(holding, 2 * DAY, dry_run=True)
    assert [blob.sha256 for blob in told.discarded] == [lost]
    assert names(blobs) == {kept, lost}
    done = collected(holding, 2 * DAY)
    assert ([blob.sha256 for blob in done.discarded], done.forgotten) == ([lost], ())
    assert done.discarded[0].bytes == len(b"of a round that was refused")
    assert names(blobs) == {kept}
    assert [blob.sha256 for blob in blobs.discarded()] == [lost]
    assert collected(holding, timedelta()) == NOTHING  # in the trash it has a day again
    assert [blob.sha256 for blob in collected(holding, 2 * DAY).forgotten] == [lost]
    assert list(blobs.discarded()) == []
    with pytest.raises(MissingBlob):
        blobs.get("weights", lost)
    assert collected(holding, 9 * DAY) == NOTHING


def test_a_blob_that_is_asked_for_comes_back_from_the_trash(holding: Served) -> None:
    blobs = holding.services.blobs
    sha256 = blobs.put("weights", b"weights")
    blobs.discard("weights", sha256)
    assert sha256 not in names(blobs)
    assert blobs.get("weights", sha256) == b"weights"
    assert sha256 in names(blobs)


def test_a_blob_that_was_discarded_while_a_row_came_to_need_it_is_taken_back(holding: Served) -> None:
    blobs, (needed,) = holding.services.blobs, names(holding.services.blobs)
    blobs.discard("trajectories", needed)
    done = collected(holding, 9 * DAY)
    assert [blob.sha256 for blob in done.taken_back] == [needed]
    assert (done.discarded, done.forgotten) == ((), ())
    assert (names(blobs), list(blobs.discarded())) == ({needed}, [])


def test_states_are_collected_like_everything_else(holding: Served) -> None:
    provenance = holding.services.provenance
    assert provenance is not None
    lost = provenance.put("provenance", b"states")
    assert [(blob.kind, blob.sha256) for blob in collected(holding, 2 * DAY).discarded] == [("provenance", lost)]
    assert names(provenance) == set()


def test_policies_and_what_their_training_goes_on_from_are_kept_as_long_as_a_row_needs_them(holding: Served) -> None:
    provenance = holding.services.provenance
    assert provenance is not None
    kept = {holding.policy(holding.project(), b"weights", state) for state in (None, b"state")}
    lost = [provenance.put(kind, b"of a training that was lost") for kind in ("policies", "trainings")]
    assert {(blob.kind, blob.sha256) for blob in collected(holding, 2 * DAY).discarded} == {
        ("policies", lost[0]),
        ("trainings", lost[1]),
    }
    assert {blob.sha256 for blob in provenance.stored() if blob.kind == "policies"} == kept
    assert provenance.get("trainings", hashlib.sha256(b"state").hexdigest()) == b"state"

"""The labeler's lease: extended while labeling takes long, given back, lost."""

from typing import Any

import numpy as np
import pytest

from api_schemas.acquisitions import Acquisition
from asim.errors import LeaseLost
from tests.workers.in_process import Loop
from workers.labeling import run_labeling


def test_the_lease_of_a_slow_simulator_is_extended_by_its_own_length_when_half_of_it_has_passed(
    labeled: Loop,
) -> None:
    labeled.change(lease_seconds=10)
    batch = labeled.acquire(20, "random", lease_seconds=600)

    def slow(done: int, of: int) -> None:
        labeled.clock.advance(100)

    accepted = run_labeling(labeled.client, batch, np.random.default_rng(0), slow, labeled.clock)
    assert accepted.created == 20
    extensions = [event for event in labeled.client.events(labeled.project.id) if event.kind == "lease.extended"]
    assert len(extensions) == 6  # after 300, 600, ... seconds of 2,000
    ends = labeled.client.acquisition(batch.id).lease_expires_at
    assert (ends - extensions[-1].created_at).total_seconds() == pytest.approx(600, abs=1)


def test_a_short_batch_does_not_extend_its_lease(labeled: Loop) -> None:
    labeled.label(5, "random")
    assert "lease.extended" not in {event.kind for event in labeled.client.events(labeled.project.id)}


def test_a_lease_that_is_lost_meanwhile_is_said_so_and_what_it_still_covers_is_stored(labeled: Loop) -> None:
    batch = labeled.acquire(40, "random", lease_seconds=60)
    taken = []

    def overslept(done: int, of: int) -> None:
        if done == of:
            labeled.clock.advance(90)
            taken.append(labeled.acquire(3, "random"))

    before = labeled.project.counts.labeled
    with pytest.raises(LeaseLost, match=rf"lost while its 40 items were answered: acquisition {batch.id}: it does"):
        run_labeling(labeled.client, batch, np.random.default_rng(0), overslept, labeled.clock)
    assert labeled.project.counts.labeled == before + 37
    run_labeling(labeled.client, taken[0], np.random.default_rng(0))
    assert labeled.project.counts.labeled == before + 40


def test_a_lease_that_was_given_back_ends_the_labeling_at_once(labeled: Loop) -> None:
    batch = labeled.acquire(10, "random", lease_seconds=60)
    labeled.client.release(batch.id, batch.token or 0)
    labeled.clock.advance(1)
    done: list[int] = []

    def late(number: int, of: int) -> None:
        done.append(number)
        labeled.clock.advance(40)

    with pytest.raises(LeaseLost, match=r"the lease was lost while its 10 items were answered: .* it is released"):
        run_labeling(labeled.client, batch, np.random.default_rng(0), late, labeled.clock)
    assert done == [1]


def test_where_all_is_labeled_the_lease_is_asked_about_once(labeled: Loop, monkeypatch: pytest.MonkeyPatch) -> None:
    batch = labeled.acquire(10, "random", lease_seconds=60)
    run_labeling(labeled.client, batch, np.random.default_rng(0))
    labeled.clock.advance(90)
    asked: list[object] = []
    extend = labeled.client.extend

    def counted(*args: Any) -> Acquisition:
        asked.append(args)
        return extend(*args)

    monkeypatch.setattr(labeled.client, "extend", counted)
    again = run_labeling(labeled.client, batch, np.random.default_rng(0), None, labeled.clock)
    assert (again.created, again.duplicates, len(asked)) == (0, 10, 1)

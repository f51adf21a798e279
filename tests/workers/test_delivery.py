"""Answers that the service refuses: each is named, the others are stored, and not all are tried in vain."""

from typing import Any

import numpy as np
import pytest

from api_schemas.labels import LabelsRequest
from asim.errors import Conflict, Invalid, LeaseLost
from tests.workers.in_process import Loop
from tests.workers.test_labeling import _measure
from workers import delivery
from workers.labeling import run_labeling


def test_a_label_that_the_service_finds_fault_with_is_named_and_the_others_are_stored(
    labeled: Loop, monkeypatch: pytest.MonkeyPatch
) -> None:
    batch, before = labeled.acquire(20, "random"), labeled.project.label_watermark
    wrong = [batch.items[3], batch.items[11]]
    _spoil(monkeypatch, {(item.trajectory, item.start) for item in wrong})
    with pytest.raises(Invalid) as caught:
        run_labeling(labeled.client, batch, np.random.default_rng(0))
    first, second = (f"segment {item.trajectory}:{item.start}" for item in wrong)
    assert first in str(caught.value)
    assert [second in note for note in caught.value.__notes__] == [True]
    assert labeled.project.label_watermark == before + 18
    answered = labeled.client.acquisition(batch.id)
    assert [item.rank for item in answered.items if not item.labeled] == [3, 11]
    assert (answered.status, labeled.project.counts.leased) == ("released", 0)


def test_a_service_that_finds_fault_with_every_label_is_not_asked_about_each(
    labeled: Loop, monkeypatch: pytest.MonkeyPatch
) -> None:
    batch = labeled.acquire(100, "random")
    _spoil(monkeypatch, {(item.trajectory, item.start) for item in batch.items})
    sizes: list[int] = []
    _measure(monkeypatch, labeled, sizes)
    with pytest.raises(Invalid):
        run_labeling(labeled.client, batch, np.random.default_rng(0))
    assert len(sizes) < 60  # of 199 that it would take to have each stand alone
    assert labeled.client.acquisition(batch.id).status == "released"


def test_one_fault_does_not_spoil_a_later_request_where_many_spoiled_the_first(
    labeled: Loop, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(delivery, "BATCH", 50)
    batch, before = labeled.acquire(100, "random"), labeled.project.label_watermark
    wrong = [*batch.items[:25], batch.items[70]]
    _spoil(monkeypatch, {(item.trajectory, item.start) for item in wrong})
    with pytest.raises(Invalid):
        run_labeling(labeled.client, batch, np.random.default_rng(0))
    assert labeled.project.label_watermark == before + 74


def test_a_budget_that_others_spend_meanwhile_costs_no_answer_that_has_room(labeled: Loop) -> None:
    batch, before = labeled.acquire(10, "random", lease_seconds=60), labeled.project.counts.labeled

    def overslept(done: int, of: int) -> None:
        if done == 1:
            labeled.clock.advance(90)
            labeled.change(label_budget=before + 5)

    with pytest.raises(Conflict, match="budget"):
        run_labeling(labeled.client, batch, np.random.default_rng(0), overslept, labeled.clock)
    assert labeled.project.counts.labeled == before + 5
    assert labeled.client.acquisition(batch.id).status == "released"


@pytest.mark.parametrize("how", ["released", "taken"])
def test_a_lease_that_holds_nothing_any_more_is_found_out_by_one_question(
    labeled: Loop, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    monkeypatch.setattr(delivery, "BATCH", 20)
    batch = labeled.acquire(50, "random", lease_seconds=60)

    def overslept(done: int, of: int) -> None:
        if done == of and how == "released":
            labeled.client.release(batch.id, batch.token or 0)
        elif done == of:
            labeled.clock.advance(90)
            labeled.acquire(of, "random")

    sizes: list[int] = []
    _measure(monkeypatch, labeled, sizes)
    with pytest.raises(LeaseLost, match="the lease was lost while its"):
        run_labeling(labeled.client, batch, np.random.default_rng(0), overslept, labeled.clock)
    assert len(sizes) == len(range(0, len(batch.items), delivery.BATCH))  # none was halved


def test_a_budget_without_room_for_one_label_is_not_asked_about_each(
    labeled: Loop, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The lease had ended, and what it had reserved was spent by others meanwhile: but for five labels."""
    batch = labeled.acquire(80, "random", lease_seconds=60)
    before = labeled.project.counts.labeled

    def overslept(done: int, of: int) -> None:
        if done == of:
            labeled.clock.advance(90)
            labeled.change(label_budget=before + 5)

    sizes: list[int] = []
    _measure(monkeypatch, labeled, sizes)
    with pytest.raises(Conflict, match="budget"):
        run_labeling(labeled.client, batch, np.random.default_rng(0), overslept)
    assert labeled.project.counts.labeled == before + 5
    assert len(sizes) < 30


def _spoil(monkeypatch: pytest.MonkeyPatch, chosen: set[tuple[str, int]]) -> None:
    """The chosen segments are answered with an action that the project does not have."""
    request = delivery.Delivery._request

    def spoilt(self: delivery.Delivery, answers: Any) -> LabelsRequest:
        asked = request(self, answers)
        changed = {"actions": [99], "action_sets": None}
        items = [
            item.model_copy(update=changed) if (item.trajectory, item.start) in chosen else item for item in asked.items
        ]
        return asked.model_copy(update={"items": items})

    monkeypatch.setattr(delivery.Delivery, "_request", spoilt)

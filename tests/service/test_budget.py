"""The label budget: what is spent and reserved, and batches smaller than asked for."""

from tests.service.kit import Served, answers, refused, segments
from tests.service.test_acquire import filled


def test_a_batch_larger_than_the_pool_is_what_the_pool_has_and_says_why(on_both: Served) -> None:
    project = filled(on_both)
    whole = on_both.acquire(project, 8)
    assert (len(whole["items"]), whole["reason"]) == (8, None)
    rest = on_both.acquire(project, 13)
    assert len(rest["items"]) == 12
    assert rest["reason"] == "13 were asked for, 12 are left in the pool split"
    assert on_both.get(f"/acquisitions/{rest['id']}")["reason"] == rest["reason"]
    assert not set(segments(whole)) & set(segments(rest))
    refused(on_both.ask(project, 1), 409, "pool-exhausted", "1 segments", "0 are unlabeled", "pool")
    refused(on_both.ask(on_both.project(), 1), 409, "pool-exhausted", "0 are unlabeled")


def test_the_budget_counts_what_is_spent_and_what_is_reserved(on_both: Served) -> None:
    project = filled(on_both, policy={"label_budget": 6})
    batch = on_both.acquire(project, 4, lease_seconds=60)
    assert batch["budget"] == {"total": 6, "spent": 0, "reserved": 4, "remaining": 2}
    assert on_both.label(project, answers(batch)[:3], batch).status_code == 201
    assert on_both.show(project)["budget"] == {"total": 6, "spent": 3, "reserved": 1, "remaining": 2}
    on_both.clock.advance(61)
    assert on_both.show(project)["budget"] == {"total": 6, "spent": 3, "reserved": 0, "remaining": 3}
    assert len(segments(on_both.acquire(project, 3))) == 3
    refused(on_both.ask(project, 1), 409, "budget-exhausted", "1 segments", "0 of the budget of 6")
    assert on_both.client.patch(f"/projects/{project}", json={"label_budget": None}).status_code == 200
    assert len(segments(on_both.acquire(project, 5))) == 5


def test_a_batch_larger_than_the_budget_is_what_the_budget_has_and_says_why(on_both: Served) -> None:
    project = filled(on_both, policy={"label_budget": 6})
    on_both.acquire(project, 4)
    rest = on_both.acquire(project, 3)
    assert len(rest["items"]) == 2
    assert rest["reason"] == "3 were asked for, 2 of the budget of 6 labels remain"
    assert rest["budget"] == {"total": 6, "spent": 0, "reserved": 6, "remaining": 0}
    refused(on_both.ask(project, 3), 409, "budget-exhausted", "3 segments", "0 of the budget of 6")


def test_the_scarcer_of_pool_and_budget_is_the_reason(served: Served) -> None:
    scarce_pool = filled(served, trajectories=1, policy={"label_budget": 6})
    assert served.acquire(scarce_pool, 9)["reason"] == "9 were asked for, 5 are left in the pool split"
    scarce_budget = filled(served, trajectories=1, policy={"label_budget": 4})
    batch = served.acquire(scarce_budget, 9)
    assert (len(batch["items"]), batch["reason"]) == (4, "9 were asked for, 4 of the budget of 4 labels remain")

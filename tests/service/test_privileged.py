"""Strategies that look at the labels which they are to choose are for benchmarks; a project is refused them."""

import pytest

from api_schemas.strategies import CATALOG, PRIVILEGED
from tests.service.kit import ROOM, Served, refused


def test_the_list_of_strategies_says_which_are_privileged(served: Served) -> None:
    listed = {each["name"]: each["privileged"] for each in served.client.get("/strategies").json()}
    assert {name for name, privileged in listed.items() if privileged} == PRIVILEGED
    assert set(listed) == {strategy.name for strategy in CATALOG}
    assert {"oracle", "oracle_easy", "oracle_uniform", "true_progress"} == PRIVILEGED


@pytest.mark.parametrize("strategy", sorted(PRIVILEGED))
def test_no_door_takes_a_privileged_strategy(served: Served, strategy: str) -> None:
    project = served.project()
    asked = {"project": project, "count": 1, "strategy": strategy}
    why = ("hidden actions", "only a benchmark")
    refused(served.client.post("/acquire", json=asked), 403, "privileged-strategy", "strategy", strategy, *why)
    patch = served.client.patch(f"/projects/{project}", json={"strategy": strategy})
    refused(patch, 403, "privileged-strategy", "strategy", strategy, *why)
    body = {"name": "peeking", "environment": ROOM, "policy": {"strategy": strategy}}
    created = served.client.post("/projects", json=body)
    refused(created, 403, "privileged-strategy", "policy.strategy", strategy, *why)
    assert [each["id"] for each in served.get("/projects")["items"]] == [project]
    assert served.get(f"/projects/{project}")["policy"]["strategy"] not in PRIVILEGED
    assert served.get(f"/projects/{project}")["counts"]["leased"] == 0

"""How much one request may carry, and how much of it an answer shows."""

import base64
from typing import Any

import numpy as np
import pytest

from api_schemas.labels import MOST_SEGMENTS
from tests.service.conftest import Serve
from tests.service.kit import Json, Served, npz, refused

POINT: Json = {
    "spaces": {
        "observations": {"point": {"dtype": "uint8", "shape": (1,)}},
        "actions": {"kind": "box", "shape": (7,), "low": -1.0, "high": 1.0},
    }
}
STILL = [0.0] * 7


def labeled(transitions: int, seed: int = 0, **more: Any) -> Json:
    """A trajectory of points with its actions."""
    points = np.random.default_rng(seed).integers(0, 256, (transitions + 1, 1), np.uint8)
    content = base64.b64encode(npz({"point": points})).decode()
    return {"content": content, "actions": [[0] * 7] * transitions} | more


def test_one_request_brings_so_many_segments_and_no_more(served: Served) -> None:
    project, half = served.project(environment=POINT), MOST_SEGMENTS // 2
    sent = [labeled(half, 1), labeled(half, 2), labeled(1, 3)]
    refused(
        served.label(project, [], trajectories=sent), 422, "invalid-field", "segments", MOST_SEGMENTS, MOST_SEGMENTS + 1
    )
    assert served.show(project)["counts"]["pool_trajectories"] == 0
    few = labeled(MOST_SEGMENTS + 1, starts=[0, MOST_SEGMENTS])
    assert served.label(project, [], trajectories=[few]).json()["created"] == 2


def test_segments_are_counted_as_the_project_cuts_them(served: Served) -> None:
    project = served.project(environment=POINT, segment_length=10, stride=20_000)
    assert served.label(project, [], trajectories=[labeled(MOST_SEGMENTS + 10)]).json()["created"] == 2


def test_a_segment_is_named_once(served: Served) -> None:
    project = served.project(environment=POINT)
    answer = served.label(project, [], trajectories=[labeled(3, starts=[1, 2, 1])])
    refused(answer, 422, "malformed-request", "trajectories.0", "starts", "more than once")


@pytest.mark.parametrize("length", [1000, 3])
def test_a_conflict_shows_where_labels_differ_however_long_they_are(on_both: Served, length: int) -> None:
    project = on_both.project(environment=POINT, segment_length=length)
    stored = [[step / length] * 7 for step in range(length)]
    (receipt,) = on_both.label(project, [], trajectories=[labeled(length) | {"actions": stored}]).json()["receipts"]
    other = [STILL if step >= length // 2 else action for step, action in enumerate(stored)]
    item = {"trajectory": receipt["trajectory"], "start": 0, "actions": other}
    problem = refused(on_both.label(project, [item]), 409, "label-conflict", receipt["trajectory"])
    assert f"different in {length - length // 2} of {length} steps" in problem["detail"]
    assert len(problem["detail"]) < 1000
    shown = problem["invalid_params"]
    assert len(shown) == min(5, length - length // 2)
    assert shown[0]["name"] == f"step {length // 2}"
    assert str(stored[length // 2]) in shown[0]["reason"]
    assert shown[0]["value"] == str(STILL)


def test_as_many_connections_are_held_as_the_settings_allow(start: Serve) -> None:
    assert start(pool_size=3).services.database.engine.pool.size() == 3  # type: ignore[attr-defined]

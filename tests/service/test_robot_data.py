"""A robot's pictures, numbers and actions are held against its project at every door, and what does not fit leaves
nothing behind: no row, no event, no blob."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tests.service.kit import ROBOT, Arrays, Json, Served, npz, refused, robot
from tests.service.test_labels import labeled, stored

STEPS = 11
STILL: list[Any] = [[0.0] * 7] * STEPS
Change = Callable[[Arrays], Arrays]


def _with(name: str, array: np.ndarray[Any, Any]) -> Change:
    return lambda arrays: arrays | {name: array}


def _nan(arrays: Arrays) -> Arrays:
    bad = arrays["proprioception"].copy()
    bad[7, 3] = np.nan
    return arrays | {"proprioception": bad}


FAULTS: dict[str, tuple[Change, list[object]]] = {
    "smaller images": (
        _with("front", np.zeros((STEPS + 1, 32, 32, 3), np.uint8)),
        ["front: shape", "(12, 32, 32, 3)", "(T + 1, 64, 64, 3)"],
    ),
    "images with their channels first": (
        _with("wrist", np.zeros((STEPS + 1, 3, 64, 64), np.uint8)),
        ["wrist: shape", "(12, 3, 64, 64)", "(T + 1, 64, 64, 3)"],
    ),
    "one image for all steps": (_with("front", np.zeros((64, 64, 3), np.uint8)), ["front: shape", "(64, 64, 3)"]),
    "images of floats": (
        _with("front", np.zeros((STEPS + 1, 64, 64, 3), np.float32)),
        ["front: dtype", "float32", "must be uint8"],
    ),
    "images of signed bytes": (_with("wrist", np.zeros((STEPS + 1, 64, 64, 3), np.int8)), ["wrist: dtype", "int8"]),
    "a camera is missing": (
        lambda arrays: {name: array for name, array in arrays.items() if name != "wrist"},
        ["streams", "['front', 'proprioception']", "['front', 'proprioception', 'wrist']"],
    ),
    "an extra camera": (_with("side", np.zeros((STEPS + 1, 64, 64, 3), np.uint8)), ["streams", "side"]),
    "a camera that lags": (
        lambda arrays: arrays | {"wrist": arrays["wrist"][:-1]},
        ["length", "'wrist': 11", "must be the same for all streams"],
    ),
    "numbers of another arm": (
        _with("proprioception", np.zeros((STEPS + 1, 8), np.float32)),
        ["proprioception: shape", "(12, 8)", "(T + 1, 9)"],
    ),
    "doubles": (_with("proprioception", np.zeros((STEPS + 1, 9))), ["proprioception: dtype", "float64", "float32"]),
    "a number that is none": (_nan, ["proprioception[7, 3]", "nan", "must be finite"]),
}
ACTIONS: dict[str, tuple[Any, list[object]]] = {
    "outside the box": ([0.0] * 6 + [1.0000001], ["must be finite and from -1.0 to 1.0", 1.0000001]),
    "of another shape": ([0.0] * 6, ["must be 7 numbers"]),
    "none": ([], ["must be 7 numbers", "[]"]),
    "of a discrete space": (3, ["must be 7 numbers", 3]),
}


def traces(served: Served, project: str) -> Json:
    """Everything that an upload could leave."""
    blobs = sorted(path.name for path in (served.settings.data_folder / "blobs").rglob("*") if path.is_file())
    return {
        "project": served.show(project),
        "events": served.get("/events", project=project),
        "trajectories": served.get("/trajectories", project=project),
        "labels": stored(served, project),
        "blobs": blobs,
    }


@pytest.mark.parametrize("fault", FAULTS)
def test_what_does_not_fit_the_cameras_is_refused_at_both_doors(served: Served, fault: str) -> None:
    project = served.project(environment=ROBOT, segment_length=4)
    served.upload(project, robot(9))
    before, (change, words) = traces(served, project), FAULTS[fault]
    bad, good = change(robot(1, STEPS)), robot(2, STEPS)
    sent = served.send(project, [("good.npz", npz(good)), ("bad.npz", npz(bad))])
    refused(sent, 422, "invalid-trajectory", "bad.npz: ", *words)
    answer = served.label(project, [], trajectories=[labeled(good, STILL), labeled(bad, STILL)])
    refused(answer, 422, "invalid-trajectory", "trajectories[1].content: ", *words)
    assert traces(served, project) == before


@pytest.mark.parametrize("fault", ACTIONS)
def test_an_action_that_no_arm_can_take_is_refused_with_its_trajectory(served: Served, fault: str) -> None:
    project = served.project(environment=ROBOT, segment_length=4)
    (receipt,) = served.upload(project, robot(9))
    before, (action, words) = traces(served, project), ACTIONS[fault]
    moving = [*STILL[:5], action, *STILL[6:]]
    answer = served.label(project, [], trajectories=[labeled(robot(1), STILL), labeled(robot(2), moving)])
    refused(answer, 422, "invalid-label", "trajectories[1].actions[5]", *words)
    item = {"trajectory": receipt["id"], "start": 4, "actions": moving[4:8]}
    refused(served.label(project, [item]), 422, "invalid-label", receipt["id"], "actions[1]", *words)
    assert traces(served, project) == before


def test_an_answer_to_explore_is_held_against_the_cameras_too(served: Served) -> None:
    project = served.project(environment=ROBOT, segment_length=4, policy={"strategy": "random"})
    served.upload(project, robot(9))
    batch = served.acquire(project, 1, mode="explore")
    (item,) = batch["items"]
    before = traces(served, project)
    dark = robot(3, len(item["actions"])) | {"front": np.zeros((len(item["actions"]) + 1, 48, 64, 3), np.uint8)}
    answer = served.label(project, [], batch, trajectories=[labeled(dark, item["actions"], rank=item["rank"])])
    refused(answer, 422, "invalid-trajectory", "trajectories[0].content: front: shape", "48, 64, 3")
    assert traces(served, project) == before
    light = labeled(robot(3, len(item["actions"])), item["actions"], rank=item["rank"])
    assert served.label(project, [], batch, trajectories=[light]).json()["created"] == 1

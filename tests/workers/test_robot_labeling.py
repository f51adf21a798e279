"""Labels of robots: the behavior's own actions where it can be run again, found ones where it cannot, none by force."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from api_schemas.labels import Label
from tests.workers.conftest import OpenLoop, new_project
from tests.workers.in_process import Loop, segments_of
from tests.workers.test_robot_collection import LIBRARIES, project_of
from workers.labeling import run_labeling
from workers.simulators.base import Action, SimulatorError, Step
from workers.simulators.catalog import make_simulator
from workers.simulators.maniskill import ManiSkillSimulator
from workers.simulators.robosuite import RobosuiteSimulator
from workers.unanswerable import SimulatorFailed, UnexplainedStep

Robot = ManiSkillSimulator | RobosuiteSimulator
Arrays = dict[str, NDArray[Any]]
GENERATOR = np.random.default_rng(0)


def actions_taken(monkeypatch: pytest.MonkeyPatch) -> dict[bytes, list[float]]:
    """The actions of all steps from here on, by the hand's place that they led to."""
    taken: dict[bytes, list[float]] = {}
    for kind in (ManiSkillSimulator, RobosuiteSimulator):
        monkeypatch.setattr(kind, "step", _recorded(kind.step, taken))
    return taken


def _recorded(step: Callable[[Any, Action], Step], taken: dict[bytes, list[float]]) -> Callable[[Any, Action], Step]:
    def recorded(simulator: Robot, action: Action) -> Step:
        reached = step(simulator, action)
        taken[reached.observation["proprioception"].tobytes()] = np.asarray(action).tolist()
        return reached

    return recorded


def behind(loop: Loop, taken: dict[bytes, list[float]], label: Label) -> list[list[float]]:
    """The actions that were really taken in a label's segment."""
    seen = loop.client.trajectory_content(loop.project.id, label.trajectory, label.start, len(label.actions))
    return [taken[place.tobytes()] for place in seen["proprioception"][1:]]


def forget_behaviors(loop: Loop, monkeypatch: pytest.MonkeyPatch) -> None:
    """Provenance tells of states only."""
    provenance = loop.client.provenance

    def nameless(project: Any, trajectory: str, start: Any = None, length: Any = None) -> tuple[Arrays, dict[str, Any]]:
        return provenance(project, trajectory, start, length)[0], {}

    monkeypatch.setattr(loop.client, "provenance", nameless)


@pytest.mark.parametrize("behavior", ["noisy_expert", "random"])
@pytest.mark.parametrize(("simulator", "cameras"), [("robosuite", False), ("maniskill", True)])
def test_labels_by_replay_are_the_actions_that_were_taken(
    opened: OpenLoop, monkeypatch: pytest.MonkeyPatch, simulator: str, cameras: bool, behavior: str
) -> None:
    loop = project_of(opened, simulator, cameras=cameras)
    taken = actions_taken(monkeypatch)
    loop.collect(18, behavior=behavior, split="pool")
    loop.label(10, "random")
    labels = list(loop.client.labels(loop.project.id))
    assert len(labels) == 10
    for label in labels:
        assert label.actions == behind(loop, taken, label)
        assert (label.residual, label.action_sets) == (0.0, None)
        assert label.source.name in ("ManiSkillSimulator", "RobosuiteSimulator")


@pytest.mark.parametrize("simulator", LIBRARIES)
def test_labels_by_search_lead_to_what_was_observed(
    opened: OpenLoop, monkeypatch: pytest.MonkeyPatch, simulator: str
) -> None:
    loop = project_of(opened, simulator, cameras=False)
    loop.collect(6, behavior="expert", split="pool")
    explored = run_labeling(loop.client, loop.acquire(1, mode="explore"), GENERATOR)  # labels without states
    forget_behaviors(loop, monkeypatch)
    loop.label(3, "random")
    robot = make_simulator(simulator, loop.project.environment.options)
    brought = {receipt.trajectory for receipt in explored.receipts}
    for label in [each for each in loop.client.labels(loop.project.id) if each.trajectory not in brought]:
        states, _ = loop.client.provenance(loop.project.id, label.trajectory, label.start, 1)
        seen = loop.client.trajectory_content(loop.project.id, label.trajectory, label.start, 1)
        robot.restore({name: array[0] for name, array in states.items()})
        reached = robot.step(np.asarray(label.actions[0], np.float32)).observation["proprioception"]
        off = float(np.abs(reached.astype(float) - seen["proprioception"][1]).max())
        assert label.residual == off <= 1e-4
    assert loop.project.counts.labeled == 4
    robot.close()


def test_a_behavior_that_does_not_verify_gives_way_to_a_search(
    opened: OpenLoop, monkeypatch: pytest.MonkeyPatch
) -> None:
    loop = project_of(opened, "maniskill", cameras=False)
    taken = actions_taken(monkeypatch)
    loop.collect(6, behavior="random", split="pool")
    provenance = loop.client.provenance

    def reseeded(*asked: Any) -> tuple[Arrays, dict[str, Any]]:
        states, told = provenance(*asked)
        return states, told | {"generator": np.random.default_rng(99).bit_generator.state}

    monkeypatch.setattr(loop.client, "provenance", reseeded)
    loop.label(2, "random")
    for label in loop.client.labels(loop.project.id):
        assert label.residual is not None
        assert 0 < label.residual < 1e-4
        np.testing.assert_allclose(
            np.asarray(label.actions)[:, :3], np.array(behind(loop, taken, label))[:, :3], atol=0.01
        )


def test_what_no_action_leads_to_is_given_back_with_its_residual_and_frees_the_budget(
    opened: OpenLoop, monkeypatch: pytest.MonkeyPatch
) -> None:
    loop = project_of(opened, "maniskill", cameras=False)
    loop.change(label_budget=5)
    loop.collect(6, behavior="random", split="pool")
    batch = loop.acquire(5, "random")
    assert (loop.project.budget.spent, loop.project.budget.reserved) == (0, 5)
    content, bent = loop.client.trajectory_content, batch.items[2]

    def moved(project: Any, trajectory: str, start: int, length: int) -> Arrays:
        arrays = {name: array.copy() for name, array in content(project, trajectory, start, length).items()}
        if (trajectory, start) == (bent.trajectory, bent.start):
            arrays["proprioception"][1, 0] += 0.01
        return arrays

    monkeypatch.setattr(loop.client, "trajectory_content", moved)
    with pytest.raises(UnexplainedStep, match=f":{bent.start}, step 0: .* is off by 0.0[01].*, 0.0001 is allowed"):
        run_labeling(loop.client, batch, GENERATOR)
    answered = loop.client.acquisition(batch.id)
    assert [item.rank for item in answered.items if not item.labeled] == [2]
    assert (answered.status, loop.project.budget.spent, loop.project.budget.reserved) == ("released", 4, 0)


@pytest.mark.parametrize("broken", ["state", "step"])
def test_a_simulator_that_fails_on_one_segment_labels_the_others(
    opened: OpenLoop, monkeypatch: pytest.MonkeyPatch, broken: str
) -> None:
    loop = project_of(opened, "maniskill", cameras=False)
    loop.collect(6, behavior="random", split="pool")
    batch = loop.acquire(4, "random")
    provenance, chosen, advance = loop.client.provenance, batch.items[1], ManiSkillSimulator.advance
    at_work = False

    def told(project: Any, trajectory: str, start: Any = None, length: Any = None) -> tuple[Arrays, dict[str, Any]]:
        nonlocal at_work
        states, of = provenance(project, trajectory, start, length)
        at_work = (trajectory, start) == (chosen.trajectory, chosen.start)
        if at_work and broken == "state":
            states["version"][:, 1] = 9
        return states, of

    def breaks(simulator: ManiSkillSimulator, action: Action) -> None:
        if at_work and broken == "step":
            raise SimulatorError("Simulator 'maniskill', task 'PullCube', broke down in step 1 of an episode: nan")
        advance(simulator, action)

    monkeypatch.setattr(loop.client, "provenance", told)
    monkeypatch.setattr(ManiSkillSimulator, "advance", breaks)
    sentence = "this is task PullCube" if broken == "state" else "broke down in step 1"
    with pytest.raises(SimulatorFailed, match=f"^segment {chosen.trajectory}:{chosen.start}: .*{sentence}"):
        run_labeling(loop.client, batch, GENERATOR)
    answered = loop.client.acquisition(batch.id)
    assert [item.rank for item in answered.items if not item.labeled] == [1]
    assert answered.status == "released"


@pytest.mark.parametrize("simulator", LIBRARIES)
def test_segments_of_several_steps_are_labeled_and_explored(
    opened: OpenLoop, monkeypatch: pytest.MonkeyPatch, simulator: str
) -> None:
    loop = project_of(opened, simulator, cameras=False)
    loop.name = "chunks"
    new_project(loop, environment=loop.client.find_project("rooms").environment, segment_length=3)
    taken = actions_taken(monkeypatch)
    loop.collect(12, split="pool")
    loop.label(3, "random")
    for label in loop.client.labels(loop.project.id):
        assert len(label.actions) == 3
        assert label.actions == behind(loop, taken, label)
    batch = loop.acquire(2, mode="explore")
    accepted = run_labeling(loop.client, batch, GENERATOR)
    assert len(accepted.receipts) == 2
    brought = {receipt.trajectory for receipt in accepted.receipts}
    explored = [label.actions for label in loop.client.labels(loop.project.id) if label.trajectory in brought]
    assert sorted(map(str, explored)) == sorted(str(item.actions) for item in batch.items)


def test_a_labeler_that_dies_gives_its_segments_and_its_budget_to_the_next(
    opened: OpenLoop, monkeypatch: pytest.MonkeyPatch
) -> None:
    loop = project_of(opened, "maniskill", cameras=False)
    loop.change(label_budget=6)
    loop.collect(6, behavior="random", split="pool")
    batch = loop.acquire(6, "random", lease_seconds=60)

    def dies(simulator: ManiSkillSimulator, action: Action) -> None:
        raise SystemExit(9)

    with monkeypatch.context() as patch:
        patch.setattr(ManiSkillSimulator, "advance", dies)
        with pytest.raises(SystemExit):
            run_labeling(loop.client, batch, GENERATOR)
    assert loop.project.budget.reserved == 6
    loop.clock.advance(61)
    again = loop.label(6, "random")
    assert sorted(segments_of(again)) == sorted(segments_of(batch))
    assert (loop.project.budget.spent, loop.project.budget.reserved) == (6, 0)

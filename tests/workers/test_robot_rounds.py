"""Rounds of a robot project: what a round trains, from where, how it is judged, and how it fails in a sentence."""

import base64
import io
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from api_schemas.environments import Environment
from api_schemas.labels import LabeledTrajectory, LabelItem, LabelsRequest
from api_schemas.projects import LabelingPolicy, ProjectCreate
from api_schemas.rounds import Round
from asim.errors import ServiceError
from models import families
from models.families import RobotFamily
from models.world_models.recurrent import RecurrentWorldModel
from tests.science import toy_robot
from tests.workers.conftest import OpenLoop, new_project
from tests.workers.in_process import Loop
from tests.workers.test_robot_collection import project_of
from workers import data, trainer
from workers.labeling import run_labeling
from workers.training import BASE
from workers.training_processes import TrainingProcesses

LENGTH, SEGMENT = 20, 4
SPACES = {
    "observations": {"position": {"dtype": "float32", "shape": [2]}},
    "actions": {"kind": "box", "shape": [2]},
}
TINY = toy_robot.PRESET
PRESETS = families.PRESETS["robot"]


@pytest.fixture(autouse=True)
def _tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PRESETS, "small", RobotFamily(TINY))


@pytest.fixture
def points(opened: OpenLoop) -> Loop:
    """A point that its action moves: 30 trajectories in the pool of which 10 are labeled, 5 held-out ones."""
    loop = opened()
    fill(loop, "points")
    return loop


def fill(loop: Loop, name: str) -> None:
    """A robot project of that name, which the loop's methods are about from now on."""
    loop.name = name
    policy = LabelingPolicy(round_labels=0, strategy="cycle")
    environment = Environment.model_validate({"spaces": SPACES})
    loop.client.create_project(
        ProjectCreate(name=name, environment=environment, segment_length=SEGMENT, held_out_fraction=0.0, policy=policy)
    )
    upload(loop, 10, seed=1)
    upload(loop, 5, seed=2, split="held_out")
    unlabeled = toy_robot.points(20, LENGTH, seed=3).observations["position"]
    files = {f"{number}.npz": {"position": positions.numpy()} for number, positions in enumerate(unlabeled)}
    loop.client.add_trajectories(loop.project.id, files, split="pool")


def upload(loop: Loop, count: int, seed: int, split: Any = "pool") -> None:
    """Trajectories with their actions."""
    batch = toy_robot.points(count, LENGTH, seed)
    assert batch.actions is not None
    labeled = []
    for positions, actions in zip(batch.observations["position"], batch.actions, strict=True):
        content = io.BytesIO()
        np.savez(content, position=positions.numpy())
        npz = base64.b64encode(content.getvalue())
        labeled.append(LabeledTrajectory(content=npz, actions=actions.tolist(), split=split))
    loop.client.label(LabelsRequest(project=loop.project.id, trajectories=labeled))


def answer(loop: Loop, count: int, strategy: str = "cycle") -> None:
    """Acquire, and label by what is known of the point: where it went, over how far an action moves it."""
    batch = loop.acquire(count, strategy)
    items = []
    for item in batch.items:
        path = loop.client.trajectory_content(loop.project.id, item.trajectory, item.start, SEGMENT)["position"]
        actions = np.clip(np.diff(path, axis=0) / toy_robot.STEP, -1.0, 1.0)
        items.append(LabelItem(trajectory=item.trajectory, start=item.start, actions=actions.tolist()))
    request = LabelsRequest(project=loop.project.id, acquisition=batch.id, token=batch.token, items=items)
    loop.client.label(request)


def loss(of: Round) -> float:
    assert of.model_error is not None
    assert of.model_error.loss is not None
    return of.model_error.loss


def test_a_round_trains_the_robot_family_and_tells_what_is_not_foreseen(points: Loop) -> None:
    done = points.train()
    assert (done.status, done.error, done.labels) == ("current", None, 50)
    assert set(done.models) == BASE
    assert {points.client.model(model).family for model in done.models.values()} == {"robot"}
    assert points.project.preset == "small"
    error = done.model_error
    assert error is not None
    assert error.exact_accuracy is None
    assert error.transitions == 5 * LENGTH
    (end,) = error.open_loop
    assert end.horizon == SEGMENT
    assert loss(done) == pytest.approx(end.errors["position"] / end.standing_still["position"])
    assert 0.0 < loss(done) < 0.5
    found = done.diagnostics
    assert found is not None
    assert (found.support, found.aliasing, found.back_action, found.actions) == (None, None, None, [])
    assert found.ranking is not None
    assert (found.ranking.segments, found.sampled) == (25, 100)


def test_a_later_round_goes_on_from_the_weights_before(points: Loop) -> None:
    first = points.train()
    assert {points.client.model(model).parent for model in first.models.values()} == {None}
    answer(points, 20)
    second = points.train()
    assert second.labels == 70
    for kind, model in second.models.items():
        assert points.client.model(model).parent == first.models[kind]
    assert loss(second) < loss(first)
    assert [event.kind for event in points.client.events(points.project.id)].count("training.from_scratch") == 0


def test_the_queue_is_ranked_by_the_cycle_and_holds_the_worst_first(points: Loop) -> None:
    done = points.train()
    batch = points.acquire(10, "cycle")
    assert batch.round == done.id
    assert all(item.length == SEGMENT for item in batch.items)
    scores = [item.score for item in batch.items]
    assert all(score is not None and score > 0 for score in scores)


def test_weights_of_another_preset_are_left_and_training_begins_anew(
    points: Loop, monkeypatch: pytest.MonkeyPatch
) -> None:
    points.train()
    other = replace(TINY, world_model=replace(toy_robot.TINY, hidden=32))
    monkeypatch.setitem(PRESETS, "small", RobotFamily(other))
    again = points.train()
    assert again.status == "current"
    parents = {kind: points.client.model(model).parent for kind, model in again.models.items()}
    assert parents["world_model"] is None
    assert parents["inverse_dynamics"] is not None
    (told,) = (each for each in points.client.events(points.project.id) if each.kind == "training.from_scratch")
    assert told.data["kind"] == "world_model"
    assert "hidden=32" in str(told.data["reason"])
    assert "hidden=64" in str(told.data["reason"])


def test_a_network_that_is_not_finite_fails_its_round_and_nothing_else(
    points: Loop, monkeypatch: pytest.MonkeyPatch
) -> None:
    good = points.train()
    real = RecurrentWorldModel.loss

    def broken(self: RecurrentWorldModel, *args: Any) -> torch.Tensor:
        return real(self, *args) * float("nan")

    monkeypatch.setattr(RecurrentWorldModel, "loss", broken)
    failed = points.train()
    assert failed.status == "failed"
    for word in ("NonFiniteError: round 2, world_model:", "is nan at step 0", "another preset", "small"):
        assert word in str(failed.error)
    assert points.project.current_round == good.id
    assert points.acquire(2, "cycle").round == good.id


def test_too_little_memory_names_the_round_and_the_setting(points: Loop, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(trainer, "advance", full)
    asked = points.client.start_round(points.project.id)
    for _ in range(4):
        points.drain()
        points.clock.advance(100)
    error = str(points.client.round(asked.id).error)
    assert "OutOfMemory: round 1, inverse_dynamics: out of memory (CUDA out of memory)" in error
    assert "ASIM_TRAINING_BYTES" in error


def test_two_processes_train_the_world_model(opened: OpenLoop, monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[str] = []

    def counting(network: Any, *rest: Any) -> Any:
        started.append(network.kind)
        return TrainingProcesses(network, *rest)

    monkeypatch.setattr(trainer, "TrainingProcesses", counting)
    loop = opened(devices="cpu,cpu")
    fill(loop, "points")
    done = loop.train()
    assert (done.status, done.error) == ("current", None)
    assert "world_model" in started
    assert "inverse_dynamics" not in started  # it reads action-free segments too
    assert loss(done) < 0.5


def test_a_robot_and_a_grid_project_live_side_by_side(labeled: Loop) -> None:
    grid = labeled.name
    fill(labeled, "points")
    asked = {"robot": labeled.client.start_round(labeled.project.id)}
    labeled.name = grid
    asked["grid"] = labeled.client.start_round(labeled.project.id)
    labeled.drain()
    for family, of in asked.items():
        done = labeled.client.round(of.id)
        assert (done.status, done.error) == ("current", None)
        assert {labeled.client.model(model).family for model in done.models.values()} == {family}
        assert done.model_error is not None
        assert bool(done.model_error.open_loop) == (family == "robot")
    assert labeled.acquire(3, "cycle").round == asked["grid"].id
    labeled.name = "points"
    assert labeled.acquire(3, "cycle").round == asked["robot"].id


def test_a_pool_of_images_is_read_in_parts_that_fit(points: Loop, monkeypatch: pytest.MonkeyPatch) -> None:
    points.train()
    monkeypatch.setattr(data, "CHUNK_BYTES", 30 * (SEGMENT + 1) * 2 * 4)
    sizes: list[int] = []
    real = data.load

    def noted(*args: Any) -> Any:
        batch = real(*args)
        sizes.append(batch.size)
        return batch

    monkeypatch.setattr(data, "load", noted)
    points.ask_for_queue("vanilla_cycle")
    points.drain()
    assert 30 in sizes
    assert max(sizes[-4:]) <= 30


@pytest.mark.parametrize("strategy", ["self_inverse", "forward_cycle"])
def test_strategies_that_try_every_action_are_refused_at_every_door(points: Loop, strategy: Any) -> None:
    with pytest.raises(ServiceError, match="tries every action"):
        points.change(strategy=strategy)
    with pytest.raises(ServiceError, match="tries every action"):
        points.acquire(1, strategy)
    environment = Environment.model_validate({"spaces": SPACES})
    with pytest.raises(ServiceError, match=r"policy\.strategy.*tries every action"):
        new_project(points, name="other", environment=environment, policy=LabelingPolicy(strategy=strategy))


def test_explore_mode_has_a_robot_executed_along_the_worst_chains(opened: OpenLoop) -> None:
    loop = project_of(opened, "maniskill", cameras=False)
    loop.collect(trajectories=4, seed=1, split="pool")
    loop.label(12, "random")
    done = loop.train()
    assert (done.status, done.error) == ("current", None)
    batch = loop.acquire(4, "cycle", mode="explore")
    assert (batch.round, batch.strategy, len(batch.items)) == (done.id, "cycle", 4)
    actions = np.array([item.actions for item in batch.items])
    assert actions.shape == (4, 1, 7)
    assert bool((np.abs(actions) <= 1).all())
    before = loop.project.counts.labeled
    run_labeling(loop.client, batch, np.random.default_rng(0))
    assert loop.project.counts.labeled == before + 4

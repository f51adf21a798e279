"""The labeling worker: the simulator explains every step that it labels."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from api_schemas.environments import Environment
from api_schemas.labels import Label
from tests.workers.conftest import ROOM, OpenLoop
from tests.workers.in_process import Loop, segments_of
from workers import labeling
from workers.explanation import explain
from workers.labeling import UnexplainedStep, run_labeling
from workers.simulators.catalog import make_simulator
from workers.simulators.minigrid import ACTION_NAMES, DROP, NOTHING

Arrays = dict[str, NDArray[Any]]


def labels_of(loop: Loop, wanted: list[tuple[str, int]]) -> list[Label]:
    """The stored labels of these segments, in their order."""
    stored = {(label.trajectory, label.start): label for label in loop.client.labels(loop.project.id)}
    return [stored[segment] for segment in wanted]


class Steps:
    """State before, observation before and observation after a label's only step; a trajectory is fetched once."""

    def __init__(self, loop: Loop) -> None:
        self._loop = loop
        self._fetched: dict[str, tuple[Arrays, Arrays]] = {}

    def of(self, label: Label) -> tuple[Arrays, Arrays, Arrays]:
        if label.trajectory not in self._fetched:
            project, client = self._loop.project.id, self._loop.client
            states, _ = client.provenance(project, label.trajectory)
            self._fetched[label.trajectory] = states, client.trajectory_content(project, label.trajectory)
        states, seen = self._fetched[label.trajectory]
        before = {name: array[label.start] for name, array in seen.items()}
        after = {name: array[label.start + 1] for name, array in seen.items()}
        return {name: array[label.start] for name, array in states.items()}, before, after


def test_exactly_the_actions_of_a_labels_set_reproduce_its_step(labeled: Loop) -> None:
    batch = labeled.label(25, "random")
    simulator, steps = make_simulator("minigrid", ROOM.options), Steps(labeled)
    for label in labels_of(labeled, segments_of(batch)):
        state, _, after = steps.of(label)
        assert label.action_sets is not None
        explaining = label.action_sets[0]
        for action in range(len(ACTION_NAMES)):
            simulator.restore(state)
            reached = simulator.step(action).observation
            same = all(np.array_equal(reached[name], after[name]) for name in after)
            assert same == (action in explaining)
        assert label.actions[0] in explaining
        assert label.residual == 0.0
        assert label.source.kind == "simulator"
        assert label.acquisition == batch.id


def test_a_step_without_effect_is_labeled_with_all_that_have_none(labeled: Loop) -> None:
    batch = labeled.label(60, "random")
    checked, steps = 0, Steps(labeled)
    for label in labels_of(labeled, segments_of(batch)):
        _, before, after = steps.of(label)
        moved = any(not np.array_equal(before[name], after[name]) for name in before)
        if moved or tuple(before["carried"]) != NOTHING:
            continue
        assert label.action_sets is not None
        assert DROP in label.action_sets[0]  # dropping nothing changes nothing
        assert len(label.action_sets[0]) > 1
        checked += 1
    assert checked >= 3


def test_the_draw_from_a_set_follows_the_generator(opened: OpenLoop, labeled_folder: Path) -> None:
    drawn = []
    for seed in (0, 0, 1):
        loop = opened(labeled_folder)
        batch = loop.label(40, "random", seed)
        drawn.append([(label.actions, label.action_sets) for label in labels_of(loop, segments_of(batch))])
    assert drawn[0] == drawn[1]
    assert [sets for _, sets in drawn[0]] == [sets for _, sets in drawn[2]]
    assert [actions for actions, _ in drawn[0]] != [actions for actions, _ in drawn[2]]


def test_an_answer_sent_again_is_a_duplicate_even_where_the_draw_differs(labeled: Loop) -> None:
    batch = labeled.acquire(40, "random")
    first = run_labeling(labeled.client, batch, np.random.default_rng(0))
    again = run_labeling(labeled.client, batch, np.random.default_rng(1))
    assert (first.created, first.duplicates, again.created, again.duplicates) == (40, 0, 0, 40)


def test_a_large_batch_goes_in_several_requests(labeled: Loop, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(labeling, "BATCH", 8)
    labeled.change(round_labels=10)
    batch = labeled.acquire(30, "random")
    seen: list[tuple[int, int]] = []
    accepted = run_labeling(labeled.client, batch, np.random.default_rng(0), lambda done, of: seen.append((done, of)))
    assert [(r.trajectory, r.start) for r in accepted.receipts] == segments_of(batch)
    assert accepted.created == 30
    assert accepted.watermark == labeled.project.label_watermark
    assert accepted.round in [each.id for each in labeled.client.rounds(labeled.project.id)]
    assert seen == [(done, 30) for done in range(1, 31)]


def test_a_held_out_acquisition_is_labeled_like_any_other(labeled: Loop) -> None:
    before = labeled.project.counts.held_out_labeled
    run_labeling(labeled.client, labeled.acquire(5, purpose="held_out"), np.random.default_rng(0))
    assert labeled.project.counts.held_out_labeled == before + 5


def test_an_observation_that_no_action_explains_is_given_back_and_the_others_are_labeled(
    labeled: Loop, monkeypatch: pytest.MonkeyPatch
) -> None:
    batch = labeled.acquire(10, "random")
    before = labeled.project.label_watermark
    bent = batch.items[6]
    _bend(monkeypatch, labeled, lambda item: item == (bent.trajectory, bent.start))
    with pytest.raises(UnexplainedStep, match=f"segment {bent.trajectory}:{bent.start}, step 0: no action reproduces"):
        run_labeling(labeled.client, batch, np.random.default_rng(0))
    assert labeled.project.label_watermark == before + 9
    answered = labeled.client.acquisition(batch.id)
    assert [item.rank for item in answered.items if not item.labeled] == [6]
    assert (answered.status, labeled.project.counts.leased) == ("released", 0)


def test_explain_gives_nothing_where_even_the_best_action_misses() -> None:
    simulator = make_simulator("minigrid", ROOM.options)
    observed = simulator.reset(1)
    state = simulator.state()
    observed["carried"] = observed["carried"] + np.uint8(3)
    actions, residual = explain(simulator, state, observed)
    assert actions == []
    assert residual == 3.0


def test_a_project_without_a_simulator_is_refused_in_a_sentence(labeled: Loop) -> None:
    batch = labeled.acquire(2, "random")
    spaces = ROOM.resolved_spaces()
    environment = Environment(spaces=spaces).model_dump(mode="json")
    labeled.set_row("project", labeled.project.id, environment=environment)
    with pytest.raises(ValueError, match="names no simulator; its labels must come from elsewhere"):
        run_labeling(labeled.client, batch, np.random.default_rng(0))


def _bend(monkeypatch: pytest.MonkeyPatch, loop: Loop, chosen: Callable[[tuple[str, int]], bool]) -> None:
    """The service tells of another next observation for the chosen segments."""
    content = loop.client.trajectory_content

    def bent(project: Any, trajectory: str, start: int, length: int) -> Arrays:
        arrays = {name: array.copy() for name, array in content(project, trajectory, start, length).items()}
        if chosen((trajectory, start)):
            arrays["grid"][1, 0, 0, 1] ^= 1  # a wall of another colour
        return arrays

    monkeypatch.setattr(loop.client, "trajectory_content", bent)

"""The labeling worker: the simulator explains every step that it labels."""

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from api_schemas.acquisitions import Acquisition, AcquisitionItem
from api_schemas.environments import Environment
from api_schemas.labels import Label, LabelsAccepted, LabelsRequest
from asim.client import Client
from asim.errors import Conflict
from tests.workers.conftest import ROOM, OpenLoop, new_project
from tests.workers.in_process import Loop, segments_of
from workers import answering, delivery
from workers.explanation import explain
from workers.labeling import run_labeling
from workers.simulators.base import Simulator
from workers.simulators.catalog import make_simulator
from workers.simulators.minigrid import ACTION_NAMES, DROP, NOTHING
from workers.unanswerable import EndedEarly, UnexplainedStep

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
    monkeypatch.setattr(delivery, "BATCH", 8)
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


def test_explorations_are_executed_and_come_back_as_labeled_trajectories(labeled: Loop) -> None:
    labeled.change(label_budget=500)
    before = labeled.project
    batch = labeled.acquire(12, mode="explore")
    reserved = labeled.project.budget
    assert (reserved.spent, reserved.reserved) == (before.counts.labeled, 12)
    accepted = run_labeling(labeled.client, batch, np.random.default_rng(0))
    after = labeled.project
    assert len(accepted.receipts) == 12
    assert after.counts.labeled == before.counts.labeled + accepted.created
    found = {receipt.trajectory for receipt in accepted.receipts}
    known = {each.id for each in labeled.client.trajectories(after.id)} - found
    assert after.counts.pool_trajectories == before.counts.pool_trajectories + len(found)
    assert after.counts.pool_segments == before.counts.pool_segments + len(found)
    assert found.isdisjoint(known)
    assert (after.budget.spent, after.budget.reserved) == (after.counts.labeled, 0)
    answered = labeled.client.acquisition(batch.id)
    assert (answered.status, {item.labeled for item in answered.items}) == ("labeled", {True})
    again = run_labeling(labeled.client, batch, np.random.default_rng(1))
    assert (again.created, again.duplicates) == (0, 12)
    assert labeled.project.counts == after.counts


def test_what_an_exploration_brings_is_what_the_simulator_shows_and_all_that_explains_it(labeled: Loop) -> None:
    batch = labeled.acquire(10, mode="explore")
    accepted = run_labeling(labeled.client, batch, np.random.default_rng(0))
    simulator, project = make_simulator("minigrid", ROOM.options), labeled.project.id
    labels = labels_of(labeled, [(receipt.trajectory, receipt.start) for receipt in accepted.receipts])
    for item, label in zip(batch.items, labels, strict=True):
        states, _ = labeled.client.provenance(project, item.trajectory, item.start, 1)
        state = {name: array[0] for name, array in states.items()}
        seen = labeled.client.trajectory_content(project, item.trajectory, item.start, 1)
        brought = labeled.client.trajectory_content(project, label.trajectory)
        assert label.actions == item.actions
        assert item.actions is not None
        simulator.restore(state)
        reached = simulator.step(int(np.asarray(item.actions[0]))).observation
        for name, stream in brought.items():
            np.testing.assert_array_equal(stream, np.stack([seen[name][0], reached[name]]))
        assert label.action_sets == [explain(simulator, state, reached)[0]]
        assert label.source.kind == "simulator"
        assert label.acquisition == batch.id


def test_an_exploration_that_ends_in_the_other_split_is_given_back_and_the_others_are_stored(
    labeled: Loop, monkeypatch: pytest.MonkeyPatch
) -> None:
    batch = labeled.acquire(9, mode="explore")
    before = labeled.project.counts
    _into_held_out(labeled, monkeypatch, batch, rank=4)
    with pytest.raises(Conflict, match="is in the split 'held_out' of this project, not in 'pool'"):
        run_labeling(labeled.client, batch, np.random.default_rng(0))
    answered = labeled.client.acquisition(batch.id)
    unanswered = [item for item in answered.items if not item.labeled]
    twins = [item for item in batch.items if (item.trajectory, item.start, item.actions) == _what(batch.items[4])]
    assert [item.rank for item in unanswered] == [item.rank for item in twins]
    counts = labeled.project.counts
    assert (answered.status, labeled.project.budget.reserved) == ("released", 0)
    assert counts.labeled > before.labeled
    assert counts.held_out_labeled == before.held_out_labeled


def test_explorations_and_labels_beyond_the_byte_limit_go_in_several_requests(
    labeled: Loop, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(delivery, "BATCH_BYTES", 3000)
    for batch in (labeled.acquire(7, mode="explore"), labeled.acquire(40, "random")):
        sizes: list[int] = []
        _measure(monkeypatch, labeled, sizes)
        accepted = run_labeling(labeled.client, batch, np.random.default_rng(0))
        assert len(accepted.receipts) == len(batch.items)
        assert len(sizes) > 1
        assert max(sizes) <= 3500  # and what stands around the answers


def test_an_exploration_whose_episode_ends_early_is_given_back_and_the_others_are_stored(
    empty: Loop, monkeypatch: pytest.MonkeyPatch
) -> None:
    empty.name = "long"
    new_project(empty, segment_length=3)
    empty.collect(300, seed=1, split="pool")
    batch = empty.acquire(6, mode="explore")
    _end_episodes(monkeypatch, batch, rank=2, after=2)
    with pytest.raises(EndedEarly, match=r"^item 2, .*: the episode ended after 2 transitions, .* needs 3$"):
        run_labeling(empty.client, batch, np.random.default_rng(0))
    answered = empty.client.acquisition(batch.id)
    assert [item.rank for item in answered.items if not item.labeled] == [2]
    assert (answered.status, empty.project.budget.reserved) == ("released", 0)


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


def _what(item: AcquisitionItem) -> tuple[object, ...]:
    return item.trajectory, item.start, item.actions


def _into_held_out(loop: Loop, monkeypatch: pytest.MonkeyPatch, batch: Acquisition, rank: int) -> None:
    """What this item's exploration will observe stands in the held-out split already."""
    sent: list[LabelsRequest] = []

    def kept(request: LabelsRequest) -> LabelsAccepted:
        sent.append(request)
        raise InterruptedError

    with monkeypatch.context() as patch:
        patch.setattr(loop.client, "label", kept)
        with suppress(InterruptedError):
            run_labeling(loop.client, batch, np.random.default_rng(0))
    (found,) = [each for each in sent[0].trajectories if each.rank == rank]
    loop.client.add_files(loop.project.id, {"found": found.content}, split="held_out")


def _measure(monkeypatch: pytest.MonkeyPatch, loop: Loop, sizes: list[int]) -> None:
    """Notes the bytes of each request for labels."""
    label = Client.label

    def measured(client: Client, request: LabelsRequest) -> LabelsAccepted:
        sizes.append(len(request.model_dump_json()))
        return label(client, request)

    monkeypatch.setattr(Client, "label", measured)


def _end_episodes(monkeypatch: pytest.MonkeyPatch, batch: Acquisition, rank: int, after: int) -> None:
    """The episode that this item explores in is over after so many steps."""
    explore = answering._explore

    def cut(
        client: Client, project: Any, simulator: Simulator, explainer: Any, item: AcquisitionItem, told: Any
    ) -> Any:
        if item.rank == rank:
            simulator = Cut(simulator, after)
        return explore(client, project, simulator, explainer, item, told)

    monkeypatch.setattr(answering, "_explore", cut)


class Cut:
    """A simulator whose episode ends after so many steps."""

    def __init__(self, simulator: Simulator, after: int) -> None:
        self._simulator, self._left = simulator, after

    def __getattr__(self, name: str) -> Any:
        return getattr(self._simulator, name)

    def step(self, action: Any) -> Any:
        self._left -= 1
        return self._simulator.step(action)._replace(truncated=self._left <= 0)


def _bend(monkeypatch: pytest.MonkeyPatch, loop: Loop, chosen: Callable[[tuple[str, int]], bool]) -> None:
    """The service tells of another next observation for the chosen segments."""
    content = loop.client.trajectory_content

    def bent(project: Any, trajectory: str, start: int, length: int) -> Arrays:
        arrays = {name: array.copy() for name, array in content(project, trajectory, start, length).items()}
        if chosen((trajectory, start)):
            arrays["grid"][1, 0, 0, 1] ^= 1  # a wall of another colour
        return arrays

    monkeypatch.setattr(loop.client, "trajectory_content", bent)

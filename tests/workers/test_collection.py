"""Collection: observations join the pool, states go to the provenance store, actions go nowhere."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from api_schemas.environments import Environment
from asim.errors import ServiceError
from service.store import codec
from tests.workers.conftest import ROOM, OpenLoop, new_project
from tests.workers.in_process import Loop
from workers.explanation import explain
from workers.simulators.base import Action, Step
from workers.simulators.catalog import make_simulator
from workers.simulators.minigrid import MiniGridSimulator


def files(folder: Path) -> dict[str, int]:
    """Path and size of everything stored below a folder."""
    return {str(path.relative_to(folder)): path.stat().st_size for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("transitions", [1, 333])
def test_the_pool_grows_by_exactly_the_transitions_that_were_asked_for(empty: Loop, transitions: int) -> None:
    job = empty.collect(transitions, seed=3, split="pool")
    assert job.state == "done"
    assert sum(each.transitions for each in empty.client.trajectories(empty.project.id)) == transitions
    assert empty.project.counts.pool_segments == transitions


def test_repeated_episodes_do_not_count_twice(opened: OpenLoop, monkeypatch: pytest.MonkeyPatch) -> None:
    reset = MiniGridSimulator.reset
    monkeypatch.setattr(MiniGridSimulator, "reset", lambda self, seed: reset(self, seed % 5))
    loop = opened()
    new_project(loop, environment=Environment(simulator="minigrid", options={"max_steps": 1}))
    job = loop.collect(8, behavior="random", seed=0, split="pool")
    assert (job.state, job.error) == ("done", None)
    assert loop.project.counts.pool_segments == loop.project.counts.pool_trajectories == 8


def test_a_simulator_with_nothing_new_to_show_ends_the_collection(empty: Loop, monkeypatch: pytest.MonkeyPatch) -> None:
    reset, step = MiniGridSimulator.reset, MiniGridSimulator.step
    monkeypatch.setattr(MiniGridSimulator, "reset", lambda self, seed: reset(self, 0))
    monkeypatch.setattr(MiniGridSimulator, "step", lambda self, action: step(self, 0)._replace(truncated=True))
    job = empty.collect(8, behavior="random", seed=0, split="pool")
    assert (job.state, job.result["transitions"]) == ("done", 1)


def test_collecting_again_with_the_same_seed_adds_nothing(empty: Loop) -> None:
    first = empty.collect(400, behavior="balanced", seed=5, split="held_out", per_action=1)
    counts, stored = empty.project.counts, files(empty.folder / "blobs") | files(empty.folder / "provenance")
    second = empty.collect(400, behavior="balanced", seed=5, split="held_out", per_action=1)
    assert second.result == {**first.result, "known_before": first.result["trajectories"]}
    assert empty.project.counts == counts
    assert files(empty.folder / "blobs") | files(empty.folder / "provenance") == stored


def test_another_seed_adds_other_trajectories(empty: Loop) -> None:
    empty.collect(200, seed=5, split="pool")
    empty.collect(200, seed=6, split="pool")
    assert empty.project.counts.pool_segments == 400


def test_every_action_gets_its_share_of_effective_labels(empty: Loop) -> None:
    job = empty.collect(3000, behavior="balanced", seed=1, split="held_out", per_action=3)
    labels = list(empty.client.labels(empty.project.id))
    assert np.bincount([int(str(label.actions[0])) for label in labels], minlength=7).tolist() == [3] * 7
    assert job.result["short_of"] == {}
    assert empty.project.counts.held_out_segments < 3000  # it stopped when the quota was met
    simulator = make_simulator("minigrid", ROOM.options)
    for label in labels:
        seen = empty.client.trajectory_content(empty.project.id, label.trajectory, label.start, 1)
        states, _ = empty.client.provenance(empty.project.id, label.trajectory, label.start, 1)
        assert any(not np.array_equal(stream[0], stream[1]) for stream in seen.values())
        explaining, _ = explain(simulator, {k: v[0] for k, v in states.items()}, {k: v[1] for k, v in seen.items()})
        assert label.actions[0] in explaining


def test_a_collection_says_what_it_is_short_of(empty: Loop) -> None:
    job = empty.collect(15, behavior="balanced", seed=1, split="held_out", per_action=9)
    taken, missing = job.result["labels"], job.result["short_of"]
    assert isinstance(taken, dict)
    assert isinstance(missing, dict)
    assert missing
    assert all(missing[name] == 9 - taken.get(name, 0) for name in missing)


def test_states_are_in_the_provenance_store_only(empty: Loop) -> None:
    empty.collect(200, seed=2, split="pool")
    names = set(make_simulator("minigrid", ROOM.options).observation_space)
    trajectories = sorted((empty.folder / "blobs").rglob("*/*/*"))
    assert trajectories
    assert all(set(decoded(path)[0]) == names for path in trajectories)
    kept = sorted((empty.folder / "provenance").rglob("*/*/*"))
    assert len(kept) == len(trajectories) == empty.project.counts.pool_trajectories
    simulator = make_simulator("minigrid", ROOM.options)
    simulator.reset(0)
    assert all(set(decoded(path)[0]) == set(simulator.state()) for path in kept)
    assert set(simulator.state()) - names


def test_no_stored_array_holds_the_actions(empty: Loop, monkeypatch: pytest.MonkeyPatch) -> None:
    episodes: list[list[int]] = []
    reset, step = MiniGridSimulator.reset, MiniGridSimulator.step

    def recorded_reset(simulator: MiniGridSimulator, seed: int) -> Any:
        episodes.append([])
        return reset(simulator, seed)

    def recorded_step(simulator: MiniGridSimulator, action: Action) -> Step:
        episodes[-1].append(int(action))
        return step(simulator, action)

    monkeypatch.setattr(MiniGridSimulator, "reset", recorded_reset)
    monkeypatch.setattr(MiniGridSimulator, "step", recorded_step)
    empty.collect(400, seed=4, split="pool")
    long = [np.array(actions) for actions in episodes if len(actions) >= 10]
    assert len(long) > 3
    stored = [path for store in ("blobs", "provenance") for path in (empty.folder / store).rglob("*/*/*")]
    assert not any(holds(array, long) for path in stored for array in decoded(path)[0].values())
    assert all("action" not in name for path in stored for name in decoded(path)[0])
    assert all("action" not in json for path in stored for json in map(str, decoded(path)[1].items()))


def test_the_search_for_actions_would_find_them() -> None:
    actions = np.arange(12) % 7
    hidden = np.zeros((13, 2, 2), np.uint8)
    hidden[1:, 1, 0] = actions
    assert holds(hidden, [actions])
    assert not holds(hidden[:, :, 1], [actions])


def test_what_the_other_split_holds_is_passed_over(empty: Loop) -> None:
    empty.collect(100, seed=7, split="pool")
    job = empty.collect(100, seed=7, split="held_out")
    assert (job.state, job.result["transitions"]) == ("done", 100)
    counts = empty.project.counts
    assert (counts.pool_segments, counts.held_out_segments) == (100, 100)


def test_an_unknown_behavior_is_refused_before_any_job(empty: Loop) -> None:
    with pytest.raises(ServiceError, match=r"must be one of .*got dance"):
        empty.collect(10, behavior="dance")
    assert not list(empty.client.jobs(empty.project.id))


def test_consecutive_states_belong_to_consecutive_observations(empty: Loop) -> None:
    empty.collect(60, seed=8, split="pool")
    simulator = make_simulator("minigrid", ROOM.options)
    for trajectory in empty.client.trajectories(empty.project.id):
        seen = empty.client.trajectory_content(empty.project.id, trajectory.id)
        states, metadata = empty.client.provenance(empty.project.id, trajectory.id)
        assert metadata["behavior"] == "mixture"
        for step in range(trajectory.transitions + 1):
            simulator.restore({name: array[step] for name, array in states.items()})
            assert all(np.array_equal(seen[name][step], stream) for name, stream in simulator.observe().items())


def decoded(path: Path) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Arrays and metadata of a stored object."""
    return codec.decode(path.read_bytes(), path.name)


def holds(array: NDArray[Any], sequences: list[NDArray[np.int64]]) -> bool:
    """True where a column of the array over time, shifted or not, is one of the sequences."""
    columns = array.reshape(len(array), -1)
    fitting = [s for s in sequences if len(s) in (len(array), len(array) - 1)]
    return any(
        np.array_equal(columns[first : first + len(s), i], s)
        for s in fitting
        for first in range(len(array) - len(s) + 1)
        for i in range(columns.shape[1])
    )


def test_a_flickering_tile_makes_no_idle_action_effective(opened: OpenLoop) -> None:
    loop = opened()
    options: dict[str, str | int | float | bool] = {"room_size": 8, "objects": 3, "noisy_tiles": 4}
    new_project(loop, environment=Environment(simulator="minigrid", options=options))
    loop.collect(3_000, per_action=5, behavior="balanced", split="held_out")
    simulator = make_simulator("minigrid", options)
    labels = list(loop.client.labels(loop.project.id))
    assert len(labels) >= 20
    for label in labels:
        states, _ = loop.client.provenance(loop.project.id, label.trajectory, label.start, 1)
        seen = loop.client.trajectory_content(loop.project.id, label.trajectory, label.start, 1)
        before, after = ({name: array[i] for name, array in arrays.items()} for i, arrays in ((0, states), (1, seen)))
        assert explain(simulator, before, after)[0] == label.actions

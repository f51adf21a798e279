"""Explore mode offline: the simulator shows what the asked action does, and chance is named by the seed."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.paper.minigrid.acquisition import ArmRun
from benchmarks.paper.minigrid.arms import Arm
from benchmarks.paper.minigrid.datasets import TUNING, DataSpec, load, load_states
from benchmarks.paper.minigrid.exploration import Exploration
from benchmarks.paper.minigrid.rooms import Rooms
from models.acquisition import Models


@pytest.fixture(scope="module")
def exploration(tmp_path_factory: pytest.TempPathFactory) -> Exploration:
    """The arm that explores by chance, on a small pool."""
    folder, spec = tmp_path_factory.mktemp("rooms"), DataSpec("mixture", 300, TUNING, states=True)
    states = tuple(load_states(spec, folder))
    return Exploration(Arm.parse("explore_random:top"), 3, spec.spaces, load(spec, folder), spec=spec, states=states)


def test_executing_what_was_done_shows_what_was_observed(exploration: Exploration) -> None:
    pool, rows = exploration.pool, torch.arange(exploration.pool.size)
    assert pool.actions is not None
    assert pool.action_sets is not None
    executed = exploration._executed(rows, pool.actions)
    assert all(torch.equal(executed.observations[name], pool.observations[name]) for name in pool.observations)
    assert executed.action_sets is not None
    assert torch.equal(executed.action_sets, pool.action_sets)


def test_an_action_that_changes_nothing_is_a_label_too(exploration: Exploration) -> None:
    rows, swap = torch.arange(60), torch.full((60, 1), 6)
    executed = exploration._executed(rows, swap)
    assert executed.size == 60
    assert executed.action_sets is not None
    assert bool(executed.action_sets[:, 0, 6].all())
    grid = executed.observations["grid"]
    idle = (grid[:, 0] == grid[:, 1]).flatten(1).all(1)
    assert int(idle.sum()) > 0
    assert bool((executed.action_sets[idle, 0].sum(1) > 1).all())


def test_chance_explores_all_actions_and_repeats_with_its_seed(exploration: Exploration) -> None:
    free, rng = torch.ones(exploration.pool.size, dtype=torch.bool), np.random.default_rng(0)
    rows, chosen = exploration._chosen(1, Models(), torch.zeros(0), free, rng)
    again, _ = exploration._chosen(1, Models(), torch.zeros(0), free, rng)
    other, _ = replace(exploration, seed=4)._chosen(1, Models(), torch.zeros(0), free, rng)
    assert chosen.actions is not None
    assert set(chosen.actions.flatten().tolist()) == set(range(7))
    assert torch.equal(rows, again)
    assert not torch.equal(rows, other)


def test_a_pool_without_states_is_not_explored(tmp_path: Path) -> None:
    rooms = Rooms(tmp_path, tuning=True, pool_transitions=300, pool=tmp_path / "pool.npz")
    run = ArmRun(Arm.parse("explore:kmeans_plus_plus"), 0, rooms, tmp_path)
    small = replace(rooms, pool=None, per_action=1, natural_transitions=10).load()
    with pytest.raises(ValueError, match="holds no states"):
        run._experiment(small)

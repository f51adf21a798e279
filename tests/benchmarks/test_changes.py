"""Dynamics Accuracy: which elements count, and which are right."""

import torch

from benchmarks.paper.minigrid.changes import accuracy, changes, without_tiles
from models.families import GRID
from models.segments import Observations
from tests.science import toy_grid
from workers.simulators.minigrid import EMPTY, FLOOR


def test_a_perfect_guess_has_every_change_and_standing_still_has_none() -> None:
    pairs = toy_grid.labeled(200, seed=3, effective=True).observations
    right, changed = changes({name: stream[:, 1] for name, stream in pairs.items()}, pairs)
    assert torch.equal(right, changed)
    assert bool((changed >= 1).all())
    right, _ = changes({name: stream[:, 0] for name, stream in pairs.items()}, pairs)
    assert int(right.sum()) == 0


def test_an_element_is_right_only_with_all_three_channels() -> None:
    pairs = _still()
    pairs["grid"][0, 1, 2, 2] = torch.tensor((5, 2, 0))
    pairs["carried"][0, 1] = torch.tensor((6, 0, 0))
    guess = {"grid": pairs["grid"][:, 1].clone(), "carried": pairs["carried"][:, 1].clone()}
    guess["grid"][0, 2, 2, 1] = 0
    right, changed = changes(guess, pairs)
    assert (right.tolist(), changed.tolist()) == ([1], [2])


def test_masked_cells_do_not_count_and_the_hand_does() -> None:
    pairs = _still()
    pairs["grid"][0, :, 1, 1] = torch.tensor(((FLOOR, 3, 0), (FLOOR, 4, 0)))
    pairs["carried"][0, 1] = torch.tensor((6, 0, 0))
    guess = {name: stream[:, 0] for name, stream in pairs.items()}
    assert changes(guess, pairs)[1].tolist() == [2]
    assert changes(guess, pairs, without_tiles(pairs["grid"][:, 0]))[1].tolist() == [1]


def test_it_agrees_with_the_world_models_own_count() -> None:
    world_model = GRID.build_world_model(toy_grid.SPACES, None, torch.Generator().manual_seed(0))
    pairs = toy_grid.labeled(100, seed=4, effective=True)
    assert pairs.actions is not None
    with torch.inference_mode():
        prediction = world_model.predict(
            world_model.encode({name: stream[:, 0] for name, stream in pairs.observations.items()}), pairs.actions[:, 0]
        )
        ours = changes(world_model.observe(prediction), pairs.observations)
        theirs = world_model.changes(prediction, pairs.observations)
    assert torch.equal(ours[0], theirs[0])
    assert torch.equal(ours[1], theirs[1])


def test_accuracy_is_pooled_over_a_group_and_unknown_where_nothing_changes() -> None:
    right, changed = torch.tensor([1, 0, 3]), torch.tensor([1, 2, 3])
    groups = {"all": torch.tensor([True, True, True]), "none": torch.tensor([False, False, False])}
    assert accuracy(right, changed, groups) == {"all": 4 / 6, "none": None}


def _still() -> Observations:
    """One pair of equal observations of an empty room."""
    grid = torch.zeros(1, 2, 5, 5, 3, dtype=torch.uint8)
    grid[..., 0] = EMPTY
    return {"grid": grid, "carried": torch.tensor([[[EMPTY, 0, 0]] * 2], dtype=torch.uint8)}

"""Families, and spaces as JSON."""

import json

import pytest
import torch

from models.families import FAMILIES, BoxAction, Spaces, family_named
from models.network import KINDS
from tests.science import toy_grid


def test_an_unknown_family_is_named_with_those_there_are() -> None:
    with pytest.raises(ValueError, match="family must be one of grid, got 'gird'"):
        family_named("gird")


@pytest.mark.parametrize("name", FAMILIES)
def test_a_family_builds_and_schedules_every_kind(name: str) -> None:
    family = family_named(name)
    for kind in KINDS:
        network = family.build(kind, toy_grid.SPACES, {}, torch.Generator().manual_seed(0))
        assert (network.family, network.kind) == (name, kind)
        assert family.training_config(kind, 500).steps > 0


def test_unknown_kinds_are_refused() -> None:
    with pytest.raises(ValueError, match="got 'critic'"):
        family_named("grid").build("critic", toy_grid.SPACES, {}, torch.Generator())
    with pytest.raises(ValueError, match="got 'critic'"):
        family_named("grid").training_config("critic", 500)


@pytest.mark.parametrize("spaces", [toy_grid.SPACES, Spaces(toy_grid.SPACES.observations, BoxAction(-1.0, 1.0, (7,)))])
def test_spaces_survive_json(spaces: Spaces) -> None:
    assert Spaces.from_json(json.loads(json.dumps(spaces.to_json()))) == spaces


def test_continuous_actions_are_not_for_the_grid_family() -> None:
    with pytest.raises(ValueError, match="discrete action space"):
        family_named("grid").check_spaces(Spaces(toy_grid.SPACES.observations, BoxAction(-1.0, 1.0, (7,))))

"""Families, and spaces as JSON."""

import json

import pytest
import torch

from models import checkpoints
from models.families import FAMILIES, ROBOT, ROBOT_PAPER, BoxAction, Spaces, family_named
from models.inverse_dynamics.latent_action import LatentActionConfig
from models.network import KINDS
from tests.science import toy_grid, toy_point

SPACES = {"grid": toy_grid.SPACES, "robot": toy_point.SPACES}


def test_an_unknown_family_is_named_with_those_there_are() -> None:
    with pytest.raises(ValueError, match="family must be one of grid, robot, got 'gird'"):
        family_named("gird")


def test_a_preset_is_another_size_of_the_same_family() -> None:
    small, paper = family_named("robot", "small"), family_named("robot", "paper")
    assert (small, paper) == (ROBOT, ROBOT_PAPER)
    assert small.name == paper.name
    with pytest.raises(ValueError, match="preset of the robot family must be one of small, paper, got 'huge'"):
        family_named("robot", "huge")
    with pytest.raises(ValueError, match="preset of the grid family must be one of none, got 'small'"):
        family_named("grid", "small")


@pytest.mark.parametrize("name", FAMILIES)
def test_a_family_builds_and_schedules_every_kind(name: str) -> None:
    family = family_named(name)
    for kind in KINDS:
        network = family.build(kind, SPACES[name], {}, torch.Generator().manual_seed(0))
        assert (network.family, network.kind) == (name, kind)
        steps = family.training_config(kind, 500).steps
        further = family.further_config(kind, 500)
        assert steps > 0
        assert (further is None) == (name == "grid")
        assert further is None or further.steps < steps


@pytest.mark.parametrize("name", FAMILIES)
def test_unknown_kinds_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match="got 'critic'"):
        family_named(name).build("critic", SPACES[name], {}, torch.Generator())
    with pytest.raises(ValueError, match="got 'critic'"):
        family_named(name).training_config("critic", 500)
    with pytest.raises(ValueError, match="got 'critic'"):
        family_named(name).further_config("critic", 500)


@pytest.mark.parametrize("spaces", [toy_grid.SPACES, Spaces(toy_grid.SPACES.observations, BoxAction(-1.0, 1.0, (7,)))])
def test_spaces_survive_json(spaces: Spaces) -> None:
    assert Spaces.from_json(json.loads(json.dumps(spaces.to_json()))) == spaces


def test_continuous_actions_are_not_for_the_grid_family() -> None:
    with pytest.raises(ValueError, match="discrete action space"):
        family_named("grid").check_spaces(Spaces(toy_grid.SPACES.observations, BoxAction(-1.0, 1.0, (7,))))


@pytest.mark.parametrize("kind", KINDS)
def test_a_robot_s_network_is_the_same_after_its_checkpoint(kind: str) -> None:
    network = ROBOT.build(kind, toy_point.SPACES, {}, torch.Generator().manual_seed(0))
    data = checkpoints.save(network)
    again = checkpoints.load(data, expect_kind=kind, expect_family="robot")
    assert again.config == network.config
    assert checkpoints.save(again) == data


def test_the_paper_s_robot_preset_has_the_stated_sizes() -> None:
    build, generator = ROBOT_PAPER.build_inverse_dynamics, torch.Generator()
    sparse = build(toy_point.SPACES, "sparse", None, generator).config
    assert (sparse.latent, sparse.sparsity, sparse.actor, sparse.every) == (16, 0.1, (1024, 1024, 1024), 2)
    assert build(toy_point.SPACES, "dense", None, generator).config == LatentActionConfig(
        sparsity=0.0, actor=(1024, 1024, 1024), window=8, width=256, layers=3, heads=4, hidden=2048
    )


def test_a_config_of_another_form_is_refused() -> None:
    with pytest.raises(ValueError, match="'sparse', 'dense' or 'masked' with its config, got 'dense'"):
        ROBOT.build_inverse_dynamics(toy_point.SPACES, "dense", LatentActionConfig(), torch.Generator())

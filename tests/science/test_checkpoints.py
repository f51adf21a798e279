"""Checkpoints come back bit for bit, and nothing else comes back at all."""

import json
from dataclasses import replace
from typing import Any

import pytest
import torch
from safetensors.torch import save as save_tensors

from models import checkpoints
from models.checkpoints import CheckpointError
from models.families import GRID
from models.network import KINDS, Network
from models.world_models.grid import GridWorldModelConfig
from tests.science import toy_grid


def _network(kind: str, config: dict[str, Any] | None = None) -> Network:
    return GRID.build(kind, toy_grid.SPACES, config or {}, torch.Generator().manual_seed(5))


@pytest.mark.parametrize("kind", KINDS)
def test_a_checkpoint_comes_back_bit_for_bit(kind: str) -> None:
    model = _network(kind)
    data = checkpoints.save(model)
    loaded = checkpoints.load(data, expect_kind=kind, expect_family="grid")
    assert checkpoints.save(loaded) == data
    assert (loaded.kind, loaded.config, loaded.spaces) == (kind, model.config, toy_grid.SPACES)
    assert all(torch.equal(loaded.state_dict()[name], tensor) for name, tensor in model.state_dict().items())


def test_the_config_comes_back_with_the_weights() -> None:
    config = GridWorldModelConfig(channels=16, blocks=1)
    model = GRID.build_world_model(toy_grid.SPACES, config, torch.Generator().manual_seed(0))
    assert checkpoints.load(checkpoints.save(model)).config == config


def test_another_kind_or_family_is_refused() -> None:
    data = checkpoints.save(_network("world_model"))
    with pytest.raises(CheckpointError, match="Expected a checkpoint of kind 'subgoal_generator', found kind 'world_m"):
        checkpoints.load(data, expect_kind="subgoal_generator")
    with pytest.raises(CheckpointError, match="family 'robot', found family 'grid'"):
        checkpoints.load(data, expect_family="robot")


@pytest.mark.parametrize("damage", [b"", b"1234", b"\x80\x04pickle would run this", b"\xff" * 100])
def test_foreign_bytes_are_refused(damage: bytes) -> None:
    with pytest.raises(CheckpointError, match="Expected a"):
        checkpoints.load(damage)


@pytest.mark.parametrize("keep", [7, 100, 2000, -1])
def test_truncated_bytes_are_refused(keep: int) -> None:
    with pytest.raises(CheckpointError):
        checkpoints.load(checkpoints.save(_network("inverse_dynamics"))[:keep])


def test_safetensors_of_somebody_else_are_refused() -> None:
    with pytest.raises(CheckpointError, match="with our metadata"):
        checkpoints.load(save_tensors({"weight": torch.zeros(2)}))
    described = {"asim": json.dumps(checkpoints.describe(checkpoints.save(_network("inverse_dynamics"))))}
    with pytest.raises(CheckpointError, match="Expected the tensors and config of a grid inverse_dynamics"):
        checkpoints.load(save_tensors({"weight": torch.zeros(2)}, described))


def test_spaces_the_family_cannot_take_are_named() -> None:
    streams = toy_grid.SPACES.observations
    flat = replace(toy_grid.SPACES, observations={**streams, "grid": replace(streams["grid"], shape=(25, 3))})
    with pytest.raises(ValueError, match=r"grid must have shape \(S, S, 3\) with S of at least 3, got \(25, 3\)"):
        GRID.build_world_model(flat, None, torch.Generator())

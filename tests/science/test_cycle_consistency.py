"""Cycle error and Algorithm 1."""

import pytest
import torch

from models.cycle_consistency import cycle_error, worst_chain
from models.families import GRID
from models.inverse_dynamics.base import DiscreteInverseDynamics
from models.segments import Observations, SegmentBatch, at
from models.subgoal_generators.grid import GridSubgoalGenerator
from models.world_models.grid import GridWorldModel
from tests.science import toy_grid


def test_cycle_error_is_larger_where_the_world_model_has_never_been(
    world_model: GridWorldModel, inverse_dynamics: DiscreteInverseDynamics, held_out: SegmentBatch
) -> None:
    assert held_out.actions is not None
    errors = cycle_error(world_model, inverse_dynamics, held_out.observations)
    unseen = held_out.actions[:, 0] >= 3  # interactions: the world model was trained on movement
    ranked = unseen[errors.argsort(descending=True)][: int(unseen.sum())]
    assert float(ranked.float().mean()) >= 0.8
    assert float(errors[unseen].median()) > 3 * float(errors[~unseen].median())


def test_cycle_error_of_a_chain_sums_its_steps(
    world_model: GridWorldModel, inverse_dynamics: DiscreteInverseDynamics
) -> None:
    chain, first_step = _two_steps(50)
    long = cycle_error(world_model, inverse_dynamics, chain)
    short = cycle_error(world_model, inverse_dynamics, first_step)
    state = world_model.encode(at(chain, 0))
    prediction = world_model.rollout(state, inverse_dynamics.infer(chain))[:, 1:]
    second = world_model.distance(prediction, {name: stream[:, 2:] for name, stream in chain.items()})
    torch.testing.assert_close(long, short + second)


def test_the_worst_chain_has_the_largest_error_of_those_drawn(
    world_model: GridWorldModel, inverse_dynamics: DiscreteInverseDynamics, held_out: SegmentBatch
) -> None:
    generator, states = _untrained_generator(), at(held_out.observations, 0)
    worst = worst_chain(world_model, inverse_dynamics, generator, states, 4, 2, torch.Generator().manual_seed(5))
    again, draws = torch.Generator().manual_seed(5), []
    for _ in range(4):
        draws.append(cycle_error(world_model, inverse_dynamics, generator.sample(states, 2, again)))
    assert torch.equal(worst.error, torch.stack(draws).amax(0))
    torch.testing.assert_close(cycle_error(world_model, inverse_dynamics, worst.chain), worst.error)
    assert torch.equal(worst.actions, inverse_dynamics.infer(worst.chain))
    assert worst.actions.shape == (held_out.size, 2)


def test_no_chain_at_all_is_refused(
    world_model: GridWorldModel, inverse_dynamics: DiscreteInverseDynamics, held_out: SegmentBatch
) -> None:
    states = at(held_out.observations, 0)
    with pytest.raises(ValueError, match="at least 1, got 0 and 1"):
        worst_chain(world_model, inverse_dynamics, _untrained_generator(), states, 0, 1, torch.Generator())


def _untrained_generator() -> GridSubgoalGenerator:
    return GRID.build_subgoal_generator(toy_grid.SPACES, None, torch.Generator().manual_seed(0))


def _two_steps(count: int) -> tuple[Observations, Observations]:
    one = toy_grid.labeled(count, seed=9).observations
    turned = toy_grid.step(one["grid"][:, 1].numpy(), one["carried"][:, 1].numpy(), torch.ones(count).long().numpy())
    last = dict(zip(("grid", "carried"), (torch.from_numpy(stream).unsqueeze(1) for stream in turned), strict=True))
    return {name: torch.cat((one[name], last[name]), 1) for name in one}, one

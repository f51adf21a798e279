"""Explore mode: what to execute where, from imagined futures alone."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from models import exploration
from models.acquisition import BATCH_RULES, EXPLORING, Models
from models.exploration import Explorations, asked, distinct, explore, looks
from models.exploration_queue import order
from models.families import GRID
from models.inverse_dynamics.base import DiscreteInverseDynamics
from models.segments import Observations, SegmentBatch, at, take
from models.subgoal_generators.grid import GridSubgoalGenerator
from models.training import TrainingConfig, train
from models.world_models.grid import GridWorldModel, GridWorldModelConfig
from tests.science import toy_grid

CYCLE = EXPLORING["cycle"]
STATES, TOGGLE = 300, 5


class NeverInfers:
    """Inverse dynamics to which no label has shown that one of the actions does anything."""

    def __init__(self, trained: DiscreteInverseDynamics, action: int) -> None:
        self.trained, self.action = trained, action

    def log_prob(self, batch: SegmentBatch) -> torch.Tensor:
        """Of every action; next to nothing of that one."""
        log_prob = self.trained.log_prob(batch).clone()
        log_prob[..., self.action] = -30.0
        return log_prob


@pytest.fixture(scope="module")
def subgoal_generator() -> GridSubgoalGenerator:
    """Has seen what follows in 3,000 toy transitions, and no action."""
    generator = torch.Generator().manual_seed(2)
    model = GRID.build_subgoal_generator(toy_grid.SPACES, None, generator)
    seen = toy_grid.labeled(3000, seed=3).without_labels()
    train(model, seen, TrainingConfig(400, 64, 5e-3, 1e-4), generator)
    return model


@pytest.fixture(scope="module")
def models(
    world_model: GridWorldModel,
    inverse_dynamics: DiscreteInverseDynamics,
    subgoal_generator: GridSubgoalGenerator,
) -> Models:
    """A world model that knows movement only, inverse dynamics that knows all seven actions, and the generator."""
    return Models(world_model, inverse_dynamics, subgoal_generator=subgoal_generator)


@pytest.fixture(scope="module")
def states() -> Observations:
    """Of rooms that nobody has seen."""
    return at(toy_grid.labeled(STATES, seed=8).observations, 0)


@pytest.fixture(scope="module")
def found(models: Models, states: Observations) -> Explorations:
    """All actions at all of them."""
    return explore(CYCLE, models, states, 1, torch.Generator())


def outcomes(found: Explorations, states: Observations) -> Observations:
    """What executing leads to: (M, ...)."""
    grid, carried = (states[name][found.states].numpy() for name in ("grid", "carried"))
    after = toy_grid.step(grid, carried, found.actions[:, 0].numpy())
    return {"grid": torch.from_numpy(after[0]), "carried": torch.from_numpy(after[1])}


@torch.inference_mode()
def true_loss(
    world_model: GridWorldModel, found: Explorations, states: Observations, after: Observations
) -> torch.Tensor:
    """Of the world model, on what it would be shown: nats (M,)."""
    state = world_model.encode({name: stream[found.states] for name, stream in states.items()})
    following = {name: stream.unsqueeze(1) for name, stream in after.items()}
    return world_model.distance(world_model.rollout(state, found.actions), following)


def test_every_action_is_scored_at_every_state(found: Explorations) -> None:
    pairs = set(zip(found.states.tolist(), found.actions[:, 0].tolist(), strict=True))
    assert pairs == {(state, action) for state in range(STATES) for action in range(toy_grid.ACTIONS)}
    assert len(found.scores) == len(pairs)
    assert bool(torch.isfinite(found.scores).all())


def test_worth_executing_is_what_the_world_model_does_not_know(
    found: Explorations, states: Observations, world_model: GridWorldModel
) -> None:
    after = outcomes(found, states)
    works = ~_same(after, {name: stream[found.states] for name, stream in states.items()})
    loss = true_loss(world_model, found, states, after)
    interaction = found.actions[:, 0] >= 3
    best = found.scores.argsort(descending=True)[:80]
    # Movement is all that it has learned. 4 of 7 by chance, .57 +- .06; .88 and more on the processors that were tried.
    assert float(interaction[best].float().mean()) > 0.8
    assert float((interaction & works)[best].float().mean()) > 2 * float((interaction & works).float().mean())
    assert float(loss[best].mean()) > 2 * float(loss.mean())
    assert float(found.scores[interaction & works].median()) > 2 * float(found.scores[~interaction].median())


def test_scores_do_not_depend_on_how_states_are_cut(models: Models, states: Observations, found: Explorations) -> None:
    again = explore(CYCLE, models, states, 1, torch.Generator(), chunk=41)
    assert torch.equal(again.actions, found.actions)
    torch.testing.assert_close(again.scores, found.scores, rtol=1e-3, atol=1e-3)


def test_several_steps_go_on_as_is_inferred_along_a_future(models: Models, states: Observations) -> None:
    some = {name: stream[:20] for name, stream in states.items()}
    left, right = (explore(CYCLE, models, some, 3, torch.Generator().manual_seed(6)) for _ in range(2))
    assert left.actions.shape == (20 * toy_grid.ACTIONS, 3)
    assert left.actions[:, 0].tolist() == list(range(toy_grid.ACTIONS)) * 20
    assert torch.equal(left.actions, right.actions)
    assert torch.equal(left.scores, right.scores)
    assert bool(torch.isfinite(left.scores).all())


@pytest.mark.parametrize("rule", BATCH_RULES)
def test_a_batch_rule_orders_the_best(rule: str, models: Models, states: Observations, found: Explorations) -> None:
    rows = order(BATCH_RULES[rule], models, states, found, 50, torch.Generator().manual_seed(0))
    best = torch.zeros(STATES).scatter_reduce(0, found.states, found.scores, "amax", include_self=False)
    expected = best.sort(descending=True).values[:50]  # one action at a state
    assert len(set(found.states[rows].tolist())) == 50
    torch.testing.assert_close(found.scores[rows].sort(descending=True).values, expected)


def test_a_batch_is_shared_out_among_the_actions(models: Models, states: Observations) -> None:
    """One action is worth more wherever it may be executed; the others weigh a third of it each."""
    every = torch.arange(STATES)
    actions = torch.where(every < 200, TOGGLE, every % TOGGLE).unsqueeze(1)
    found = Explorations(every, actions, torch.where(every < 200, 9.0, 1.0))
    rows = order(BATCH_RULES["top"], models, states, found, STATES, torch.Generator())
    assert sorted(rows.tolist()) == every.tolist()
    assert found.actions[rows[:24], 0].bincount().tolist() == [3, 3, 3, 3, 3, 9]
    alone = Explorations(every, torch.full((STATES, 1), TOGGLE), torch.linspace(0, 1, STATES))
    rule = BATCH_RULES["top"]
    assert order(rule, models, states, alone, 50, torch.Generator()).tolist() == every.flip(0)[:50].tolist()
    assert order(rule, models, states, found.take(every[:0]), 50, torch.Generator()).tolist() == []


def test_an_action_that_is_never_inferred_is_proposed_all_the_same(models: Models, states: Observations) -> None:
    """Its label is what would show the inverse dynamics that it explains something."""
    seeing: Any = CYCLE.verifier(models)
    blind: Any = NeverInfers(seeing, TOGGLE)
    found = explore(CYCLE, replace(models, inverse_dynamics=blind), states, 1, torch.Generator())
    toggles = found.actions[:, 0] == TOGGLE
    works = outcomes(found, states)["grid"].ne(states["grid"][found.states]).flatten(1).any(1)
    movement = found.actions[:, 0] < 3
    assert float(found.scores[toggles & works].median()) > 2 * float(found.scores[movement].median())
    rows = order(BATCH_RULES["signatures"], models, states, found, STATES, torch.Generator())[:100]
    assert 10 < int(toggles[rows].sum()) < 50  # nor is all of a batch spent on it


@pytest.mark.parametrize("steps", [1, 3])
def test_a_prediction_that_is_certain_leaves_no_doubt(steps: int) -> None:
    """However high the floor under what is decoded."""
    world_model = GridWorldModel(toy_grid.SPACES, GridWorldModelConfig(floor=0.3), torch.Generator().manual_seed(0))
    now = {name: stream[:, :1] for name, stream in toy_grid.labeled(9, seed=8).observations.items()}
    state = world_model.infer_state(now)
    least = exploration._least(world_model, state, now, steps)
    still = {name: torch.cat([stream] * steps, 1) for name, stream in now.items()}
    moved = {**still, "carried": still["carried"] + (still["carried"] == 0).to(torch.uint8)}
    prediction = torch.stack([state] * steps, 1)
    torch.testing.assert_close(world_model.distance(prediction, still), least)
    assert bool((world_model.distance(prediction, moved) > least + 1.0).all())


def test_rooms_that_look_the_same_are_one_state(states: Observations) -> None:
    some = {name: stream[:5] for name, stream in states.items()}
    assert distinct(looks(some)).tolist() == [0, 1, 2, 3, 4]
    assert distinct(looks(take(some, torch.tensor([3, 1, 1, 3, 0])))).tolist() == [0, 1, 4]
    assert distinct([]).tolist() == []


def test_what_was_executed_where_it_looks_the_same_is_left_out(found: Explorations, states: Observations) -> None:
    seen = looks(states)
    seen[1] = seen[0]
    left = found.without(seen, {asked(seen[0], [2]), asked(seen[5], [6])})
    gone = {(0, 2), (1, 2), (5, 6)}
    pairs = set(zip(found.states.tolist(), found.actions[:, 0].tolist(), strict=True))
    assert set(zip(left.states.tolist(), left.actions[:, 0].tolist(), strict=True)) == pairs - gone
    assert asked(b"", [[0.5, 1.0]]) == (b"", ((0.5, 1.0),))


def test_without_a_subgoal_generator_nothing_is_explored(models: Models, states: Observations) -> None:
    with pytest.raises(ValueError, match="cycle needs subgoal_generator"):
        explore(CYCLE, replace(models, subgoal_generator=None), states, 1, torch.Generator())


def test_futures_hold_what_is_rare_and_that_nothing_happens(subgoal_generator: GridSubgoalGenerator) -> None:
    batch = toy_grid.labeled(300, seed=12, effective=True)
    futures = subgoal_generator.futures(at(batch.observations, 0), 1, torch.Generator())
    assert set(futures.states.tolist()) == set(range(300))
    after = {name: batch.observations[name][futures.states, 1] for name in batch.observations}
    now = {name: batch.observations[name][futures.states, 0] for name in batch.observations}
    came = _same({name: chain[:, 1] for name, chain in futures.chains.items()}, after)
    still = _same({name: chain[:, 1] for name, chain in futures.chains.items()}, now)
    assert len(set(futures.states[came].tolist())) > 0.6 * 300  # samples of it would mostly be movements
    assert set(futures.states[still].tolist()) == set(range(300))
    unreachable = ~_reachable(futures.chains)
    assert float(unreachable[futures.steady].float().mean()) < float(unreachable[~futures.steady].float().mean())


def _same(left: Observations, right: Observations) -> torch.Tensor:
    return torch.stack([(left[name] == right[name]).flatten(1).all(1) for name in left]).all(0)


def _reachable(chains: Observations) -> torch.Tensor:
    """Whether any action leads there."""
    grid, carried = chains["grid"].numpy(), chains["carried"].numpy()
    outcomes = [
        toy_grid.step(grid[:, 0], carried[:, 0], np.full(len(grid), action)) for action in range(toy_grid.ACTIONS)
    ]
    reached = [(a == grid[:, 1]).all((1, 2, 3)) & (b == carried[:, 1]).all(1) for a, b in outcomes]
    return torch.from_numpy(np.stack(reached).any(0))

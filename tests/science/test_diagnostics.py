"""Diagnostics on toy rooms whose answers are known."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from models.diagnostics import (
    CHUNK,
    BackAction,
    Mask,
    Support,
    diagnose,
)
from models.families import GRID
from models.inverse_dynamics.base import DiscreteInverseDynamics
from models.inverse_dynamics.grid import GridSparseInverseDynamics, SparseInverseDynamicsConfig
from models.network import Network
from models.networks.symmetry import turn
from models.segments import Observations, SegmentBatch
from models.spaces import BoxAction, Spaces
from models.support import nearest, whole_observation
from models.world_models.grid import GridWorldModel
from tests.science import toy_grid


class Sure(GridSparseInverseDynamics):
    """Infers action 0, but action 1 where the upper left cell is no plain wall."""

    def infer(self, observations: Observations) -> Tensor:
        return (observations["grid"][:, :-1, 0, 0, 1] != 0).long()


def sure() -> Sure:
    return Sure(toy_grid.SPACES, SparseInverseDynamicsConfig(), torch.Generator().manual_seed(0))


def repainted(batch: SegmentBatch) -> SegmentBatch:
    """The same segments with all walls of the first row in another colour: nothing that any action touches or does."""
    grid = batch.observations["grid"].clone()
    grid[:, :, 0, :, 1] = 3
    return replace(batch, observations={**batch.observations, "grid": grid})


def moving(batch: SegmentBatch, action: int) -> SegmentBatch:
    """Those that this action alone explains, in the middle of the room: no wall is touched."""
    sets = batch.action_sets
    assert sets is not None
    inner = (batch.observations["grid"][:, 0, 2, 2, 0] == toy_grid.AGENT).nonzero().flatten()
    return batch.take(inner[sets[inner, 0, action] & (sets[inner, 0].sum(1) == 1)])


def test_distance_counts_the_channels_that_differ_in_what_the_action_touches(
    inverse_dynamics: DiscreteInverseDynamics, training_set: SegmentBatch, held_out: SegmentBatch
) -> None:
    model = sure()
    labeled, some = training_set.take(slice(0, CHUNK + 44)), held_out.take(slice(0, 50))
    blocks = [model.verifying_block(batch.observations).view(batch.size, 6, 22) for batch in (labeled, some)]
    channels = (slice(0, 11), slice(11, 17), slice(17, 22))
    codes = [torch.cat([block[:, :, channel].argmax(2) for channel in channels], 1) for block in blocks]
    apart = (codes[1].unsqueeze(1) != codes[0].unsqueeze(0)).sum(2).amin(1)
    assert torch.equal(nearest(model.verifying_block, some, labeled), apart.float())
    assert apart.min() == 0
    assert apart.max() > 0


def test_the_block_and_the_rest_share_nothing(held_out: SegmentBatch) -> None:
    model, before = sure(), moving(held_out, 0)
    after = repainted(before)
    assert torch.equal(model.verifying_block(before.observations), model.verifying_block(after.observations))
    changed = model.rest(before.observations).float() - model.rest(after.observations).float()
    assert changed.square().sum(1).tolist() == [2 * 2 * 5] * before.size  # 5 cells at both times, 2 for each code
    hand = {**before.observations, "carried": before.observations["carried"] + 1}
    assert torch.equal(model.rest(before.observations), model.rest(hand))
    assert not torch.equal(model.verifying_block(before.observations), model.verifying_block(hand))


def test_a_model_that_reads_all_leaves_no_rest_and_has_no_back_action(
    world_model: GridWorldModel, training_set: SegmentBatch, held_out: SegmentBatch
) -> None:
    generator = torch.Generator().manual_seed(0)
    dense = GRID.build_inverse_dynamics(toy_grid.SPACES, "dense", None, generator)
    found = diagnose(world_model, dense, training_set, held_out, held_out, {})
    assert found.back_action is None
    assert found.mask == Mask(26.0, 26)
    sparse = diagnose(world_model, sure(), training_set, held_out, held_out, {})
    assert sparse.mask == Mask(3.0, 26)
    assert sparse.support is not None
    assert found.support is not None
    assert found.support.outside > sparse.support.outside  # a room as a whole is new more often than two of its cells


def test_support_is_left_where_labels_show_only_movement(
    world_model: GridWorldModel, inverse_dynamics: DiscreteInverseDynamics, movement_only: SegmentBatch
) -> None:
    def outside(pool: SegmentBatch) -> float:
        support = diagnose(world_model, inverse_dynamics, movement_only, pool, None, {}).support
        assert support is not None
        return support.outside

    more = toy_grid.labeled(1500, seed=5, effective=True)
    assert more.actions is not None
    interacting = more.take((more.actions[:, 0] > 2).nonzero().flatten())
    moves = more.take((more.actions[:, 0] < 3).nonzero().flatten())
    assert outside(movement_only) == 0
    assert outside(interacting) > 0.9
    assert outside(moves) < 0.3


def test_a_label_shows_its_room_in_every_turn(
    world_model: GridWorldModel, inverse_dynamics: DiscreteInverseDynamics, held_out: SegmentBatch
) -> None:
    """Training turns the rooms, so a pool that is turned is not new."""
    some, quarters = held_out.take(slice(0, 100)), torch.arange(100) % 4
    turned = {**some.observations, "grid": turn(some.observations["grid"], quarters)}
    assert (nearest(sure().verifying_block, replace(some, observations=turned), some) > 0).any()
    support = diagnose(world_model, inverse_dynamics, some, replace(some, observations=turned), None, {}).support
    assert support == Support(0.0, 0.0, 0.0)


def test_a_segment_is_as_far_as_its_farthest_step(
    world_model: GridWorldModel, inverse_dynamics: DiscreteInverseDynamics, movement_only: SegmentBatch
) -> None:
    known, strange = movement_only.take(slice(0, 4)), toy_grid.labeled(40, seed=5, effective=True)
    assert strange.actions is not None
    strange = strange.take((strange.actions[:, 0] == 6).nonzero().flatten()[:2])
    frames = {name: stream.flatten(0, 1) for name, stream in known.observations.items()}
    odd = {name: stream.flatten(0, 1) for name, stream in strange.observations.items()}
    long = {name: torch.cat((frames[name][:2], odd[name][:2])).unsqueeze(0) for name in frames}  # 3 steps
    support = diagnose(world_model, inverse_dynamics, movement_only, SegmentBatch(long), None, {}).support
    assert support is not None
    steps = nearest(sure().verifying_block, SegmentBatch(long), sure().views(movement_only))
    assert steps[0] == 0
    assert (support.outside, support.mean) == (1.0, float(steps.max()))


def test_the_whole_observation_stands_in_for_a_block_that_is_not_named(
    world_model: GridWorldModel, movement_only: SegmentBatch, held_out: SegmentBatch
) -> None:
    describe = whole_observation(movement_only.observations, held_out.observations)
    some = held_out.take(slice(0, 20))
    frames = [torch.cat([s.flatten(1) for s in batch.observations.values()], 1) for batch in (some, movement_only)]
    apart = (frames[0].unsqueeze(1) != frames[1].unsqueeze(0)).sum(2).amin(1)
    assert torch.equal(nearest(describe, some, movement_only), apart.float())
    floats = {"pose": torch.tensor([[[0.0], [1.0]], [[0.0], [3.0]]])}
    assert whole_observation(floats)(floats).tolist() == [[0, 1], [0, 3]]


def test_aliasing_is_the_entropy_of_the_inferred_action(
    world_model: GridWorldModel, inverse_dynamics: DiscreteInverseDynamics, training_set: SegmentBatch
) -> None:
    effects = toy_grid.labeled(600, seed=6, effective=True)
    clear = diagnose(world_model, inverse_dynamics, training_set, effects, None, {}).aliasing
    assert clear is not None
    assert clear.mean < 0.2
    undecided = sure()
    for parameter in undecided.parameters():
        parameter.data.zero_()
    found = diagnose(world_model, undecided, training_set, effects, None, {}).aliasing
    assert found is not None
    assert found.mean == pytest.approx(math.log(7))
    assert found.percentile_95 == pytest.approx(math.log(7))
    assert found.above_ln_2 == 1.0


def test_back_action_is_seen_where_novelty_elsewhere_misleads(
    world_model: GridWorldModel, training_set: SegmentBatch, held_out: SegmentBatch
) -> None:
    plain = moving(held_out, 0)
    half = plain.size // 2
    strange = repainted(plain.take(slice(half, None)))
    mixed = {
        name: torch.cat((stream[:half], strange.observations[name])) for name, stream in plain.observations.items()
    }
    batch = replace(plain, observations=mixed)
    found = diagnose(world_model, sure(), training_set, None, batch, {})
    for back in (found.back_action, found.back_action_in_support):
        assert back is not None
        assert (back.nearest, back.farthest) == (0.0, 1.0)
        assert back.spearman == pytest.approx(0.87, abs=0.1)
    calm = diagnose(world_model, sure(), training_set, None, plain, {})
    assert calm.back_action == BackAction(plain.size, 0.0, 0.0, None)


def test_what_no_label_shows_is_no_back_action_in_support(
    world_model: GridWorldModel, movement_only: SegmentBatch, held_out: SegmentBatch
) -> None:
    """An interaction that no label shows is inferred wrong, and that is not the doing of the rest of the room."""
    found = diagnose(world_model, sure(), movement_only, None, held_out, {})
    inside = nearest(sure().verifying_block, held_out, sure().views(movement_only)) == 0
    assert found.back_action is not None
    assert found.back_action_in_support is not None
    assert found.back_action.steps == held_out.size
    new = (~inside).nonzero().flatten()
    assert 0 < found.back_action_in_support.steps == int(inside.sum()) < held_out.size
    assert diagnose(world_model, sure(), movement_only, None, held_out.take(new), {}).back_action_in_support is None


def test_the_score_ranks_where_the_inverse_model_knows_the_actions(
    world_model: GridWorldModel,
    inverse_dynamics: DiscreteInverseDynamics,
    training_set: SegmentBatch,
    held_out: SegmentBatch,
) -> None:
    found = diagnose(world_model, inverse_dynamics, training_set, None, held_out, toy_grid.GROUPS)
    assert found.ranking is not None
    assert found.ranking.segments == 400
    assert found.ranking.spearman is not None
    assert found.ranking.spearman > 0.9
    assert found.ranking.kendall is not None
    assert 0.8 < found.ranking.kendall <= found.ranking.spearman
    counts = {name: group.segments for name, group in found.ranking_by_group.items()}
    assert held_out.actions is not None
    movements = int((held_out.actions < 3).sum())
    assert counts == {"movement": movements, "interaction": 400 - movements}
    blind = diagnose(world_model, sure(), training_set, None, held_out, {}).ranking
    assert blind is not None
    assert blind.spearman is not None
    assert blind.spearman < found.ranking.spearman - 0.1  # not far: a step without effect is kept, whatever the action


def test_an_action_is_known_by_the_steps_that_it_alone_explains(
    world_model: GridWorldModel, training_set: SegmentBatch, held_out: SegmentBatch
) -> None:
    found = diagnose(world_model, sure(), training_set, None, held_out, {}).actions
    assert len(found) == 7
    for batch, counts in ((training_set, [each.labels for each in found]), (held_out, [e.held_out for e in found])):
        assert batch.actions is not None
        assert batch.action_sets is not None
        alone = batch.actions[batch.action_sets.sum(2) == 1]
        assert counts == torch.bincount(alone, minlength=7).tolist()
    assert [each.accuracy for each in found] == [1.0] + 6 * [0.0]


def test_without_held_out_labels_or_pool_the_rest_is_still_there(
    world_model: GridWorldModel, inverse_dynamics: DiscreteInverseDynamics, training_set: SegmentBatch
) -> None:
    found = diagnose(world_model, inverse_dynamics, training_set, training_set, None, toy_grid.GROUPS)
    assert (found.back_action, found.ranking, found.ranking_by_group) == (None, None, {})
    assert found.sampled == 1500
    assert None not in (found.mask, found.support, found.aliasing)
    assert all(each.labels > 0 and each.accuracy is None for each in found.actions)
    nothing = diagnose(world_model, inverse_dynamics, training_set, None, None, {})
    assert (nothing.sampled, nothing.mask, nothing.support, nothing.aliasing) == (0, None, None, None)


def test_diagnosing_changes_nothing_and_says_that_it_is_at_work(
    world_model: GridWorldModel,
    inverse_dynamics: DiscreteInverseDynamics,
    training_set: SegmentBatch,
    held_out: SegmentBatch,
) -> None:
    models: tuple[Network, ...] = (world_model, inverse_dynamics)
    weights = [{name: tensor.clone() for name, tensor in model.state_dict().items()} for model in models]
    told: list[None] = []
    first_time = diagnose(
        world_model, inverse_dynamics, training_set, training_set, held_out, toy_grid.GROUPS, lambda: told.append(None)
    )
    assert first_time == diagnose(world_model, inverse_dynamics, training_set, training_set, held_out, toy_grid.GROUPS)
    for model, before in zip(models, weights, strict=True):
        assert all(torch.equal(tensor, before[name]) for name, tensor in model.state_dict().items())
    chunks = 1500 // CHUNK + 1
    assert len(told) >= chunks * chunks

    def stop() -> None:
        raise InterruptedError

    with pytest.raises(InterruptedError):
        diagnose(world_model, inverse_dynamics, training_set, training_set, held_out, {}, stop)


def test_what_cannot_be_diagnosed_is_refused(
    world_model: GridWorldModel,
    inverse_dynamics: DiscreteInverseDynamics,
    held_out: SegmentBatch,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with pytest.raises(ValueError, match="carries no actions"):
        diagnose(world_model, inverse_dynamics, held_out.without_labels(), None, None, {})
    broken = torch.full((held_out.size,), 1.0)
    broken[7] = torch.nan
    with monkeypatch.context() as patch:
        patch.setattr("models.diagnostics.nearest_true_actions", lambda _, batch: (None, broken[: batch.size]))
        with pytest.raises(ValueError, match=r"Segment\(trajectory='toy-1', start=7\) has score .* true loss nan"):
            diagnose(world_model, inverse_dynamics, held_out, None, held_out, {})
    model = sure()
    model.spaces = Spaces(toy_grid.SPACES.observations, BoxAction(-1.0, 1.0, (2,)))
    with pytest.raises(ValueError, match="need a discrete action space"):
        diagnose(world_model, model, held_out, None, None, {})

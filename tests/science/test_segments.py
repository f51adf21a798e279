"""Segment batches: shapes are checked, parts keep their order and names."""

import pytest
import torch

from models.segments import Segment, SegmentBatch, concatenate
from tests.science import toy_grid


def test_take_keeps_observations_labels_and_names_together() -> None:
    batch = toy_grid.labeled(10, seed=0)
    part = batch.take(torch.tensor([7, 2]))
    assert part.segments == (Segment("toy-0", 7), Segment("toy-0", 2))
    assert batch.actions is not None
    assert part.actions is not None
    assert part.actions.tolist() == batch.actions[[7, 2]].tolist()
    assert torch.equal(part.observations["carried"][0], batch.observations["carried"][7])


def test_concatenate_undoes_slicing() -> None:
    batch = toy_grid.labeled(10, seed=0)
    joined = concatenate([batch.take(slice(0, 4)), batch.take(slice(4, 10))])
    assert torch.equal(joined.observations["grid"], batch.observations["grid"])
    assert joined.segments == batch.segments


def test_an_action_without_a_set_joins_as_the_set_of_itself() -> None:
    batch = toy_grid.labeled(2, seed=0)
    plain = SegmentBatch(batch.observations, torch.tensor([[3], [6]]))
    joined = concatenate([batch, plain])
    assert joined.action_sets is not None
    assert joined.action_sets[2:, 0].nonzero().tolist() == [[0, 3], [1, 6]]


def test_labels_of_another_length_are_refused() -> None:
    batch = toy_grid.labeled(3, seed=0)
    with pytest.raises(ValueError, match=r"actions must begin with \(segments, steps\) = \(3, 1\), got \(3, 2\)"):
        SegmentBatch(batch.observations, torch.zeros(3, 2, dtype=torch.int64))


def test_transitions_cut_long_segments_into_pairs() -> None:
    frames = torch.arange(6, dtype=torch.uint8).view(2, 3, 1)
    batch = SegmentBatch({"x": frames}, torch.tensor([[1, 2], [3, 4]]), segments=(Segment("a", 0), Segment("b", 5)))
    pairs = batch.transitions()
    assert pairs.observations["x"].flatten(1).tolist() == [[0, 1], [1, 2], [3, 4], [4, 5]]
    assert pairs.actions is not None
    assert pairs.actions.tolist() == [[1], [2], [3], [4]]
    assert pairs.segments == (Segment("a", 0), Segment("a", 1), Segment("b", 5), Segment("b", 6))


def test_windows_are_cut_from_a_start_of_each_segment_s_own() -> None:
    frames = torch.arange(9).expand(40, 9)
    actions = torch.arange(8.0).expand(40, 8).unsqueeze(2)
    batch = SegmentBatch({"x": frames}, actions, segments=tuple(Segment("a", 10 * row) for row in range(40)))
    cut = batch.windows(3, torch.Generator().manual_seed(0))
    starts = cut.observations["x"][:, 0]
    assert set(starts.tolist()) == set(range(6))
    assert torch.equal(cut.observations["x"], starts.unsqueeze(1) + torch.arange(4))
    assert cut.actions is not None
    assert torch.equal(cut.actions.squeeze(2), (starts.unsqueeze(1) + torch.arange(3)).float())
    assert [name.start for name in cut.segments] == [10 * row + int(start) for row, start in enumerate(starts)]
    assert batch.windows(8, torch.Generator()) is batch


def test_windows_of_action_sets_are_refused() -> None:
    frames = {"x": torch.zeros(1, 3, 1)}
    batch = SegmentBatch(frames, torch.zeros(1, 2, dtype=torch.int64), torch.ones(1, 2, 4, dtype=torch.bool))
    with pytest.raises(ValueError, match="the batch carries action sets"):
        batch.windows(1, torch.Generator())

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

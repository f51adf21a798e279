"""Open-loop errors by hand."""

import pytest
import torch
from torch import Tensor

from models.open_loop import OpenLoopError, open_loop, open_loop_errors
from models.segments import SegmentBatch
from tests.science import toy_robot


def _batch(stream: str, values: Tensor) -> SegmentBatch:
    return SegmentBatch({stream: values}, torch.zeros(len(values), values.shape[1] - 1, 2))


def test_numbers_count_in_their_units() -> None:
    model = toy_robot.Standstill(toy_robot.POINT, toy_robot.TINY, torch.Generator())
    path = torch.tensor([[[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]], [[0.0, 0.0], [0.0, 0.0], [0.0, 4.0]]])
    errors = open_loop_errors(model, _batch("position", path), horizons=(1, 2), chunk=1)
    assert errors[1]["position"] == pytest.approx((1 / 2 + 0) / 2)  # two coordinates, two segments
    assert errors[2]["position"] == pytest.approx(((1 / 2 + 0) + (4 / 2 + 16 / 2)) / 4)


def test_pixels_count_as_shares_of_white() -> None:
    model = toy_robot.Standstill(toy_robot.PICTURE, toy_robot.TINY, torch.Generator())
    film = torch.zeros(1, 2, 16, 16, 3, dtype=torch.uint8)
    film[0, 1, :8] = 255
    assert open_loop_errors(model, _batch("camera", film), horizons=(1,))[1]["camera"] == pytest.approx(0.5)


def test_what_is_not_foreseen_is_a_share_of_what_changes() -> None:
    model = toy_robot.Standstill(toy_robot.POINT, toy_robot.TINY, torch.Generator())
    batch = toy_robot.points(20, 40, seed=0)
    found = open_loop(model, batch)
    assert [each.horizon for each in found] == [8, 32, 40]
    for each in found:
        assert each.errors["position"] == pytest.approx(each.standing_still["position"], rel=1e-5)
        assert each.unforeseen == pytest.approx(1.0, rel=1e-5)
    assert [each.horizon for each in open_loop(model, toy_robot.points(2, 8, seed=0))] == [8]


def test_the_share_is_a_mean_over_the_streams_that_change() -> None:
    error = OpenLoopError(8, {"arm": 1.0, "table": 0.5, "camera": 3.0}, {"arm": 4.0, "table": 0.0, "camera": 4.0})
    assert error.unforeseen == pytest.approx((0.25 + 0.75) / 2)
    assert OpenLoopError(8, {"table": 0.5}, {"table": 0.0}).unforeseen is None


def test_segments_shorter_than_the_horizon_are_refused() -> None:
    model = toy_robot.Standstill(toy_robot.POINT, toy_robot.TINY, torch.Generator())
    with pytest.raises(ValueError, match="Segments of 4 steps are too short for a horizon of 32"):
        open_loop_errors(model, toy_robot.points(2, 4, seed=0))
    with pytest.raises(ValueError, match="no actions"):
        open_loop_errors(model, toy_robot.points(2, 4, seed=0).without_labels())
    with pytest.raises(ValueError, match="no segment"):
        open_loop_errors(model, toy_robot.points(2, 40, seed=0).take(slice(0, 0)))

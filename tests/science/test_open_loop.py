"""Open-loop errors by hand."""

import pytest
import torch
from torch import Tensor

from models.open_loop import open_loop_errors
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


def test_segments_shorter_than_the_horizon_are_refused() -> None:
    model = toy_robot.Standstill(toy_robot.POINT, toy_robot.TINY, torch.Generator())
    with pytest.raises(ValueError, match="Segments of 4 steps are too short for a horizon of 32"):
        open_loop_errors(model, toy_robot.points(2, 4, seed=0))
    with pytest.raises(ValueError, match="no actions"):
        open_loop_errors(model, toy_robot.points(2, 4, seed=0).without_labels())
    with pytest.raises(ValueError, match="no segment"):
        open_loop_errors(model, toy_robot.points(2, 40, seed=0).take(slice(0, 0)))

"""Pictures of predictions: what is outlined is what is wrong, and any code can be drawn."""

from itertools import product
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from benchmarks.paper.minigrid.datasets import TUNING
from benchmarks.paper.minigrid.drawing import WRONG, draw_observation
from benchmarks.paper.minigrid.predictions import draw_predictions, examples_of
from models.segments import SegmentBatch, at
from tests.benchmarks.transitions import transitions
from workers.simulators.minigrid import CHANNEL_SIZES


@pytest.fixture(scope="module")
def shown() -> SegmentBatch:
    """One step of each action, twice."""
    return examples_of(transitions("balanced", 600, TUNING + 700_000), 2)


def test_examples_go_through_the_actions_one_by_one(shown: SegmentBatch) -> None:
    assert shown.actions is not None
    assert shown.actions[:, 0].tolist() == [*range(7)] * 2


def test_too_few_transitions_of_an_action_are_told(shown: SegmentBatch) -> None:
    assert shown.actions is not None
    with pytest.raises(ValueError, match=r"fewer than 1 transitions of swap"):
        examples_of(shown.take(torch.nonzero(shown.actions[:, 0] < 6).flatten()), 1)


def test_the_wrong_elements_are_outlined_and_no_others(shown: SegmentBatch) -> None:
    before, after = at(shown.observations, 0), at(shown.observations, 1)
    for row in range(7):
        truth = (after["grid"][row].numpy(), after["carried"][row].numpy())
        axes = Figure().subplots()
        wrong = draw_observation(axes, before["grid"][row].numpy(), before["carried"][row].numpy(), truth)
        changed = int((before["grid"][row] != after["grid"][row]).any(-1).sum())
        changed += int((before["carried"][row] != after["carried"][row]).any())
        outlines = [patch for patch in axes.patches if isinstance(patch, Rectangle) and _is_outline(patch)]
        assert wrong == len(outlines) == changed
        cells = {(int(box.get_y()), int(box.get_x())) for box in outlines} - {(0, 0)}
        assert cells == {
            tuple(place) for place in np.argwhere((before["grid"][row] != after["grid"][row]).any(-1).numpy())
        }


def test_the_truth_has_no_outline(shown: SegmentBatch) -> None:
    grid, carried = (at(shown.observations, 0)[name][0].numpy() for name in ("grid", "carried"))
    assert draw_observation(Figure().subplots(), grid, carried, (grid, carried)) == 0


def test_every_code_can_be_drawn(tmp_path: Path) -> None:
    """A world model may predict what no room has."""
    codes = np.array(list(product(*map(range, CHANNEL_SIZES))), np.uint8)
    grid = np.resize(codes, (19, 19, 3))
    figure = Figure()
    draw_observation(figure.subplots(), grid, codes[-1])
    figure.savefig(tmp_path / "codes.png", dpi=20)


def test_a_picture_has_a_row_a_model_and_tells_what_is_wrong(shown: SegmentBatch, tmp_path: Path) -> None:
    first = shown.take(slice(0, 2))
    truth, before = at(first.observations, 1), at(first.observations, 0)
    guesses = {"knows, 500 labels": truth, "stands still, 500 labels": before}
    assert draw_predictions(first, guesses, tmp_path / "9.png") == 2  # a turn is one cell
    assert (tmp_path / "9.png").read_bytes().startswith(b"\x89PNG")


def _is_outline(box: Rectangle) -> bool:
    return bool(box.get_edgecolor() == to_rgba(WRONG)) and not box.get_fill()

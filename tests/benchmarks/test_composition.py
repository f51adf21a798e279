"""The compositional split, held against the table as it is printed in its documentation, on steps of the simulator."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.paper.minigrid import composition
from benchmarks.paper.minigrid.datasets import TUNING
from models.segments import SegmentBatch
from workers.episodes import new_episodes
from workers.simulators.catalog import make_behavior, make_simulator
from workers.simulators.minigrid import ACTION_NAMES, BALL, BLUE, BOX, KEY, RED

SEED = TUNING + 600_000
COLUMNS = ((KEY, RED), (KEY, BLUE), (BALL, RED), (BALL, BLUE))
ROWS = {"pickup": "pickup", "drop": "drop", "toggle": "toggle", "swap": "swap for box"}
Elements = NDArray[np.uint8]


def printed_table() -> dict[tuple[str, int, int], str]:
    """By (action, object, colour), from the module's own words."""
    table = dict[tuple[str, int, int], str]()
    for action, title in ROWS.items():
        line = next(line for line in (composition.__doc__ or "").splitlines() if line.strip().startswith(title))
        words = line.replace(title, "").replace("held out", "held_out").split()
        table |= {(action, *thing): word for thing, word in zip(COLUMNS, words, strict=True)}
    return table


def expected(action: str, before: dict[str, Elements], after: dict[str, Elements]) -> str:
    """By what a step did to hand and cells, not by where the agent looks."""
    hands = [before["carried"], after["carried"]]
    cells = np.argwhere((before["grid"] != after["grid"]).any(-1))
    if (action in ("left", "right", "forward")) or (not len(cells) and (hands[0] == hands[1]).all()):
        return "neutral"
    (row, column), *others = cells.tolist()
    assert not others, "an interaction changes one cell"
    about = {
        "pickup": [hands[1]],
        "drop": [hands[0]],
        "toggle": [before["grid"][row, column]],
        "swap": hands,
    }[action]
    things = [tuple(thing[:2].tolist()) for thing in about if thing[0] != BOX]
    if len(things) != 1:
        return "absent" if things or action == "toggle" else "neutral"
    return printed_table()[(action, *things[0])]


def steps_of(batch: SegmentBatch) -> Counter[tuple[str, str]]:
    """How many steps of each action stand where in the table."""
    assert batch.actions is not None
    counts = Counter[tuple[str, str]]()
    for row, action in enumerate(batch.actions[:, 0].tolist()):
        frames = [
            {name: stream[row, frame].numpy() for name, stream in batch.observations.items()} for frame in range(2)
        ]
        counts[ACTION_NAMES[action], expected(ACTION_NAMES[action], *frames)] += 1
    return counts


def test_the_table_holds_what_its_documentation_prints() -> None:
    printed = {key: word for key, word in printed_table().items() if word != "absent"}
    assert {(ACTION_NAMES[action], *thing): where for (action, *thing), where in composition.TABLE.items()} == printed


def test_every_cell_of_the_table_is_told_of_real_steps() -> None:
    simulator = make_simulator("minigrid", {})
    seen = Counter[tuple[str, str]]()
    for episode in new_episodes(simulator, make_behavior("balanced", simulator), 8000, SEED):
        for start, action in enumerate(episode.actions):
            frames = [
                {name: stream[start + frame] for name, stream in episode.observations.items()} for frame in (0, 1)
            ]
            where = expected(ACTION_NAMES[action], *frames)
            assert composition.coverage_of(episode, start) == where
            seen[ACTION_NAMES[action], where] += 1
    wanted = {(action, where) for (action, *_), where in printed_table().items()}
    assert wanted | {("pickup", "neutral"), ("swap", "neutral"), ("forward", "neutral")} <= set(seen)


def test_balanced_labels_hold_as_many_of_each_action_and_no_pair_that_is_held_out_or_absent(tmp_path: Path) -> None:
    labels = composition.training_set(SEED, 72, "balanced", tmp_path)
    counts = steps_of(labels)
    assert {where for _, where in counts} == {"seen", "neutral"}
    by_action = Counter[str]()
    for (action, _), count in counts.items():
        by_action[action] += count
    assert [by_action[name] for name in ACTION_NAMES] == [11, 11, 10, 10, 10, 10, 10]


def test_uniform_labels_hold_no_pair_that_is_held_out_or_absent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(composition, "POOL", 2500)
    counts = steps_of(composition.training_set(SEED, 1500, "uniform", tmp_path))
    assert {where for _, where in counts} == {"seen", "neutral"}
    assert sum(counts.values()) == 1500


def test_a_smaller_set_is_part_of_a_larger_one(tmp_path: Path) -> None:
    small, large = (composition.training_set(SEED, labels, "balanced", tmp_path) for labels in (21, 42))
    rows = [{grid.numpy().tobytes() for grid in batch.observations["grid"]} for batch in (small, large)]
    assert rows[0] <= rows[1]


def test_the_test_holds_interactions_that_are_held_out_and_no_others(tmp_path: Path) -> None:
    counts = steps_of(composition.test_set(SEED, 6, tmp_path))
    movement = {(name, "neutral"): 6 for name in ("left", "right", "forward")}
    assert counts == movement | {(name, "held_out"): 6 for name in ROWS}

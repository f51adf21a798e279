"""World model against the simulator under inferred actions: what a known inference must lead to."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from benchmarks.paper.minigrid import foreign, prediction_data
from benchmarks.paper.minigrid.datasets import ACTIONS, TUNING, grid_spaces
from benchmarks.paper.minigrid.prediction import POINTS, Point, main, runs_of
from benchmarks.paper.minigrid.prediction_accuracy import FRESH, with_simulator, without_simulator
from benchmarks.paper.minigrid.prediction_data import Room, labels_of_each
from benchmarks.paper.minigrid.prediction_table import figures_of, print_file_table
from benchmarks.paper.runs import Json, do
from models.families import GRID, GridFamily
from models.segments import Observations, SegmentBatch
from models.training import TrainingConfig, train
from models.world_models.base import WorldModel
from tests.benchmarks.transitions import transitions
from workers.simulators.base import State
from workers.simulators.minigrid import LEFT

GROUPS = ("overall", "movement", "interaction")
NOISY = Room(noisy_tiles=4)


@dataclass(frozen=True)
class Told:
    """Inverse dynamics that infers what it is told to, whatever it sees."""

    actions: Tensor

    def infer(self, observations: Observations) -> Tensor:
        """(B, 1)."""
        return self.actions


@pytest.fixture(scope="module", autouse=True)
def _one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of the sets."""
    return tmp_path_factory.mktemp("data")


@pytest.fixture
def _small_pool(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(prediction_data, "EACH", 40)


@pytest.fixture(scope="module")
def noisy(folder: Path) -> tuple[SegmentBatch, list[State]]:
    """Effective steps of rooms with four noisy tiles."""
    return NOISY.test(12, TUNING, folder)


@pytest.fixture(scope="module")
def world_model(noisy: tuple[SegmentBatch, list[State]]) -> WorldModel:
    """Knows a little."""
    generator = torch.Generator().manual_seed(0)
    model = GRID.build_world_model(grid_spaces(6), None, generator)
    train(model, noisy[0], TrainingConfig(60, 32, 1e-2, 0.5), generator)
    return model


@pytest.fixture(scope="module")
def told(world_model: WorldModel, noisy: tuple[SegmentBatch, list[State]]) -> Json:
    """Of an inverse dynamics that is always right, and of one that always says left."""
    test, states = noisy
    assert test.actions is not None
    inverses = {"right": Told(test.actions), "left": Told(torch.full_like(test.actions, LEFT))}
    return with_simulator(world_model, inverses, NOISY, test, states)


def test_the_right_action_leads_to_what_was_observed_flicker_and_all(told: Json) -> None:
    assert told["all"]["right"] == dict.fromkeys(GROUPS, 1.0)
    assert told["masked"]["right"] == dict.fromkeys(GROUPS, 1.0)


def test_another_chance_costs_the_tiles_alone(told: Json) -> None:
    assert all(told["all"]["right" + FRESH][group] < 1.0 for group in GROUPS)
    assert told["masked"]["right" + FRESH] == dict.fromkeys(GROUPS, 1.0)


def test_a_wrong_action_leads_elsewhere(told: Json) -> None:
    assert told["masked"]["left"]["interaction"] == 0.0
    assert 0.0 < told["masked"]["left"]["movement"] < 1.0  # a third of the movements are turns to the left
    assert told["inferred"]["left"]["overall"] == pytest.approx(1 / ACTIONS)


def test_the_world_model_is_held_against_the_same_elements(told: Json) -> None:
    assert 0.0 < told["masked"]["world_model"]["overall"] < 1.0
    assert set(told["all"]) == set(told["masked"]) == {"world_model", "right", "left", "right" + FRESH, "left" + FRESH}


def test_a_file_of_the_same_steps_gives_the_same_numbers(
    world_model: WorldModel, noisy: tuple[SegmentBatch, list[State]], tmp_path: Path
) -> None:
    full = (noisy[0].observations["carried"][..., 2] > 0).any(1)
    test = noisy[0].take(torch.nonzero(~full).flatten())
    foreign.write(test, tmp_path / "file.npz")
    inverses = {"sparse": GRID.build_inverse_dynamics(grid_spaces(6), "sparse", None, torch.Generator())}
    ours = without_simulator(world_model, inverses, test)
    assert without_simulator(world_model, inverses, foreign.read(tmp_path / "file.npz")) == ours
    assert 0.0 < ours["inferred"]["sparse"]["overall"] < 1.0


@pytest.fixture
def done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, _small_pool: None) -> Callable[[Path | None], list[str]]:
    """Options of a 4b of one point, whose run is finished: barely trained, in this process."""
    monkeypatch.setitem(POINTS, "4b", [Point(70, 70, Room(), Room())])
    monkeypatch.setattr(GridFamily, "training_config", lambda *_: TrainingConfig(20, 32, 1e-2, 0.5))

    def finish(test_set: Path | None) -> list[str]:
        (run,) = runs_of(("4b",), ("balanced",), 1, tmp_path / "data", True, test_set)
        do(replace(run, per_action=10), tmp_path)
        options = ["--figures", "4b", "--draws", "balanced", "--seeds", "1", "--tuning", "--out", str(tmp_path)]
        return options if test_set is None else [*options, "--test-set", str(test_set)]

    return finish


def test_the_figure_is_printed_drawn_and_held_against_its_target(
    done: Callable[[Path | None], list[str]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert [(figure.name, figure.target) for figure in main(done(None))] == [
        ("4b_world_model_70", None),
        ("4b_sparse_70", 0.97),
        ("4b_dense_70", None),
    ]
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(" | ")[:4] for line in lines[2:]] == [
        ["70", "balanced", "1", predictor] for predictor in ("world_model", "sparse", "dense")
    ]
    assert {path.name for path in tmp_path.glob("*.png")} == {"4b-overall.png", "4b-interaction.png"}


def test_a_files_rooms_take_the_place_of_the_test(
    done: Callable[[Path | None], list[str]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    foreign.write(transitions("random", 60, TUNING + 800_000), tmp_path / "theirs.npz")
    assert main(done(tmp_path / "theirs.npz")) == []
    lines = capsys.readouterr().out.splitlines()
    assert "no inferred action is executed" in lines[0]
    assert [line.split(" | ")[:5] for line in lines[2:]] == [
        ["6-3-0", "balanced", "70", "1", what] for what in ("world_model", "actions, sparse", "actions, dense")
    ]


@pytest.mark.usefixtures("_small_pool")
def test_labels_of_one_seed_are_nested_and_those_of_another_differ(folder: Path) -> None:
    small, large, other = (
        {
            grid.numpy().tobytes()
            for grid in Room().labeled("balanced", labels, seed, TUNING, folder).observations["grid"]
        }
        for labels, seed in ((70, 0), (140, 0), (70, 1))
    )
    assert small <= large
    assert small != other


@pytest.mark.usefixtures("_small_pool")
def test_balanced_labels_are_effective_and_as_many_of_each_action(folder: Path) -> None:
    batch = Room().labeled("balanced", 72, 0, TUNING, folder)
    assert batch.actions is not None
    assert batch.action_sets is not None
    assert bool((batch.action_sets.sum(-1) == 1).all())
    assert batch.actions[:, 0].bincount().tolist() == labels_of_each(72) == [11, 11, 10, 10, 10, 10, 10]


@pytest.mark.usefixtures("_small_pool")
def test_more_labels_than_there_are_are_refused(folder: Path) -> None:
    with pytest.raises(ValueError, match="labels must be at most 280 where they are drawn balanced, got 281"):
        Room().labeled("balanced", 281, 0, TUNING, folder)


def test_points_of_the_same_labels_are_one_run(folder: Path) -> None:
    runs = runs_of(("4b", "4c", "noise"), ("balanced",), 2, folder)
    assert len({run.name for run in runs}) == len(runs) == 2 * (5 + 1 + 4)
    (objects,) = [run for run in runs if run.trained.size == 8 and run.seed == 0]
    assert [room.objects for room in objects.tested] == [6, 8, 10, 12, 14]


def test_the_target_is_on_the_sparse_form_and_of_noise_on_the_masked_figure() -> None:
    found = [_result(point.trained.name, point.tested.name, all_=0.5, masked=0.98) for point in POINTS["noise"]]
    told = {figure.name: figure for figure in figures_of(["noise"], found)}
    assert all(told[f"noise_sparse_{tiles}"].met for tiles in range(5))
    assert told["noise_sparse_3"].value == pytest.approx(0.98)
    missed = figures_of(["noise"], [_result(p.trained.name, p.tested.name, 0.99, 0.96) for p in POINTS["noise"]])
    assert [figure.met for figure in missed if "sparse" in figure.name] == [False] * 5


def test_of_a_file_it_is_said_that_nothing_was_executed(capsys: pytest.CaptureFixture[str]) -> None:
    accuracies = {"overall": 0.5, "movement": 0.25, "interaction": None}
    inferred = {form: {"overall": 0.75} for form in ("sparse", "dense")}
    test = {"all": {"world_model": accuracies}, "inferred": inferred}
    print_file_table([{"trained": "6-3-0", "draw": "balanced", "labels": 400, "tests": {"f": test}}], "f")
    said = capsys.readouterr().out
    assert "no inferred action is executed" in said
    assert "world_model | 0.5 ± inf | 0.25 ± inf | \n" in said


def _result(trained: str, tested: str, all_: float, masked: float) -> Json:
    """Sparse as given, the others worse."""
    tests: Json = {}
    for counted, value in (("all", all_), ("masked", masked)):
        values = {"sparse": value, "dense": value / 2, "world_model": value / 3}
        tests[counted] = {name: dict.fromkeys(GROUPS, each) for name, each in values.items()}
    return {"draw": "balanced", "labels": 2000, "trained": trained, "tests": {tested: tests}}

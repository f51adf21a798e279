"""Learning curves as a figure and as a table."""

import struct
from datetime import UTC, datetime
from pathlib import Path
from uuid import uuid4

from rich.console import Console

from api_schemas.rounds import GroupError, ModelError, ModelErrorCurve, ModelErrorPoint, OpenLoopError, Round
from asim.figure import draw_learning_curves
from asim.tables import error_table, warning_lines


def curve(losses: dict[int, float | None]) -> ModelErrorCurve:
    points = [
        ModelErrorPoint(
            round=uuid4(),
            number=number,
            labels=labels,
            created_at=datetime(2026, 1, 1, tzinfo=UTC),
            model_error=ModelError(
                transitions=10,
                loss=loss,
                dynamics_accuracy=None if loss is None else 1 - loss,
                inverse_accuracy=None,
                by_group={
                    "movement": GroupError(transitions=5, loss=loss, dynamics_accuracy=0.9, inverse_accuracy=None),
                    "interaction": GroupError(transitions=0, loss=None, dynamics_accuracy=None, inverse_accuracy=None),
                },
            ),
        )
        for number, (labels, loss) in enumerate(losses.items(), 1)
    ]
    return ModelErrorCurve(project=uuid4(), points=points)


def robots(losses: dict[int, float]) -> ModelErrorCurve:
    """A curve of errors of which each is that share of what standing still errs by."""
    still = {"front": 0.02, "proprioception": 0.001}
    points = [
        point.model_copy(
            update={
                "model_error": ModelError(
                    transitions=10,
                    loss=losses[point.labels],
                    dynamics_accuracy=0.5,
                    inverse_accuracy=0.5,
                    open_loop=[
                        OpenLoopError(
                            horizon=horizon,
                            errors={name: losses[point.labels] * each for name, each in still.items()},
                            standing_still=still,
                        )
                        for horizon in (8, 16)
                    ],
                )
            }
        )
        for point in curve(dict.fromkeys(losses)).points
    ]
    return ModelErrorCurve(project=uuid4(), points=points)


def table_lines(curves: dict[str, ModelErrorCurve]) -> list[list[str]]:
    """The words of each line that a terminal of 160 columns shows."""
    console = Console(width=160, record=True)
    with console.capture() as captured:
        console.print(error_table(curves))
    return [line.split() for line in captured.get().splitlines() if line.strip()]


def test_the_figure_is_a_png_of_readable_size(tmp_path: Path) -> None:
    path = tmp_path / "results" / "curves.png"
    draw_learning_curves({"cycle": curve({200: 0.5, 300: 0.25}), "random": curve({200: 0.5, 300: None})}, path)
    content = path.read_bytes()
    assert content.startswith(b"\x89PNG")
    width, height = struct.unpack(">II", content[16:24])
    assert width > 1000
    assert height > 400


def test_the_figure_of_a_project_without_rounds_is_empty_and_no_error(tmp_path: Path) -> None:
    draw_learning_curves({"new": curve({})}, tmp_path / "empty.png")
    assert (tmp_path / "empty.png").stat().st_size > 0


def test_the_table_shows_each_round_and_marks_unknown_numbers() -> None:
    console = Console(width=120, record=True, quiet=True)
    console.quiet = False
    with console.capture() as captured:
        console.print(error_table({"cycle": curve({200: 0.5, 300: 0.25})}, first_column="strategy"))
    lines = [line.split() for line in captured.get().splitlines() if line.strip()]
    assert lines[0] == ["strategy", "labels", "test", "loss", "Dynamics", "Accuracy", "movement", "interaction"]
    assert lines[1:] == [
        ["cycle", "200", "0.5000", "50.0%", "90.0%", "-"],
        ["cycle", "300", "0.2500", "75.0%", "90.0%", "-"],
    ]


def test_the_table_of_robots_says_what_is_not_foreseen_and_the_errors_at_the_end_of_segments() -> None:
    head, *rows = table_lines({"lift": robots({150: 0.75, 220: 0.5})})
    assert " ".join(head) == ("project labels not foreseen Dynamics Accuracy front, 16 steps proprioception, 16 steps")
    assert rows[:2] == [
        ["lift", "150", "75.0%", "50.0%", "0.0150", "/", "0.0200", "0.0008", "/", "0.0010"],
        ["lift", "220", "50.0%", "50.0%", "0.0100", "/", "0.0200", "0.0005", "/", "0.0010"],
    ]
    assert "that nothing moves" in " ".join(word for row in rows[2:] for word in row)


def test_nats_and_shares_have_columns_of_their_own() -> None:
    head, grid, robot, *_ = table_lines({"rooms": curve({200: 0.5}), "lift": robots({150: 0.75})})
    assert head[:6] == ["project", "labels", "test", "loss", "not", "foreseen"]
    assert grid[:4] == ["rooms", "200", "0.5000", "-"]
    assert robot[:4] == ["lift", "150", "-", "75.0%"]


def test_the_figure_of_robots_has_a_chart_for_each_stream(tmp_path: Path) -> None:
    path = tmp_path / "robots.png"
    draw_learning_curves({"cycle": robots({150: 0.75, 220: 0.5})}, path)
    robot_width, _ = struct.unpack(">II", path.read_bytes()[16:24])
    draw_learning_curves({"cycle": curve({150: 0.75, 220: 0.5})}, path)
    grid_width, _ = struct.unpack(">II", path.read_bytes()[16:24])
    assert robot_width / grid_width == 3 / 2  # what is not foreseen and two streams; loss and accuracy


def warned(*warnings: str) -> Round:
    """A second round whose diagnostics say only this."""
    parts = dict.fromkeys(("mask", "support", "aliasing", "back_action", "back_action_in_support", "ranking"))
    fields = dict.fromkeys(("model_error", "job", "error", "finished_at"))
    ids = {"id": uuid4(), "project": uuid4(), "number": 2, "watermark": 9, "labels": 9, "stages": [], "models": {}}
    diagnostics = {**parts, "sampled": 0, "actions": [], "warnings": list(warnings)}
    moment = {"status": "current", "created_at": datetime(2026, 1, 1, tzinfo=UTC)}
    return Round.model_validate({**fields, **ids, **moment, "diagnostics": diagnostics})


def test_warnings_are_lines_that_name_project_and_round_and_cannot_command_a_terminal() -> None:
    shown = warned("The score does not rank.", "The inverse model knows too little of \x1b[2Jswap.")
    assert warning_lines("kitchen", shown) == [
        "kitchen, round 2: The score does not rank.",
        "kitchen, round 2: The inverse model knows too little of \\u001b[2Jswap.",
    ]
    assert warning_lines("kitchen", warned()) == []
    assert warning_lines("kitchen", shown.model_copy(update={"diagnostics": None})) == []

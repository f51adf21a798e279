"""The demo, with a small plan: both arms end with a learning curve from the same start."""

import json
from pathlib import Path

import pytest

from asim.demo import demo
from asim.demo_plans import DemoPlan
from asim.errors import AsimError

SMALL = DemoPlan(
    pool_transitions=2000,
    test_transitions=20_000,
    test_labels_per_action=10,
    seed_labels=40,
    batch_labels=20,
    batches=1,
)


@pytest.mark.slow
def test_the_demo_compares_two_arms_that_start_alike(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    demo(seed=3, keep=tmp_path / "data", plan=SMALL)
    curves = json.loads((tmp_path / "results" / "demo-seed-3.json").read_text())
    labels = {arm: [point["labels"] for point in curve["points"]] for arm, curve in curves.items()}
    assert labels == {"confident_cycle": [40, 60], "random": [40, 60]}
    first = [curve["points"][0]["model_error"]["loss"] for curve in curves.values()]
    assert first[0] == first[1]
    assert (tmp_path / "results" / "demo-seed-3.png").read_bytes().startswith(b"\x89PNG")
    printed = capsys.readouterr().out
    assert "at 60 labels, confident_cycle's test loss" in printed
    assert "the demo took" in printed
    assert not (tmp_path / "data" / "serve.json").exists()


def test_the_demo_does_not_start_in_a_folder_with_something_in_it(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(AsimError, match="is not empty; the demo starts from nothing"):
        demo(seed=0, keep=tmp_path)

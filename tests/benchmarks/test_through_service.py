"""The loop offline and through a running service: one seed, the same picks and errors."""

from pathlib import Path

import pytest
import torch

from benchmarks.paper.minigrid import through_service
from benchmarks.paper.minigrid.loop import Plan
from benchmarks.paper.minigrid.rooms import Rooms
from tests.figures import Figures


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("arm", [("confident_cycle", "signatures"), ("progress", "k_center"), ("uncertainty", "top")])
def test_a_project_picks_what_the_loop_picks(
    arm: tuple[str, str], small_rooms: Rooms, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, figures: Figures
) -> None:
    monkeypatch.setattr(through_service, "Plan", lambda: Plan(40, 20, 2))
    monkeypatch.setattr(through_service, "Rooms", lambda *_, **__: small_rooms)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")  # which main sets for the service's processes
    threads = torch.get_num_threads()
    strategy, rule = arm
    try:
        told = through_service.main(["--strategy", strategy, "--rule", rule, "--out", str(tmp_path), "--tuning"])
    finally:
        torch.set_num_threads(threads)
    for each in told:
        figures.add(f"{strategy}:{rule} {each.name}", each.value, each.unit, each.target, each.better)
    assert told[0].value == 40

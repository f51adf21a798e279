"""Supervised processes start again when they die, ever more slowly, and all end together."""

import os
import sys
import time
from pathlib import Path

from asim.supervision import STEADY_SECONDS, Supervised, Supervisor


def supervised(program: str) -> Supervised:
    return Supervised("toy", [sys.executable, "-c", program], dict(os.environ))


def silent(line: str) -> None:
    """Tells nobody."""


def wait_until(path: Path) -> str:
    deadline = time.monotonic() + 20
    while not (path.exists() and path.read_text()):
        assert time.monotonic() < deadline, f"{path} was never written"
        time.sleep(0.01)
    return path.read_text()


def await_death(toy: Supervised) -> None:
    assert toy.process is not None
    toy.process.wait()


def test_a_process_that_dies_starts_again_at_doubling_pauses() -> None:
    toy, told = supervised("raise SystemExit(3)"), list[str]()
    now, pauses = 0.0, list[float]()
    for _ in range(8):
        toy.watch(now, told.append)  # starts
        await_death(toy)
        toy.watch(now, told.append)  # notes the death
        pauses.append(toy.next_start - now)
        toy.watch(toy.next_start - 0.01, told.append)
        assert toy.process is None  # not a moment too early
        now = toy.next_start
    assert [round(pause, 6) for pause in pauses] == [0.2, 0.4, 0.8, 1.6, 3.2, 6.4, 10.0, 10.0]
    assert told[0] == "toy ended with status 3; it starts again in 0.2 s"


def test_a_process_that_ran_steadily_starts_again_soon() -> None:
    toy = supervised("pass")
    toy.deaths = 6
    toy.watch(0.0, silent)
    await_death(toy)
    toy.watch(STEADY_SECONDS, silent)
    assert toy.next_start == STEADY_SECONDS + 0.2


def test_a_killed_process_comes_back_by_itself(tmp_path: Path) -> None:
    file = tmp_path / "pid"
    program = f"import os, pathlib, time; pathlib.Path({str(file)!r}).write_text(str(os.getpid())); time.sleep(60)"
    supervisor = Supervisor([supervised(program)], tell=silent)
    supervisor.start()
    try:
        first = wait_until(file)
        file.unlink()
        os.kill(int(first), 9)
        assert wait_until(file) != first
    finally:
        supervisor.stop()


def test_stop_ends_the_willing_and_kills_the_others(tmp_path: Path) -> None:
    ready = tmp_path / "ready"
    stubborn = supervised(
        "import pathlib, signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); "
        f"pathlib.Path({str(ready)!r}).write_text('ready'); time.sleep(60)"
    )
    willing = supervised("import time; time.sleep(60)")
    supervisor = Supervisor([stubborn, willing], tell=silent)
    supervisor.start()
    wait_until(ready)
    supervisor.stop(grace=0.5)
    assert stubborn.process is not None
    assert willing.process is not None
    assert stubborn.process.returncode == -9
    assert willing.process.returncode == -15

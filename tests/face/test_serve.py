"""asim serve: what it refuses, how it ends, and what comes back."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from asim.client import Client
from asim.errors import AsimError
from asim.runners import COLLECTOR_QUEUES, SCIENCE_QUEUES, runner_environment, runner_processes
from asim.served import served
from service.settings import Settings


def asim(*arguments: str) -> "subprocess.CompletedProcess[str]":
    argv = [sys.executable, "-m", "asim", *arguments]
    return subprocess.run(argv, capture_output=True, text=True, timeout=60, check=False)


def refusal(*arguments: str) -> str:
    """What a command that must fail says: one line, no traceback."""
    done = asim(*arguments)
    assert done.returncode == 1, done.stderr
    assert done.stderr.count("\n") == 1, done.stderr
    return done.stderr


def eventually(holds: Callable[[], bool], seconds: float = 20.0) -> bool:
    deadline = time.monotonic() + seconds
    while not holds() and time.monotonic() < deadline:
        time.sleep(0.05)
    return holds()


def children(pid: int) -> set[int]:
    """Process ids; a child belongs to the thread that started it."""
    threads = Path(f"/proc/{pid}/task").iterdir()
    return {int(child) for thread in threads for child in (thread / "children").read_text().split()}


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def pid_of(folder: Path) -> int:
    return int(json.loads((folder / "serve.json").read_text())["pid"])


def test_a_folder_is_served_once(url: str, served_folder: Path) -> None:
    said = refusal("serve", "--data", str(served_folder), "--port", "0")
    assert f"data folder {served_folder} is being served already at {url} by process {pid_of(served_folder)}" in said


def test_a_taken_port_is_refused_before_anything_starts(url: str, tmp_path: Path) -> None:
    port = url.rsplit(":", 1)[1]
    assert f"port {port}: Address already in use" in refusal("serve", "--data", str(tmp_path), "--port", port)
    assert not (tmp_path / "asim.db").exists()


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.0.7", "::", "example.org"])
def test_a_host_that_others_reach_is_refused(host: str, tmp_path: Path) -> None:
    assert f"host {host!r} is not a loopback address" in refusal("serve", "--data", str(tmp_path), "--host", host)
    assert list(tmp_path.iterdir()) == []


def test_a_killed_service_leaves_no_runner_behind_and_starts_again_until_sigterm_ends_all(tmp_path: Path) -> None:
    with served(tmp_path):
        killed = pid_of(tmp_path)
        assert eventually(lambda: len(children(killed)) == 2)
        orphans = children(killed)
        os.kill(killed, signal.SIGKILL)
        assert eventually(lambda: not any(map(alive, orphans)))
    with served(tmp_path):
        assert pid_of(tmp_path) != killed
        assert eventually(lambda: len(children(pid_of(tmp_path))) == 2)
        runners = children(pid_of(tmp_path))
    assert not any(map(alive, runners))
    assert not (tmp_path / "serve.json").exists()


def test_a_killed_runner_is_replaced(url: str, served_folder: Path) -> None:
    def collector() -> set[int]:
        return {pid for pid in children(pid_of(served_folder)) if b"label" in Path(f"/proc/{pid}/cmdline").read_bytes()}

    with Client(url) as client:
        assert eventually(lambda: client.health().workers_alive == 2)
    (first,) = collector()
    os.kill(first, signal.SIGKILL)
    assert eventually(lambda: bool(collector() - {first}))
    assert "collector ended with status -9; it starts again in 0.2 s" in (served_folder / "serve.log").read_text()


def test_only_the_collector_can_reach_simulator_states(tmp_path: Path) -> None:
    settings = Settings(data_folder=tmp_path)
    assert runner_environment(settings, SCIENCE_QUEUES)["ASIM_PROVENANCE_URL"] == ""
    assert "ASIM_PROVENANCE_URL" not in runner_environment(settings, COLLECTOR_QUEUES)
    queues = [each.argv[each.argv.index("--queues") + 1] for each in runner_processes(settings, 2)]
    assert queues == ["train,score,default", "train,score,default", "label"]
    names = [each.name for each in runner_processes(settings, 1, collectors=3)]
    assert names == ["runner 1", "collector", "collector 2", "collector 3"]
    assert runner_processes(Settings(data_folder=tmp_path, broker_url="redis://127.0.0.1"), 2) == []


def test_a_worker_that_would_mix_collecting_with_training_is_refused(tmp_path: Path) -> None:
    assert "queues: train,label mixes label" in refusal("worker", "--data", str(tmp_path), "--queues", "train,label")
    assert "queues: trian given; known are" in refusal("worker", "--data", str(tmp_path), "--queues", "trian")


def test_a_worker_of_a_folder_that_was_never_served_is_refused(tmp_path: Path) -> None:
    assert f"data folder {tmp_path} holds no database" in refusal("worker", "--data", str(tmp_path))


def test_a_service_that_cannot_start_says_why_to_the_one_who_started_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ASIM_JOB_LEASE_SECONDS", "-1")
    with pytest.raises(AsimError, match=r"(?s)ended with status 1.*job_lease_seconds: .* greater than 0"):  # noqa: SIM117
        with served(tmp_path):
            pytest.fail("it cannot have started")

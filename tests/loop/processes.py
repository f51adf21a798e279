"""Processes under test: an `asim serve` that keeps its port over restarts, and who runs below it."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path

START_SECONDS = 60.0


class Serving:
    """`asim serve` on a data folder. It may be killed and started again; clients keep the URL."""

    def __init__(self, folder: Path, **settings: str) -> None:
        self.folder, self.port = folder, free_port()
        self.url = f"http://127.0.0.1:{self.port}"
        self.environment = environment(ASIM_DATA_FOLDER=str(folder), **settings)
        self.process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start, and wait until it listens."""
        argv = [sys.executable, "-m", "asim", "serve", "--port", str(self.port)]
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(argv, env=self.environment, stdout=log, stderr=log, process_group=0)
        eventually(self._listens, START_SECONDS, lambda: f"asim serve does not listen:\n{self.log.read_text()[-3000:]}")

    @property
    def log(self) -> Path:
        """Output of the service and its runners."""
        return self.folder / "serve.log"

    @property
    def pid(self) -> int:
        """The process that `serve.json` names."""
        return int(json.loads((self.folder / "serve.json").read_text())["pid"])

    def runners(self) -> list[int]:
        """Science runners below the service, by process id."""
        assert self.process is not None
        return [pid for pid in runners_of(self.process.pid) if "train" in command_of(pid)]

    def end(self, number: signal.Signals, seconds: float) -> int:
        """Signal the service and wait; the exit status."""
        assert self.process is not None
        os.kill(self.pid, number)
        return self.process.wait(seconds)

    def close(self) -> None:
        """SIGTERM, if it still runs."""
        if self.process is not None and self.process.poll() is None:
            self.process.terminate()
            self.process.wait(30)

    def _listens(self) -> bool:
        assert self.process is not None
        assert self.process.poll() is None, self.log.read_text()[-3000:]
        try:
            return self.pid == self.process.pid
        except (OSError, ValueError):  # not told yet
            return False


def environment(**settings: str) -> dict[str, str]:
    """This process's environment without its ASIM_* variables, one torch thread, and these settings."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("ASIM_")}
    return {**kept, "OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1", **settings}


def eventually(holds: Callable[[], bool], seconds: float, otherwise: Callable[[], str] | str) -> float:
    """Wait until `holds`; returns the seconds that it took."""
    began = time.monotonic()
    while not holds():
        if time.monotonic() - began > seconds:
            raise AssertionError(otherwise if isinstance(otherwise, str) else otherwise())
        time.sleep(0.02)
    return time.monotonic() - began


def runners_of(parent: int) -> list[int]:
    """Runners that were started to end with `parent`, orphans too."""
    wanted = f"--parent {parent}"
    return [pid for pid in _pids() if "workers.runner" in command_of(pid) and command_of(pid).endswith(wanted)]


def command_of(pid: int) -> str:
    """Command line; empty for a process that has ended."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace").strip()
    except OSError:
        return ""


def free_port() -> int:
    """A port that nobody listens on now."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


def stop(process: "subprocess.Popen[bytes]", seconds: float = 30.0) -> None:
    """SIGTERM, then SIGKILL."""
    process.terminate()
    try:
        process.wait(seconds)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def started(argv: list[str], settings: Mapping[str, str], log: Path) -> "subprocess.Popen[bytes]":
    """A process whose output goes to a file."""
    with log.open("ab") as output:
        return subprocess.Popen(argv, env=environment(**settings), stdout=output, stderr=output, process_group=0)


def _pids() -> list[int]:
    return [int(path.name) for path in Path("/proc").iterdir() if path.name.isdigit()]

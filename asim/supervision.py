"""Keeping processes alive: one that dies is started again, all of them end together."""

import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

FIRST_PAUSE, LONGEST_PAUSE = 0.2, 10.0  # seconds between a death and the next start; doubles with each death
STEADY_SECONDS = 30.0  # a process that lived this long starts again at the first pause
STOP_SECONDS = 10.0  # between SIGTERM and SIGKILL


@dataclass
class Supervised:
    """A process that shall run. `deaths` counts since it last ran steadily."""

    name: str
    argv: Sequence[str]
    env: Mapping[str, str]
    process: subprocess.Popen[bytes] | None = None
    started: float = 0.0
    deaths: int = 0
    next_start: float = 0.0

    def watch(self, now: float, tell: Callable[[str], None]) -> None:
        """Start the process where it is due; note it where it has died."""
        if self.process is None:
            if now >= self.next_start:
                self._start(now)
            return
        status = self.process.poll()
        if status is None:
            return
        self.deaths = 1 if now - self.started >= STEADY_SECONDS else self.deaths + 1
        pause = min(FIRST_PAUSE * 2 ** (self.deaths - 1), LONGEST_PAUSE)
        self.process, self.next_start = None, now + pause
        tell(f"{self.name} ended with status {status}; it starts again in {pause:g} s")

    def _start(self, now: float) -> None:
        # A process group of its own: Ctrl-C in the terminal reaches the supervisor alone, which then ends this one.
        self.process = subprocess.Popen(self.argv, env=self.env, stdin=subprocess.DEVNULL, process_group=0)  # noqa: S603  (our own)
        self.started = now


@dataclass
class Supervisor:
    """Watches processes from a thread of its own, from `start` to `stop`."""

    supervised: Sequence[Supervised]
    tell: Callable[[str], None]
    _stopping: threading.Event = field(default_factory=threading.Event)
    _thread: threading.Thread | None = None

    def start(self) -> None:
        """Start all processes and the watch over them."""
        self._thread = threading.Thread(target=self._watch, name="supervisor", daemon=True)
        self._thread.start()

    def stop(self, grace: float = STOP_SECONDS) -> None:
        """SIGTERM to all, and SIGKILL to those that still run after `grace` seconds."""
        self._stopping.set()
        if self._thread is not None:
            self._thread.join()
        processes = [each.process for each in self.supervised if each.process is not None]
        for process in processes:
            _signal(process, signal.SIGTERM)
        deadline = time.monotonic() + grace
        for process in processes:
            try:
                process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                _signal(process, signal.SIGKILL)
                process.wait()

    def _watch(self) -> None:
        while not self._stopping.is_set():
            for each in self.supervised:
                each.watch(time.monotonic(), self.tell)
            self._stopping.wait(0.05)


def _signal(process: subprocess.Popen[bytes], number: signal.Signals) -> None:
    if process.poll() is None:
        os.kill(process.pid, number)

"""An `asim serve` of one's own, as a child process."""

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from asim.errors import AsimError

START_SECONDS = 120.0  # the first start on a cold machine reads torch from disk


@contextmanager
def served(folder: Path, runners: int = 1, host: str = "127.0.0.1", collectors: int = 1) -> Iterator[str]:
    """Run `asim serve` on `folder` and a free port of `host`; yields its URL. Its output goes to `serve.log` there.

    Raises AsimError where the process ends by itself, with the end of its log.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    options = {"--data": folder, "--host": host, "--port": 0, "--runners": runners, "--collectors": collectors}
    argv = [sys.executable, "-m", "asim", "serve", *(str(word) for option in options.items() for word in option)]
    log = folder / "serve.log"
    with log.open("w") as output:
        process = subprocess.Popen(argv, stdout=output, stderr=subprocess.STDOUT, process_group=0)  # noqa: S603  (our own program)
    try:
        yield _await_url(process, folder, log)
    except AsimError as error:
        if process.poll() is not None:
            raise _died(process, log) from error
        raise
    finally:
        process.terminate()
        process.wait()


def _await_url(process: "subprocess.Popen[bytes]", folder: Path, log: Path) -> str:
    deadline = time.monotonic() + START_SECONDS
    while time.monotonic() < deadline and process.poll() is None:
        told = _told(folder / "serve.json")
        if told.get("pid") == process.pid:  # not that of an earlier one, which was killed
            return str(told["url"])
        time.sleep(0.05)
    raise AsimError(f"asim serve did not listen within {START_SECONDS:g} s; the end of its log:\n{_tail(log)}")


def _told(file: Path) -> dict[str, object]:
    try:
        return dict(json.loads(file.read_text()))
    except FileNotFoundError:
        return {}


def _died(process: "subprocess.Popen[bytes]", log: Path) -> AsimError:
    return AsimError(f"asim serve ended with status {process.returncode}; the end of its log:\n{_tail(log)}")


def _tail(log: Path, lines: int = 20) -> str:
    return "\n".join(log.read_text(errors="replace").splitlines()[-lines:])

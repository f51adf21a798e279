"""Servers that a test may kill: each listens on a port of its own and can be started there again."""

import os
import pwd
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Self

from redis import Redis
from redis.exceptions import RedisError
from sqlalchemy import create_engine
from sqlalchemy.exc import OperationalError

START_SECONDS = 30.0
# An interrupted pytest-xdist ends its processes before their fixtures can end a server.
END_WITH_TESTS = ["setpriv", "--pdeathsig", "INT"] if shutil.which("setpriv") else []


class PrivateServer:
    """A server process with a data folder. As a context manager it runs for the block, and its folder goes with it."""

    name = "server"

    def __init__(self) -> None:
        self.port = free_port()
        self.folder = Path(tempfile.mkdtemp(prefix="asim-server-"))
        self.process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        try:
            self.start()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def url(self) -> str:
        """Where it answers."""
        raise NotImplementedError

    def answers(self) -> bool:
        """True where a client can connect."""
        raise NotImplementedError

    def command(self) -> list[str]:
        """What is run."""
        raise NotImplementedError

    def start(self) -> None:
        """Start on the data that is there, and wait until it answers."""
        with (self.folder / "log").open("ab") as log:
            self.process = subprocess.Popen(
                [*END_WITH_TESTS, *self.command()],
                user=unprivileged_user(),
                cwd=self.folder,
                stdout=log,
                stderr=log,
                process_group=0,
            )
        wait_for(self.answers, self.name, self._ended)

    def end(self, number: signal.Signals) -> None:
        """Signal it, and wait until it is gone; by SIGKILL it has no time to save anything."""
        if self.process is not None:
            self.process.send_signal(number)
            self.process.wait(timeout=START_SECONDS)
            self.process = None

    def close(self) -> None:
        """End it for good."""
        try:
            self.end(signal.SIGTERM)
        except subprocess.TimeoutExpired:
            self.end(signal.SIGKILL)
        finally:
            shutil.rmtree(self.folder, ignore_errors=True)

    def _ended(self) -> str | None:
        """The end of its log, where it has ended instead of answering."""
        if self.process is None or self.process.poll() is None:
            return None
        return (self.folder / "log").read_text(errors="replace")[-2000:]


class PrivateRedis(PrivateServer):
    """Redis. `append_only`: it keeps what it is told over a kill; otherwise it comes back empty."""

    name = "Redis"

    def __init__(self, *, append_only: bool = False) -> None:
        super().__init__()
        own(self.folder)
        self.append_only = append_only

    @property
    def url(self) -> str:
        """URL of its first database."""
        return f"redis://127.0.0.1:{self.port}/0"

    def command(self) -> list[str]:
        """Without snapshots; with an append-only file that is synced at every write, or none."""
        kept = ["--appendonly", "yes", "--appendfsync", "always"] if self.append_only else ["--appendonly", "no"]
        return ["redis-server", "--port", str(self.port), "--bind", "127.0.0.1", "--save", "", "--dir", ".", *kept]

    def answers(self) -> bool:
        """True where it answers a ping."""
        return redis_answers(self.url)

    def forget(self) -> None:
        """Lose what it has kept; call it while it does not run."""
        shutil.rmtree(self.folder / "appendonlydir", ignore_errors=True)

    def client(self) -> Redis:
        """A connection of the test's own."""
        return Redis.from_url(self.url, socket_timeout=10)


class PrivatePostgres(PrivateServer):
    """PostgreSQL with an empty data folder at first. A kill leaves the data as it was written."""

    name = "PostgreSQL"

    def __init__(self, options: Mapping[str, str] | None = None) -> None:
        super().__init__()
        programs = postgres_folder()
        if programs is None:
            raise FileNotFoundError("PostgreSQL: initdb is not installed")
        own(self.folder)
        self._programs, self._options = programs, {"fsync": "off", **(options or {})}
        initialise = [str(programs / "initdb"), "-D", "data", "-U", "postgres", "-A", "trust", "--no-sync"]
        subprocess.run(
            initialise, check=True, user=unprivileged_user(), cwd=self.folder, stdout=subprocess.DEVNULL, timeout=120
        )

    @property
    def url(self) -> str:
        """URL of the database `postgres`."""
        return f"postgresql+psycopg://postgres@127.0.0.1:{self.port}/postgres"

    def command(self) -> list[str]:
        """No fsync by default: a killed process loses nothing by that, only a machine would."""
        options = [part for name, value in self._options.items() for part in ("-c", f"{name}={value}")]
        serve = [str(self._programs / "postgres"), "-D", "data", "-p", str(self.port), "-h", "127.0.0.1"]
        return [*serve, "-k", str(self.folder), *options]

    def answers(self) -> bool:
        """True where a connection is accepted."""
        return postgres_answers(self.url)


def postgres_answers(url: str) -> bool:
    """True where a connection is accepted."""
    engine = create_engine(url, connect_args={"connect_timeout": 2})
    try:
        with engine.connect():
            return True
    except OperationalError:
        return False
    finally:
        engine.dispose()


def redis_answers(url: str) -> bool:
    """True where a ping is answered."""
    try:
        with Redis.from_url(url, socket_connect_timeout=2) as client:
            return bool(client.ping())
    except (RedisError, OSError):
        return False


def postgres_folder() -> Path | None:
    """Where initdb is; Debian keeps it out of the path."""
    found = shutil.which("initdb")
    places = [Path(found)] if found else sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
    return places[-1].resolve().parent if places else None


def unprivileged_user() -> str | None:
    """PostgreSQL refuses to run as root; the user that its package made, or nobody, runs it then."""
    if os.geteuid() != 0:
        return None
    known = {entry.pw_name for entry in pwd.getpwall()}
    return "postgres" if "postgres" in known else "nobody"


def own(folder: Path) -> None:
    """Give the folder to whom the server runs as."""
    user = unprivileged_user()
    if user is not None:
        shutil.chown(folder, user)


def free_port() -> int:
    """A port that nobody listens on now."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


def wait_for(answers: Callable[[], bool], name: str, ended: Callable[[], str | None]) -> None:
    """Wait until it answers. Raises TimeoutError, or RuntimeError where it has ended."""
    deadline = time.monotonic() + START_SECONDS
    while not answers():
        log = ended()
        if log is not None:
            raise RuntimeError(f"{name} ended at its start: {log}")
        if time.monotonic() > deadline:
            raise TimeoutError(f"{name} did not answer within {START_SECONDS:.0f} s of its start")
        time.sleep(0.05)

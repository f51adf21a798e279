"""Embedded mode: the API in this process, the runners that do its jobs as watched processes beside it."""

import contextlib
import fcntl
import ipaddress
import json
import os
import signal
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType

import uvicorn

from asim.errors import AsimError
from asim.runners import runner_processes
from asim.supervision import Supervisor
from service.log import configure_logs
from service.settings import Settings

Tell = Callable[[str], None]


class ServeRefused(AsimError):
    """The service cannot start like this; the text says why and what to do."""


def serve(settings: Settings, host: str, port: int, runners: int, tell: Tell, *, collectors: int = 1) -> None:
    """Serve until SIGINT or SIGTERM, then end all runners; SystemExit 0 after a signal.

    Args:
        port: 0 takes a free one. The URL is told, and written to `serve.json` in the data folder with this process' id.
        runners: processes for training and scoring.
        tell: prints one line for a person.
        collectors: processes for collections, which may reach simulator states.

    Raises:
        ServeRefused: the port is taken, the data folder is being served already, or the host is not loopback and there
            is no API key.
    """
    if settings.embedded:  # elsewhere every request needs a key
        _refuse_foreign_host(host, settings)
    folder = settings.make_data_folder()
    with _locked(folder), _listening(host, port) as listener, _ended_by_signals():
        from service.app import create_app  # after the checks: a refusal comes at once
        from service.store.database import migrate

        configure_logs()
        if not settings.embedded:  # embedded, the service does it by itself
            migrate(settings.resolved_database_url())
        (folder / "serve.json").unlink(missing_ok=True)  # of one that was killed
        url = _url(host, listener.getsockname()[1])
        supervisor = Supervisor(runner_processes(settings, runners, collectors), tell)

        def started() -> None:
            _write_whole(folder / "serve.json", json.dumps({"url": url, "pid": os.getpid()}))
            supervisor.start()
            tell(f"ASIM listens on {url} (dashboard: {url}/dashboard, data: {folder})")

        config = uvicorn.Config(create_app(settings), log_config=None, access_log=False, timeout_graceful_shutdown=2)
        try:
            _Server(config, started).run(sockets=[listener])
        finally:
            for number in (signal.SIGINT, signal.SIGTERM):  # the end is near and bounded; a second signal adds nothing
                signal.signal(number, signal.SIG_IGN)
            supervisor.stop()
            (folder / "serve.json").unlink(missing_ok=True)


class _Server(uvicorn.Server):
    """uvicorn, telling when it listens."""

    def __init__(self, config: uvicorn.Config, on_started: Callable[[], None]) -> None:
        super().__init__(config)
        self._on_started = on_started

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets=sockets)
        if self.started:
            self._on_started()


def _refuse_foreign_host(host: str, settings: Settings) -> None:
    """Others need a key in any case; where there is none yet, nobody meant to let them in."""
    with contextlib.suppress(ValueError):
        if host == "localhost" or ipaddress.ip_address(host).is_loopback:
            return
    if not _has_key(settings):
        raise ServeRefused(
            f"host {host!r} is not a loopback address, and there is no API key with which others could be told apart; "
            "make one with asim key create, or use --host 127.0.0.1"
        )


def _has_key(settings: Settings) -> bool:
    from service import keys
    from service.clock import utc_now
    from service.store.database import migrate, open_database

    url = settings.resolved_database_url()
    if not settings.database_url and not (settings.data_folder / "asim.db").exists():
        return False
    migrate(url)
    with contextlib.closing(open_database(url)) as database, database.read() as session:
        return keys.usable(session, utc_now())


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold `serve.lock`; the kernel releases it with the process, however that ends."""
    with (folder / "serve.lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ServeRefused(
                f"data folder {folder} is being served already{_by_whom(folder)}; stop that, or choose another --data"
            ) from None
        yield


def _by_whom(folder: Path) -> str:
    try:
        other = json.loads((folder / "serve.json").read_text())
        return f" at {other['url']} by process {other['pid']}"
    except (OSError, ValueError, KeyError):  # it is still starting and has not told yet
        return ""


@contextlib.contextmanager
def _listening(host: str, port: int) -> Iterator[socket.socket]:
    """A bound socket, before anything else starts: a taken port is known at once, port 0 has its number."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # asyncio turns Nagle's algorithm off only on sockets that name their protocol; without it each answer waits 40 ms.
    with socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP) as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((host, port))
        except OSError as error:
            raise ServeRefused(
                f"cannot listen on {host} port {port}: {error.strerror}; choose another --port, 0 takes a free one"
            ) from error
        yield listener


@contextlib.contextmanager
def _ended_by_signals() -> Iterator[None]:
    """SIGINT and SIGTERM end the block with SystemExit 0. uvicorn has its own handlers while it runs, and raises the
    signal again afterwards: without this, SIGTERM would then end the process before its runners are stopped."""

    def end(number: int, frame: FrameType | None) -> None:
        raise SystemExit(0)

    before = {number: signal.signal(number, end) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _url(host: str, port: int) -> str:
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


def _write_whole(path: Path, text: str) -> None:
    """Write so that a reader sees all of it or nothing."""
    unfinished = path.with_suffix(".tmp")
    unfinished.write_text(text)
    unfinished.replace(path)

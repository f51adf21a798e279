"""Runs of a benchmark: each is a file of results, a finished one is not run again, several processes share the rest.

A file says which code made it. What other code made is made again and told nowhere: means over seeds are of one code.
"""

import argparse
import hashlib
import json
import multiprocessing
import os
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, Protocol

import torch

Json = dict[str, Any]
ROOT = Path(__file__).parents[2]
DATA = (
    "workers/simulators",
    "workers/episodes.py",
    "workers/explanation.py",
    "workers/quotas.py",
    "service/store/codec.py",
    "benchmarks/paper/minigrid/composition.py",
    "benchmarks/paper/minigrid/datasets.py",
)
"""What the simulator's own sets depend on."""
CODE = (*DATA, "models", "workers/data.py", "workers/diagnosis.py", "workers/training.py", "benchmarks/paper")
"""What results depend on; on code of ALL_CODE only those that name it under `also`."""
EXPLORATION_CODE = ("models/exploration.py", "models/exploration_queue.py", "benchmarks/paper/minigrid/exploration.py")
ROBOT_CODE = ("benchmarks/paper/robots",)
"""What results on robots depend on beside CODE, and those on MiniGrid do not."""
ALL_CODE = (*EXPLORATION_CODE, *ROBOT_CODE)
TELLING = ("_table", "__main__", "charts", "drawing", "foreign_path", "picked_losses", "statistics", "through_service")
"""How the names of modules end that results do not depend on: they tell of them or ask for them."""
LIBRARIES = ("gymnasium", "minigrid", "numpy", "torch")


class Run(Protocol):
    """One unit of work that a process does by itself: picklable, decided by its fields alone."""

    @property
    def name(self) -> str:
        """Of its file, unlike any other's in the same folder."""
        ...

    def results(self) -> Json:
        """Do it. EXPLORATION_CODE or ROBOT_CODE is named under `also` where they depend on it."""
        ...


def add_options(parser: argparse.ArgumentParser, folder: str) -> None:
    """Options that all figures share: where results go, how many processes and threads, which rooms."""
    parser.add_argument("--out", type=Path, default=Path("results/paper/minigrid") / folder)
    parser.add_argument("--processes", type=int, default=multiprocessing.cpu_count())
    parser.add_argument("--threads", type=int, default=1, help="of torch, in each process")
    parser.add_argument("--tuning", action="store_true", help="rooms that no table reports, to choose settings on")


def run_missing(runs: Sequence[Run], out: Path, processes: int, threads: int) -> None:
    """Do every run whose file is not there, in order of appearance; each file appears at once when its run ends."""
    missing = [run for run in runs if read(result_file(out, run)) is None]
    if not missing:
        return
    stale = sum(result_file(out, run).exists() for run in missing)
    if stale:
        print(f"{stale} results in {out} are of other code: they are made again.", flush=True)
    out.mkdir(parents=True, exist_ok=True)
    context = multiprocessing.get_context("spawn")
    began = time.monotonic()
    with ProcessPoolExecutor(processes, context, initializer=torch.set_num_threads, initargs=(threads,)) as pool:
        futures = [pool.submit(do, run, out, code_digest(*ALL_CODE)) for run in missing]
        try:
            for done, future in enumerate(as_completed(futures), 1):
                name, seconds = future.result()
                total = time.monotonic() - began
                print(f"{done} of {len(missing)}, {total:.0f} s: {name} took {seconds:.0f} s", flush=True)
        finally:
            pool.shutdown(cancel_futures=True)  # a run has failed: what it tells need not wait for all others


def results(runs: Sequence[Run], out: Path) -> list[Json]:
    """Of the finished runs among these, in their order."""
    found = [read(result_file(out, run)) for run in runs]
    return [each for each in found if each is not None]


def read(path: Path) -> Json | None:
    """What a run told; None where it has not ended, or other code made the file."""
    if not path.exists():
        return None
    told: Json = json.loads(path.read_text())
    code = _digests().get(tuple(told.get("also", ())))
    return told if code is not None and told.get("code") == code else None


def result_file(out: Path, run: Run) -> Path:
    """Where a run's results are kept."""
    return out / f"{run.name}.json"


def code_digest(*also: str) -> str:
    """Of what results depend on: the sources in CODE and `also`, Python and the libraries of LIBRARIES."""
    return _digests()[also]


@cache
def _digests() -> dict[tuple[str, ...], str]:
    """All at one moment: sources may change while a run lasts, and it began with the earlier ones."""
    return {also: sources_digest(*CODE, *also) for also in ((), EXPLORATION_CODE, ROBOT_CODE, ALL_CODE)}


@cache
def sources_digest(*names: str) -> str:
    """Of Python files and folders of them below the root, but for modules that only tell; of Python and LIBRARIES.

    Those of ALL_CODE count only where they, or files in them, are named themselves.
    """
    left_out = [part for part in ALL_CODE if not any(f"{name}/".startswith(f"{part}/") for name in names)]
    apart = {path for part in left_out for path in _sources(ROOT / part)}
    found = {path for name in names for path in _sources(ROOT / name) if not path.stem.endswith(TELLING)}
    files = sorted(found - apart)
    libraries = [f"{name} {version(name)}" for name in LIBRARIES]
    digest = hashlib.sha256(" ".join((sys.version, *libraries)).encode())
    for path in files:
        digest.update(str(path.relative_to(ROOT)).encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


def _sources(path: Path) -> list[Path]:
    return [path] if path.is_file() else list(path.rglob("*.py"))


def write_at_once(path: Path, content: bytes) -> None:
    """The whole file or none of it: another process may be writing or reading the same."""
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f"{path.name}.{os.getpid()}.unfinished")
    try:
        unfinished.write_bytes(content)
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)


def do(run: Run, out: Path, code: str | None = None) -> tuple[str, float]:
    """A run in this process, its results kept: its name, and how many seconds it took.

    code: the digest of all code with which the benchmark began. Raises RuntimeError where it is another by now.
    """
    if code not in (None, code_digest(*ALL_CODE)):
        raise RuntimeError("The code has changed since the benchmark began; start it again.")
    began = time.monotonic()
    found = run.results()
    seconds = time.monotonic() - began
    code = code_digest(*found.get("also", ()))
    about = {"name": run.name, "code": code, "seconds": seconds, "threads": torch.get_num_threads()}
    write_at_once(result_file(out, run), json.dumps({**about, **found}).encode())
    return run.name, seconds

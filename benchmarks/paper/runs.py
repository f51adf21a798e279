"""Runs of a benchmark: each is a file of results, a finished one is not run again, several processes share the rest.

A file says which code made it. What other code made is made again and told nowhere: means over seeds are of one code.
"""

import argparse
import hashlib
import json
import multiprocessing
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import cache
from pathlib import Path
from typing import Any, Protocol

import torch

Json = dict[str, Any]
ROOT = Path(__file__).parents[2]
CODE = ("models", "workers", "benchmarks/paper/minigrid")
TELLING = ("_table", "__main__", "picked_losses", "foreign_path")
"""What results depend on, and how the names of modules end that only tell of them or ask for them."""


class Run(Protocol):
    """One unit of work that a process does by itself: picklable, decided by its fields alone."""

    @property
    def name(self) -> str:
        """Of its file, unlike any other's in the same folder."""
        ...

    def results(self) -> Json:
        """Do it."""
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
        futures = [pool.submit(do, run, out) for run in missing]
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
    return told if told.get("code") == code_digest() else None


def result_file(out: Path, run: Run) -> Path:
    """Where a run's results are kept."""
    return out / f"{run.name}.json"


@cache
def code_digest() -> str:
    """Of the sources in CODE and of torch: results may differ where it does."""
    files = sorted(path for folder in CODE for path in (ROOT / folder).rglob("*.py") if not path.stem.endswith(TELLING))
    digest = hashlib.sha256(torch.__version__.encode())
    for path in files:
        digest.update(str(path.relative_to(ROOT)).encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


def write_at_once(path: Path, content: bytes) -> None:
    """The whole file or none of it: another process may be writing or reading the same."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".unfinished", delete=False) as file:
        file.write(content)
    Path(file.name).replace(path)


def do(run: Run, out: Path) -> tuple[str, float]:
    """A run in this process, its results kept: its name, and how many seconds it took."""
    began = time.monotonic()
    found = run.results()
    seconds = time.monotonic() - began
    about = {"name": run.name, "code": code_digest(), "seconds": seconds, "threads": torch.get_num_threads()}
    write_at_once(result_file(out, run), json.dumps({**about, **found}).encode())
    return run.name, seconds

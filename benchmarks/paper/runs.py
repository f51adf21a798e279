"""Runs of a benchmark: each is a file of results, a finished one is not run again, several processes share the rest."""

import argparse
import json
import multiprocessing
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any, Protocol

import torch

Json = dict[str, Any]


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
    missing = [run for run in runs if not result_file(out, run).exists()]
    if not missing:
        return
    out.mkdir(parents=True, exist_ok=True)
    context = multiprocessing.get_context("spawn")
    began = time.monotonic()
    with ProcessPoolExecutor(processes, context, initializer=torch.set_num_threads, initargs=(threads,)) as pool:
        futures = [pool.submit(_done, run, out) for run in missing]
        try:
            for done, future in enumerate(as_completed(futures), 1):
                name, seconds = future.result()
                total = time.monotonic() - began
                print(f"{done} of {len(missing)}, {total:.0f} s: {name} took {seconds:.0f} s", flush=True)
        finally:
            pool.shutdown(cancel_futures=True)  # a run has failed: what it tells need not wait for all others


def results(runs: Sequence[Run], out: Path) -> list[Json]:
    """Of the finished runs among these, in their order."""
    files = [result_file(out, run) for run in runs]
    return [json.loads(file.read_text()) for file in files if file.exists()]


def result_file(out: Path, run: Run) -> Path:
    """Where a run's results are kept."""
    return out / f"{run.name}.json"


def _done(run: Run, out: Path) -> tuple[str, float]:
    began = time.monotonic()
    found = run.results()
    seconds = time.monotonic() - began
    path = result_file(out, run)
    unfinished = path.with_suffix(".unfinished")
    told = {"name": run.name, "seconds": seconds, "threads": torch.get_num_threads(), **found}
    unfinished.write_text(json.dumps(told))
    unfinished.replace(path)
    return run.name, seconds

"""Simulator states and the behavior that made a trajectory are out of reach of everything that trains or scores."""

import json
import shutil
import subprocess
import sys
import types
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from asim.runners import COLLECTOR_QUEUES, SCIENCE_QUEUES, runner_environment
from service.pool import NoProvenance
from service.settings import Settings
from service.store.provenance import ProvenanceBlobs, open_provenance
from tests.workers.conftest import OpenLoop
from tests.workers.in_process import Loop
from workers import collection, scoring, training
from workers.dispatch import open_worker
from workers.job import RunningJob, Worker

MODELS = ("acquisition", "checkpoints", "cycle_consistency", "evaluation", "families", "training")
SCIENCE = [
    *(f"workers.{name}" for name in ("training", "scoring", "evaluation", "data", "job")),
    *(f"models.{name}" for name in MODELS),
]


def environment_of(settings: Settings, queues: str, monkeypatch: pytest.MonkeyPatch) -> Settings:
    """The settings of a runner that `asim serve` starts for these queues."""
    for name, value in runner_environment(settings, queues).items():
        if name.startswith("ASIM_"):
            monkeypatch.setenv(name, value)
    return Settings()


@pytest.fixture
def science(trained: Loop, monkeypatch: pytest.MonkeyPatch) -> Worker:
    """A worker as `asim serve` starts it for training and scoring."""
    monkeypatch.setenv("ASIM_PROVENANCE_URL", str(trained.folder / "provenance"))  # as the API's environment names it
    settings = environment_of(trained.settings, SCIENCE_QUEUES, monkeypatch)
    return open_worker(settings, trained.clock, tuple(SCIENCE_QUEUES.split(",")))


def test_nothing_that_a_science_job_is_handed_leads_to_provenance(
    trained: Loop, science: Worker, monkeypatch: pytest.MonkeyPatch
) -> None:
    handed: dict[str, tuple[Any, ...]] = {}
    for module, name in (
        (training, "run_round"),
        (training, "run_subgoal_generator"),
        (scoring, "run_shard"),
        (scoring, "run_selection"),
    ):
        monkeypatch.setattr(module, name, _noting(handed, name, getattr(module, name)))
    trained.label(3, "random")
    trained.collect(2000, seed=61, split="pool")
    trained.client.start_round(trained.project.id)
    trained.drain(science)
    assert set(handed) == {"run_round", "run_subgoal_generator", "run_shard", "run_selection"}
    root = str(trained.folder / "provenance")
    for name, arguments in handed.items():
        found = list(reachable(arguments))
        assert any(isinstance(each, RunningJob) for each in found)
        assert any(each is science.blobs for each in found)
        assert not [each for each in found if isinstance(each, ProvenanceBlobs)], name
        assert not [each for each in found if isinstance(each, str | Path) and root in str(each)], name


def test_the_walk_would_find_the_way_of_a_collection(trained: Loop, monkeypatch: pytest.MonkeyPatch) -> None:
    handed: dict[str, tuple[Any, ...]] = {}
    monkeypatch.setattr(collection, "run_collection", _noting(handed, "run_collection", collection.run_collection))
    trained.collect(10, seed=62, split="pool")
    assert [each for each in reachable(handed["run_collection"]) if isinstance(each, ProvenanceBlobs)]
    assert "/secret" in reachable(Holder(Settings(provenance_url="/secret")))


def test_no_science_module_loads_the_provenance_store_or_a_simulator() -> None:
    loaded = loaded_by(SCIENCE)
    assert {"service.store.blobs", "torch"} <= loaded
    assert not {"service.store.provenance", "workers.collection", "workers.simulators"} & loaded


def test_the_search_for_loaded_modules_would_find_the_store() -> None:
    assert "service.store.provenance" in loaded_by(["workers.collection"])


def test_training_and_scoring_run_after_the_provenance_is_gone(trained: Loop, science: Worker) -> None:
    trained.label(5, "random")
    shutil.rmtree(trained.folder / "provenance")
    asked = trained.client.start_round(trained.project.id)
    trained.drain(science)
    assert trained.client.round(asked.id).status == "current"
    assert trained.acquire(3).round == asked.id
    assert not (trained.folder / "provenance").exists()  # nobody even opened it


def test_a_science_worker_refuses_a_collection_in_a_sentence(
    opened: OpenLoop, trained_folder: Path, science: Worker
) -> None:
    assert open_provenance(science.settings) is None
    loop = opened(trained_folder, provenance_url="")
    before = loop.project.counts
    job = loop.collect(20, seed=63, split="pool")
    assert job.state == "failed"
    assert job.error is not None
    assert job.error.startswith(f"{NoProvenance.__name__}: ")
    assert "provenance" in job.error
    assert loop.project.counts == before


def test_only_the_collector_is_started_with_provenance(trained: Loop, monkeypatch: pytest.MonkeyPatch) -> None:
    assert "label" not in SCIENCE_QUEUES.split(",")
    science = environment_of(trained.settings, SCIENCE_QUEUES, monkeypatch)
    assert open_provenance(science) is None
    monkeypatch.delenv("ASIM_PROVENANCE_URL")
    collector = environment_of(trained.settings, COLLECTOR_QUEUES, monkeypatch)
    assert isinstance(open_provenance(collector), ProvenanceBlobs)


@dataclass
class Holder:
    """An object of a foreign class on the way to settings."""

    held: object


def loaded_by(modules: list[str]) -> set[str]:
    """Names of the modules that a fresh interpreter holds after importing these."""
    code = f"import json, sys\n{''.join(f'import {name};' for name in modules)}\nprint(json.dumps(list(sys.modules)))"
    answer = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    return set(json.loads(answer.stdout))


def reachable(start: object) -> Iterator[object]:
    """Everything that attributes, items, closures and bound arguments lead to; modules and classes are not entered."""
    seen: set[int] = set()
    waiting: list[object] = [start]
    while waiting:
        each = waiting.pop()
        if id(each) in seen or isinstance(each, types.ModuleType | type):
            continue
        seen.add(id(each))
        yield each
        waiting.extend(_next(each))


def _next(each: object) -> list[object]:
    if isinstance(each, dict):
        return [*each.keys(), *each.values()]
    if isinstance(each, list | tuple | set | frozenset):
        return list(each)
    if isinstance(each, types.FunctionType):
        return [cell.cell_contents for cell in each.__closure__ or ()] + list(each.__defaults__ or ())
    if isinstance(each, types.MethodType):
        return [each.__self__]
    fields = list(vars(each).values()) if hasattr(each, "__dict__") else []
    slots = [getattr(each, name, None) for name in getattr(type(each), "__slots__", ()) if isinstance(name, str)]
    return fields + slots


def _noting(handed: dict[str, tuple[Any, ...]], name: str, real: Callable[..., Any]) -> Callable[..., Any]:
    def noted(*arguments: Any) -> Any:
        handed[name] = arguments
        return real(*arguments)

    return noted

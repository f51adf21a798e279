"""What cannot be loaded or is not there fails the round in a sentence, and spoils nothing."""

from collections.abc import Callable
from typing import Any

import pytest

from models import checkpoints
from models.families import GRID
from service.store.errors import MissingBlob
from service.store.queries import labels as label_queries
from service.store.tables import ScoringRow
from tests.workers.in_process import Loop
from tests.workers.test_rounds import _generator, start
from workers import data
from workers.dispatch import run_next


def foreign_kind(loop: Loop) -> bytes:
    """The weights of another kind of network."""
    (model,) = (m for m in loop.client.models(loop.project.id) if m.kind == "subgoal_generator")
    return loop.client.weights(model.id)


def foreign_family(loop: Loop) -> bytes:
    """A checkpoint that says that it is of another family."""
    network = GRID.build_world_model(data.model_spaces(loop.project.environment.resolved_spaces()), None, _generator())
    network.family = "tree"
    return checkpoints.save(network)


@pytest.mark.parametrize(
    ("blob", "sentence"),
    [
        (foreign_kind, "CheckpointError: Expected a checkpoint of kind 'world_model', found kind 'subgoal_generator'."),
        (foreign_family, "CheckpointError: Expected a checkpoint of family 'grid', found family 'tree'."),
    ],
)
def test_a_foreign_checkpoint_fails_the_round_in_a_sentence(
    trained: Loop, blob: Callable[[Loop], bytes], sentence: str
) -> None:
    sha256 = trained.blobs.put("weights", blob(trained))

    def exchange(model: Any) -> None:
        trained.set_row("model_version", model, sha256=sha256)

    assert sentence in _fails_scoring(trained, exchange)


def test_corrupted_weights_fail_the_round_in_a_sentence(trained: Loop) -> None:
    def corrupt(model: Any) -> None:
        sha256 = trained.client.model(model).sha256
        path = trained.folder / "blobs" / "weights" / sha256[:2] / sha256
        content = bytearray(path.read_bytes())
        content[len(content) // 2] ^= 1
        path.write_bytes(content)

    assert "should have the hash" in _fails_scoring(trained, corrupt)


def test_a_round_without_pool_labels_fails_in_a_sentence(trained: Loop, monkeypatch: pytest.MonkeyPatch) -> None:
    trained.label(1)
    asked = start(trained)
    monkeypatch.setattr(label_queries, "labels_up_to", lambda *_: [])
    trained.drain()
    assert "has no pool labels to train on" in str(trained.client.round(asked.id).error)


def test_a_missing_observation_blob_fails_the_round_in_a_sentence(trained: Loop) -> None:
    batch = trained.label(1)
    asked = start(trained)
    for path in (trained.folder / "blobs" / "trajectories").rglob("*/*"):
        path.unlink()
    trained.drain()
    assert batch.round != asked.id
    error = trained.client.round(asked.id).error
    assert error is not None
    assert MissingBlob.__name__ in error


def _fails_scoring(loop: Loop, spoil: Callable[[Any], None]) -> str:
    """The error of a second round whose world model is spoilt between training and scoring; the first is in use."""
    before = loop.project.current_round
    loop.label(5)
    asked = start(loop)
    while "world_model" not in loop.client.round(asked.id).models:
        run_next(loop.worker)
    spoil(loop.client.round(asked.id).models["world_model"])
    loop.drain()
    failed = loop.client.round(asked.id)
    assert failed.status == "failed"
    with loop.worker.database.read() as session:
        scoring = session.query(ScoringRow).filter_by(round_id=asked.id).one()
    assert scoring.status == "failed"
    assert loop.project.current_round == before
    assert loop.acquire(2).round == before
    return str(failed.error)

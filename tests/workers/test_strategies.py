"""Every strategy of the catalog runs through the service."""

import pytest
from sqlalchemy import select

from api_schemas.strategies import CATALOG
from service.scorings import PREVIOUS
from service.store.tables import ModelVersionRow
from tests.workers.in_process import Loop, segments_of
from workers.training import BASE, ENSEMBLE_MEMBERS

NETWORKS: dict[str, set[str]] = {
    strategy.name: set(strategy.needs) - {PREVIOUS} for strategy in CATALOG if not strategy.privileged
}


def kinds(names: dict[str, object]) -> set[str]:
    """Kinds of networks; the members of an ensemble are one kind."""
    return {name.split("-")[0] for name in names}


@pytest.mark.parametrize("strategy", NETWORKS)
def test_a_strategy_trains_what_it_lacks_and_keeps_the_current_round(trained: Loop, strategy: str) -> None:
    (before,) = trained.client.rounds(trained.project.id)
    batch = trained.acquire(12, strategy)
    (after,) = trained.client.rounds(trained.project.id)
    assert (batch.strategy, batch.requested_strategy) == (strategy, strategy)
    assert len(set(segments_of(batch))) == 12
    assert batch.round == (before.id if NETWORKS[strategy] else None)
    assert (after.id, after.status, after.error) == (before.id, "current", None)
    assert all(after.models[name] == model for name, model in before.models.items())  # nothing is trained twice
    assert kinds(dict(after.models)) == BASE | NETWORKS[strategy]
    assert {model.kind for model in trained.client.models(trained.project.id)} >= BASE | NETWORKS[strategy]
    assert after.model_error == before.model_error
    assert [stage.name for stage in after.stages][: len(before.stages)] == [stage.name for stage in before.stages]


@pytest.mark.parametrize("strategy", NETWORKS)
def test_a_projects_own_strategy_is_ready_when_its_round_is(trained: Loop, strategy: str) -> None:
    trained.change(strategy=strategy)
    trained.label(4, "random")
    done = trained.train()
    assert (done.status, trained.project.current_round) == ("current", done.id)
    assert kinds(dict(done.models)) == BASE | NETWORKS[strategy]
    jobs = len(list(trained.client.jobs(trained.project.id)))
    batch = trained.acquire(6)
    assert (batch.strategy, batch.round) == (strategy, done.id if NETWORKS[strategy] else None)
    if NETWORKS[strategy]:
        assert len(list(trained.client.jobs(trained.project.id))) == jobs  # nobody waits for a queue


def test_the_members_of_an_ensemble_differ(trained: Loop) -> None:
    trained.acquire(1, "uncertainty")
    (current,) = trained.client.rounds(trained.project.id)
    members = [model for name, model in current.models.items() if name.startswith("ensemble")]
    assert len(members) == ENSEMBLE_MEMBERS
    assert len({trained.client.model(model).sha256 for model in members}) == ENSEMBLE_MEMBERS


def test_before_the_first_round_every_strategy_falls_back_on_random(labeled: Loop) -> None:
    for strategy in NETWORKS:
        batch = labeled.acquire(2, strategy)
        assert (batch.strategy, batch.requested_strategy, batch.round) == ("random", strategy, None)


def test_what_another_version_of_the_service_trained_is_not_compared_with(trained: Loop) -> None:
    """A round ended by an upgrade leaves a world model with another config, whose weights nobody can read."""
    with trained.worker.database.write() as session:
        row = session.scalars(select(ModelVersionRow).where(ModelVersionRow.kind == "world_model")).one()
        row.config, row.sha256 = {"channels": 32, "reconstruction": 0.1}, "0" * 64
    trained.change(strategy="progress")
    trained.label(4, "random")
    done = trained.train()
    assert (done.status, done.error) == ("current", None)
    assert len(segments_of(trained.acquire(6))) == 6

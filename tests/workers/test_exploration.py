"""Explore mode over HTTP: what a strategy proposes is given out once, executed as asked, and comes back labeled."""

from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest
import torch

from api_schemas.acquisitions import Acquisition
from asim.errors import Conflict, NotReady
from models import checkpoints
from models.acquisition import EXPLORING, STRATEGIES
from models.exploration import distinct, explore, looks
from models.segments import at
from models.subgoal_generators.base import SubgoalGenerator
from service.store.queries import pool as pool_queries
from service.store.tables import MembershipRow, ProjectRow, QueueRow, ScoringRow
from tests.workers.conftest import OpenLoop
from tests.workers.in_process import Loop
from workers import data, scoring
from workers.dispatch import run_next
from workers.labeling import run_labeling

Proposal = tuple[str, int, tuple[object, ...]]


def proposals(batch: Acquisition) -> list[Proposal]:
    """State and actions of each item, by rank."""
    return [(item.trajectory, item.start, tuple(item.actions or ())) for item in batch.items]


def queued(loop: Loop) -> list[tuple[Proposal, float | None]]:
    """What explore mode would give out next, best first."""
    with loop.worker.database.read() as session:
        rows = session.query(QueueRow).join(ScoringRow, ScoringRow.id == QueueRow.scoring_id)
        rows = rows.filter(ScoringRow.mode == "explore").order_by(QueueRow.rank)
        return [((row.trajectory_id, row.start, tuple(row.actions or ())), row.score) for row in rows]


@pytest.fixture
def few_states(monkeypatch: pytest.MonkeyPatch) -> None:
    """A job looks at 100 states of the 600, for tests that do not ask which."""
    monkeypatch.setattr("models.exploration.STATES", 100)


@pytest.mark.usefixtures("few_states")
def test_a_strategy_proposes_under_the_rounds_models(trained: Loop) -> None:
    with pytest.raises(NotReady):
        trained.client.acquire(trained.project.id, 5, mode="explore", wait=0)
    (job,) = trained.jobs("propose_explorations")
    assert (job.state, job.queue) == ("queued", "score")
    batch = trained.acquire(5, mode="explore")
    assert (batch.mode, batch.strategy, batch.requested_strategy) == ("explore", "confident_cycle", "confident_cycle")
    assert (batch.round, batch.reason) == (trained.project.current_round, None)
    assert [len(item.actions or ()) for item in batch.items] == [1] * 5
    assert trained.project.counts.leased == 0  # no segment is claimed
    assert trained.project.counts.unlabeled == 540


def test_proposals_have_the_scores_of_the_strategy_on_the_rounds_networks(trained: Loop) -> None:
    with pytest.raises(NotReady):
        trained.client.acquire(trained.project.id, 1, mode="explore", wait=0)
    trained.drain()
    with trained.worker.database.read() as session:
        project = session.get_one(ProjectRow, trained.project.id)
        windows = data.windows_of(session, project, pool_queries.memberships(session, project.id, "pool"), None)
    needs = STRATEGIES["confident_cycle"].needs
    models = scoring.load_models(trained.worker.database, trained.blobs, project, trained.project.current_round, needs)
    (generator,) = (m for m in trained.client.models(project.id) if m.kind == "subgoal_generator")
    subgoals = checkpoints.load(trained.blobs.get("weights", generator.sha256))
    models = replace(models, subgoal_generator=cast(SubgoalGenerator, subgoals))
    batch = data.load(trained.blobs, windows, 1)
    batch = batch.take(distinct(looks(at(batch.observations, 0))))  # of rooms that look the same, one
    found = explore(EXPLORING["confident_cycle"], models, at(batch.observations, 0), 1, torch.Generator())
    names = [batch.segments[int(row)] for row in found.states]
    direct = {
        (name.trajectory, name.start, tuple(actions)): score
        for name, actions, score in zip(names, found.actions.tolist(), found.scores.tolist(), strict=True)
    }
    assert 300 < batch.size < 600
    assert len(direct) == batch.size * 7
    ranked = queued(trained)  # in each room the best action
    assert {key[:2] for key, _ in ranked} == {tuple(name) for name in batch.segments}
    assert len(ranked) == batch.size
    expected = [direct[key] for key, _ in ranked]
    np.testing.assert_allclose([score or 0.0 for _, score in ranked], expected, rtol=1e-3, atol=1e-3)


@pytest.mark.usefixtures("few_states")
def test_a_proposal_is_given_out_once_and_others_follow(opened: OpenLoop, trained_folder: Path) -> None:
    trained = opened(trained_folder, queue_length=30)
    first, second = trained.acquire(20, mode="explore"), trained.acquire(20, mode="explore")
    assert len(first.items) == 20
    assert len(second.items) == 10
    assert second.reason == "20 were asked for, 10 explorations were ready"
    assert len({*proposals(first), *proposals(second)}) == 30
    assert len(trained.jobs("propose_explorations")) == 1
    trained.client.release(first.id, first.token or 0)
    third = trained.acquire(20, mode="explore")  # what was given back is not offered again
    assert len(trained.jobs("propose_explorations")) == 2
    assert len(third.items) == 20


@pytest.mark.usefixtures("few_states")
def test_the_labeling_worker_executes_what_is_proposed(trained: Loop) -> None:
    batch = trained.acquire(12, mode="explore")
    before = trained.project.counts.labeled
    run_labeling(trained.client, batch, np.random.default_rng(0))
    assert trained.project.counts.labeled == before + 12
    assert trained.client.acquisition(batch.id).status == "labeled"
    labels = [label for label in trained.client.labels(trained.project.id) if label.acquisition == batch.id]
    for item, label in zip(batch.items, labels, strict=True):
        assert label.actions == item.actions
        came = trained.client.trajectory_content(trained.project.id, label.trajectory)
        asked = trained.client.trajectory_content(trained.project.id, item.trajectory, item.start, 1)
        assert all(np.array_equal(came[name][0], asked[name][0]) for name in asked)
    trained.train()
    assert trained.acquire(3, mode="explore").round == trained.project.current_round


def test_where_no_model_can_propose_chance_does_and_says_so(trained: Loop) -> None:
    for strategy in ("random", "uncertainty"):
        batch = trained.acquire(4, strategy, mode="explore")
        assert (batch.strategy, batch.requested_strategy, batch.round) == ("random", strategy, None)
    assert not trained.jobs("propose_explorations")


@pytest.mark.usefixtures("few_states")
def test_until_a_subgoal_generator_is_trained_chance_explores(labeled: Loop) -> None:
    asked = labeled.client.start_round(labeled.project.id)
    while labeled.client.round(asked.id).status != "current":
        run_next(labeled.worker)
    assert labeled.acquire(4, mode="explore").strategy == "random"
    labeled.drain()
    assert labeled.acquire(4, mode="explore").strategy == "confident_cycle"


@pytest.mark.usefixtures("few_states")
def test_another_strategys_networks_are_trained_before_it_proposes(trained: Loop) -> None:
    with pytest.raises(NotReady):
        trained.client.acquire(trained.project.id, 2, strategy="vanilla_cycle", mode="explore", wait=0)
    assert trained.jobs("train_round")[-1].state == "queued"
    trained.drain()
    assert trained.acquire(2, "vanilla_cycle", mode="explore").strategy == "vanilla_cycle"


@pytest.mark.usefixtures("few_states")
def test_labels_of_the_pool_leave_proposals_and_pool_queues_apart(trained: Loop) -> None:
    with pytest.raises(NotReady):
        trained.client.acquire(trained.project.id, 1, mode="explore", wait=0)
    trained.drain()
    before = queued(trained)
    labeled = trained.label(540)  # every segment that is left
    assert len(labeled.items) == 540
    assert queued(trained) == before


@pytest.mark.usefixtures("few_states")
def test_a_job_that_runs_twice_proposes_the_same(trained: Loop) -> None:
    with pytest.raises(NotReady):
        trained.client.acquire(trained.project.id, 1, mode="explore", wait=0)
    trained.drain()
    before = queued(trained)
    (job,) = trained.jobs("propose_explorations")
    with trained.worker.database.read() as session:
        (row,) = session.query(ScoringRow).filter_by(mode="explore").all()
    trained.set_row("scoring", row.id, selections=0, status="scoring")  # as if it had crashed before its last write
    with trained.worker.database.write() as session:
        session.query(QueueRow).filter_by(scoring_id=row.id).delete()
    assert queued(trained) == []
    trained.requeue(job.id)
    trained.drain()
    assert queued(trained) == before


@pytest.mark.usefixtures("few_states")
def test_a_cancelled_job_is_asked_for_anew(trained: Loop) -> None:
    with pytest.raises(NotReady):
        trained.client.acquire(trained.project.id, 1, mode="explore", wait=0)
    trained.cancel(trained.jobs("propose_explorations")[0].id)
    assert trained.client.round(trained.project.current_round or trained.project.id).status == "current"
    assert trained.acquire(2, mode="explore").strategy == "confident_cycle"
    assert len(trained.jobs("propose_explorations")) == 2


def test_after_a_cancelled_job_other_states_are_drawn_than_before(
    opened: OpenLoop, trained_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("models.exploration.STATES", 20)
    trained = opened(trained_folder, queue_length=10)
    first = trained.acquire(10, mode="explore")
    with pytest.raises(NotReady):
        trained.client.acquire(trained.project.id, 10, mode="explore", wait=0)
    trained.cancel(trained.jobs("propose_explorations")[-1].id)
    second = trained.acquire(10, mode="explore")
    states = [{(item.trajectory, item.start) for item in batch.items} for batch in (first, second)]
    assert len(states[0] | states[1]) > len(states[0]) + 5  # 10 of 600 are hardly ever drawn again


def test_what_was_given_out_is_not_proposed_again_and_in_the_end_there_is_nothing(
    opened: OpenLoop, trained_folder: Path
) -> None:
    trained = opened(trained_folder)
    with trained.worker.database.write() as session:  # a pool of few rooms: every job proposes again for all of them
        first = session.query(MembershipRow.id).filter_by(split="pool").order_by(MembershipRow.id).limit(2)
        session.query(MembershipRow).filter(MembershipRow.id.not_in(first)).update({"segments": 0})
    given: list[Proposal] = []

    def ask_for_all() -> None:
        while True:
            given.extend(proposals(trained.acquire(450, mode="explore")))

    with pytest.raises(Conflict, match=r"all that confident_cycle finds to explore .* has been given out"):
        ask_for_all()
    rooms = {proposal[:2] for proposal in given}
    assert len(given) == len(set(given)) == len(rooms) * 7 > 200
    assert len(trained.jobs("propose_explorations")) == 7 + 1


def test_nor_is_it_from_another_state_that_looks_the_same(
    opened: OpenLoop, trained_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("models.exploration.STATES", 400)  # of 600: others of a room are drawn the second time
    trained = opened(trained_folder)
    given = [item for _ in range(4) for item in trained.acquire(150, mode="explore").items]
    assert len(trained.jobs("propose_explorations")) == 2
    content = {
        name: trained.client.trajectory_content(trained.project.id, name)
        for name in {each.trajectory for each in given}
    }
    seen = [
        (*(content[each.trajectory][name][each.start].tobytes() for name in ("grid", "carried")), str(each.actions))
        for each in given
    ]
    assert len(set(seen)) == len(seen)


def test_what_one_strategy_gave_out_another_does_not(opened: OpenLoop, trained_folder: Path) -> None:
    """Both propose the same: in explore mode `confident_cycle` is `cycle`."""
    trained = opened(trained_folder)
    for strategy in ("confident_cycle", "cycle"):
        with pytest.raises(NotReady):
            trained.client.acquire(trained.project.id, 1, strategy=strategy, mode="explore", wait=0)
    trained.drain()
    first, second = (trained.acquire(100, strategy, mode="explore") for strategy in ("confident_cycle", "cycle"))
    assert (first.strategy, second.strategy) == ("confident_cycle", "cycle")
    assert len({*proposals(first), *proposals(second)}) == 200


def test_a_pool_of_trajectories_too_short_for_a_segment_is_not_explored(trained: Loop) -> None:
    with trained.worker.database.write() as session:
        session.query(MembershipRow).update({"segments": 0})
    with pytest.raises(Conflict, match="no trajectory whose states in minigrid are kept"):
        trained.client.acquire(trained.project.id, 1, mode="explore", wait=0)
    assert not trained.jobs("propose_explorations")

"""Batches under a lease: never the same segment twice, always a free one while there is one, and honest refusals."""

from concurrent.futures import ThreadPoolExecutor
from datetime import datetime
from typing import Any
from uuid import UUID

import numpy as np
import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select

from service import registry, rounds, scorings
from service.registry import TrainedModel
from service.scorings import Ranked
from service.store.queries import acquisitions as acquisition_queries
from service.store.queries import rounds as round_queries
from service.store.tables import JobRow, ProjectRow
from tests.service.conftest import Serve
from tests.service.kit import UNKNOWN, Json, Served, answers, refused, room, segments


def filled(served: Served, trajectories: int = 4, **fields: Any) -> str:
    """A project with five segments a trajectory."""
    project = served.project(**fields)
    served.upload(project, *[room(seed) for seed in range(trajectories)])
    return project


def in_use(served: Served, project: str) -> UUID:
    """A round whose networks and `cycle` queue are in use, without the hours of training; returns the scoring."""
    held = served.services
    with held.database.write() as session:
        row = session.get_one(ProjectRow, UUID(project))
        row.policy = row.policy | {"strategy": "cycle"}
    batch = served.acquire(project, 1, strategy="random")
    assert served.label(project, answers(batch), batch).status_code == 201
    with held.database.write() as session:
        row, now = session.get_one(ProjectRow, UUID(project)), served.clock()
        current = rounds.request(session, row, now)
        for kind in ("inverse_dynamics", "world_model"):
            model = TrainedModel(kind, 0, "grid", {}, "0" * 64, 1, {})
            registry.register(session, row.id, current.id, model, current.watermark, now)
        scoring = scorings.start(session, row, "cycle", current, now, held.limits)
        rounds.begin_training(session, current.id, now)
        rounds.begin_scoring(session, current.id, now)
        rounds.make_current(session, current.id, now)
        for job in session.scalars(select(JobRow).where(JobRow.subject_id.in_([current.id, scoring.id]))):
            job.state = "done"
        return scoring.id


def rank(served: Served, scoring: UUID, ranked: list[tuple[str, int]]) -> None:
    """The scoring's queue, best first; what its jobs would have done is done."""
    with served.services.database.write() as session:
        queue = [Ranked(*segment, -number) for number, segment in enumerate(ranked)]
        scorings.publish(session, scoring, queue, served.clock())


def test_the_first_batch_waits_for_a_scoring(on_both: Served) -> None:
    project = filled(on_both)
    pending = on_both.ask(project, 3, labeler="ada")
    assert pending.status_code == 202
    assert pending.headers["retry-after"] == "1"
    job = on_both.get(pending.headers["location"])
    assert job["id"] == pending.json()["job"]
    assert (job["kind"], job["queue"], job["state"]) == ("score_shard", "score", "queued")
    assert on_both.ask(project, 3).json()["job"] == job["id"]
    on_both.drain()
    given = on_both.ask(project, 3, labeler="ada")
    assert given.status_code == 201
    batch = given.json()
    assert given.headers["location"] == f"/acquisitions/{batch['id']}"
    assert batch["token"] is not None
    assert [item["rank"] for item in batch["items"]] == [0, 1, 2]
    assert {(item["length"], item["labeled"]) for item in batch["items"]} == {(1, False)}
    assert (batch["status"], batch["purpose"], batch["labeler"], batch["round"]) == ("leased", "pool", "ada", None)
    assert on_both.get(given.headers["location"]) == batch | {"token": None}
    refused(on_both.client.get(f"/acquisitions/{UNKNOWN}"), 404, "unknown-resource", UNKNOWN)


def test_a_cold_start_names_the_strategy_that_ranked(served: Served) -> None:
    project = filled(served)
    batch = served.acquire(project)
    assert (batch["strategy"], batch["requested_strategy"]) == ("random", "confident_cycle")
    batch = served.acquire(project, strategy="uncertainty")
    assert (batch["strategy"], batch["requested_strategy"]) == ("random", "uncertainty")


def test_no_segment_is_offered_twice_until_the_pool_is_drained(on_both: Served) -> None:
    project = filled(on_both)
    offered: list[tuple[str, int]] = []
    tokens = []
    for count in (7, 1, 5, 3, 4):
        batch = on_both.acquire(project, count)
        offered += segments(batch)
        tokens.append(batch["token"])
        scores = [item["score"] for item in batch["items"]]
        assert scores == sorted(scores, reverse=True)
    assert len(set(offered)) == len(offered) == 20
    assert tokens == sorted(set(tokens))
    refused(on_both.ask(project, 1), 409, "pool-exhausted", "1 segments", "0 are unlabeled")
    assert on_both.show(project)["counts"]["leased"] == 20


def test_eight_labelers_at_once_get_disjoint_batches(on_both: Served) -> None:
    project = filled(on_both, trajectories=10)
    on_both.acquire(project)

    def take(_: int) -> list[Json]:
        client = TestClient(on_both.app, base_url="http://127.0.0.1", client=("127.0.0.1", 50000))
        given = [client.post("/acquire", json={"project": project, "count": 2}) for _ in range(3)]
        return [answer.json() for answer in given if answer.status_code == 201]

    with ThreadPoolExecutor(8) as threads:
        batches = [batch for taken in threads.map(take, range(8)) for batch in taken]
    offered = [segment for batch in batches for segment in segments(batch)]
    assert len(batches) == 24
    assert len(set(offered)) == len(offered) == 48
    assert len({batch["token"] for batch in batches}) == 24


@pytest.mark.parametrize("seed", range(3))
def test_whatever_labelers_do_what_is_held_or_labeled_is_not_offered(served: Served, seed: int) -> None:
    """Chance acquires, labels, releases, extends and lets time pass; a plain account of it must agree."""
    rng = np.random.default_rng(seed)
    project = filled(served, trajectories=3)
    held: dict[tuple[str, int], Json] = {}
    labeled: set[tuple[str, int]] = set()
    batches: list[Json] = []
    for _ in range(25):
        action = rng.choice(["acquire", "acquire", "label", "label", "release", "extend", "wait"])
        batch = batches[rng.integers(len(batches))] if batches else None
        mine = [segment for segment, holder in held.items() if holder is batch]
        free = 15 - len(labeled) - sum(holder["until"] > served.clock.now for holder in held.values())
        if action == "acquire" and free:
            given = served.acquire(project, int(rng.integers(1, min(free, 4) + 1)), lease_seconds=100)
            given["until"] = datetime.fromisoformat(given["lease_expires_at"])
            taken = {segment for segment, holder in held.items() if holder["until"] > served.clock.now}
            assert not (taken | labeled) & set(segments(given))
            held |= dict.fromkeys(segments(given), given)
            batches.append(given)
        elif action == "wait":
            served.clock.advance(float(rng.integers(10, 60)))
        elif batch and mine and action == "label":
            items = [item for item in answers(batch) if (item["trajectory"], item["start"]) in mine][:2]
            assert served.label(project, items, batch).status_code == 201
            for item in items:
                labeled.add((item["trajectory"], item["start"]))
                del held[item["trajectory"], item["start"]]
        elif batch and mine and action == "release":
            lease = {"token": batch["token"]}
            assert served.client.post(f"/acquisitions/{batch['id']}/release", json=lease).status_code == 200
            for segment in mine:
                del held[segment]
        elif batch and mine and action == "extend":
            lease = {"token": batch["token"], "lease_seconds": 100}
            answer = served.client.post(f"/acquisitions/{batch['id']}/extend", json=lease)
            batch["until"] = datetime.fromisoformat(answer.json()["lease_expires_at"])
        counts = served.show(project)["counts"]
        live = sum(holder["until"] > served.clock.now for holder in held.values())
        assert (counts["labeled"], counts["leased"]) == (len(labeled), live)
        assert counts["unlabeled"] == 15 - len(labeled) - live
    assert labeled


def test_an_expired_lease_gives_its_segments_back_in_the_next_claim_itself(on_both: Served) -> None:
    project = filled(on_both, trajectories=1)
    first = on_both.acquire(project, 5, lease_seconds=60)
    on_both.clock.advance(59)
    refused(on_both.ask(project, 1), 409, "pool-exhausted")
    on_both.clock.advance(1)
    second = on_both.acquire(project, 5, lease_seconds=60)
    assert sorted(segments(second)) == sorted(segments(first))
    assert second["token"] > first["token"]
    assert on_both.get(f"/acquisitions/{first['id']}")["status"] == "expired"
    assert on_both.get(f"/acquisitions/{second['id']}")["status"] == "leased"


def test_a_lease_can_be_extended_by_its_token_alone(served: Served) -> None:
    project = filled(served, trajectories=1)
    batch = served.acquire(project, 5, lease_seconds=60)
    path = f"/acquisitions/{batch['id']}/extend"
    refused(served.client.post(path, json={"token": batch["token"] + 1}), 403, "invalid-lease-token", batch["id"])
    served.clock.advance(30)
    extended = served.client.post(path, json={"token": batch["token"], "lease_seconds": 100}).json()
    assert extended["lease_expires_at"] > batch["lease_expires_at"]
    served.clock.advance(99)
    refused(served.ask(project, 1), 409, "pool-exhausted")
    served.clock.advance(2)
    other = served.acquire(project, 5)
    refused(served.client.post(path, json={"token": batch["token"]}), 410, "lease-lost", batch["id"])
    assert served.get(f"/acquisitions/{other['id']}")["status"] == "leased"
    refused(served.client.post(f"/acquisitions/{UNKNOWN}/extend", json={"token": 1}), 404, "unknown-resource")


def test_an_expired_lease_that_nobody_took_can_be_extended(served: Served) -> None:
    project = filled(served, trajectories=1)
    batch = served.acquire(project, 5, lease_seconds=60)
    served.clock.advance(61)
    other = served.acquire(project, 2)
    path = f"/acquisitions/{batch['id']}/extend"
    revived = served.client.post(path, json={"token": batch["token"], "lease_seconds": 60})
    assert revived.status_code == 200
    assert served.show(project)["counts"]["leased"] == 5
    mine = [item for item in answers(batch) if (item["trajectory"], item["start"]) not in segments(other)]
    assert served.label(project, mine, batch).status_code == 201
    refused(served.label(project, answers(other), batch), 410, "lease-lost")


def test_a_released_batch_is_free_at_once_and_takes_no_more_labels(served: Served) -> None:
    project = filled(served, trajectories=1)
    batch = served.acquire(project, 4)
    assert served.label(project, answers(batch)[:1], batch).status_code == 201
    path = f"/acquisitions/{batch['id']}/release"
    refused(served.client.post(path, json={"token": 0}), 403, "invalid-lease-token", batch["id"])
    released = served.client.post(path, json={"token": batch["token"]}).json()
    assert released["status"] == "released"
    assert [item["labeled"] for item in released["items"]] == [True, False, False, False]
    refused(served.client.post(path, json={"token": batch["token"]}), 410, "lease-lost", "released")
    refused(served.label(project, answers(batch)[1:], batch), 410, "lease-lost")
    assert len(segments(served.acquire(project, 4))) == 4


def test_an_impossible_request_is_refused_by_name(served: Served) -> None:
    project = filled(served)
    refused(served.ask(UNKNOWN), 404, "unknown-resource", UNKNOWN)
    refused(served.ask(project, strategy="psychic"), 422, "unknown-strategy", "psychic", "vanilla_cycle")
    refused(served.ask(project, 0), 422, "malformed-request", "count")
    refused(served.ask(project, purpose="train"), 422, "malformed-request", "purpose", "train")
    refused(served.ask(project, lease_seconds=0), 422, "malformed-request", "lease_seconds")
    refused(served.ask(project, stratgey="random"), 422, "malformed-request", "stratgey")


def test_held_out_batches_are_uniform_over_held_out_segments(served: Served) -> None:
    project = filled(served, trajectories=2, policy={"label_budget": 1})
    (member,) = served.upload(project, room(100, transitions=8), split="held_out")
    drawn = []
    for _ in range(30):
        batch = served.acquire(project, 2, purpose="held_out", lease_seconds=10)
        assert (batch["strategy"], batch["purpose"]) == ("random", "held_out")
        assert {item["score"] for item in batch["items"]} == {None}
        drawn += segments(batch)
        served.clock.advance(10)
    assert set(drawn) == {(member["id"], start) for start in range(8)}
    assert max(drawn.count(segment) for segment in drawn) < 18  # 7.5 expected, 2.4 standard deviation
    batches = [served.acquire(project, count, purpose="held_out") for count in (5, 9)]
    assert [len(batch["items"]) for batch in batches] == [5, 3]
    assert [batch["reason"] for batch in batches] == [None, "9 were asked for, 3 are left in the held_out split"]
    assert len({segment for batch in batches for segment in segments(batch)}) == 8
    assert {served.label(project, answers(batch), batch).status_code for batch in batches} == {201}
    counts, budget = served.show(project)["counts"], served.show(project)["budget"]
    assert (counts["held_out_labeled"], counts["labeled"], budget["spent"]) == (8, 0, 0)
    refused(served.ask(project, 1, purpose="held_out"), 409, "pool-exhausted", "0 are unlabeled")


def test_a_drained_queue_is_selected_again_without_scoring_again(start: Serve) -> None:
    served = start(queue_length=3)
    project = filled(served)
    offered = segments(served.acquire(project, 3))
    pending = served.ask(project, 2)
    assert pending.status_code == 202
    assert served.get(pending.headers["location"])["kind"] == "select_queue"
    assert served.drain() == 1
    offered += segments(served.acquire(project, 3))
    offered += segments(served.acquire(project, 8))
    assert len(set(offered)) == len(offered) == 14
    kinds = [job["kind"] for job in served.get("/jobs", project=project)["items"]]
    assert kinds.count("score_shard") == kinds.count("merge_scores") == 1


def test_the_largest_batch_is_given(on_postgres: Served) -> None:
    project = on_postgres.project()
    on_postgres.upload(project, room(0, transitions=10_000))
    assert len(set(segments(on_postgres.acquire(project, 10_000)))) == 10_000
    refused(on_postgres.ask(project, 10_001), 422, "malformed-request", "count", 10_001)


def test_many_shards_make_one_queue(start: Serve) -> None:
    served = start(shard_transitions=6)
    project = filled(served, trajectories=5)
    assert served.ask(project, 1).status_code == 202
    assert served.drain() == 4
    batch = served.acquire(project, 25)
    assert len(set(segments(batch))) == 25
    scores = [item["score"] for item in batch["items"]]
    assert scores == sorted(scores, reverse=True)
    assert len(set(scores)) == 25


def test_what_joins_the_pool_later_is_offered_too(served: Served) -> None:
    project = filled(served, trajectories=1)
    served.acquire(project, 5)
    (late,) = served.upload(project, room(50))
    assert {trajectory for trajectory, _ in segments(served.acquire(project, 5))} == {late["id"]}


def test_projects_of_equal_seed_and_pool_draw_alike(served: Served) -> None:
    first, second, other = (segments(served.acquire(filled(served, seed=seed), 20)) for seed in (7, 7, 8))
    assert first == second
    assert sorted(first) == sorted(other)
    assert first != other


def test_a_round_in_use_gives_its_own_ranking(served: Served) -> None:
    project = filled(served)
    scoring = in_use(served, project)
    free = sorted(set(segments(served.acquire(project, 19, strategy="random", lease_seconds=1))))
    served.clock.advance(2)
    rank(served, scoring, free[::-1])
    batch = served.acquire(project, 6)
    assert (batch["strategy"], batch["requested_strategy"]) == ("cycle", "cycle")
    assert batch["round"] == served.show(project)["current_round"]
    assert segments(batch) == free[::-1][:6]


def test_a_pool_that_outgrows_a_round_is_scored_again_when_the_old_ranking_is_spent(served: Served) -> None:
    project = filled(served, trajectories=1)
    scoring = in_use(served, project)
    free = segments(served.acquire(project, 4, strategy="random", lease_seconds=1))
    served.clock.advance(2)
    rank(served, scoring, free)
    (late,) = served.upload(project, room(50))
    assert segments(served.acquire(project, 4)) == free
    pending = served.ask(project, 3)
    assert pending.status_code == 202
    job = served.get(pending.headers["location"])
    assert job["kind"] == "score_shard"  # to select again from the old scores would find nothing, for ever
    with served.services.database.read() as session:
        current = round_queries.current_round(session, UUID(project))
        assert current is not None
        newest = acquisition_queries.newest_scoring(session, UUID(project), "cycle", current.id)
    assert newest is not None
    assert newest.id != scoring
    rank(served, newest.id, [(late["id"], start) for start in range(5)])
    assert segments(served.acquire(project, 3)) == [(late["id"], start) for start in range(3)]

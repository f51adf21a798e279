"""Chance acquires, explores, extends, releases, answers, repeats, lets time pass; a model of the rules must agree."""

import base64
import os
from datetime import datetime, timedelta
from random import randrange
from typing import ClassVar
from uuid import UUID

import numpy as np
import pytest
from httpx2 import Response
from hypothesis import HealthCheck, Phase, seed, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    Bundle,
    MultipleResults,
    RuleBasedStateMachine,
    get_state_machine_test,
    initialize,
    invariant,
    multiple,
    precondition,
    rule,
)
from sqlalchemy import select

from service import leases as lease_rules
from service.store import codec
from service.store.tables import ClaimRow
from tests.figures import Figures
from tests.service.kit import Arrays, Json, Served, npz, refused
from tests.service.rules_model import WRONG_TOKEN, Actions, Lease, Refused, Rules, Segment

LENGTH, STRIDE, CHOICES = 2, 3, 3
POLE: Json = {
    "spaces": {
        "observations": {"angle": {"dtype": "float32", "shape": [1]}},
        "actions": {"kind": "discrete", "n": CHOICES},
    }
}
leased, explored = Bundle[Lease]("leased"), Bundle[Lease]("explored")
kinds = st.sampled_from(("pool", "pool", "held_out"))
picks = st.lists(st.integers(0, 9), min_size=1, max_size=4)
acts = st.sampled_from(((0, 0), (0, 0), (0, 0), (1, 2)))
seconds = st.sampled_from((20, 60))


def pole(number: int, transitions: int) -> Arrays:
    """A trajectory of its own for every number."""
    return {"angle": np.random.default_rng(number).normal(size=(transitions + 1, 1)).astype(np.float32)}


class RulesMachine(RuleBasedStateMachine):
    """One project of a service; `model` is what it must be like."""

    served: ClassVar[Served]

    @initialize(budget=st.sampled_from((None, 5, 12)), held_out=st.booleans())
    def begin(self, budget: int | None, held_out: bool) -> None:
        policy = {"label_budget": budget, "strategy": "random"}
        self.project = self.served.project(environment=POLE, segment_length=LENGTH, stride=STRIDE, policy=policy)
        self.model, self.given = Rules(budget), list[Lease]()
        self.uploads, self.keys = 0, 0
        self.kept: list[tuple[str, Json, str, Response]] = []
        self.used = 0
        self.upload("pool")
        if held_out:
            self.upload("held_out")

    @property
    def now(self) -> datetime:
        return self.served.clock.now

    @rule(split=st.sampled_from(("pool", "pool", "held_out")))
    def upload(self, split: str) -> None:
        self.uploads += 1
        (receipt,) = self.served.upload(self.project, pole(self.uploads, 10), split=split)
        assert receipt["status"] == "created"
        segments: set[Segment] = {(receipt["id"], start) for start in (0, 3, 6)}
        (self.model.pool if split == "pool" else self.model.held_out).update(segments)

    @rule(target=leased, kind=kinds, count=st.integers(1, 4), seconds=seconds, keyed=st.booleans())
    def acquire(self, kind: str, count: int, seconds: int, keyed: bool) -> Lease | MultipleResults[Lease]:
        return self._acquire(kind, count, seconds, keyed)

    @rule(targets=(leased, explored), count=st.integers(1, 3), seconds=seconds, keyed=st.booleans())
    def explore(self, count: int, seconds: int, keyed: bool) -> Lease | MultipleResults[Lease]:
        return self._acquire("explore", count, seconds, keyed)

    @precondition(lambda self: any(lease.kind != "explore" for lease in self.given))
    @rule(keyed=st.booleans())
    def label_the_newest(self, keyed: bool) -> None:
        """What a labeler does that is neither late nor lost, as a rule."""
        lease = next(lease for lease in reversed(self.given) if lease.kind != "explore")
        self._label(lease, lease.items, (0, 0), keyed)

    @rule(lease=leased, picks=picks, actions=acts, keyed=st.booleans())
    def label(self, lease: Lease, picks: list[int], actions: Actions, keyed: bool) -> None:
        """Some of a batch, in time or late; of an exploration only the state, which the lease does not hold."""
        self._label(lease, [lease.items[pick % len(lease.items)] for pick in picks], actions, keyed)

    @rule(lease=leased, actions=acts)
    def label_all(self, lease: Lease, actions: Actions) -> None:
        self._label(lease, lease.items, actions)

    @rule(picks=picks, actions=acts)
    def label_without_a_lease(self, picks: list[int], actions: Actions) -> None:
        everything = sorted(self.model.pool | self.model.held_out)
        self._label(None, [everything[7 * pick % len(everything)] for pick in picks], actions)

    @rule(lease=leased, other=leased)
    def label_what_another_was_given(self, lease: Lease, other: Lease) -> None:
        self._label(lease, other.items[:2], (0, 0))

    @rule(lease=explored, rank=st.integers(0, 3), made=st.integers(0, 6), actions=acts, keyed=st.booleans())
    def answer(self, lease: Lease, rank: int, made: int, actions: Actions, keyed: bool) -> None:
        content = pole(1000 + made, LENGTH)
        trajectory = {"content": base64.b64encode(npz(content)).decode(), "actions": actions, "rank": rank}
        body = {"project": self.project, "acquisition": lease.id, "token": lease.token, "trajectories": [trajectory]}
        answer = self._post("/labels", body, keyed)
        name = answer.json()["receipts"][0]["trajectory"] if answer.status_code == 201 else codec.content_id(content)
        assert name == codec.content_id(content)
        self._receipts(answer, self.model.answer(lease, rank, name, actions, self.now))

    @rule(lease=leased, seconds=seconds)
    def extend(self, lease: Lease, seconds: int) -> None:
        answer = self._post(f"/acquisitions/{lease.id}/extend", {"token": lease.token, "lease_seconds": seconds})
        expected = self.model.extend(lease, self.now + timedelta(seconds=seconds), self.now)
        if expected:
            self._refused(answer, expected)
        else:
            assert answer.status_code == 200, answer.text
            lease.until = datetime.fromisoformat(answer.json()["lease_expires_at"])

    @rule(lease=leased)
    def release(self, lease: Lease) -> None:
        answer = self._post(f"/acquisitions/{lease.id}/release", {"token": lease.token})
        expected = self.model.release(lease)
        if expected:
            self._refused(answer, expected)
        else:
            assert answer.status_code == 200, answer.text

    @rule(lease=leased, change=st.sampled_from((-1, 1)))
    def use_a_wrong_token(self, lease: Lease, change: int) -> None:
        token = lease.token + change
        body = self._items(lease.items, (0, 0)) | {"acquisition": lease.id, "token": token}
        self._refused(self._post("/labels", body), WRONG_TOKEN)
        for what in ("extend", "release"):
            self._refused(self._post(f"/acquisitions/{lease.id}/{what}", {"token": token}), WRONG_TOKEN)

    @rule(lease=leased, rank=st.integers(0, 3))
    def answer_no_exploration(self, lease: Lease, rank: int) -> None:
        if lease.kind != "explore":
            self.answer(lease, rank, 0, (0, 0), keyed=False)

    @rule(passed=st.sampled_from((1, 21, 61)), swept=st.booleans())
    def wait(self, passed: int, swept: bool) -> None:
        self.served.clock.advance(passed)
        if swept:
            with self.served.services.database.write() as session:
                lease_rules.note_expired(session, self.now)

    @rule(total=st.sampled_from((None, 2, 5, 12)))
    def change_the_budget(self, total: int | None) -> None:
        answer = self.served.client.patch(f"/projects/{self.project}", json={"label_budget": total})
        assert answer.status_code == 200, answer.text
        self.model.budget = total
        self.used = self.model.used(self.now)

    @precondition(lambda self: bool(self.kept))
    @rule(which=st.integers(0, 9))
    def repeat(self, which: int) -> None:
        """The same request under the same key, whatever has happened since; and another one."""
        path, body, key, first = self.kept[which % len(self.kept)]
        again = self.served.client.post(path, json=body, headers={"Idempotency-Key": key})
        assert (again.status_code, again.content) == (first.status_code, first.content)
        assert again.headers.get("location") == first.headers.get("location")
        assert again.headers["idempotency-replayed"] == "true"
        other = body | ({"count": body["count"] + 1} if path == "/acquire" else {"source": {"name": "another"}})
        answer = self.served.client.post(path, json=other, headers={"Idempotency-Key": key})
        refused(answer, 422, "idempotency-key-reused", key)

    @invariant()
    def project_is_what_the_model_says(self) -> None:
        if not hasattr(self, "model"):
            return
        model, now, shown = self.model, self.now, self.served.show(self.project)
        counts, budget = shown["counts"], shown["budget"]
        held = sum(lease.kind == "pool" for lease in model.held_now(now).values())
        labeled = model.spent()
        assert (counts["pool_segments"], counts["leased"], counts["labeled"]) == (len(model.pool), held, labeled)
        assert counts["unlabeled"] + held + labeled == len(model.pool)
        tested = len(model.labels.keys() & model.held_out)
        assert (counts["held_out_segments"], counts["held_out_labeled"]) == (len(model.held_out), tested)
        left = None if model.budget is None else max(0, model.budget - model.used(now))
        expected = {"total": model.budget, "spent": labeled, "reserved": model.reserved(now), "remaining": left}
        assert budget == expected
        assert shown["label_watermark"] == len(model.labels)

    @invariant()
    def the_budget_holds(self) -> None:
        """Where it was lowered below what was used, use may only fall."""
        if hasattr(self, "model") and self.model.budget is not None:
            used = self.model.used(self.now)
            assert used <= max(self.model.budget, self.used)
            self.used = used

    @invariant()
    def labels_are_those_that_were_acknowledged(self) -> None:
        if hasattr(self, "model"):
            rows = self.served.get("/labels", project=self.project, limit=1000)["items"]
            stored = [((row["trajectory"], row["start"]), tuple(row["actions"])) for row in rows]
            assert stored == list(self.model.labels.items())
            assert [row["watermark"] for row in rows] == list(range(1, len(rows) + 1))

    @invariant()
    def nobody_holds_what_the_model_gives_to_another(self) -> None:
        if not hasattr(self, "model"):
            return
        live = select(ClaimRow).where(ClaimRow.project_id == UUID(self.project), ClaimRow.expires_at > self.now)
        with self.served.services.database.read() as session:
            claims = {(row.trajectory_id, row.start): str(row.acquisition_id) for row in session.scalars(live)}
        held = self.model.held_now(self.now).items()
        assert claims == {_claimed(lease, place): lease.id for place, lease in held}
        assert len({lease.token for lease in self.given}) == len(self.given)

    def teardown(self) -> None:
        for lease in getattr(self, "given", []):
            shown = self.served.get(f"/acquisitions/{lease.id}")
            assert shown["status"] == self.model.shown_status(lease, self.now)
            assert [item["labeled"] for item in shown["items"]] == self.model.labeled(lease)
            assert [(item["trajectory"], item["start"]) for item in shown["items"]] == lease.items

    def _acquire(self, kind: str, count: int, seconds: int, keyed: bool) -> Lease | MultipleResults[Lease]:
        fields: Json = {"mode": "explore"} if kind == "explore" else {"purpose": kind}
        body = {"project": self.project, "count": count, "lease_seconds": seconds} | fields
        answer = self._post("/acquire", body, keyed)
        expected = self.model.room(kind, count, self.now)
        if isinstance(expected, Refused):
            self._refused(answer, expected)
            return multiple()
        batch = self._given(answer, kind, count, expected)
        lease = Lease(
            batch["id"],
            batch["token"],
            kind,
            datetime.fromisoformat(batch["lease_expires_at"]),
            [(item["trajectory"], item["start"]) for item in batch["items"]],
        )
        self.model.give(lease)
        self.given.append(lease)
        return lease

    def _given(self, answer: Response, kind: str, count: int, expected: int) -> Json:
        """The batch, checked: as many items as there is room for, all free; or states of the pool and their actions."""
        assert answer.status_code == 201, answer.text
        batch: Json = answer.json()
        items = [(item["trajectory"], item["start"]) for item in batch["items"]]
        assert len(items) == expected
        assert (batch["reason"] is None) == (expected == count)
        assert batch["status"] == "leased"
        if kind == "explore":
            assert set(items) <= self.model.pool
            assert all(len(item["actions"]) == LENGTH for item in batch["items"])
            assert {action for item in batch["items"] for action in item["actions"]} <= set(range(CHOICES))
        else:
            assert len(set(items)) == len(items)
            assert set(items) <= self.model.free(kind, self.now)
            assert {item["actions"] for item in batch["items"]} == {None}
        return batch

    def _label(self, lease: Lease | None, segments: list[Segment], actions: Actions, keyed: bool = False) -> None:
        owner = {"acquisition": lease.id, "token": lease.token} if lease else {}
        answer = self._post("/labels", self._items(segments, actions) | owner, keyed)
        expected = self.model.label(lease, [(segment, actions) for segment in segments], self.now)
        self._receipts(answer, expected, actions)

    def _receipts(self, answer: Response, expected: list[str] | Refused, actions: Actions | None = None) -> None:
        if isinstance(expected, Refused):
            words = [list(actions)] if actions and expected.kind == "label-conflict" else []
            self._refused(answer, expected, *words)
            return
        assert answer.status_code == 201, answer.text
        assert [receipt["status"] for receipt in answer.json()["receipts"]] == expected
        assert answer.json()["created"] == expected.count("created")
        assert answer.json()["watermark"] == len(self.model.labels)

    def _items(self, segments: list[Segment], actions: Actions) -> Json:
        items = [{"trajectory": name, "start": start, "actions": actions} for name, start in segments]
        return {"project": self.project, "items": items}

    def _post(self, path: str, body: Json, keyed: bool = False) -> Response:
        """The answer, after the scoring that it may have to wait for."""
        self.keys += keyed
        headers = {"Idempotency-Key": f"{self.project} {self.keys}"} if keyed else {}
        answer = self.served.client.post(path, json=body, headers=headers)
        for _ in range(3):
            if answer.status_code == 202:
                self.served.drain()
                answer = self.served.client.post(path, json=body, headers=headers)
        assert "idempotency-replayed" not in answer.headers
        if keyed and answer.status_code == 201:
            self.kept.append((path, body, headers["Idempotency-Key"], answer))
        return answer

    def _refused(self, answer: Response, expected: Refused, *words: object) -> None:
        refused(answer, expected.status, expected.kind, *words)


def _claimed(lease: Lease, place: tuple[str, int]) -> tuple[str, int]:
    """The place as its claim names it."""
    if lease.kind != "explore":
        return place
    return lease_rules.exploration_name(UUID(lease.id)), place[1]


def check(served: Served, examples: int, steps: int, value: int) -> None:
    """Run the machine this often, from this seed. A failure is shown as it was found: to shrink it takes minutes."""
    machine = type("Rules", (RulesMachine,), {"served": served})
    bounds = settings(
        max_examples=examples,
        stateful_step_count=steps,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    seed(value)(get_state_machine_test(machine, settings=bounds))()


def test_whatever_happens_the_rules_hold_on_sqlite(served: Served) -> None:
    check(served, 25, 25, 0)


def test_whatever_happens_the_rules_hold_on_postgresql(on_postgres: Served) -> None:
    check(on_postgres, 10, 25, 1)


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_the_rules_hold_in_many_more_runs(on_both: Served, figures: Figures) -> None:
    value = int(os.environ.get("ASIM_TEST_SEED") or randrange(2**32))
    figures.note(f"ASIM_TEST_SEED={value}")
    check(on_both, 2 * int(os.environ.get("REPEAT", "50")), 40, value)

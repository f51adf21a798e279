"""The rules of leases, labels and budget in plain Python: what the service must answer, without a database.

A place is what a lease holds: a segment, or an exploration by its acquisition and rank.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime

Segment = tuple[str, int]
Place = tuple[str, int]
Actions = tuple[int, ...]


@dataclass(frozen=True)
class Refused:
    """A refusal: HTTP status and kind of problem."""

    status: int
    kind: str


POOL_EXHAUSTED = Refused(409, "pool-exhausted")
BUDGET_EXHAUSTED = Refused(409, "budget-exhausted")
WRONG_TOKEN = Refused(403, "invalid-lease-token")
LEASE_LOST = Refused(410, "lease-lost")
LEASED_TO_ANOTHER = Refused(423, "segment-leased")
CONFLICT = Refused(409, "label-conflict")
NO_SUCH_RANK = Refused(422, "invalid-field")


@dataclass(eq=False)
class Lease:
    """An acquisition. kind: pool, held_out or explore. answers: by rank, the trajectory that came of an exploration."""

    id: str
    token: int
    kind: str
    until: datetime
    items: list[Segment]
    status: str = "leased"
    answers: dict[int, str] = field(default_factory=dict)

    def places(self) -> list[Place]:
        """What it was given, in the order of the ranks."""
        return [(self.id, rank) for rank in range(len(self.items))] if self.kind == "explore" else list(self.items)


@dataclass
class Rules:
    """One project. Labels are in the order of their watermarks; a holder stays when its lease has expired."""

    budget: int | None
    pool: set[Segment] = field(default_factory=set)
    held_out: set[Segment] = field(default_factory=set)
    labels: dict[Segment, Actions] = field(default_factory=dict)
    holders: dict[Place, Lease] = field(default_factory=dict)

    def live(self, place: Place, now: datetime) -> bool:
        """A lease on the place has not expired."""
        return place in self.holders and self.holders[place].until > now

    def free(self, kind: str, now: datetime) -> set[Segment]:
        """Segments that a batch may be made of."""
        split = self.held_out if kind == "held_out" else self.pool
        return {segment for segment in split if segment not in self.labels and not self.live(segment, now)}

    def spent(self) -> int:
        return len(self.labels.keys() & self.pool)

    def reserved(self, now: datetime) -> int:
        return sum(lease.kind != "held_out" for lease in self.held_now(now).values())

    def held_now(self, now: datetime) -> dict[Place, Lease]:
        """Who holds what under a live lease."""
        return {place: lease for place, lease in self.holders.items() if lease.until > now}

    def used(self, now: datetime) -> int:
        return self.spent() + self.reserved(now)

    def room(self, kind: str, count: int, now: datetime) -> int | Refused:
        """How many items an acquisition of `count` gets."""
        if kind != "explore":
            count = min(count, len(self.free(kind, now)))
            if count == 0:
                return POOL_EXHAUSTED
        if kind == "held_out" or self.budget is None:
            return count
        left = max(0, self.budget - self.used(now))
        return min(count, left) if left else BUDGET_EXHAUSTED

    def give(self, lease: Lease) -> None:
        """The lease takes its places, from expired ones where there are any."""
        self.holders |= dict.fromkeys(lease.places(), lease)

    def extend(self, lease: Lease, until: datetime, now: datetime) -> Refused | None:
        held = [place for place, holder in self.holders.items() if holder is lease]
        if lease.status != "leased" or not held:
            return LEASE_LOST
        revived = lease.until <= now and lease.kind != "held_out"
        if revived and self.budget is not None and self.used(now) + len(held) > self.budget:
            return BUDGET_EXHAUSTED
        lease.until = until
        return None

    def release(self, lease: Lease) -> Refused | None:
        if lease.status != "leased":
            return LEASE_LOST
        self.holders = {place: holder for place, holder in self.holders.items() if holder is not lease}
        lease.status = "released"
        return None

    def label(
        self, lease: Lease | None, items: Sequence[tuple[Segment, Actions]], now: datetime
    ) -> list[str] | Refused:
        """Receipts' statuses; all items are taken or none."""
        fresh: dict[Segment, Actions] = {}
        for segment, actions in items:
            known = self.labels.get(segment) or fresh.get(segment)
            refused = self._why_not(lease, segment, now) if known is None else CONFLICT if known != actions else None
            if refused:
                return refused
            fresh |= {} if known else {segment: actions}
        covered = sum(self._covers(lease, segment, now) for segment in fresh)
        if not self._affords(len(fresh.keys() & self.pool) - covered, now):
            return BUDGET_EXHAUSTED
        self._store(lease, fresh)
        created = iter(list(fresh))
        first = next(created, None)
        receipts = []
        for segment, _ in items:
            receipts.append("created" if segment == first else "duplicate")
            first = next(created, None) if segment == first else first
        return receipts

    def answer(self, lease: Lease, rank: int, trajectory: str, actions: Actions, now: datetime) -> list[str] | Refused:
        """A trajectory of one segment comes of an exploration, and joins the pool with its label."""
        place, segment = (lease.id, rank), (trajectory, 0)
        if lease.kind != "explore" or rank >= len(lease.items):
            return NO_SUCH_RANK
        if lease.answers.get(rank) != trajectory and place not in self.holders:
            return LEASE_LOST
        known = self.labels.get(segment)
        if known not in (None, actions):
            return CONFLICT
        if not self._affords((known is None) - self.live(place, now), now):
            return BUDGET_EXHAUSTED
        if lease.answers.get(rank) != trajectory:
            lease.answers[rank] = trajectory
            del self.holders[place]
        self.pool.add(segment)
        self._store(lease, {} if known else {segment: actions})
        return ["duplicate" if known else "created"]

    def shown_status(self, lease: Lease, now: datetime) -> str:
        return "expired" if lease.status == "leased" and lease.until <= now else lease.status

    def labeled(self, lease: Lease) -> list[bool]:
        """Of each item, whether it is answered, by whomever."""
        if lease.kind == "explore":
            return [rank in lease.answers for rank in range(len(lease.items))]
        return [segment in self.labels for segment in lease.items]

    def _why_not(self, lease: Lease | None, segment: Segment, now: datetime) -> Refused | None:
        holds = lease is not None and self.holders.get(segment) is lease
        if lease is not None and not holds:
            return LEASE_LOST
        return LEASED_TO_ANOTHER if self.live(segment, now) and not holds else None

    def _covers(self, lease: Lease | None, segment: Segment, now: datetime) -> bool:
        return segment in self.pool and lease is not None and self.live(segment, now)

    def _affords(self, unreserved: int, now: datetime) -> bool:
        """What a live lease had reserved needs no room; the budget may have been lowered since."""
        return unreserved <= 0 or self.budget is None or self.used(now) + unreserved <= self.budget

    def _store(self, lease: Lease | None, fresh: dict[Segment, Actions]) -> None:
        self.labels |= fresh
        self.holders = {place: holder for place, holder in self.holders.items() if place not in fresh}
        if lease is not None and lease.status == "leased" and all(self.labeled(lease)):
            lease.status = "labeled"

"""The pool: trajectories and their membership in a project."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from numpy.typing import NDArray
from sqlalchemy.orm import Session

from api_schemas.environments import Spaces, Stream
from api_schemas.trajectories import SplitChoice, Trajectory, TrajectoryReceipt
from service import events, streams
from service.errors import ServiceError, UnknownResource
from service.store import codec
from service.store.blobs import Blobs
from service.store.queries import pool as queries
from service.store.tables import MembershipRow, ProjectRow, TrajectoryRow


class SplitConflict(ServiceError):
    """The trajectory is in the other split of this project."""

    status_code = 409

    def __init__(self, trajectory: str, split: str, asked: str) -> None:
        super().__init__(f"split: trajectory {trajectory} is in the split {split!r} of this project, not in {asked!r}")


class NoProvenance(ServiceError):
    """No simulator states are kept for this trajectory, or not in reach of this process."""

    status_code = 404

    def __init__(self, trajectory: str) -> None:
        super().__init__(f"trajectory {trajectory} has no provenance here")


@dataclass(frozen=True)
class StoredTrajectory:
    """A trajectory whose blob is written; no row refers to it yet."""

    id: str
    blob_sha256: str
    transitions: int
    streams: dict[str, object]
    bytes: int
    source: str


def store(blobs: Blobs, spaces: Spaces, arrays: Mapping[str, NDArray[Any]], source: str) -> StoredTrajectory:
    """Check a trajectory against the spaces and write its blob, outside any transaction. Raises InvalidTrajectory.

    arrays: one a stream, (T + 1, ...), T >= 1.
    """
    streams.check(spaces, arrays, source)
    return write(blobs, spaces, arrays, source)


def write(blobs: Blobs, spaces: Spaces, arrays: Mapping[str, NDArray[Any]], source: str) -> StoredTrajectory:
    """Write the blob of a trajectory that was checked."""
    data = codec.encode(arrays)
    told: dict[str, object] = {name: spec.model_dump(mode="json") for name, spec in spaces.observations.items()}
    transitions = len(next(iter(arrays.values()))) - 1
    sha256 = blobs.put("trajectories", data)
    return StoredTrajectory(codec.content_id(arrays), sha256, transitions, told, len(data), source)


def keep(session: Session, stored: Sequence[StoredTrajectory], now: datetime) -> None:
    """Write the contents' rows, before any project is locked and in one order for all: two projects that are given the
    same trajectories at the same time wait for each other once, and never both at once."""
    known = queries.contents(session, [each.id for each in stored])
    fresh = {each.id: _trajectory_row(each, now) for each in stored if each.id not in known}
    queries.keep_contents(session, [fresh[name] for name in sorted(fresh)])


def add(
    session: Session,
    project: ProjectRow,
    stored: StoredTrajectory,
    split: SplitChoice,
    now: datetime,
    provenance_sha256: str | None = None,
) -> TrajectoryReceipt:
    """Make one trajectory a member; see `add_all`."""
    return add_all(session, project, [(stored, provenance_sha256)], split, now)[0]


def add_all(
    session: Session,
    project: ProjectRow,
    stored: Sequence[tuple[StoredTrajectory, str | None]],
    split: SplitChoice,
    now: datetime,
) -> list[TrajectoryReceipt]:
    """Make trajectories, each with its provenance if any, members of the locked project; their contents are kept.

    The same content twice is one. Raises SplitConflict.
    """
    known = queries.membership_rows(session, project.id, [each.id for each, _ in stored])
    receipts = []
    for each, provenance_sha256 in stored:
        member = known.get(each.id)
        if member is None:
            known[each.id] = member = _join(session, project, each, split, now)
            status = "created"
        else:
            status = "duplicate"
        if split not in ("auto", member.split):
            raise SplitConflict(each.id, member.split, split)
        member.provenance_sha256 = member.provenance_sha256 or provenance_sha256
        receipts.append(_receipt(each, member, status))
    session.flush()
    return receipts


def content_split(trajectory_id: str, held_out_fraction: float) -> str:
    """The split that a trajectory's hash decides."""
    return "held_out" if int(trajectory_id[:12], 16) / 16**12 < held_out_fraction else "pool"


def segment_count(transitions: int, length: int, stride: int) -> int:
    """How many windows of `length` transitions, `stride` apart, fit."""
    return 0 if transitions < length else (transitions - length) // stride + 1


def find(session: Session, project: ProjectRow, trajectory_id: str) -> tuple[MembershipRow, TrajectoryRow]:
    """Membership and content of a trajectory of this project. Raises UnknownResource."""
    member = queries.membership(session, project.id, trajectory_id)
    content = None if member is None else session.get(TrajectoryRow, trajectory_id)
    if member is None or content is None:
        raise UnknownResource(f"trajectory in project {project.id}", trajectory_id)
    return member, content


def describe(member: MembershipRow, content: TrajectoryRow, labeled: int) -> Trajectory:
    """The trajectory as the API shows it."""
    return Trajectory(
        id=content.id,
        project=member.project_id,
        split=member.split,  # type: ignore[arg-type]  # pydantic checks the literal
        transitions=content.transitions,
        segments=member.segments,
        labeled=labeled,
        streams={name: Stream.model_validate(spec) for name, spec in content.streams.items()},
        bytes=content.bytes,
        has_provenance=member.provenance_sha256 is not None,
        created_at=member.created_at,
    )


def _join(
    session: Session, project: ProjectRow, stored: StoredTrajectory, split: SplitChoice, now: datetime
) -> MembershipRow:
    """A new member, counted in its split."""
    member = MembershipRow(
        project_id=project.id,
        trajectory_id=stored.id,
        split=content_split(stored.id, project.held_out_fraction) if split == "auto" else split,
        segments=segment_count(stored.transitions, project.segment_length, project.stride),
        created_at=now,
    )
    session.add(member)
    if member.split == "pool":
        project.pool_trajectories += 1
        project.pool_segments += member.segments
    else:
        project.held_out_trajectories += 1
        project.held_out_segments += member.segments
    events.record(session, project.id, "trajectory.added", {"trajectory": stored.id, "split": member.split}, now)
    return member


def _trajectory_row(stored: StoredTrajectory, now: datetime) -> TrajectoryRow:
    return TrajectoryRow(
        id=stored.id,
        blob_sha256=stored.blob_sha256,
        transitions=stored.transitions,
        streams=stored.streams,
        bytes=stored.bytes,
        created_at=now,
    )


def _receipt(stored: StoredTrajectory, member: MembershipRow, status: str) -> TrajectoryReceipt:
    return TrajectoryReceipt.model_validate(
        {
            "id": stored.id,
            "source": stored.source,
            "status": status,
            "split": member.split,
            "transitions": stored.transitions,
        }
    )

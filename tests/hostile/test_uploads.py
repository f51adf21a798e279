"""What strangers upload is refused with its fault named, in little memory, and leaves nothing behind."""

import os
from collections import Counter
from pathlib import Path

import httpx
import pytest
from sqlalchemy import func, select

from api_schemas.errors import PROBLEM_JSON, Problem
from service.store.columns import Row
from service.store.database import open_database
from tests.figures import Figures
from tests.hostile.conftest import Exposed
from tests.hostile.malformed import LARGE_BYTES, Malformed, large_room, malformed, valid
from tests.service.kit import npz

UPLOADS = 200
MEBIBYTE = 2**20
MOST_MEMORY = 300  # MiB above idle
SEED = int(os.environ.get("ASIM_TEST_SEED", "1"))


@pytest.mark.timeout(600)
def test_malformed_uploads_are_refused_in_little_memory_and_leave_nothing(exposed: Exposed, figures: Figures) -> None:
    with httpx.Client(base_url=exposed.url, headers=exposed.keys["admin"], timeout=60) as client:
        _upload_valid(client, exposed)
        before, files, idle = _rows(exposed), _files(exposed), _memory(exposed.api.pid, "VmRSS")
        _forget_peak(exposed.api.pid)
        refused = Counter(_refused(client, exposed, each) for each in malformed(SEED, UPLOADS))
        peak = _memory(exposed.api.pid, "VmHWM")
        left = _rows(exposed), _files(exposed)
        _upload_large(client, exposed)
        assert _memory(exposed.api.pid, "VmHWM") > idle + LARGE_BYTES, "the measure does not see what is unpacked"
    assert sum(refused.values()) == UPLOADS
    assert min(refused.values()) == UPLOADS // 8, refused
    assert left == (before, files)
    figures.add("memory above idle", (peak - idle) / MEBIBYTE, "MiB", target=MOST_MEMORY, better="below")
    figures.note(f"ASIM_TEST_SEED={SEED}: {dict(refused)}")


def _refused(client: httpx.Client, exposed: Exposed, each: Malformed) -> str:
    """Its kind, once it is refused as it should be."""
    answer = _send(client, exposed, each)
    assert 400 <= answer.status_code < 500, (each.kind, answer.status_code, answer.text[:500])
    assert answer.headers["content-type"] == PROBLEM_JSON, each.kind
    detail = Problem.model_validate(answer.json()).detail
    assert len(detail) < 5000, (each.kind, len(detail))
    assert any(word in detail for word in each.words), (each.kind, each.words, detail[:500])
    return each.kind


def _send(client: httpx.Client, exposed: Exposed, each: Malformed) -> httpx.Response:
    project = exposed.robot if each.of_robot else exposed.things["project"]
    if each.path is not None:
        body = each.body.replace(b"PROJECT", project.encode())
        return client.post(each.path, content=body, headers={"Content-Type": "application/json"})
    files = [("files", ("../../upload.npz", each.body))]
    if len(each.body) % 2:  # behind one that is whole
        whole = valid(len(each.body))[each.of_robot]
        files.insert(0, ("files", ("whole.npz", npz(whole))))
    return client.post("/trajectories", params={"project": project}, files=files)


def _upload_valid(client: httpx.Client, exposed: Exposed) -> None:
    for project, arrays in zip((exposed.things["project"], exposed.robot), valid(7), strict=True):
        files = {"files": ("whole.npz", npz(arrays))}
        assert client.post("/trajectories", params={"project": project}, files=files).status_code == 201


def _upload_large(client: httpx.Client, exposed: Exposed) -> None:
    files = {"files": ("large.npz", large_room())}
    assert client.post("/trajectories", params={"project": exposed.things["project"]}, files=files).status_code == 201


def _rows(exposed: Exposed) -> dict[str, int]:
    database = open_database(exposed.database_url)
    try:
        with database.read() as session:
            tables = Row.metadata.sorted_tables
            return {table.name: session.scalar(select(func.count()).select_from(table)) or 0 for table in tables}
    finally:
        database.close()


def _files(exposed: Exposed) -> list[Path]:
    return sorted(path for path in exposed.folder.rglob("*") if path.is_file())


def _memory(pid: int, name: str) -> int:
    """Bytes: VmRSS is held now, VmHWM was at the peak."""
    (line,) = [line for line in Path(f"/proc/{pid}/status").read_text().splitlines() if line.startswith(name)]
    return int(line.split()[1]) * 1024


def _forget_peak(pid: int) -> None:
    Path(f"/proc/{pid}/clear_refs").write_text("5")

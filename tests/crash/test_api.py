"""An API that is killed between its commit and its answer, and what clients may rely on. Crash tests 5 and 9 to 12."""

import itertools
import random
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar
from uuid import UUID, uuid4

import httpx
import numpy as np
import pytest
from sqlalchemy import func, select

from service.store.tables import AcquisitionRow, EventRow
from tests.crash.conftest import REPEAT, Deploy, Prepared
from tests.crash.deployment import Deployment
from tests.crash.hammer import Hammer, Labelers, ask_again
from tests.figures import Figures
from tests.loop.rows import Segment

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]
PARALLEL = 20
CLIENTS, SEGMENTS, BATCH = 16, 1000, 5
Result = TypeVar("Result")


def test_5_an_answer_that_a_kill_has_swallowed_is_given_again(
    deploy: Deploy, prepared: Prepared, figures: Figures, chance: random.Random
) -> None:
    deployment = deploy()
    names = {each.id: each.name for each in deployment.client.projects()}
    before = _counts(deployment)
    hammers = [
        Hammer(deployment.url, deployment.key, project, pause=0.05, seed=seed)
        for seed, project in enumerate([*names, *names])  # two rivals a project
    ]
    for hammer in hammers:
        hammer.start()
    began = time.monotonic()
    for _ in range(REPEAT):
        time.sleep(chance.uniform(0.0, 1.0))
        deployment.api.end(signal.SIGKILL)
        deployment.start_api()
        deployment.check_rows()
    seconds = (time.monotonic() - began) / REPEAT
    for hammer in hammers:
        hammer.finish()
    acquired, labeled = (sum(_answers(hammer, path) for hammer in hammers) for path in ("/acquire", "/labels"))
    after = _counts(deployment)
    assert after == (before[0] + acquired, before[1] + labeled), "rows that nobody was told of, or that are lost"
    for hammer in hammers:
        ask_again(deployment.url, deployment.key, hammer.labelers.answers[-40:])
    assert _counts(deployment) == after
    told = _told(prepared, names, hammers)
    deployment.check(told)
    figures.add("kills of the API", REPEAT, f"at {seconds:.1f} s each")
    figures.add("requests answered", acquired + labeled, "answers")
    figures.add("requests that went unanswered", sum(each.labelers.unanswered for each in hammers), "requests")
    figures.add("answers to what had been done before the kill", sum(each.replays for each in hammers), "replays")
    figures.none("labels lost or doubled", deployment.lost_or_doubled(told))
    given = Counter((each.project, segment) for each in hammers for segment in each.given)
    figures.none("segments given twice", sum(given.values()) - len(given))


def test_9_the_same_upload_many_times_at_once_is_one(deploy: Deploy, prepared: Prepared, figures: Figures) -> None:
    deployment = deploy()
    project = deployment.client.find_project("busy").id
    first, second = _batch(deployment, project, 10), _batch(deployment, project, 10)
    key = uuid4().hex
    same = _at_once(PARALLEL, lambda _: _post(deployment, "/labels", first, key))
    assert {answer.status_code for answer in same} == {201}
    assert len({answer.text for answer in same}) == 1
    effects = sum("Idempotency-Replayed" not in answer.headers for answer in same)
    others = _at_once(PARALLEL, lambda _: _post(deployment, "/labels", second, uuid4().hex))
    assert {answer.status_code for answer in others} == {201}
    assert sorted(answer.json()["created"] for answer in others) == [0] * (PARALLEL - 1) + [10]
    assert all(answer.json()["created"] + answer.json()["duplicates"] == 10 for answer in others)
    deployment.check(_with(deployment, prepared, "busy", [*_segments(first), *_segments(second)]))
    figures.add("uploads of one batch at once that had an effect", effects, f"of {PARALLEL}", target=2, better="below")


def test_10_a_key_that_comes_back_with_another_body_is_refused(
    deploy: Deploy, prepared: Prepared, figures: Figures
) -> None:
    deployment = deploy()
    project = deployment.client.find_project("busy").id
    first, second = _batch(deployment, project, 3), _batch(deployment, project, 3)
    assert _post(deployment, "/labels", first, "one key").status_code == 201
    before = _counts(deployment)
    asked = {"project": str(project), "count": 2}
    assert _post(deployment, "/acquire", asked, "another key").status_code == 201
    for path, body, key in (("/labels", second, "one key"), ("/acquire", {**asked, "count": 3}, "another key")):
        answer = _post(deployment, path, body, key)
        assert (answer.status_code, answer.headers["Content-Type"]) == (422, "application/problem+json")
        assert answer.json()["type"].endswith("idempotency-key-reused")
    assert _counts(deployment) == (before[0] + 1, before[1])
    deployment.check(_with(deployment, prepared, "busy", _segments(first)))
    figures.note("a used key with another body: 422 on /labels and on /acquire, nothing changed")


def test_11_many_clients_drain_a_pool(deploy: Deploy, prepared: Prepared, figures: Figures) -> None:
    deployment = deploy()
    project = deployment.client.find_project("room 0").id
    tickets, seconds, given = itertools.count(), list[float](), list[Segment]()
    lock = threading.Lock()

    def drain(_: int) -> None:
        labelers = Labelers(deployment.url, deployment.key)
        while next(tickets) < SEGMENTS // BATCH:
            began = time.monotonic()
            answered = labelers.insist("/acquire", {"project": str(project), "count": BATCH, "lease_seconds": 600})
            took, batch = time.monotonic() - began, httpx.Response(201, text=answered.body).json()
            assert answered.status == 201, answered.body
            with lock:
                seconds.append(took)
                given.extend((item["trajectory"], item["start"]) for item in batch["items"])
        labelers.close()

    _at_once(CLIENTS, drain)
    deployment.check(_with(deployment, prepared, "room 0", []))
    figures.add("segments served", len(given), "segments", target=SEGMENTS)
    figures.none("segments given twice", len(given) - len(set(given)))
    for share in (50, 95):
        latency = 1000 * float(np.percentile(seconds, share))
        figures.add(f"p{share} of /acquire, {CLIENTS} clients at once", latency, "ms")


def test_12_the_segments_of_a_client_that_vanished_come_back(
    deploy: Deploy, prepared: Prepared, figures: Figures
) -> None:
    deployment = deploy()
    project = deployment.client.find_project("room 1").id
    lease = 3.0
    vanished = _batch(deployment, project, 3, lease_seconds=lease)
    began = time.monotonic()
    rest = deployment.client.project(project).counts.unlabeled
    assert len(_segments(_batch(deployment, project, rest))) == rest == 1200 - 60 - 3
    request, refusals = {"project": str(project), "count": 3, "lease_seconds": 600.0}, 0
    while (answer := _post(deployment, "/acquire", request, uuid4().hex)).status_code == 409:
        assert answer.json()["type"].endswith("pool-exhausted")
        refusals += 1
        assert time.monotonic() - began < lease + 30
        time.sleep(0.05)
    seconds = time.monotonic() - began
    assert answer.status_code == 201, answer.text
    taken = _answered(answer.json(), project)
    assert sorted(_segments(taken)) == sorted(_segments(vanished))
    late = _post(deployment, "/labels", vanished, uuid4().hex)
    assert (late.status_code, late.json()["type"].rsplit(":", 1)[-1]) == (410, "lease-lost")
    assert _post(deployment, "/labels", taken, uuid4().hex).status_code == 201
    assert refusals >= 1
    deployment.check(_with(deployment, prepared, "room 1", _segments(taken)))
    figures.add(f"a lease of {lease:g} s is given to another after", seconds, "s", target=lease + 1, better="below")


def _batch(deployment: Deployment, project: UUID, count: int, lease_seconds: float = 600.0) -> dict[str, object]:
    """Acquire, and make the body that labels all of it."""
    request = {"project": str(project), "count": count, "lease_seconds": lease_seconds}
    answer = _post(deployment, "/acquire", request, uuid4().hex)
    assert answer.status_code == 201, answer.text
    return _answered(answer.json(), project)


def _answered(batch: dict[str, object], project: UUID) -> dict[str, object]:
    given = batch["items"]
    assert isinstance(given, list)
    items = [{"trajectory": item["trajectory"], "start": item["start"], "actions": [2]} for item in given]
    return {"project": str(project), "acquisition": batch["id"], "token": batch["token"], "items": items}


def _segments(body: dict[str, object]) -> list[Segment]:
    items = body["items"]
    assert isinstance(items, list)
    return [(item["trajectory"], item["start"]) for item in items]


def _post(deployment: Deployment, path: str, body: dict[str, object], key: str) -> httpx.Response:
    headers = {"Authorization": f"Bearer {deployment.key}", "Idempotency-Key": key}
    return httpx.post(f"{deployment.url}{path}", json=body, headers=headers, timeout=60)


def _at_once(threads: int, do: Callable[[int], Result]) -> list[Result]:
    """Do it in threads that begin together."""
    barrier = threading.Barrier(threads)

    def one(number: int) -> Result:
        barrier.wait(30)
        return do(number)

    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(one, range(threads)))


def _counts(deployment: Deployment) -> tuple[int, int]:
    """Acquisitions, and batches of labels, in the database."""
    with deployment.database.read() as session:
        acquisitions = session.scalar(select(func.count()).select_from(AcquisitionRow)) or 0
        accepted = select(func.count()).where(EventRow.kind == "labels.accepted")
        return acquisitions, session.scalar(accepted) or 0


def _answers(hammer: Hammer, path: str) -> int:
    return sum(answer.path == path for answer in hammer.labelers.answers)


def _told(prepared: Prepared, names: dict[UUID, str], hammers: list[Hammer]) -> dict[UUID, list[Segment]]:
    """By project, the labels that were acknowledged, before the test and by its hammers."""
    own = {project: [s for each in hammers if each.project == project for s in each.acknowledged] for project in names}
    return {project: [*prepared.labeled[name], *own[project]] for project, name in names.items()}


def _with(deployment: Deployment, prepared: Prepared, name: str, more: list[Segment]) -> dict[UUID, list[Segment]]:
    """By project, the labels of the prepared database, and more in one of them."""
    names = {each.id: each.name for each in deployment.client.projects()}
    return {project: [*prepared.labeled[each], *(more if each == name else [])] for project, each in names.items()}

"""Jobs that outlast their message, always kill their worker, or find the disk full. Crash tests 13, 14 and 16."""

import re
import resource
import signal
from collections import Counter
from uuid import UUID

import pytest

from api_schemas.projects import ProjectPatch
from api_schemas.rounds import Round
from tests.crash.conftest import Deploy, Prepared
from tests.crash.deployment import Deployment, kill
from tests.figures import Figures
from tests.loop.processes import command_of, eventually
from tests.loop.rows import Segment

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]
VISIBILITY_SECONDS = 2
FILE_BYTES = 150_000  # less than a network
ENDS = ("done", "failed", "cancelled")


def test_13_a_job_that_outlasts_the_visibility_of_its_message_runs_once(
    deploy: Deploy, prepared: Prepared, figures: Figures
) -> None:
    deployment = deploy(2, ASIM_VISIBILITY_SECONDS=str(VISIBILITY_SECONDS))
    deployment.await_workers()
    room = deployment.client.find_project("room 0").id
    deployment.client.change_project(room, ProjectPatch(strategy="uncertainty"))  # an ensemble takes longer
    asked = deployment.client.start_round(room)
    done = deployment.await_round(asked, 280)
    job = deployment.job(_job_of(asked))
    assert (job.fence, job.attempts, done.status) == (1, 1, "current")
    assert job.started_at is not None
    assert job.finished_at is not None
    deployment.await_rest()
    deployment.check(_labeled(deployment, prepared))
    took = (job.finished_at - job.started_at).total_seconds()
    figures.add(f"a job under a visibility of {VISIBILITY_SECONDS} s ran for", took, "s", target=5 * VISIBILITY_SECONDS)
    figures.add("most deliveries of one message", _deliveries(deployment), "deliveries", target=2)
    figures.add("effective runs", job.fence, "runs", target=2, better="below")


def test_14_a_job_that_always_kills_its_worker_ends_and_the_queue_moves_on(
    deploy: Deploy, prepared: Prepared, figures: Figures
) -> None:
    deployment = deploy(2, ASIM_CHECKPOINT_SECONDS="60")
    deployment.await_workers()
    rooms = [deployment.client.find_project(name) for name in ("room 0", "room 1")]
    poisoned, sound = (deployment.client.start_round(room.id) for room in rooms)
    kills = 0
    while holder := deployment.await_holder(_job_of(poisoned), 60, fence=kills):
        kills += kill(holder, signal.SIGKILL)
    job = deployment.job(_job_of(poisoned))
    assert (job.state, job.attempts, kills) == ("failed", 3, 3)
    failed = deployment.client.round(poisoned.id)
    assert failed.status == "failed"
    assert deployment.client.project(rooms[0].id).current_round == rooms[0].current_round
    assert deployment.await_round(sound).status == "current"
    deployment.await_rest()
    deployment.check(_labeled(deployment, prepared), ended=[job.id])
    figures.add("attempts of a job that always kills its worker", kills, "attempts", target=4, better="below")
    figures.note(f"its error: {job.error}")


def test_16_a_full_disk_fails_the_round_and_leaves_the_older_one_in_use(
    deploy: Deploy, prepared: Prepared, figures: Figures
) -> None:
    deployment = deploy(1)
    worker = deployment.workers[0]
    resource.prlimit(worker.pid, resource.RLIMIT_FSIZE, (FILE_BYTES, FILE_BYTES))  # its child is not there yet
    deployment.await_workers()
    room = deployment.client.find_project("room 0")
    asked = deployment.client.start_round(room.id)
    eventually(lambda: deployment.job(_job_of(asked)).state in ENDS, 200, deployment.last_words)
    failed, job = deployment.client.round(asked.id), deployment.job(_job_of(asked))
    assert (failed.status, job.state) == ("failed", "failed")
    assert job.error
    assert failed.error
    assert deployment.client.project(room.id).current_round == room.current_round
    worker.end(signal.SIGTERM)
    deployment.revive()
    assert deployment.await_round(deployment.client.start_round(room.id)).status == "current"
    deployment.await_rest()
    deployment.check(_labeled(deployment, prepared), ended=[job.id])
    assert command_of(worker.pid)
    figures.note(f"a disk that takes no file of more than {FILE_BYTES} bytes: {failed.error}")


def _job_of(asked: Round) -> UUID:
    assert asked.job is not None
    return asked.job


def _deliveries(deployment: Deployment) -> int:
    """How often the message was delivered that was delivered most."""
    said = "".join(worker.said() for worker in deployment.workers)
    return max(Counter(re.findall(r"run_job\[([0-9a-f-]+)\] received", said)).values())


def _labeled(deployment: Deployment, prepared: Prepared) -> dict[UUID, list[Segment]]:
    return {each.id: prepared.labeled[each.name] for each in deployment.client.projects()}

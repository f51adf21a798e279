"""Policies through the service: trained in stages, resumed, listed, rolled out by collections, replayed by labelers."""

from collections.abc import Callable
from copy import copy
from datetime import timedelta
from typing import Any

import numpy as np
import pytest

from api_schemas.environments import BoxActions, Environment, Stream
from api_schemas.environments import Spaces as ProjectSpaces
from api_schemas.jobs import Job
from api_schemas.policies import Policy, PolicyCreate
from api_schemas.projects import Project, ProjectCreate
from asim.client import Client
from asim.errors import AsimError, Conflict, Invalid, NotFound
from asim.policy_parts import parts_of
from models import checkpoints
from models.training import advance
from service.clock import utc_now
from service.garbage import collect
from service.store.provenance import ProvenanceBlobs
from tests.workers.brief_policies import brief
from tests.workers.conftest import OpenLoop
from tests.workers.in_process import Loop
from tests.workers.test_robot_collection import project_of
from tests.workers.test_robot_labeling import actions_taken, behind
from workers import policy_training
from workers.answering import SimulatorAnswerer
from workers.behaviors import behaviors_of
from workers.dispatch import run_next
from workers.job import GaveWay
from workers.labeling import run_labeling
from workers.policy_training import stage_steps

STAGES, STEPS = 3, 100


@pytest.fixture(autouse=True)
def _short_training(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(policy_training, "training_config", brief(STEPS))
    monkeypatch.setattr(policy_training, "TRIALS", 1)


@pytest.fixture
def loop(opened: OpenLoop) -> Loop:
    return project_of(opened, "maniskill", cameras=False, horizon=25)


def asked(loop: Loop, **more: Any) -> PolicyCreate:
    fields = {"project": loop.project.id, "demonstrations": 2, "stages": STAGES, "seed": 5, **more}
    return PolicyCreate.model_validate(fields)


def trained(loop: Loop, **more: Any) -> Job:
    job = loop.client.train_policy(asked(loop, **more))
    loop.drain()
    return loop.client.job(job.id)


def policies(loop: Loop) -> list[Policy]:
    return list(loop.client.policies(loop.project.id))


def store(loop: Loop) -> ProvenanceBlobs:
    return ProvenanceBlobs(str(loop.folder / "provenance"))


def test_stages_are_kept_as_they_are_reached(loop: Loop) -> None:
    job = trained(loop)
    assert (job.state, job.error, job.queue) == ("done", None, "label")
    kept = policies(loop)
    assert [policy.id for policy in kept] == job.result["policies"]
    assert [(policy.stage, policy.steps) for policy in kept] == list(enumerate(stage_steps(STEPS, STAGES)))
    for policy in kept:
        weights = loop.client.policy_weights(loop.project.id, policy.id)
        assert checkpoints.describe(weights)["kind"] == "policy"
        assert (policy.bytes, policy.training, policy.observations) == (len(weights), job.id, "state")
        assert (policy.episodes, policy.success) in ((1, 0.0), (1, 1.0))
    assert {blob.kind for blob in store(loop).stored()} == {"policies"}  # what training went on from is gone
    assert not [blob for blob in loop.blobs.stored() if blob.kind in ("weights", "checkpoints")]
    assert trained(loop).result == job.result  # the same again is the same policies
    assert len(policies(loop)) == STAGES


@pytest.mark.parametrize("stopped_at", [0, 1])
def test_a_second_attempt_goes_on_from_the_last_stage_to_the_same_weights(
    loop: Loop, opened: OpenLoop, monkeypatch: pytest.MonkeyPatch, stopped_at: int
) -> None:
    job = loop.client.train_policy(asked(loop))
    with monkeypatch.context() as patch:
        patch.setattr(policy_training, "_keep", stopping_after(stopped_at, policy_training._keep))
        assert run_next(loop.worker)
    assert loop.client.job(job.id).state == "queued"
    kept = policies(loop)
    assert len(kept) == stopped_at + 1
    steps = list[int]()
    monkeypatch.setattr(policy_training, "advance", counting(steps, advance))
    loop.drain()
    assert steps == stage_steps(STEPS, STAGES)[stopped_at:-1]
    other = project_of(opened, "maniskill", cameras=False, horizon=25)
    assert trained(other).result == loop.client.job(job.id).result


def stopping_after(stage: int, keep: Callable[..., None], error: Exception | None = None) -> Callable[..., None]:
    def stopping(*arguments: Any) -> None:
        keep(*arguments)
        if arguments[5] == stage:
            raise error or GaveWay("the worker stops")

    return stopping


def counting(steps: list[int], advance: Callable[..., Any]) -> Callable[..., Any]:
    def counted(policy: Any, batch: Any, state: Any, mark: int, **more: Any) -> Any:
        steps.append(state.step)
        return advance(policy, batch, state, mark, **more)

    return counted


def test_a_lost_state_means_to_begin_anew_with_the_same_weights(loop: Loop, monkeypatch: pytest.MonkeyPatch) -> None:
    job = loop.client.train_policy(asked(loop))
    with monkeypatch.context() as patch:
        patch.setattr(policy_training, "_keep", stopping_after(1, policy_training._keep))
        run_next(loop.worker)
    first = policies(loop)
    (state,) = [blob for blob in store(loop).stored() if blob.kind == "trainings"]
    store(loop).delete("trainings", state.sha256)
    loop.drain()
    assert loop.client.job(job.id).state == "done"
    assert {policy.id for policy in first} <= {policy.id for policy in policies(loop)}
    assert {blob.kind for blob in store(loop).stored()} == {"policies"}


@pytest.mark.parametrize("ended", ["cancelled", "failed"])
def test_a_training_that_ends_early_leaves_its_stages_and_no_state(
    loop: Loop, monkeypatch: pytest.MonkeyPatch, ended: str
) -> None:
    job = loop.client.train_policy(asked(loop))
    error = ValueError("it cannot go on") if ended == "failed" else None
    monkeypatch.setattr(policy_training, "_keep", stopping_after(1, policy_training._keep, error))
    run_next(loop.worker)
    if ended == "cancelled":
        assert kinds_after_garbage(loop) == {"policies", "trainings"}  # so far another attempt goes on from it
        loop.cancel(job.id)
    assert loop.client.job(job.id).state == ended
    kept = [policy.id for policy in policies(loop)]
    assert len(kept) == 2
    assert kinds_after_garbage(loop) == {"policies"}
    assert all(loop.client.policy_weights(loop.project.id, policy) for policy in kept)


def kinds_after_garbage(loop: Loop) -> set[str]:
    """What the provenance store holds once all that is old enough and of no use is in the trash."""
    collect(loop.worker.database, [store(loop)], utc_now() + timedelta(days=2), timedelta(days=1))
    return {blob.kind for blob in store(loop).stored()}


def test_a_collection_rolls_a_policy_out_and_its_labels_are_the_actions_taken(
    loop: Loop, monkeypatch: pytest.MonkeyPatch
) -> None:
    trained(loop)
    policy = policies(loop)[-1]
    taken = actions_taken(monkeypatch)
    job = loop.collect(60, behavior=f"policy:{policy.id}", split="pool")
    assert (job.state, job.error) == ("done", None)
    trajectory = next(loop.client.trajectories(loop.project.id))
    assert loop.client.provenance(loop.project.id, trajectory.id)[1]["behavior"] == f"policy:{policy.id}"
    batch = loop.acquire(10, "random")
    behaviors = behaviors_of(loop.client, loop.project.id)

    def opened(client: Client, project: Project) -> SimulatorAnswerer:
        return SimulatorAnswerer(client, project, behaviors)

    run_labeling(loop.client, batch, np.random.default_rng(0), open_answerer=opened)
    labels = list(loop.client.labels(loop.project.id))
    assert len(labels) == 10
    assert all((label.residual, label.actions) == (0.0, behind(loop, taken, label)) for label in labels)


def test_labels_of_a_policy_that_a_labeler_does_not_have_are_searched(loop: Loop) -> None:
    trained(loop)
    loop.collect(20, behavior=f"policy:{policies(loop)[0].id}", split="pool")
    batch = loop.acquire(1, "random")
    run_labeling(loop.client, batch, np.random.default_rng(0))
    (label,) = loop.client.labels(loop.project.id)
    assert label.residual is not None
    assert 0 < label.residual < 1e-4


def test_a_project_with_cameras_rolls_out_the_same_policy(loop: Loop, monkeypatch: pytest.MonkeyPatch) -> None:
    trained(loop)
    policy = policies(loop)[-1]
    pictured = another_project(loop, "pictured", "maniskill", task="PullCube", cameras=True, horizon=25)
    job = pictured.collect(5, behavior=f"policy:{policy.id}", split="pool")
    assert (job.state, job.error) == ("done", None)
    assert [each.id for each in policies(pictured)] == [policy.id]
    (trajectory,) = pictured.client.trajectories(pictured.project.id)
    assert set(trajectory.streams) == {"front", "wrist", "proprioception"}
    weights = pictured.client.policy_weights(pictured.project.id, policy.id)
    assert weights == loop.client.policy_weights(loop.project.id, policy.id)
    assert len(policies(loop)) == STAGES


def another_project(loop: Loop, name: str, simulator: str, **options: Any) -> Loop:
    """On the same service."""
    return named(loop, name, Environment(simulator=simulator, options=options))


def named(loop: Loop, name: str, environment: Environment) -> Loop:
    loop.client.create_project(ProjectCreate(name=name, environment=environment))
    other = copy(loop)
    other.name = name
    return other


def test_what_a_project_cannot_use_is_refused_by_field_and_value(loop: Loop) -> None:
    trained(loop)
    name = f"policy:{policies(loop)[0].id}"
    poke = another_project(loop, "poke", "maniskill", task="PokeCube", cameras=False)
    lift = another_project(loop, "lift", "robosuite", cameras=False)
    sentence = "behavior: is a policy of PullCube of maniskill, and this project is of {}, got policy:"
    with pytest.raises(Invalid, match=sentence.format("PokeCube of maniskill")):
        poke.collect(5, behavior=name)
    with pytest.raises(Invalid, match=sentence.format("Lift of robosuite")):
        lift.collect(5, behavior=name)
    with pytest.raises(Invalid, match=f"behavior: names a policy that there is not; .*, got policy:{'0' * 64}"):
        loop.collect(5, behavior=f"policy:{'0' * 64}")
    with pytest.raises(Invalid, match="behavior: names a policy that there is not"):
        loop.collect(5, behavior="policy:lift")
    with pytest.raises(Invalid, match="observations: acts by images, and this project has no cameras, got images"):
        trained(loop, observations="images")
    with pytest.raises(NotFound, match=f"there is no policy '{'0' * 64}'"):
        loop.client.policy_weights(loop.project.id, "0" * 64)
    assert not list(poke.client.jobs(poke.project.id))


def test_a_worker_that_cannot_reach_the_provenance_store_refuses(loop: Loop) -> None:
    job = loop.client.train_policy(asked(loop))
    loop.drain(loop.another_worker(loop.settings.model_copy(update={"provenance_url": ""})))
    ended = loop.client.job(job.id)
    assert (ended.state, policies(loop)) == ("failed", [])
    assert "weights of policies are in the provenance store" in (ended.error or "")


def test_only_robots_have_policies(empty: Loop) -> None:
    with pytest.raises(Invalid, match="project: needs actions in a box, this one's are 7 discrete"):
        trained(empty)
    arm = ProjectSpaces(observations={"arm": Stream(dtype="float32", shape=(3,))}, actions=BoxActions(shape=(2,)))
    with pytest.raises(Conflict, match="names no simulator"):
        trained(named(empty, "own", Environment(spaces=arm)))


def test_a_policy_of_images_learns_from_pictures(opened: OpenLoop) -> None:
    loop = project_of(opened, "maniskill", cameras=True, horizon=25)
    job = trained(loop, observations="images", stages=1, demonstrations=1)
    assert (job.state, job.error) == ("done", None)
    (policy,) = policies(loop)
    assert (policy.observations, policy.steps) == ("images", STEPS)
    assert loop.collect(3, behavior=f"policy:{policy.id}", split="pool").state == "done"


def test_a_training_gives_warm_up_pool_and_validation(loop: Loop) -> None:
    trained(loop)
    found = [
        policy.model_copy(update={"success": success})
        for policy, success in zip(policies(loop), (0, 0.4, 1), strict=True)
    ]
    parts = parts_of(found, 9)
    behaviors = ["expert", *(f"policy:{found[stage].id}" for stage in (2, 0, 1))]
    assert [(part.name, part.behavior, part.trajectories) for part in parts] == list(
        zip(("warm-up", "warm-up", "pool", "validation"), behaviors, (3, 2, 2, 2), strict=True)
    )
    asked = [part.collection(loop.project.id, 0, number, 1) for number, part in enumerate(parts)]
    assert len({each.seed for each in asked}) == len(parts)
    for each in asked:
        loop.client.collect(each)
    loop.drain()
    counts, labels = loop.project.counts, list(loop.client.labels(loop.project.id))
    held_out = {each.id for each in loop.client.trajectories(loop.project.id) if each.split == "held_out"}
    assert (counts.pool_trajectories, len(held_out)) == (7, 2)
    labeled = {label.trajectory for label in labels}
    assert held_out < labeled
    assert len(labeled) == 7  # all but the pool's two


@pytest.mark.parametrize(("stages", "trajectories"), [(0, 9), (2, 9), (3, 3)])
def test_too_few_stages_or_trajectories_are_said(loop: Loop, stages: int, trajectories: int) -> None:
    trained(loop)
    with pytest.raises(AsimError, match=f"^({stages} stages of a policy|trajectories: {trajectories} cannot)"):
        parts_of(policies(loop)[:stages], trajectories)

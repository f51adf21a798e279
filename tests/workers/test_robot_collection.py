"""Collection in the robot simulators: boxes of numbers as actions, two cameras, and words for what cannot be."""

import re
import sys
import threading
import time
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray

from api_schemas.collections import CollectionCreate, CollectionLabels
from api_schemas.environments import Environment
from asim.errors import Invalid
from service.reaper import reap
from tests.workers.conftest import OpenLoop, new_project
from tests.workers.in_process import Loop
from workers.job import RunningJob
from workers.simulators.base import Action, SimulatorError, SimulatorUnavailable, Step
from workers.simulators.catalog import make_behavior, make_simulator
from workers.simulators.maniskill import ManiSkillSimulator

LIBRARIES = {"robosuite": "Lift", "maniskill": "PullCube"}


def project_of(opened: OpenLoop, simulator: str, **options: str | int | float | bool) -> Loop:
    """An empty project of a robot task; skips, saying why, where its packages are missing."""
    chosen = {"task": LIBRARIES[simulator], "horizon": 6, **options}
    try:
        make_simulator(simulator, chosen).close()
    except SimulatorUnavailable as error:
        pytest.skip(str(error))
    loop = opened()
    new_project(loop, environment=Environment(simulator=simulator, options=chosen))
    return loop


@pytest.mark.parametrize(("simulator", "cameras"), [("robosuite", False), ("maniskill", True)])
def test_the_default_behavior_fills_the_pool_and_can_be_run_again(
    opened: OpenLoop, simulator: str, cameras: bool
) -> None:
    loop = project_of(opened, simulator, cameras=cameras)
    job = loop.collect(12, seed=3, split="pool")
    assert (job.state, job.error) == ("done", None)
    assert loop.project.counts.pool_segments == 12
    robot = make_simulator(simulator, loop.project.environment.options)
    for trajectory in loop.client.trajectories(loop.project.id):
        seen = loop.client.trajectory_content(loop.project.id, trajectory.id)
        states, told = loop.client.provenance(loop.project.id, trajectory.id)
        assert told["behavior"] == "noisy_expert"
        behavior, rng = make_behavior("noisy_expert", robot), np.random.default_rng()
        rng.bit_generator.state = cast(dict[str, Any], told["generator"])
        observed = [robot.reset(int(str(told["seed"])))]
        behavior.reset(rng)
        for _ in range(trajectory.transitions):
            observed.append(robot.step(behavior.act(robot, rng)).observation)
        assert all(np.array_equal(seen[name], np.stack([each[name] for each in observed])) for name in seen)
        assert all(np.array_equal(states[name][-1], array) for name, array in robot.state().items())
    robot.close()


def test_labels_cannot_be_counted_by_action_where_actions_are_boxes(opened: OpenLoop) -> None:
    loop = opened()
    new_project(loop, environment=Environment(simulator="robosuite"))
    sentence = r"labels.per_action: needs discrete actions .* boxes of shape \[7\], got 3"
    with pytest.raises(Invalid, match=sentence):
        loop.collect(12, per_action=3)
    with pytest.raises(Invalid, match="behavior: must be one of expert, noisy_expert, random, got mixture"):
        loop.collect(12, behavior="mixture")
    assert not list(loop.client.jobs(loop.project.id))


@pytest.mark.parametrize("simulator", LIBRARIES)
def test_a_missing_package_ends_the_job_with_the_command_that_installs_it(
    opened: OpenLoop, simulator: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("robosuite", "mani_skill.envs"):
        monkeypatch.setitem(sys.modules, module, None)
    loop = opened()
    new_project(loop, environment=Environment(simulator=simulator))
    job = loop.collect(12)
    assert (job.state, job.attempts) == ("failed", 1)
    assert "Run `make setup-robots`" in (job.error or "")


def test_a_simulation_that_breaks_down_ends_the_job_in_a_sentence_and_others_go_on(
    opened: OpenLoop, monkeypatch: pytest.MonkeyPatch
) -> None:
    loop = project_of(opened, "maniskill", cameras=False)
    step = ManiSkillSimulator.step
    with monkeypatch.context() as patch:
        patch.setattr(ManiSkillSimulator, "step", _breaks_down)
        job = loop.collect(12, behavior="random")
    assert (job.state, loop.project.counts.pool_segments) == ("failed", 0)
    assert "broke down in step 1" in (job.error or "")
    assert ManiSkillSimulator.step is step
    assert loop.collect(12, behavior="random", split="pool").state == "done"


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"proprioception": np.full(11, np.nan, np.float32)}, r"proprioception\[1, 0\]: must be finite, got nan"),
        ({"objects": np.zeros(9, np.float32)}, r"objects: shape: must be \(T \+ 1, 18\)"),
    ],
)
def test_an_observation_that_does_not_fit_the_project_is_not_stored(
    opened: OpenLoop, monkeypatch: pytest.MonkeyPatch, wrong: dict[str, NDArray[Any]], sentence: str
) -> None:
    loop = project_of(opened, "maniskill", cameras=False)
    step, observe = ManiSkillSimulator.step, ManiSkillSimulator.observe

    def bent(simulator: ManiSkillSimulator, action: NDArray[Any]) -> Step:
        taken = step(simulator, action)
        return taken._replace(observation={**taken.observation, **wrong})

    monkeypatch.setattr(ManiSkillSimulator, "step", bent)
    if "objects" in wrong:
        monkeypatch.setattr(ManiSkillSimulator, "observe", lambda self: {**observe(self), **wrong})
    job = loop.collect(12, behavior="random")
    assert (job.state, loop.project.counts.pool_segments) == ("failed", 0)
    assert re.search(sentence, job.error or ""), job.error


def _breaks_down(simulator: ManiSkillSimulator, action: NDArray[Any]) -> Step:
    raise SimulatorError("Simulator 'maniskill', task 'PullCube', broke down in step 1 of an episode: no number.")


def test_a_hung_simulator_loses_its_job_to_a_worker_that_goes_on(
    opened: OpenLoop, monkeypatch: pytest.MonkeyPatch
) -> None:
    loop = project_of(opened, "maniskill", cameras=False, horizon=50)
    advance, hung, released = ManiSkillSimulator.advance, threading.Event(), threading.Event()

    def hangs_once(simulator: ManiSkillSimulator, action: Action) -> None:
        if not hung.is_set():
            hung.set()
            released.wait(60)
        advance(simulator, action)

    monkeypatch.setattr(ManiSkillSimulator, "advance", hangs_once)
    impatient = loop.settings.model_copy(update={"silence_seconds": 0.3, "job_lease_seconds": 1.5})
    asked = loop.client.collect(CollectionCreate(project=loop.project.id, transitions=12, split="pool"))
    first = threading.Thread(target=loop.drain, args=(loop.another_worker(impatient),))
    first.start()
    assert hung.wait(30)
    time.sleep(0.6)  # from here on it counts as hung, and its lease is not renewed
    loop.clock.advance(60)
    reap(loop.worker.database, loop.clock())
    loop.clock.advance(600)  # it waits a little for its next attempt
    loop.drain()
    released.set()
    first.join(60)
    assert loop.client.job(asked.id).state == "done"
    started = [event for event in loop.client.events(loop.project.id) if event.kind == "job.started"]
    assert [event.data["attempt"] for event in started] == [1, 2]
    assert loop.project.counts.pool_segments == 12


def test_a_long_episode_says_at_every_step_that_it_is_at_work(
    opened: OpenLoop, monkeypatch: pytest.MonkeyPatch
) -> None:
    loop = project_of(opened, "maniskill", cameras=False, horizon=50)
    told, go_on = list[RunningJob](), RunningJob.go_on

    def counted(job: RunningJob) -> None:
        told.append(job)
        go_on(job)

    monkeypatch.setattr(RunningJob, "go_on", counted)
    loop.collect(50, behavior="random")
    assert len(told) > 50


@pytest.mark.parametrize("split", ["pool", "held_out"])
@pytest.mark.parametrize(("labels", "count"), [({"all": True}, 6), ({"segments": 4}, 4)])
def test_whole_segments_are_labeled_with_the_actions_that_were_taken(
    opened: OpenLoop, monkeypatch: pytest.MonkeyPatch, split: str, labels: dict[str, object], count: int
) -> None:
    loop = project_of(opened, "maniskill", cameras=False)
    loop.name = "chunks"
    new_project(loop, environment=loop.client.find_project("rooms").environment, segment_length=2)
    taken, step = dict[bytes, list[float]](), ManiSkillSimulator.step

    def recorded(simulator: ManiSkillSimulator, action: Action) -> Step:
        reached = step(simulator, action)
        taken[reached.observation["proprioception"].tobytes()] = np.asarray(action).tolist()
        return reached

    monkeypatch.setattr(ManiSkillSimulator, "step", recorded)
    job = loop.collect(trajectories=2, split=split, labels=CollectionLabels.model_validate(labels))
    assert (job.state, job.error) == ("done", None)
    assert (job.result["labels"], job.result["short_of"]) == ({"segments": count}, {})
    found = list(loop.client.labels(loop.project.id))
    assert len(found) == count
    for label in found:
        seen = loop.client.trajectory_content(loop.project.id, label.trajectory, label.start, 2)
        assert label.actions == [taken[place.tobytes()] for place in seen["proprioception"][1:]]
        assert (label.split, label.source.kind, label.source.name) == (split, "simulator", "noisy_expert")
    if split == "pool":  # the labeling worker finds the same actions: one label, not two that differ
        again = loop.collect(trajectories=2, split=split, labels=CollectionLabels(all=True))
        assert (again.state, again.error) == ("done", None)
        assert again.result["known_before"] == 2
        assert len(list(loop.client.labels(loop.project.id))) == 6

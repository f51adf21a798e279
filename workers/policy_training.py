"""Training of policies: an expert demonstrates, a policy learns, and what it is at each stage is kept and tried out.

It needs actions and simulator states, so it is done where collections are: all that it stores is in the provenance
store, out of reach of what trains on labels.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing

import numpy as np

from api_schemas.policies import PolicyCreate
from models import checkpoints
from models.chance import training_generator
from models.policies.diffusion import DiffusionPolicy, DiffusionPolicyConfig, training_config
from models.segments import SegmentBatch
from models.spaces import BoxAction, Spaces, StreamSpec
from models.training import Progress, TrainingState, advance, begin
from service import jobs, policies, projects
from service.log import get_logger
from service.policies import PoliciesOutOfReach, Stage
from service.store.errors import CorruptBlob, MissingBlob
from service.store.provenance import ProvenanceBlobs
from service.store.queries import policies as queries
from service.store.tables import PolicyRow
from workers.checkpoint import delete_unneeded
from workers.demonstrations import FIRST_OTHER, demonstrate, segments
from workers.job import RunningJob
from workers.policies import PolicyBehavior, check_installed, policy_of
from workers.rollouts import rollout
from workers.simulators.base import Simulator
from workers.simulators.catalog import make_simulator
from workers.stage import own

log = get_logger("worker")
TRIALS = 10  # episodes by which a stage's success is told
FIRST_SHARE = 0.01  # of all steps: where the first of several stages is
PREPARED = 0.2  # of a training's time: the demonstrations


def run_policy_training(job: RunningJob, asked: PolicyCreate, provenance: ProvenanceBlobs | None) -> dict[str, object]:
    """Train, from the last stage on that an earlier attempt kept; the weights are those of one uninterrupted run."""
    if provenance is None:
        raise PoliciesOutOfReach(f"training in project {asked.project}")
    check_installed()
    with job.worker.database.read() as session:
        environment = projects.environment_of(projects.find(session, asked.project))
    options = environment.options | {"cameras": asked.observations == "images"}  # poses are known without drawing
    if len(_kept(job, asked)) < asked.stages:  # else an attempt ended before its job was done
        with closing(make_simulator(environment.simulator or "", options)) as simulator:
            _train(job, asked, provenance, simulator)
    kept = _kept(job, asked)
    return {"policies": [row.sha256 for row in kept], "success": [row.success for row in kept]}


def stage_steps(steps: int, stages: int) -> list[int]:
    """After how many steps each stage is: they grow by the same factor, from FIRST_SHARE of all steps to all."""
    shares = np.geomspace(FIRST_SHARE, 1.0, stages) if stages > 1 else np.ones(1)
    return [max(1, round(steps * float(share))) for share in shares]


def begun(batch: SegmentBatch, seed: int) -> tuple[DiffusionPolicy, TrainingState]:
    """A policy for what the segments hold, before its first step; the seed decides all that follows."""
    streams = {name: StreamSpec(tuple(s.shape[2:]), str(s.numpy().dtype)) for name, s in batch.observations.items()}
    actions = () if batch.actions is None else tuple(batch.actions.shape[3:])
    generator = training_generator(seed, 0, DiffusionPolicy.kind)
    policy = DiffusionPolicy(Spaces(streams, BoxAction(-1.0, 1.0, actions)), DiffusionPolicyConfig(), generator)
    policy.fit_statistics(batch)
    return policy, begin(policy, training_config(policy.spaces), generator)


def states_at(
    policy: DiffusionPolicy, batch: SegmentBatch, state: TrainingState, marks: list[int], progress: Progress
) -> Iterator[TrainingState]:
    """Trains on from a state, and stops at each of the steps `marks` that is still ahead. progress: may raise."""
    for mark in marks:
        if mark > state.step:
            state = advance(policy, batch, state, mark, progress=progress)
            yield state


def success(
    simulator: Simulator, weights: bytes, seed: int, episodes: int, on_step: Callable[[], None] = lambda: None
) -> float:
    """The share of episodes that a policy solves. None of them begins as a demonstration does."""
    behavior, rng = PolicyBehavior(policy_of(weights)), np.random.default_rng(seed)
    at = rng.integers(FIRST_OTHER, 2 * FIRST_OTHER, episodes)
    return sum(rollout(simulator, behavior, int(each), rng, on_step=on_step).is_solved for each in at) / episodes


def _train(job: RunningJob, asked: PolicyCreate, provenance: ProvenanceBlobs, simulator: Simulator) -> None:
    def shown(done: int) -> None:
        job.report(PREPARED * done / asked.demonstrations, f"{done} of {asked.demonstrations} demonstrations")

    episodes = demonstrate(simulator, asked.observations, asked.demonstrations, asked.seed, shown)
    batch = segments(episodes, DiffusionPolicyConfig().chunk)
    policy, first = begun(batch, asked.seed)
    state = _resumed(job, asked, provenance, first) or first
    marks = stage_steps(state.config.steps, asked.stages)

    def tell(step: int, steps: int, loss: float) -> None:
        job.report(PREPARED + (1 - PREPARED) * step / steps, f"step {step} of {steps}, loss {loss:.3f}")

    for reached in states_at(policy, batch, state, marks, tell):
        weights, number = checkpoints.save(policy), marks.index(reached.step)
        share = success(simulator, weights, asked.seed + number, TRIALS, job.go_on)
        _keep(job, asked, provenance, weights, reached, number, share)


def _keep(
    job: RunningJob,
    asked: PolicyCreate,
    provenance: ProvenanceBlobs,
    weights: bytes,
    state: TrainingState,
    number: int,
    share: float,
) -> None:
    """Blobs first, then the row; the state that an earlier stage left is of no use then."""
    is_last = number + 1 == asked.stages
    stage = Stage(
        sha256=provenance.put("policies", weights),
        bytes=len(weights),
        state_sha256=None if is_last else provenance.put("trainings", own(job.lease.job_id, state).to_bytes()),
        number=number,
        steps=state.step,
        success=share,
        episodes=TRIALS,
    )
    with job.transaction() as session:
        left = policies.keep(session, job.lease.job_id, asked, stage, job.now())
        jobs.made_progress(session, job.lease)
    delete_unneeded(provenance, "trainings", left)


def _kept(job: RunningJob, asked: PolicyCreate) -> Sequence[PolicyRow]:
    with job.worker.database.read() as session:
        return queries.of_training(session, asked.project, job.lease.job_id)


def _resumed(
    job: RunningJob, asked: PolicyCreate, provenance: ProvenanceBlobs, first: TrainingState
) -> TrainingState | None:
    """The state at the last stage that an earlier attempt kept, if it is whole and of the same training as `first`."""
    kept = policies.with_state(_kept(job, asked))
    if kept is None:
        return None
    try:
        state = TrainingState.from_bytes(provenance.get("trainings", str(kept.state_sha256)))
    except (MissingBlob, CorruptBlob, ValueError) as error:  # begun anew it comes to the same weights
        log.warning("training_unusable", stage=kept.stage, error=str(error))
        return None
    if state.config != first.config:  # an upgrade came between the attempts
        log.warning("training_of_another_schedule", found=str(state.config), now=str(first.config))
        return None
    log.info("training_resumed", stage=kept.stage, step=state.step)
    return state

"""One network's training inside a job: in slices, with checkpoints from which another worker goes on, bit for bit."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from uuid import UUID

import torch
from sqlalchemy.orm import Session

from models.network import Network
from models.segments import SegmentBatch
from models.training import TrainingConfig, TrainingState, begin
from service import events, jobs
from service.log import get_logger
from service.store.tables import JobRow
from workers.checkpoint import Checkpoint
from workers.job import GaveWay, RunningJob
from workers.trainer import Advance, trainer

log = get_logger("worker")
FIRST_STEPS = 5  # of a slice; the later ones follow the time that it took
SLICE_SECONDS = 1.0  # between two looks at whether the job is to stop; a slice itself costs less than a hundredth
Tell = Callable[[int, int, float], None]  # step, steps, loss


class Stage:
    """The training of one network of a job. Only the stage of this name takes up a checkpoint of this name."""

    def __init__(self, job: RunningJob, name: str, round_id: UUID | None) -> None:
        self._job, self._name, self._round = job, name, round_id
        self._checkpoint = Checkpoint(job, name)
        self._stored = 0  # the step of the newest checkpoint

    def train(
        self,
        network: Network,
        batch: SegmentBatch,
        config: TrainingConfig,
        generator: torch.Generator,
        tell: Tell,
        action_free: SegmentBatch | None = None,
    ) -> TrainingState:
        """Train to the end of the schedule, from where an earlier attempt left off. Raises GaveWay, JobLost.

        The weights are those of one uninterrupted run, however it is cut. `tell` may raise to stop it. action_free:
        what a SemiSupervised network reads besides.
        """
        state = self._resumed(network, batch, config) or begin(network, config, generator)
        self._stored = state.step
        self._job.prepared()
        with trainer(network, batch, state, self._job.worker.settings.training_devices, action_free) as advance:
            return self._advanced(state, advance, tell)

    def _advanced(self, state: TrainingState, advance: Advance, tell: Tell) -> TrainingState:
        """Slice by slice to the end, with a checkpoint now and then."""
        steps, saved = FIRST_STEPS, time.monotonic()
        while state.step < state.config.steps:
            started = time.monotonic()
            if started - saved >= self._job.worker.settings.checkpoint_seconds:
                self._store(state)
                saved = started
            state, loss = advance(state, min(state.step + steps, state.config.steps))
            steps = _next_steps(steps, time.monotonic() - started)
            self._look_up(state, loss, tell)
        return state

    @contextmanager
    def finished(self) -> Iterator[Session]:
        """The transaction that stores the stage's result; its checkpoint goes with it. Raises JobLost."""
        with self._job.transaction() as session:
            yield session
            left = self._checkpoint.refer(session, None)
        self._checkpoint.discard(left)

    def _look_up(self, state: TrainingState, loss: float, tell: Tell) -> None:
        """Tell how far it is; where the job is to stop here, what was done is kept."""
        try:
            tell(state.step, state.config.steps, loss)
            self._let_others_go_first(state)
        except GaveWay:
            self._store(state)
            raise

    def _let_others_go_first(self, state: TrainingState) -> None:
        if state.step < state.config.steps and self._job.should_give_way():
            raise GaveWay(f"other work waits at step {state.step} of {state.config.steps} of {self._name}")

    def _resumed(self, network: Network, batch: SegmentBatch, config: TrainingConfig) -> TrainingState | None:
        """The state that an earlier attempt left, if it is whole and of this schedule, network and data."""
        data = self._checkpoint.load()
        if data is None:
            return None
        try:
            state = TrainingState.from_bytes(data)
        except ValueError as error:
            self._checkpoint.cannot_use(error)
            return None
        differs = _difference(state, network, batch, config)
        if differs is not None:  # an upgrade came between the attempts; loading it would fail each of them
            log.warning("checkpoint_of_another_training", stage=self._name, differs=differs)
            return None
        self._tell_of_resuming(state.step)
        return state

    def _tell_of_resuming(self, step: int) -> None:
        round_id = None if self._round is None else str(self._round)
        data: dict[str, object] = {"round": round_id, "stage": self._name, "step": step}
        with self._job.transaction() as session:
            row = session.get_one(JobRow, self._job.lease.job_id)
            events.record(session, row.project_id, "training.resumed", {"job": str(row.id), **data}, self._job.now())
        log.info("training_resumed", stage=self._name, step=step)

    def _store(self, state: TrainingState) -> None:
        """Replace the checkpoint by one that is further; that is progress, so attempts count anew."""
        if state.step <= self._stored:
            return
        sha256 = self._checkpoint.write(own(self._job.lease.job_id, state).to_bytes())
        with self._job.transaction() as session:
            replaced = self._checkpoint.refer(session, sha256)
            jobs.made_progress(session, self._job.lease)
        self._stored = state.step
        self._checkpoint.discard(replaced)


def own(job_id: UUID, state: TrainingState) -> TrainingState:
    """The state under the job's name: equal states of two jobs are two blobs, and deleting one keeps the other."""
    name = torch.tensor(list(job_id.bytes), dtype=torch.uint8)
    return replace(state, tensors={**state.tensors, "job": name})


def _difference(state: TrainingState, network: Network, batch: SegmentBatch, config: TrainingConfig) -> str | None:
    """Why training cannot go on from `state`; None where it can."""
    if state.config != config:
        return f"schedule {state.config}, now {config}"
    shapes = {f"model.{name}": tensor.shape for name, tensor in network.state_dict().items()}
    found = {name: tensor.shape for name, tensor in state.tensors.items() if name.startswith("model.")}
    other = sorted(name for name in shapes.keys() | found.keys() if shapes.get(name) != found.get(name))
    if other:
        return f"{other[0]} of shape {found.get(other[0])}, now {shapes.get(other[0])}"
    order = state.tensors.get("order")
    if order is None or (state.step and len(order) != batch.size):
        return f"{0 if order is None else len(order)} segments, now {batch.size}"
    return None


def _next_steps(steps: int, seconds: float) -> int:
    """About SLICE_SECONDS of them, approached by doubling."""
    fitting = int(steps * SLICE_SECONDS / max(seconds, 1e-6))
    return max(1, min(2 * steps, fitting))

"""Training of any network: AdamW, scheduled learning rate, clipped gradients; resumable at every step, bit for bit."""

import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import Tensor

from models.network import Network, SemiSupervised
from models.segments import SegmentBatch

Progress = Callable[[int, int, float], None]
PROGRESS_EVERY = 25  # steps


class NonFiniteError(ValueError):
    """A loss or gradient that is not finite."""


@dataclass(frozen=True)
class TrainingConfig:
    """`warm_up` is the share of the steps in which the learning rate rises from 0.

    After it a cosine brings it back to 0, or, where it is `constant`, it stays.
    """

    steps: int
    batch_size: int
    learning_rate: float
    weight_decay: float
    warm_up: float = 0.15
    clip: float = 1.0  # largest norm of the gradient
    constant: bool = False

    def __post_init__(self) -> None:
        if self.steps < 1 or self.batch_size < 1:
            raise ValueError(f"steps and batch_size must be at least 1, got {self.steps} and {self.batch_size}.")


@dataclass(frozen=True)
class TrainingResult:
    """Steps done, and the mean minibatch loss over the last tenth of them."""

    steps: int
    final_loss: float


@dataclass(frozen=True)
class TrainingState:
    """Everything that training needs to go on from `step` as if it had never stopped.

    tensors: `model.*`, `optimiser.*`, `generator` (its state) and `order` (the shuffled indices of this epoch).
    """

    step: int
    config: TrainingConfig
    tensors: dict[str, Tensor]
    recent: tuple[float, ...] = ()  # losses of the last tenth of the schedule

    def weights(self) -> dict[str, Tensor]:
        """Of the model."""
        return _under(self.tensors, "model.")

    def to_bytes(self) -> bytes:
        """Safetensors, with step, config and recent losses as JSON metadata."""
        meta = {"step": self.step, "config": asdict(self.config), "recent": [loss.hex() for loss in self.recent]}
        return save_tensors(self.tensors, {"training": json.dumps(meta)})

    @staticmethod
    def from_bytes(data: bytes) -> "TrainingState":
        """Raises ValueError for bytes that `to_bytes` did not write."""
        try:
            tensors = load_tensors(data)
            header: dict[str, Any] = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
            meta = json.loads(header["__metadata__"]["training"])
        except (SafetensorError, KeyError, ValueError) as error:
            raise ValueError(f"These {len(data)} bytes are no training state: {error}") from error
        recent = tuple(float.fromhex(loss) for loss in meta["recent"])
        return TrainingState(meta["step"], TrainingConfig(**meta["config"]), tensors, recent)


def train(
    model: Network,
    dataset: SegmentBatch,
    config: TrainingConfig,
    generator: torch.Generator,
    device: torch.device | str = "cpu",
    progress: Progress | None = None,
    action_free: SegmentBatch | None = None,
) -> TrainingResult:
    """Trains in place, all steps at once, and leaves the model on `device`.

    action_free: what a SemiSupervised network reads beside the dataset, a minibatch of each a step. Raises
    NonFiniteError naming step and segments, ValueError for observations outside the model's spaces.
    """
    state = advance(model, dataset, begin(model, config, generator), config.steps, device, progress, action_free)
    return TrainingResult(state.step, sum(state.recent) / len(state.recent))


def begin(model: Network, config: TrainingConfig, generator: torch.Generator) -> TrainingState:
    """The state before the first step; later draws continue from the generator's state at this moment."""
    tensors = {f"model.{name}": tensor.detach().clone() for name, tensor in model.state_dict().items()}
    tensors["generator"] = generator.get_state()
    tensors["order"] = torch.empty(0, dtype=torch.int64)
    return TrainingState(0, config, tensors)


def advance(
    model: Network,
    dataset: SegmentBatch,
    state: TrainingState,
    until: int,
    device: torch.device | str = "cpu",
    progress: Progress | None = None,
    action_free: SegmentBatch | None = None,
) -> TrainingState:
    """Trains from `state` to step `until`; the model, in place, takes the state's weights first.

    Slices of any length give bitwise the weights of one uninterrupted run.
    """
    _check_dataset(model, dataset)
    model.to(device)
    run = _Run(model, dataset, state, device, _checked(model, action_free))
    for step in range(state.step, until):
        loss = run.step(step)
        if progress is not None and ((step + 1) % PROGRESS_EVERY == 0 or step + 1 == until):
            progress(step + 1, state.config.steps, loss)
    return run.state(max(until, state.step))


def learning_rate(config: TrainingConfig, step: int) -> float:
    """One cycle: linear warm-up, then a cosine to zero, or constant. `step` counts from 0."""
    rise = max(1.0, config.warm_up * config.steps)
    if step < rise:
        return config.learning_rate * (step + 1) / (rise + 1)
    if config.constant:
        return config.learning_rate
    fraction = (step - rise) / max(1.0, config.steps - rise)
    return config.learning_rate * 0.5 * (1.0 + math.cos(math.pi * fraction))


def _check_dataset(model: Network, dataset: SegmentBatch) -> None:
    if dataset.size == 0:
        raise ValueError(f"Training a {model.kind} needs at least one segment, got none.")
    model.check(dataset)


def _checked(model: Network, action_free: SegmentBatch | None) -> SegmentBatch | None:
    """What the model reads beside its dataset, without labels. Raises ValueError for a model that reads nothing."""
    if action_free is None:
        return None
    if not isinstance(model, SemiSupervised):
        raise ValueError(f"A {model.kind} of the {model.family} family does not learn from action-free segments.")
    _check_dataset(model, action_free)
    return action_free.without_labels()


class _Run:
    """One slice of training: the model, its optimiser and generator, restored from a state."""

    def __init__(
        self,
        model: Network,
        dataset: SegmentBatch,
        state: TrainingState,
        device: torch.device | str,
        action_free: SegmentBatch | None,
    ) -> None:
        self.model, self.config, self.device = model, state.config, device
        self.names = dataset.segments
        self.dataset = SegmentBatch(dataset.observations, dataset.actions, dataset.action_sets)
        self.action_free = action_free
        self.beside: SegmentBatch | None = None  # the minibatch of it
        model.load_state_dict(state.weights())
        self.parameters = dict(model.named_parameters())
        self.optimiser = torch.optim.AdamW(
            self.parameters.values(), lr=state.config.learning_rate, weight_decay=state.config.weight_decay, fused=True
        )
        self._restore_optimiser(_under(state.tensors, "optimiser."))
        self.generator = torch.Generator()
        self.generator.set_state(state.tensors["generator"].cpu())
        self.order = state.tensors["order"]
        self.recent = list(state.recent)

    def step(self, step: int) -> float:
        """One minibatch; returns its loss."""
        indices = self._minibatch(step)
        for group in self.optimiser.param_groups:
            group["lr"] = learning_rate(self.config, step)
        self.optimiser.zero_grad()
        loss = self._loss(indices)
        value = float(loss.detach())
        self._require_finite("loss", value, step, indices)
        loss.backward()  # type: ignore[no-untyped-call]  # torch leaves it unannotated
        norm = torch.nn.utils.clip_grad_norm_(self.parameters.values(), self.config.clip)
        self._require_finite("gradient norm", float(norm), step, indices)
        self.optimiser.step()
        if step >= self.config.steps - max(1, self.config.steps // 10):
            self.recent.append(value)
        return value

    def _loss(self, indices: Tensor) -> Tensor:
        batch = self.dataset.take(indices).to(self.device)  # all of it may be too much for a device
        if self.action_free is None or not isinstance(self.model, SemiSupervised):
            return self.model.loss(batch, self.generator)
        rows = torch.randint(self.action_free.size, (len(indices),), generator=self.generator)
        self.beside = self.action_free.take(rows).to(self.device)
        return self.model.semi_supervised_loss(batch, self.beside, self.generator)

    def state(self, step: int) -> TrainingState:
        """A copy of everything, after `step` steps."""
        tensors = {f"model.{name}": tensor.detach().clone() for name, tensor in self.model.state_dict().items()}
        for name, parameter in self.parameters.items():
            for field, value in self.optimiser.state[parameter].items():
                tensors[f"optimiser.{field}.{name}"] = value.detach().clone()
        tensors["generator"], tensors["order"] = self.generator.get_state(), self.order.clone()
        return TrainingState(step, self.config, tensors, tuple(self.recent))

    def _minibatch(self, step: int) -> Tensor:
        """Epochs without replacement; what is left of an epoch and smaller than a minibatch is dropped."""
        size = min(self.config.batch_size, self.dataset.size)
        place = step % (self.dataset.size // size)
        if place == 0:
            self.order = torch.randperm(self.dataset.size, generator=self.generator)
        return self.order[place * size : (place + 1) * size]

    def _restore_optimiser(self, saved: dict[str, Tensor]) -> None:
        for name, parameter in self.parameters.items():
            keys = {field: f"{field}.{name}" for field in ("step", "exp_avg", "exp_avg_sq")}
            fields = {field: saved[key] for field, key in keys.items() if key in saved}
            if fields:  # else no loss has reached the parameter so far
                self.optimiser.state[parameter] = {
                    key: value.clone().to(parameter.device) for key, value in fields.items()
                }

    def _require_finite(self, what: str, value: float, step: int, indices: Tensor) -> None:
        if math.isfinite(value):
            return
        named = [f"{self.names[i].trajectory}:{self.names[i].start}" for i in indices.tolist()] if self.names else []
        if self.beside is not None:
            named += [f"{self.beside.name(row)} (action-free)" for row in range(self.beside.size)]
        which = ", ".join(named) or f"rows {indices.tolist()}"
        raise NonFiniteError(f"The {what} of {self.model.kind} is {value} at step {step}; its segments: {which}.")


def _under(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}

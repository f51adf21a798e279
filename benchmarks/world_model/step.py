"""A training step of the recurrent world model at its paper preset: 16 sequences of 32 observations, two cameras."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeVar

import torch
from torch import Tensor

from benchmarks.world_model.clock import seconds
from models.segments import Observations, SegmentBatch
from models.spaces import BoxAction, Spaces, StreamSpec
from models.training import TrainingConfig
from models.world_models.recurrent import PAPER, RecurrentWorldModel

SEQUENCES = 16
IMAGE = StreamSpec((64, 64, 3), "uint8")
SPACES = Spaces(
    {"front": IMAGE, "wrist": IMAGE, "proprioception": StreamSpec((11,), "float32")}, BoxAction(-1.0, 1.0, (7,), (6,))
)
T = TypeVar("T")
PARTS = ("encoder", "recurrence", "decoder", "optimizer")


def sequences(generator: torch.Generator) -> SegmentBatch:
    """Random images, numbers and actions: what they show does not change what they cost."""
    lead = (SEQUENCES, PAPER.window)
    observations: Observations = {
        name: torch.randint(256, (*lead, *IMAGE.shape), generator=generator, dtype=torch.uint8)
        for name in ("front", "wrist")
    }
    observations["proprioception"] = torch.randn((*lead, 11), generator=generator)
    actions = torch.rand((SEQUENCES, PAPER.window - 1, 7), generator=generator) * 2 - 1
    return SegmentBatch(observations, actions)


@dataclass
class Step:
    """A model, its optimiser, and a batch on their device."""

    model: RecurrentWorldModel
    batch: SegmentBatch
    config: TrainingConfig
    generator: torch.Generator
    optimiser: torch.optim.Optimizer = field(init=False)

    def __post_init__(self) -> None:
        rate, decay = self.config.learning_rate, self.config.weight_decay
        self.optimiser = torch.optim.AdamW(self.model.parameters(), lr=rate, weight_decay=decay, fused=True)

    def run(self) -> None:
        """As training does it."""
        self.backward()
        self.update()

    def backward(self) -> None:
        """The loss and its gradient."""
        self.optimiser.zero_grad()
        self.model.loss(self.batch, self.generator).backward()  # type: ignore[no-untyped-call]  # untyped in torch

    def update(self) -> None:
        """Clipping and the optimizer's step."""
        torch.nn.utils.clip_grad_norm_(self.model.parameters(), self.config.clip)
        self.optimiser.step()


def shares(step: Step, device: torch.device) -> dict[str, float]:
    """Seconds of each of PARTS: the step cut where embeddings and states pass from one part to the next."""
    model, actions, spent = step.model, step.batch.actions, dict.fromkeys(PARTS, 0.0)
    assert actions is not None

    def timed(part: str, work: Callable[[], T]) -> T:
        done: list[T] = []
        spent[part] += seconds(lambda: done.append(work()), device)
        return done[0]

    step.optimiser.zero_grad()
    frame = model.streams.frame(step.batch.observations)
    embeddings = timed("encoder", lambda: model.embed(frame))
    seen = embeddings.detach().requires_grad_()
    uniform = torch.rand((*seen.shape[:2], model.config.groups), generator=step.generator).to(device)
    latent, divergence = timed("recurrence", lambda: model.latent(seen, actions, uniform))
    states = latent.detach().requires_grad_()
    timed("decoder", lambda: _backward((model.reconstruction(states, frame).mean(), None)))
    timed("recurrence", lambda: _backward((divergence.mean(), None), (latent, states.grad)))
    timed("encoder", lambda: _backward((embeddings, seen.grad)))
    timed("optimizer", step.update)
    return spent


def _backward(*results: tuple[Tensor, Tensor | None]) -> None:
    """From results with the gradients that reached them."""
    torch.autograd.backward([result for result, _ in results], [gradient for _, gradient in results])

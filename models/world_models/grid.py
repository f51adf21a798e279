"""World model of grid worlds: coordinate convolution, quantised action code, FiLM residual dynamics, per-cell heads."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from models.networks import grid as cells
from models.networks.film import FilmDynamics
from models.networks.initialisation import initialise
from models.networks.quantisation import SupervisedCodebook
from models.networks.symmetry import turned
from models.segments import Observations, SegmentBatch, at, flatten_steps, future
from models.spaces import DiscreteAction, Spaces


@dataclass(frozen=True)
class GridWorldModelConfig:
    """Widths are multiples of 16, which CPU convolutions are fastest at."""

    channels: int = 32
    blocks: int = 2
    code_size: int = 16
    carried_hidden: int = 32
    reconstruction: float = 0.1  # weight of decode(encode(x_t)) against x_t


class GridWorldModel(nn.Module):
    """States are (B, S, S, C). Distances are nats, summed over all cells and the carried object."""

    family = "grid"
    kind = "world_model"

    def __init__(self, spaces: Spaces, config: GridWorldModelConfig, generator: torch.Generator) -> None:
        super().__init__()
        if not isinstance(spaces.action, DiscreteAction):
            raise TypeError(f"The grid world model needs a discrete action space, got {spaces.action}.")
        self.spaces, self.config = spaces, config
        self.size = spaces.observations["grid"].shape[0]
        self.encoder = cells.GridEncoder(self.size, config.channels)
        self.codebook = SupervisedCodebook(spaces.action.n, config.code_size)
        self.dynamics = FilmDynamics(config.code_size, config.channels, self.size, self.size, config.blocks)
        self.decoder = cells.GridDecoder(config.channels, config.carried_hidden)
        initialise(self, generator)
        self.dynamics.weaken(0.0)

    def check(self, batch: SegmentBatch) -> None:
        """Raises ValueError for values outside the vocabulary."""
        cells.check(batch.observations)

    def encode(self, observations: Observations) -> Tensor:
        """grid (B, S, S, 3), carried (B, 3) -> (B, S, S, C)."""
        z: Tensor = self.encoder((observations,))
        return z

    def predict(self, state: Tensor, actions: Tensor) -> Tensor:
        """(B, S, S, C), int64 (B,) -> (B, S, S, C)."""
        film = self.dynamics.parameters_of(self.codebook())  # once an action, not once a row
        z: Tensor = self.dynamics(state, film[actions])
        return z

    def decode(self, state: Tensor) -> Observations:
        """(B, S, S, C) -> logits, vocabulary first: grid (22, B*S*S), carried (22, B)."""
        logits: Observations = self.decoder(state)
        return logits

    def observe(self, state: Tensor) -> Observations:
        """(B, S, S, C) -> the mode of every channel: uint8 grid (B, S, S, 3), carried (B, 3)."""
        return cells.decoded_modes(self.decode(state), self.size)

    def infer_state(
        self, observations: Observations, actions: Tensor | None = None, context: Tensor | None = None
    ) -> Tensor:
        """A grid is fully observed: the last frame is the state; actions and context add nothing."""
        return self.encode(at(observations, -1))

    def rollout(self, state: Tensor, actions: Tensor) -> Tensor:
        """(B, S, S, C), int64 (B, L) -> (B, L, S, S, C), in latent space."""
        predictions = []
        for step in range(actions.shape[1]):
            state = self.predict(state, actions[:, step])
            predictions.append(state)
        return torch.stack(predictions, 1)

    def distance(self, prediction: Tensor, reference: Observations) -> Tensor:
        """Cross-entropy in nats of the decoded prediction, summed over elements and the L steps -> (B,)."""
        batch, steps = prediction.shape[:2]
        logits = self.decode(prediction.flatten(0, 1))  # (B, L, ...) -> (B*L, ...)
        return cells.observation_cross_entropy(logits, flatten_steps(reference)).view(batch, steps).sum(1)

    def loss(self, batch: SegmentBatch, generator: torch.Generator) -> Tensor:
        """Mean nats a transition + reconstruction of x_t + the codebook's loss.

        The generator turns the rooms and, where several actions explain a step, draws one.
        """
        if batch.actions is None:
            raise ValueError("The grid world model trains on labeled segments; the batch carries no actions.")
        batch = turned(batch.with_drawn_actions(generator), generator)
        assert batch.actions is not None  # noqa: S101  # drawn or given
        now = at(batch.observations, 0)
        state = self.encode(now)
        prediction = self.rollout(state, batch.actions)
        dynamics = self.distance(prediction, future(batch.observations)).mean() / batch.length
        reconstruction = cells.observation_cross_entropy(self.decode(state), now).mean()
        codes: Tensor = self.codebook.loss()
        return dynamics + self.config.reconstruction * reconstruction + codes

    def disagreement(self, decoded: Sequence[Observations]) -> Tensor:
        """Mutual information of member and outcome, H(mean p) - mean H(p), summed over elements -> (B,) nats."""
        grid = _mutual_information([member["grid"] for member in decoded])
        return grid.view(-1, self.size**2).sum(1) + _mutual_information([member["carried"] for member in decoded])

    def latent_features(self, observations: Observations, actions: Tensor) -> Tensor:
        """Predicted z at the agent's cell and the cell in front, mean over steps -> (B, 2*C)."""
        batch, steps = actions.shape
        state = self.infer_state({name: stream[:, :1] for name, stream in observations.items()})
        prediction = self.rollout(state, actions).view(batch * steps, self.size**2, -1)
        touched = cells.touched_cells(observations["grid"][:, :-1].flatten(0, 1))  # (B*L, 2)
        return cells.gather_cells(prediction, touched).view(batch, steps, -1).mean(1)

    def signatures(self, observations: Observations, actions: Tensor) -> Tensor:
        """Per step the action, the cell in front and the hand before, and both after it -> int64 (B, 5 * L)."""
        grid = observations["grid"]
        front = cells.touched_cells(grid[:, :-1].flatten(0, 1))[:, 1:]  # (B*L, 1)
        parts = [actions.reshape(-1)]
        for frame in (slice(None, -1), slice(1, None)):
            seen = cells.gather_cells(grid[:, frame].flatten(0, 1).flatten(1, 2), front).squeeze(1)  # (B*L, 3)
            parts += [cells.word(seen), cells.word(observations["carried"][:, frame].flatten(0, 1))]
        return torch.stack(parts, 1).view(len(actions), -1)  # (B*L, 5) -> (B, 5*L)

    def changes(self, prediction: Tensor, observations: Observations) -> tuple[Tensor, Tensor]:
        """A cell is right when its three channels are; the carried object counts as one element more."""
        guess = self.observe(prediction)
        correct = torch.zeros(len(prediction), dtype=torch.int64, device=prediction.device)
        changed = torch.zeros_like(correct)
        for name, stream in observations.items():
            moved = (stream[:, 0] != stream[:, 1]).any(-1)
            hit = (guess[name] == stream[:, 1]).all(-1) & moved
            correct += hit.view(len(hit), -1).sum(1)
            changed += moved.view(len(moved), -1).sum(1)
        return correct, changed


def _mutual_information(members: Sequence[Tensor]) -> Tensor:
    total = torch.zeros_like(members[0][0])
    for head in zip(*(cells.probabilities(logits) for logits in members), strict=True):
        stacked = torch.stack(head)  # (members, V, N)
        total += _entropy(stacked.mean(0)) - _entropy(stacked).mean(0)
    return total.clamp_(min=0.0)


def _entropy(probability: Tensor) -> Tensor:
    """(..., V, N) -> (..., N) nats."""
    entropy: Tensor = torch.special.entr(probability).sum(-2)
    return entropy

"""World model of grid worlds: soft observations, quantised action code, FiLM residual dynamics, heads that can copy."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from models.networks import grid as cells
from models.networks.coordinate_convolution import CoordinateConvolution
from models.networks.film import FilmDynamics
from models.networks.initialisation import initialise, linear
from models.networks.mlp import Mlp
from models.networks.pointer_generator import PointerGenerator
from models.networks.quantisation import SupervisedCodebook
from models.networks.symmetry import turned
from models.segments import Observations, SegmentBatch, at, future
from models.spaces import DiscreteAction, Spaces


@dataclass(frozen=True)
class GridWorldModelConfig:
    """Widths are multiples of 16, which CPU convolutions are fastest at."""

    channels: int = 32
    blocks: int = 2
    code_size: int = 16
    carried_hidden: int = 32
    keep: float = 4.0  # of an element, against copying and writing: added to the logit at the start
    floor: float = 3e-4  # share of a decoded channel that is uniform: no surprise is endless

    def __post_init__(self) -> None:
        if not 0.0 < self.floor < 1.0:
            raise ValueError(f"floor must be between 0 and 1, got {self.floor}.")


class GridWorldModel(nn.Module):
    """States are soft observations (B, S*S + 1, 22): each channel's distribution, of the cells and then of the hand.

    Distances are nats, summed over all cells and the carried object.
    """

    family = "grid"
    kind = "world_model"
    symbolic = True
    uniform: Tensor

    def __init__(self, spaces: Spaces, config: GridWorldModelConfig, generator: torch.Generator) -> None:
        super().__init__()
        if not isinstance(spaces.action, DiscreteAction):
            raise TypeError(f"The grid world model needs a discrete action space, got {spaces.action}.")
        self.spaces, self.config = spaces, config
        self.size = spaces.observations["grid"].shape[0]
        channels, outputs = config.channels, PointerGenerator.OUTPUTS
        self.embedding = linear(cells.WORDS, channels)
        self.carried_embedding = linear(cells.WORDS, channels)
        self.convolution = CoordinateConvolution(channels, channels, self.size, self.size)
        self.codebook = SupervisedCodebook(spaces.action.n, config.code_size)
        self.dynamics = FilmDynamics(config.code_size, channels, self.size, self.size, config.blocks)
        self.attention = linear(channels, 1)
        self.cells = PointerGenerator(linear(channels, outputs), config.keep)
        self.carried = PointerGenerator(Mlp((channels, config.carried_hidden, outputs)), config.keep)
        self.register_buffer("uniform", 1.0 / torch.tensor(cells.VOCABULARY)[cells.channel_of_word()], persistent=False)
        initialise(self, generator)
        self.dynamics.weaken(0.0)

    def check(self, batch: SegmentBatch) -> None:
        """Raises ValueError for values outside the vocabulary."""
        cells.check(batch.observations)

    def encode(self, observations: Observations) -> Tensor:
        """grid (B, S, S, 3), carried (B, 3) -> (B, S*S + 1, 22), which holds all of it: nothing is learned."""
        return cells.one_hot(_elements(observations, 1)).float()

    def predict(self, state: Tensor, actions: Tensor) -> Tensor:
        """(B, S*S + 1, 22), int64 (B,) -> (B, S*S + 1, 22).

        A cell may copy what the hand held, the hand what it attends to among the cells.
        """
        words = state.movedim(2, 0)  # (22, B, S*S + 1)
        grid, carried = words[..., :-1], words[..., -1:]
        film = self.dynamics.parameters_of(self.codebook())  # once an action, not once a row
        z = self.dynamics(self._features(state), film[actions]).flatten(1, 2)  # (B, S*S, C)
        attention = self.attention(z).squeeze(2).softmax(1)  # (B, S*S)
        pooled = torch.bmm(attention.unsqueeze(1), z)  # (B, 1, C)
        source = (attention * grid).sum(2, keepdim=True)  # (22, B, 1)
        after = self.cells(z, grid, carried), self.carried(pooled, carried, source)
        return torch.cat(after, 2).movedim(0, 2)

    def _features(self, state: Tensor) -> Tensor:
        """(B, S*S + 1, 22) -> (B, S, S, C)."""
        z = self.embedding(state[:, :-1]) + self.carried_embedding(state[:, -1:])
        h: Tensor = self.convolution(z.view(len(z), self.size, self.size, z.shape[2]))
        return h.relu_()

    def decode(self, state: Tensor) -> Observations:
        """(B, S*S + 1, 22) -> logits, vocabulary first: grid (22, B*S*S), carried (22, B)."""
        logits = torch.lerp(state, self.uniform, self.config.floor).log()
        return {"grid": logits[:, :-1].flatten(0, 1).t(), "carried": logits[:, -1].t()}

    def observe(self, state: Tensor) -> Observations:
        """(B, S*S + 1, 22) -> the mode of every channel: uint8 grid (B, S, S, 3), carried (B, 3)."""
        return cells.decoded_modes(self.decode(state), self.size)

    def infer_state(
        self, observations: Observations, actions: Tensor | None = None, context: Tensor | None = None
    ) -> Tensor:
        """A grid is fully observed: the last frame is the state; actions and context add nothing."""
        return self.encode(at(observations, -1))

    def rollout(self, state: Tensor, actions: Tensor) -> Tensor:
        """(B, S*S + 1, 22), int64 (B, L) -> (B, L, S*S + 1, 22), each step from distributions, not from their modes."""
        predictions = []
        for step in range(actions.shape[1]):
            state = self.predict(state, actions[:, step])
            predictions.append(state)
        return torch.stack(predictions, 1)

    def distance(self, prediction: Tensor, reference: Observations) -> Tensor:
        """Cross-entropy in nats of the decoded prediction, summed over elements and the L steps -> (B,).

        A prediction that is right and certain is about 2.5 floor an element away. Raises ValueError for other shapes.
        """
        targets = cells.word_targets(_elements(reference, 2))  # (B, L, S*S + 1, 3)
        if prediction.shape[:3] != targets.shape[:3]:
            raise ValueError(f"predictions {tuple(prediction.shape)} are of other steps than {tuple(targets.shape)}.")
        probability = prediction.gather(3, targets)
        uniform = self.uniform[targets]
        nats: Tensor = -torch.lerp(probability, uniform, self.config.floor).log().sum((1, 2, 3))
        return nats

    def loss(self, batch: SegmentBatch, generator: torch.Generator) -> Tensor:
        """Mean nats a transition + the codebook's loss.

        The generator turns the rooms and, where several actions explain a step, draws one.
        """
        if batch.actions is None:
            raise ValueError("The grid world model trains on labeled segments; the batch carries no actions.")
        batch = turned(batch.with_drawn_actions(generator), generator)
        assert batch.actions is not None  # noqa: S101  # drawn or given
        prediction = self.rollout(self.encode(at(batch.observations, 0)), batch.actions)
        dynamics = self.distance(prediction, future(batch.observations)).mean() / batch.length
        codes: Tensor = self.codebook.loss()
        return dynamics + codes

    def disagreement(self, decoded: Sequence[Observations]) -> Tensor:
        """Mutual information of member and outcome, H(mean p) - mean H(p), summed over elements -> (B,) nats."""
        grid = _mutual_information([member["grid"] for member in decoded])
        return grid.view(-1, self.size**2).sum(1) + _mutual_information([member["carried"] for member in decoded])

    def latent_features(self, observations: Observations, actions: Tensor) -> Tensor:
        """The soft prediction of the agent's cell, the cell in front and the hand, mean over steps -> (B, 66)."""
        batch, steps = actions.shape
        state = self.infer_state({name: stream[:, :1] for name, stream in observations.items()})
        prediction = self.rollout(state, actions).flatten(0, 1)  # (B*L, S*S + 1, 22)
        touched = cells.touched_cells(observations["grid"][:, :-1].flatten(0, 1))  # (B*L, 2)
        hand = torch.full_like(touched[:, :1], self.size**2)
        read = cells.gather_cells(prediction, torch.cat((touched, hand), 1))
        return read.view(batch, steps, 3 * cells.WORDS).mean(1)

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


def _elements(observations: Observations, lead: int) -> Tensor:
    """All cells, then the hand, of observations with `lead` leading dimensions: uint8 (..., S*S + 1, 3)."""
    grid = observations["grid"].flatten(lead, lead + 1)
    return torch.cat((grid, observations["carried"].unsqueeze(lead)), lead)


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

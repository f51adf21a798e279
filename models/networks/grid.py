"""What the grid networks share: vocabulary, embedding, encoder and decoder of an observation.

Observation: `grid` uint8 (B, S, S, 3) with channels (object, colour, state), and `carried` uint8 (B, 3) in the same
code (empty hand 1, 0, 0). The agent hides the cell it stands on; its state channel is its direction.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from models.networks.coordinate_convolution import CoordinateConvolution
from models.networks.initialisation import linear, table
from models.networks.mlp import Mlp
from models.segments import Observations

OBJECTS, COLOURS, STATES = 11, 6, 5
VOCABULARY = (OBJECTS, COLOURS, STATES)
WORDS = sum(VOCABULARY)  # 22 logits an element: the three channels' heads one after the other
AGENT = 10
FORWARD = ((0, 1), (1, 0), (0, -1), (-1, 0))  # (row, column) step of direction right, down, left, up


def check(observations: Observations) -> None:
    """Raises ValueError naming stream, channel and value when a value is outside the vocabulary."""
    for name in ("grid", "carried"):
        highest = observations[name].reshape(-1, 3).amax(0).tolist()
        for channel, value, size in zip(("object", "colour", "state"), highest, VOCABULARY, strict=True):
            if value >= size:
                raise ValueError(f"{name}: {channel} must be below {size}, got {value}.")


def touched_cells(grid: Tensor) -> Tensor:
    """Flat positions (B, 2) of the agent's cell and the cell in front of it, in grid (B, S, S, 3).

    At the border the front cell is clamped to the grid. A grid without an agent (a generated one) gives cell 0.
    """
    size = grid.shape[1]
    agent = (grid[..., 0] == AGENT).flatten(1).byte().argmax(1)  # (B,)
    direction = grid[..., 2].flatten(1).gather(1, agent.unsqueeze(1)).squeeze(1).long() % len(FORWARD)
    step = torch.tensor(FORWARD, device=grid.device)[direction]  # (B, 2)
    row = (agent // size + step[:, 0]).clamp_(0, size - 1)
    column = (agent % size + step[:, 1]).clamp_(0, size - 1)
    return torch.stack((agent, row * size + column), 1)


def gather_cells(z: Tensor, cells: Tensor) -> Tensor:
    """z (B, S*S, C) at cells (B, N) -> (B, N, C)."""
    return z.gather(1, cells.unsqueeze(2).expand(-1, -1, z.shape[2]))


def word(elements: Tensor) -> Tensor:
    """The three channels of an element as one number: uint8 (..., 3) -> int64 (...)."""
    channels = elements.long()
    return (channels[..., 0] * COLOURS + channels[..., 1]) * STATES + channels[..., 2]


def channel_of_word() -> Tensor:
    """Which channel each of the 22 words is a value of: int64 (22,)."""
    return torch.arange(len(VOCABULARY)).repeat_interleave(torch.tensor(VOCABULARY))


def word_targets(elements: Tensor) -> Tensor:
    """Places of an element's three channels among the 22 words: uint8 (..., 3) -> int64 (..., 3)."""
    return elements.long() + torch.tensor((0, OBJECTS, OBJECTS + COLOURS), device=elements.device)


def one_hot(elements: Tensor) -> Tensor:
    """Each channel one-hot: uint8 (..., 3) -> uint8 (..., 22)."""
    codes = torch.zeros(*elements.shape[:-1], WORDS, dtype=torch.uint8, device=elements.device)
    return codes.scatter_(-1, word_targets(elements), 1)


def split_heads(logits: Tensor) -> tuple[Tensor, ...]:
    """(22, N) -> (11, N), (6, N), (5, N)."""
    heads: tuple[Tensor, ...] = logits.split(VOCABULARY)  # type: ignore[no-untyped-call]  # untyped in torch
    return heads


def cross_entropy(logits: Tensor, elements: Tensor) -> Tensor:
    """-log p(element), summed over its three channels: logits (22, N), elements uint8 (N, 3) -> (N,) nats.

    The vocabulary leads so that each log-sum-exp runs along rows that lie contiguous in memory.
    """
    heads = [torch.logsumexp(head, 0) for head in split_heads(logits)]
    return heads[0] + heads[1] + heads[2] - logits.gather(0, word_targets(elements).t()).sum(0)


def probabilities(logits: Tensor) -> list[Tensor]:
    """Each channel's distribution: logits (22, N) -> (11, N), (6, N), (5, N)."""
    return [head.softmax(0) for head in split_heads(logits)]


def most_likely(logits: Tensor) -> Tensor:
    """The mode of every channel: logits (22, N) -> uint8 (N, 3)."""
    return torch.stack([head.argmax(0) for head in split_heads(logits)], 1).byte()


class ElementEmbedding(nn.Module):
    """Factored embedding: the sum of an object's, a colour's and a state's vector, (..., 3) -> (..., C)."""

    def __init__(self, size: int) -> None:
        super().__init__()
        self.objects = table(OBJECTS, size, 0.5)
        self.colours = table(COLOURS, size, 0.5)
        self.states = table(STATES, size, 0.5)

    def forward(self, elements: Tensor) -> Tensor:
        # All 330 sums are formed once a call, so an element costs one look-up instead of three and two additions.
        sums = self.objects[:, None, None] + self.colours[:, None] + self.states
        return torch.nn.functional.embedding(word(elements), sums.flatten(0, 2))


class GridEncoder(nn.Module):
    """Frames and what is carried at their times, embedded and convolved: -> (B, S, S, C).

    `frames` observations are read together (1: an encoder; 2: x_t and x_{t+1}), each through its own embedding.
    """

    def __init__(self, size: int, channels: int, frames: int = 1) -> None:
        super().__init__()
        self.cells = nn.ModuleList(ElementEmbedding(channels) for _ in range(frames))
        self.hand = nn.ModuleList(ElementEmbedding(channels) for _ in range(frames))
        self.convolution = CoordinateConvolution(channels, channels, size, size)

    def forward(self, frames: Sequence[Observations]) -> Tensor:
        z: Tensor | None = None
        for cells, hand, frame in zip(self.cells, self.hand, frames, strict=True):
            carried: Tensor = hand(frame["carried"])
            embedded = cells(frame["grid"]) + carried[:, None, None]  # (B, S, S, C) + (B, 1, 1, C)
            z = embedded if z is None else z + embedded
        h: Tensor = self.convolution(z)
        return h.relu_()


class GridDecoder(nn.Module):
    """Per-cell heads of the three channels, and the carried object's heads over an attention pool of the cells."""

    def __init__(self, channels: int, hidden: int) -> None:
        super().__init__()
        self.cells = linear(channels, WORDS + 1)  # the last row is the attention of the carried head
        self.carried = Mlp((channels, hidden, WORDS))

    def forward(self, z: Tensor) -> Observations:
        """z (B, S, S, C) -> logits, vocabulary first: grid (22, B*S*S), carried (22, B)."""
        batch, channels = z.shape[0], z.shape[-1]
        flat = z.reshape(-1, channels)
        logits = torch.addmm(self.cells.bias.unsqueeze(1), self.cells.weight, flat.t())  # (23, B*S*S)
        attention = logits[WORDS].view(batch, 1, -1).softmax(2)
        pooled = torch.bmm(attention, z.reshape(batch, -1, channels)).squeeze(1)  # (B, C)
        return {"grid": logits[:WORDS], "carried": self.carried(pooled).t()}


class PooledHead(nn.Module):
    """Convolution, mean and max pool over cells, perceptron: (B, S, S, C) -> (B, outputs)."""

    def __init__(self, size: int, channels: int, hidden: int, outputs: int) -> None:
        super().__init__()
        self.convolution = CoordinateConvolution(channels, channels, size, size)
        self.mlp = Mlp((2 * channels, hidden, outputs))

    def forward(self, z: Tensor) -> Tensor:
        h = self.convolution(z).relu_().flatten(1, 2)  # (B, S*S, C)
        out: Tensor = self.mlp(torch.cat((h.mean(1), h.amax(1)), 1))
        return out


def observation_cross_entropy(logits: Observations, observations: Observations) -> Tensor:
    """Summed over all cells and the carried object: decoder logits, observations (B, ...) -> (B,) nats."""
    batch = observations["grid"].shape[0]
    cells = cross_entropy(logits["grid"], observations["grid"].reshape(-1, 3)).view(batch, -1).sum(1)
    return cells + cross_entropy(logits["carried"], observations["carried"])


def decoded_modes(logits: Observations, size: int) -> Observations:
    """The most likely observation: decoder logits -> uint8 grid (B, S, S, 3), carried (B, 3)."""
    grid = most_likely(logits["grid"]).view(-1, size, size, 3)
    return {"grid": grid, "carried": most_likely(logits["carried"])}

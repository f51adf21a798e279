"""What inverse dynamics of grid worlds reads: elements (cells and the hand) of x_t and x_{t+1}, side by side."""

import torch
from torch import Tensor, nn

from models.networks import grid as cells
from models.networks.mlp import Mlp
from models.segments import Observations
from models.spaces import DiscreteAction, Spaces

CHANNELS = len(cells.VOCABULARY)
PAIR_WORDS = 2 * cells.WORDS + CHANNELS  # an element's channels one-hot before and after, and which stayed the same


class ElementPairs(nn.Module):
    """What became of E elements in a step: words (N, E, 47) -> (N, outputs).

    Whether a channel stayed the same stands beside its two values, and training hides a share of the values: so what a
    key tells of an action also holds of a ball, and a combination that no label shows is no reason to guess.
    """

    channel_of_word: Tensor

    def __init__(self, elements: int, hidden: int, outputs: int, dropout: float) -> None:
        super().__init__()
        self.dropout = dropout
        self.mlp = Mlp((elements * PAIR_WORDS, hidden, hidden, outputs))
        values = cells.channel_of_word()
        same = torch.full((CHANNELS,), CHANNELS)  # never hidden
        self.register_buffer("channel_of_word", torch.cat((values, values, same)), persistent=False)

    def forward(self, words: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """A generator hides values (training); without one nothing is hidden."""
        if generator is not None:
            words = words * self._shown(words, generator)
        out: Tensor = self.mlp(words.flatten(1))
        return out

    def _shown(self, words: Tensor, generator: torch.Generator) -> Tensor:
        """(N, E, 47): 0 for a hidden channel before and after, else 1."""
        draw = torch.rand((*words.shape[:2], CHANNELS), generator=generator, device=generator.device)
        shown = (draw >= self.dropout).to(words)
        always = shown.new_ones(*words.shape[:2], 1)
        return torch.cat((shown, always), 2)[..., self.channel_of_word]


def element_words(before: Tensor, after: Tensor) -> Tensor:
    """Elements uint8 (N, E, 3) at t and t+1 -> float (N, E, 47)."""
    same = before == after
    return torch.cat((cells.one_hot(before), cells.one_hot(after), same), 2).float()


def touched_elements(before: Observations, after: Observations) -> tuple[Tensor, Tensor]:
    """The agent's cell and the one in front, both fixed by x_t, and the hand, at t and t+1: each uint8 (N, 3, 3)."""
    touched = cells.touched_cells(before["grid"])  # (N, 2)
    both = [
        torch.cat((cells.gather_cells(frame["grid"].flatten(1, 2), touched), frame["carried"].unsqueeze(1)), 1)
        for frame in (before, after)
    ]
    return both[0], both[1]


def pairs(observations: Observations) -> tuple[Observations, Observations]:
    """(B, L+1, ...) -> x_t and x_{t+1}, each (B*L, ...)."""
    before = {name: stream[:, :-1].flatten(0, 1) for name, stream in observations.items()}
    return before, {name: stream[:, 1:].flatten(0, 1) for name, stream in observations.items()}


def steps(observations: Observations) -> int:
    """L of observations (B, L+1, ...)."""
    return int(observations["grid"].shape[1]) - 1


def element_count(spaces: Spaces) -> int:
    """Elements of an observation: cells and the hand."""
    size = spaces.observations["grid"].shape[0]
    return size * size + 1


def action_count(spaces: Spaces) -> int:
    """Raises TypeError for an action space that is not discrete."""
    if not isinstance(spaces.action, DiscreteAction):
        raise TypeError(f"Grid inverse dynamics needs a discrete action space, got {spaces.action}.")
    return spaces.action.n

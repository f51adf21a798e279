"""The recurrent state-space model (Hafner et al. 2019) in DreamerV3's form: what steps a latent state through time.

    x_t = SiLU(LN(W1 [z_{t-1}, a_{t-1}])),  h_t = GRU(x_t, h_{t-1})
    prior p(z_t | h_t),  posterior q(z_t | h_t, e_t),  z_t: G groups of C classes

No action leads to the first observation: its h is a learned constant, or, where the config says so, read from the
observation itself. Then what one frame shows needs not pass through the few nats of its z.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn

from models.networks import categorical
from models.networks.initialisation import linear, table
from models.networks.mlp import NormalisedMlp
from models.networks.normalisation import NormalisedSilu
from models.networks.recurrent_cell import NormalisedGruCell


@dataclass(frozen=True)
class RecurrentStateSpaceConfig:
    """deterministic: size of h. hidden: of each layer between. unimix: share of every distribution that is uniform.

    reads_first: whether the first h comes from the first observation and not from a constant.
    """

    deterministic: int = 512
    groups: int = 32
    classes: int = 32
    hidden: int = 512
    unimix: float = 0.01
    reads_first: bool = False

    def __post_init__(self) -> None:
        if not 0.0 < self.unimix < 1.0:
            raise ValueError(f"unimix must be between 0 and 1, got {self.unimix}.")

    @property
    def stochastic(self) -> int:
        """Size of z."""
        return self.groups * self.classes

    @property
    def state(self) -> int:
        """Size of a state [h, z]."""
        return self.deterministic + self.stochastic


class Filtered(NamedTuple):
    """What T observations made of the latent state: states [h, z] (B, T, D), posterior q(z | h, e) (B, T, G, C)."""

    states: Tensor
    posterior: Tensor


class RecurrentStateSpace(nn.Module):
    """States are (B, D) = [h, z]. Only what depends on the step before is computed step by step: the shares of actions
    and embeddings in their layers are products over all steps at once, and the prior waits until all h are known."""

    def __init__(self, actions: int, embedding: int, config: RecurrentStateSpaceConfig) -> None:
        super().__init__()
        self.config = config
        hidden, size = config.hidden, config.deterministic
        self.first = linear(embedding, size) if config.reads_first else table(1, size, 0.1)
        self.from_z = linear(config.stochastic, hidden, bias=False)  # these two are W1
        self.from_action = linear(actions, hidden, bias=False)
        self.norm = NormalisedSilu(hidden)
        self.cell = NormalisedGruCell(hidden, size)
        self.prior_layers = NormalisedMlp((size, hidden))
        self.prior_head = linear(hidden, config.stochastic)
        self.from_h = linear(size, hidden, bias=False)  # these two are one layer of the posterior
        self.from_embedding = linear(embedding, hidden, bias=False)
        self.posterior_norm = NormalisedSilu(hidden)
        self.posterior_head = linear(hidden, config.stochastic)

    def split(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """(..., D) -> h and z."""
        return state[..., : self.config.deterministic], state[..., self.config.deterministic :]

    def filter(
        self, embeddings: Tensor, actions: Tensor, uniform: Tensor | None = None, context: Tensor | None = None
    ) -> Filtered:
        """Embeddings (B, T, E), actions (B, T-1, A) between them, one more before them where `context` (B, D) is the
        state before the first.

        z is drawn by uniform (B, T, G), or the mode without it.
        """
        seen: Tensor = self.from_embedding(embeddings)
        h, z = self._beginning(embeddings[:, 0]) if context is None else self.split(context)
        moves = list(self.from_action(actions).unbind(1))
        draws = [None] * seen.shape[1] if uniform is None else uniform.unbind(1)
        states, posteriors = [], []
        for step, (embedding, draw) in enumerate(zip(seen.unbind(1), draws, strict=True)):
            if step > 0 or context is not None:
                h = self._advance(h, z, moves.pop(0))
            posterior = self._posterior(h, embedding)
            z = self._code(posterior, draw)
            states.append(torch.cat((h, z), -1))
            posteriors.append(posterior)
        return Filtered(torch.stack(states, 1), torch.stack(posteriors, 1))

    def imagine(self, state: Tensor, actions: Tensor) -> Tensor:
        """Without observations, along the prior's mode: (B, D), actions (B, L, A) -> (B, L, D)."""
        states = []
        for move in self.from_action(actions).unbind(1):
            h = self._advance(*self.split(state), move)
            state = torch.cat((h, self._code(self.prior(h), None)), -1)
            states.append(state)
        return torch.stack(states, 1)

    def prior(self, h: Tensor) -> Tensor:
        """p(z | h): (..., deterministic) -> (..., G, C)."""
        return self._distribution(self.prior_head(self.prior_layers(h)))

    def posterior(self, h: Tensor, embeddings: Tensor) -> Tensor:
        """q(z | h, e): (..., deterministic), (..., E) -> (..., G, C)."""
        return self._posterior(h, self.from_embedding(embeddings))

    def _beginning(self, embedding: Tensor) -> tuple[Tensor, Tensor]:
        """h of a first observation, and a z that nothing reads."""
        learned = self.first(embedding) if isinstance(self.first, nn.Linear) else self.first.expand(len(embedding), -1)
        return torch.tanh(learned), embedding.new_zeros(len(embedding), self.config.stochastic)

    def _advance(self, h: Tensor, z: Tensor, move: Tensor) -> Tensor:
        x: Tensor = self.norm(self.from_z(z) + move)
        following: Tensor = self.cell(x, h)
        return following

    def _posterior(self, h: Tensor, seen: Tensor) -> Tensor:
        return self._distribution(self.posterior_head(self.posterior_norm(self.from_h(h) + seen)))

    def _distribution(self, logits: Tensor) -> Tensor:
        groups = logits.unflatten(-1, (self.config.groups, self.config.classes))  # type: ignore[no-untyped-call]  # untyped in torch
        return categorical.probabilities(groups, self.config.unimix)

    def _code(self, probability: Tensor, uniform: Tensor | None) -> Tensor:
        """(B, G, C) -> z (B, G*C)."""
        if uniform is None:
            return categorical.mode(probability).flatten(1)
        return categorical.straight_through_sample(probability, uniform).flatten(1)

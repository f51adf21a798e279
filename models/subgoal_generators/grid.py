"""Subgoal generator of grid worlds: a latent-categorical model of the next observation."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from models.networks import grid as cells
from models.networks.film import FilmDynamics
from models.networks.initialisation import gumbel, initialise, table
from models.networks.symmetry import turned
from models.segments import Observations, SegmentBatch, at
from models.spaces import Spaces


@dataclass(frozen=True)
class GridSubgoalGeneratorConfig:
    """`codes` is the number of ways an observation can go on that the model can tell apart."""

    codes: int = 16
    channels: int = 32
    blocks: int = 2
    code_size: int = 16
    hidden: int = 64
    exploration: float = 0.1  # share of pairs trained with a random code
    prior_weight: float = 0.02  # of -log p(k|x) in the choice of a pair's code: keeps outcomes from being split up


class GridSubgoalGenerator(nn.Module):
    """p(x'|x) = sum_k p(k|x) p(x'|x, k), trained by hard expectation maximisation.

    The decoder is the world model's architecture with the latent code k where the action would be. The code of a pair
    is the one that explains it best, found by trying all of them. An amortised posterior trained by straight-through
    Gumbel softmax collapsed onto one code: an outcome is worth as much in the decoder's entropy as in the code, and
    then the decoder's mode is always the likeliest outcome.
    """

    family = "grid"
    kind = "subgoal_generator"

    def __init__(self, spaces: Spaces, config: GridSubgoalGeneratorConfig, generator: torch.Generator) -> None:
        super().__init__()
        self.spaces, self.config = spaces, config
        self.size = spaces.observations["grid"].shape[0]
        self.encoder = cells.GridEncoder(self.size, config.channels)
        self.prior = cells.PooledHead(self.size, config.channels, config.hidden, config.codes)
        self.codes = table(config.codes, config.code_size)
        self.dynamics = FilmDynamics(config.code_size, config.channels, self.size, self.size, config.blocks)
        self.decoder = cells.GridDecoder(config.channels, config.hidden)
        initialise(self, generator)
        self.dynamics.weaken(0.1)

    def check(self, batch: SegmentBatch) -> None:
        """Raises ValueError for values outside the vocabulary, or for a batch that carries actions."""
        _refuse_actions(batch)
        cells.check(batch.observations)

    def loss(self, batch: SegmentBatch, generator: torch.Generator) -> Tensor:
        """Mean over transitions of -log p(x'|x, k) - log p(k|x) at each pair's best k."""
        _refuse_actions(batch)
        pairs = turned(batch.transitions(), generator).observations
        before, after = at(pairs, 0), at(pairs, 1)
        state: Tensor = self.encoder((before,))
        prior = self.prior(state).log_softmax(1)  # (B, K)
        best = self._best_codes(state.detach(), prior.detach(), after)
        used = self._explored(best, generator)
        reconstruction = cells.observation_cross_entropy(self._decode(state, used), after)
        return reconstruction.mean() + F.nll_loss(prior, best)

    def sample(self, observations: Observations, horizon: int, generator: torch.Generator) -> Observations:
        """Autoregressive: at each step a code from the prior, then the decoder's most likely observation."""
        chain = [observations]
        for _ in range(horizon):
            state: Tensor = self.encoder((chain[-1],))
            logits: Tensor = self.prior(state)
            choice = (logits + gumbel(logits.shape, generator, logits.device)).argmax(1)
            chain.append(cells.decoded_modes(self._decode(state, choice), self.size))
        return {name: torch.stack([step[name] for step in chain], 1) for name in ("grid", "carried")}

    def _explored(self, best: Tensor, generator: torch.Generator) -> Tensor:
        """A share of the codes (B,) replaced by random ones: a code that never wins still learns what is usual."""
        shape, device = best.shape, generator.device
        swap = torch.rand(shape, generator=generator, device=device) < self.config.exploration
        other = torch.randint(self.config.codes, shape, generator=generator, device=device)
        return torch.where(swap.to(best.device), other.to(best.device), best)

    @torch.no_grad()
    def _best_codes(self, state: Tensor, prior: Tensor, after: Observations) -> Tensor:
        """argmin_k of -log p(x'|x, k) - prior_weight * log p(k|x): (B, S, S, C), (B, K) -> (B,)."""
        batch, codes = prior.shape
        every = torch.arange(codes, device=state.device).repeat(batch)  # (B*K,)
        repeated = {name: stream.repeat_interleave(codes, 0) for name, stream in after.items()}
        logits = self._decode(state.repeat_interleave(codes, 0), every)
        cost = cells.observation_cross_entropy(logits, repeated).view(batch, codes)
        return (cost - self.config.prior_weight * prior).argmin(1)

    def _decode(self, state: Tensor, codes: Tensor) -> Observations:
        """state (B, S, S, C), codes (B,) -> logits of the next observation."""
        film = self.dynamics.parameters_of(self.codes)  # once a code, not once a row
        logits: Observations = self.decoder(self.dynamics(state, film[codes]))
        return logits


def _refuse_actions(batch: SegmentBatch) -> None:
    if batch.actions is not None or batch.action_sets is not None:
        raise ValueError("A subgoal generator never sees actions, but the batch carries them; use without_labels().")

"""Subgoal generator of grid worlds: a latent-categorical model of the next observation."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from models.networks import grid as cells
from models.networks.film import FilmDynamics
from models.networks.initialisation import gumbel, initialise, table
from models.networks.mlp import Mlp
from models.networks.symmetry import DIRECTIONS, turn, turned
from models.segments import Observations, SegmentBatch, at
from models.spaces import Spaces
from models.subgoal_generators.base import Futures, refuse_actions, with_idle


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
    floor: float = 1e-3  # a future whose code is less likely is none
    idle: float = 0.02  # what the future is taken to be worth in which nothing happens
    agreeing: int = 3  # of the four turns of a room, in which a future must come out alike to be stood by


class GridSubgoalGenerator(nn.Module):
    """p(x'|x) = sum_k p(k|x) p(x'|x, k), trained by hard expectation maximisation.

    The decoder writes every cell of x' from convolved features, under the latent code k. The code of a pair is the one
    that explains it best, found by trying all of them. An amortised posterior trained by straight-through Gumbel
    softmax collapsed onto one code: an outcome is worth as much in the decoder's entropy as in the code, and then the
    decoder's mode is always the likeliest outcome.
    """

    family = "grid"
    kind = "subgoal_generator"

    def __init__(self, spaces: Spaces, config: GridSubgoalGeneratorConfig, generator: torch.Generator) -> None:
        super().__init__()
        self.spaces, self.config = spaces, config
        self.size = spaces.observations["grid"].shape[0]
        self.encoder = cells.GridEncoder(self.size, config.channels)
        self.prior = Mlp((4 * config.channels, config.hidden, config.codes))
        self.codes = table(config.codes, config.code_size)
        self.dynamics = FilmDynamics(config.code_size, config.channels, self.size, self.size, config.blocks)
        self.decoder = cells.GridDecoder(config.channels, config.hidden)
        initialise(self, generator)
        self.dynamics.weaken(0.1)

    def check(self, batch: SegmentBatch) -> None:
        """Raises ValueError for values outside the vocabulary, or for a batch that carries actions."""
        refuse_actions(batch)
        cells.check(batch.observations)

    def loss(self, batch: SegmentBatch, generator: torch.Generator) -> Tensor:
        """Mean over transitions of -log p(x'|x, k) - log p(k|x) at each pair's best k."""
        refuse_actions(batch)
        pairs = turned(batch.transitions(), generator).observations
        before, after = at(pairs, 0), at(pairs, 1)
        state: Tensor = self.encoder((before,))
        prior = self._log_prior(before, state)  # (B, K)
        best = self._best_codes(state.detach(), prior.detach(), after)
        used = self._explored(best, generator)
        reconstruction = cells.observation_cross_entropy(self._decode(state, used), after)
        return reconstruction.mean() + F.nll_loss(prior, best)

    def sample(self, observations: Observations, horizon: int, generator: torch.Generator) -> Observations:
        """Autoregressive: at each step a code from the prior, then the decoder's most likely observation."""
        chain = [observations]
        for _ in range(horizon):
            state: Tensor = self.encoder((chain[-1],))
            prior = self._log_prior(chain[-1], state)
            choice = (prior + gumbel(prior.shape, generator, prior.device)).argmax(1)
            chain.append(cells.decoded_modes(self._decode(state, choice), self.size))
        return {name: torch.stack([step[name] for step in chain], 1) for name in ("grid", "carried")}

    def futures(self, observations: Observations, horizon: int, generator: torch.Generator) -> Futures:
        """A chain for every code above the floor; at later steps a code is drawn, all above the floor equally likely.

        It stands by those that it would also give, turned, if the room were turned, by at most one quarter less: a
        decoder that is trained on all turns and still disagrees with itself has seen too little of such a step.
        """
        prior = self._log_prior(observations, self.encoder((observations,)))  # (B, codes)
        rows, codes = (prior > math.log(self.config.floor)).nonzero().unbind(1)
        chain, log_prob = [_rows(observations, rows)], torch.zeros_like(prior[:, 0])[rows]
        steady = torch.ones_like(rows, dtype=torch.bool)
        for step in range(horizon):
            if step:
                prior = self._log_prior(chain[-1], self.encoder((chain[-1],)))
                codes = _uniform(prior > math.log(self.config.floor), generator)
            likelihood = prior[rows if step == 0 else torch.arange(len(rows), device=rows.device), codes]
            following, doubt = self._step(chain[-1], codes)
            log_prob = log_prob + likelihood - doubt
            steady = steady & (self._agreeing(chain[-1], codes, following) >= self.config.agreeing)
            chain.append(following)
        return with_idle(observations, chain, Futures({}, rows, log_prob, steady), math.log(self.config.idle))

    def _step(self, observations: Observations, codes: Tensor) -> tuple[Observations, Tensor]:
        """The likeliest outcome of codes (M,), and how unsure of it the decoder is: nats (M,)."""
        logits = self._decode(self.encoder((observations,)), codes)
        following = cells.decoded_modes(logits, self.size)
        return following, cells.observation_cross_entropy(logits, following)

    def _agreeing(self, observations: Observations, codes: Tensor, following: Observations) -> Tensor:
        """In how many of the four turns of the room the codes (M,) have this outcome: (M,)."""
        agreeing = torch.ones_like(codes)
        for count in range(1, DIRECTIONS):
            quarters = torch.full_like(codes, count)
            room = turn(observations["grid"].unsqueeze(1), quarters).squeeze(1)
            outcome, _ = self._step({**observations, "grid": room}, codes)
            back = turn(outcome["grid"].unsqueeze(1), DIRECTIONS - quarters).squeeze(1)
            same = (back == following["grid"]).flatten(1).all(1) & (outcome["carried"] == following["carried"]).all(1)
            agreeing += same
        return agreeing

    def _log_prior(self, observations: Observations, state: Tensor) -> Tensor:
        """log p(k | x) of observations (B, ...) and their states (B, S, S, C): (B, codes).

        What can follow depends on what lies before the agent first of all: a pool over all cells blurs it.
        """
        flat = state.flatten(1, 2)  # (B, S*S, C)
        local = cells.gather_cells(flat, cells.touched_cells(observations["grid"])).flatten(1)
        prior: Tensor = self.prior(torch.cat((local, flat.mean(1), flat.amax(1)), 1))
        return prior.log_softmax(1)

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


def _rows(observations: Observations, rows: Tensor) -> Observations:
    return {name: stream[rows] for name, stream in observations.items()}


def _uniform(allowed: Tensor, generator: torch.Generator) -> Tensor:
    """One of the columns allowed in each row: bool (B, K) -> (B,)."""
    draw = torch.rand(allowed.shape, generator=generator, device=generator.device).to(allowed.device)
    return (draw * allowed).argmax(1)

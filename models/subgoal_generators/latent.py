"""Subgoal generator of robots: flow matching (Lipman et al. 2023) in the latent space of a frame encoder of its own.

    c_t = enc(x_t),  d_t = (c_{t+1} - c_t) / deviation
    y_s = (1 - s) y_0 + s d_t,  y_0 ~ N(0, 1),  s ~ U(0, 1)
    loss = |v(y_s, s, c_t, d_{t-1}) - (d_t - y_0)|^2 + image error

A sample is the end, at s = 1, of dy/ds = v from a y_0. So one x_t has many futures, each whole: what goes along in the
data goes along in a sample, which a mean, or coordinates drawn each by itself, would lose. No step of a sample changes
a coordinate more than any step in the data does, and none leaves their range: of many chains the worst is looked for
(Algorithm 1), and that would be the one that the generator gets wrong.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from models.networks.bounds import Bounds
from models.networks.frame_changes import as_observations
from models.networks.frame_coordinates import FrameCoordinates
from models.networks.initialisation import initialise
from models.networks.mlp import Mlp
from models.networks.moments import Moments
from models.networks.streams import check_finite
from models.segments import Observations, SegmentBatch
from models.spaces import Spaces
from models.subgoal_generators.base import Futures, refuse_actions, with_idle


@dataclass(frozen=True)
class LatentSubgoalGeneratorConfig:
    """latent, depth: of the images' encoder. hidden: widths of the velocity field. steps: in which it is followed.

    window: observations of a training sequence. forget: share of steps trained as if nothing was known of what came
    before, as of a chain's first. blur: deviation of what is added to the latent before images are read back, so that
    near latents give near images. futures: samples of what may follow a state. idle: what the future is taken to be
    worth in which nothing happens.
    """

    latent: int = 32
    depth: int = 8
    hidden: tuple[int, ...] = (256, 256)
    steps: int = 12
    window: int = 4
    forget: float = 0.5
    blur: float = 0.1
    futures: int = 8
    idle: float = 0.02

    def __post_init__(self) -> None:
        object.__setattr__(self, "hidden", tuple(self.hidden))  # JSON has lists
        if self.steps < 1 or self.futures < 1:
            raise ValueError(f"steps and futures must be at least 1, got {self.steps} and {self.futures}.")


SMALL = LatentSubgoalGeneratorConfig()
PAPER = LatentSubgoalGeneratorConfig(latent=128, depth=32, hidden=(1024, 1024, 1024), window=8)


class LatentSubgoalGenerator(nn.Module):
    """p(x_{t+1} | x_t, x_{t-1}), and of a chain's first step p(x_{t+1} | x_t). No action is anywhere in its path."""

    family = "robot"
    kind = "subgoal_generator"

    def __init__(self, spaces: Spaces, config: LatentSubgoalGeneratorConfig, generator: torch.Generator) -> None:
        super().__init__()
        self.spaces, self.config = spaces, config
        self.frame = FrameCoordinates(spaces, config.latent, config.depth)
        size = self.frame.size
        self.change = Moments(size)
        self.range, self.reach = Bounds(size), Bounds(size)
        self.velocity = Mlp((3 * size + 2, *config.hidden, size))
        initialise(self, generator)

    def check(self, batch: SegmentBatch) -> None:
        """Raises ValueError for numbers that are not finite, or for a batch that carries actions."""
        refuse_actions(batch)
        check_finite(batch)

    def loss(self, batch: SegmentBatch, generator: torch.Generator) -> Tensor:
        """Mean over transitions and coordinates; the generator draws windows, s, y_0, what to forget and the blur."""
        refuse_actions(batch)
        batch = batch.windows(self.config.window - 1, generator)
        if torch.is_grad_enabled():
            self.frame.measure(batch.observations)
        c = self.frame(batch.observations)  # (B, L+1, C)
        blurred = c + self.config.blur * _normal(c, generator)
        known = c.detach()  # images alone shape the latent: else a constant one would be the easiest to foresee
        if torch.is_grad_enabled():
            self.change.update(known.diff(dim=1).flatten(0, 1))
            self.range.update(known.flatten(0, 1))
            self.reach.update(known.diff(dim=1).flatten(0, 1))
        change = self.change.standardised(known.diff(dim=1))  # (B, L, C)
        place, start = _uniform(change[..., :1], generator), _normal(change, generator)
        remembered = (_uniform(change[:, 1:, :1], generator) >= self.config.forget).float()
        before = torch.cat((torch.zeros_like(change[:, :1]), change[:, :-1] * remembered), 1)
        remembered = torch.cat((torch.zeros_like(place[:, :1]), remembered), 1)
        flow = self._velocity(torch.lerp(start, change, place), place, known[:, :-1], before, remembered)
        return (flow - (change - start)).square().mean() + self.frame.error(blurred, batch.observations)

    @torch.no_grad()
    def sample(self, observations: Observations, horizon: int, generator: torch.Generator) -> Observations:
        """Step after step in latent space; each is then read back. The generator draws every y_0."""
        c = self.frame(_as_sequence(observations))[:, 0]
        change, remembered = torch.zeros_like(c), torch.zeros_like(c[:, :1])
        chain = [observations]
        for _ in range(horizon):
            drawn = self._followed(_normal(c, generator), c, change, remembered)
            change, remembered = self.reach(self.change.restored(drawn)), torch.ones_like(remembered)
            c = self.frame.settled(self.range(c + change))
            change = self.change.standardised(change)
            chain.append(as_observations(self.frame.streams, self.frame.decode(c)))
        return {name: torch.stack([step[name] for step in chain], 1) for name in observations}

    def futures(self, observations: Observations, horizon: int, generator: torch.Generator) -> Futures:
        """As many samples of each state, all equally likely, and that nothing happens. It stands by its samples."""
        count, device = SegmentBatch(_as_sequence(observations)).size, next(iter(observations.values())).device
        states = torch.arange(count, device=device).repeat_interleave(self.config.futures)
        chains = self.sample({name: stream[states] for name, stream in observations.items()}, horizon, generator)
        log_prob = torch.full((len(states),), -math.log(self.config.futures), device=device)
        found = Futures({}, states, log_prob, torch.ones_like(states, dtype=torch.bool))
        steps = [{name: stream[:, step] for name, stream in chains.items()} for step in range(horizon + 1)]
        return with_idle(observations, steps, found, math.log(self.config.idle))

    def _followed(self, y: Tensor, c: Tensor, before: Tensor, remembered: Tensor) -> Tensor:
        """y_0 -> y_1 by Euler's method: (B, C)."""
        steps = self.config.steps
        for step in range(steps):
            place = torch.full_like(remembered, step / steps)
            y = y + self._velocity(y, place, c, before, remembered) / steps
        return y

    def _velocity(self, y: Tensor, place: Tensor, c: Tensor, before: Tensor, remembered: Tensor) -> Tensor:
        """v at y (..., C) and s (..., 1)."""
        velocity: Tensor = self.velocity(torch.cat((y, c, before, place, remembered), -1))
        return velocity


def _as_sequence(observations: Observations) -> Observations:
    return {name: stream.unsqueeze(1) for name, stream in observations.items()}


def _normal(like: Tensor, generator: torch.Generator) -> Tensor:
    return torch.randn(like.shape, generator=generator, device=generator.device).to(like.device)


def _uniform(like: Tensor, generator: torch.Generator) -> Tensor:
    return torch.rand(like.shape, generator=generator, device=generator.device).to(like.device)

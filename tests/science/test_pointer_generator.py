"""Heads that keep, copy or write: each by its gate, and what copying is worth where kinds are new."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from models.evaluation import evaluate
from models.families import GRID
from models.networks.grid import VOCABULARY, WORDS, channel_of_word, split_heads
from models.networks.initialisation import initialise, linear
from models.networks.pointer_generator import LIMIT, PointerGenerator
from models.segments import SegmentBatch, at
from models.training import TrainingConfig, train
from models.world_models.grid import GridWorldModel
from tests.science import toy_grid

KEEP, COPY, WRITE = range(3)
OBJECT, COLOUR, STATE = range(3)
EVERY = (OBJECT, COLOUR, STATE)


def soft(elements: int, seed: int) -> Tensor:
    """Distributions (22, 1, N)."""
    drawn = torch.rand(WORDS, 1, elements, generator=torch.Generator().manual_seed(seed))
    return torch.cat([channel / channel.sum(0) for channel in split_heads(drawn)])


def opened(gate: int, channels: tuple[int, ...] = EVERY, write: Tensor | None = None) -> PointerGenerator:
    """One whose gate stands wide open in the channels and shut in the others, where it keeps."""
    layer = linear(4, PointerGenerator.OUTPUTS)
    wide = 20 * LIMIT
    gates = torch.full((3, 3), -wide)  # (gate, channel)
    gates[KEEP] = wide
    for channel in channels:
        gates[:, channel] = -wide
        gates[gate, channel] = wide
    with torch.no_grad():
        layer.weight.zero_()
        layer.bias.copy_(torch.cat((torch.zeros(WORDS) if write is None else write, gates.flatten())))
    return PointerGenerator(layer, keep=0.0)


def test_each_gate_does_what_it_is_called() -> None:
    now, source, z = soft(5, 1), soft(1, 2), torch.zeros(1, 5, 4)
    torch.testing.assert_close(opened(KEEP)(z, now, source), now, rtol=0, atol=1e-6)
    torch.testing.assert_close(opened(COPY)(z, now, source), source.expand_as(now), rtol=0, atol=1e-6)
    write = torch.linspace(-3, 3, WORDS)
    written = torch.cat([part.softmax(0) for part in split_heads(LIMIT * (write / LIMIT).tanh())])
    expected = written.view(WORDS, 1, 1).expand_as(now)
    torch.testing.assert_close(opened(WRITE, write=write)(z, now, source), expected, rtol=0, atol=1e-6)


def test_a_channel_has_gates_of_its_own() -> None:
    now, source, z = soft(5, 1), soft(5, 2), torch.zeros(1, 5, 4)
    after = opened(COPY, (COLOUR,))(z, now, source)
    of = channel_of_word()
    torch.testing.assert_close(after[of == COLOUR], source[of == COLOUR], rtol=0, atol=1e-6)
    torch.testing.assert_close(after[of != COLOUR], now[of != COLOUR], rtol=0, atol=1e-6)


def test_the_outcome_is_a_distribution_of_each_channel() -> None:
    head = PointerGenerator(linear(4, PointerGenerator.OUTPUTS), keep=4.0)
    generator = torch.Generator().manual_seed(0)
    initialise(head, generator)
    after = head(torch.randn(1, 5, 4, generator=generator), soft(5, 1), soft(1, 2)).detach()
    assert float(after.min()) > 0
    for channel in split_heads(after):
        torch.testing.assert_close(channel.sum(0), torch.ones(1, 5))


def test_an_untrained_head_keeps() -> None:
    """By e^4 against 1 and 1, the share that `keep` gives; what it writes then is uniform."""
    head, now, source = opened(KEEP), soft(5, 1), soft(1, 2)
    head.keep = 4.0
    assert isinstance(head.head, torch.nn.Linear)
    torch.nn.init.zeros_(head.head.bias)
    share = math.exp(4.0) / (math.exp(4.0) + 2.0)
    uniform = 1.0 / torch.tensor(VOCABULARY)[channel_of_word()].view(WORDS, 1, 1)
    expected = share * now + (1.0 - share) / 2 * (source + uniform)
    torch.testing.assert_close(head(torch.zeros(1, 5, 4), now, source), expected)


def test_nothing_vanishes_into_denormal_floats(movement_only: SegmentBatch) -> None:
    """At which a processor takes several times as long: gates that are shut pass small gradients, not tiny ones."""
    model = GRID.build_world_model(toy_grid.SPACES, None, torch.Generator().manual_seed(0))
    train(model, movement_only, TrainingConfig(200, 32, 1e-2, 1e-2), torch.Generator().manual_seed(0))
    model.zero_grad()
    torch.autograd.backward(model.loss(movement_only.take(slice(0, 32)), torch.Generator().manual_seed(0)))
    for head in (model.cells, model.carried):
        for name, parameter in head.named_parameters():
            assert parameter.grad is not None
            sizes = parameter.grad.abs()
            assert float(sizes[sizes > 0].min()) > 1e-30, name


def test_a_state_holds_the_whole_observation(world_model: GridWorldModel, held_out: SegmentBatch) -> None:
    now = at(held_out.observations, 0)
    seen = world_model.observe(world_model.encode(now))
    assert all(torch.equal(seen[name], now[name]) for name in now)


def swaps(held: tuple[int, int], other: bool, count: int, seed: int) -> SegmentBatch:
    """Swaps of key and ball by kind and colour: those that take `held` into the hand, or all others."""
    batch = toy_grid.labeled(count, seed, effective=True)
    assert batch.actions is not None
    hand = batch.observations["carried"][:, 1]
    taken = (hand[:, 0] == held[0]) & (hand[:, 1] == held[1])
    things = torch.from_numpy(np.isin(hand[:, 0].numpy(), (toy_grid.KEY, toy_grid.BALL)))
    chosen = (batch.actions[:, 0] == 6) & things & (taken != other)
    return batch.take(chosen.nonzero().flatten())


@pytest.mark.parametrize("held", [(toy_grid.KEY, 0), (toy_grid.BALL, toy_grid.BLUE)])
def test_a_swap_is_known_of_what_was_never_swapped(held: tuple[int, int]) -> None:
    """What lies in front comes into the hand, whatever it is: no label shows it of this kind and colour."""
    generator = torch.Generator().manual_seed(0)
    model = GRID.build_world_model(toy_grid.SPACES, None, generator)
    shown = swaps(held, True, 30_000, seed=4)
    assert shown.size > 100
    train(model, shown.take(slice(0, 200)), GRID.training_config("world_model", 200), generator)
    test = swaps(held, False, 16_000, seed=5)
    assert test.size > 30
    exact = evaluate(model, test, {}).overall.exact_accuracy
    assert exact is not None
    assert exact > 0.9

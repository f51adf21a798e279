"""The parts of the recurrent state-space model against their definitions."""

import torch

from models.networks import categorical
from models.networks.initialisation import initialise
from models.networks.moments import Moments
from models.networks.recurrent_cell import NormalisedGruCell
from models.networks.symlog import symexp, symlog


def test_the_gradient_of_a_draw_is_that_of_its_probabilities() -> None:
    draw = torch.Generator().manual_seed(0)
    probability = torch.rand(5, 3, 4, generator=draw).softmax(-1).requires_grad_()
    weight = torch.randn(5, 3, 4, generator=draw)
    code = categorical.straight_through_sample(probability, torch.rand(5, 3, generator=draw))
    assert set(code.detach().round(decimals=5).flatten().tolist()) == {0.0, 1.0}
    assert torch.allclose(code.detach().sum(-1), torch.ones(5, 3))
    (code * weight).sum().backward()  # type: ignore[no-untyped-call]  # untyped in torch
    assert probability.grad is not None
    torch.testing.assert_close(probability.grad, weight)


def test_classes_are_drawn_as_often_as_their_probabilities_say() -> None:
    probability = torch.tensor((0.1, 0.0, 0.6, 0.3)).expand(20_000, 1, 4)
    uniform = torch.rand(20_000, 1, generator=torch.Generator().manual_seed(0))
    share = categorical.straight_through_sample(probability, uniform).mean((0, 1))
    torch.testing.assert_close(share, torch.tensor((0.1, 0.0, 0.6, 0.3)), atol=0.01, rtol=0.0)


def test_no_class_is_less_likely_than_its_share_of_unimix() -> None:
    probability = categorical.probabilities(torch.tensor([[100.0, 0.0, 0.0, 0.0]]), unimix=0.01)
    torch.testing.assert_close(probability, torch.tensor([[0.9925, 0.0025, 0.0025, 0.0025]]))


def test_the_divergence_is_the_sum_over_groups() -> None:
    draw = torch.Generator().manual_seed(0)
    p, q = (torch.randn(2, 3, 4, generator=draw).softmax(-1) for _ in range(2))
    known = torch.distributions.kl_divergence(
        torch.distributions.Categorical(probs=p), torch.distributions.Categorical(probs=q)
    )
    torch.testing.assert_close(categorical.kl_divergence(p, q), known.sum(1))


def test_a_closed_gate_keeps_the_state() -> None:
    cell = NormalisedGruCell(3, 4)
    initialise(cell, torch.Generator().manual_seed(0))
    with torch.no_grad():
        cell.norm.gain.zero_()
        cell.norm.bias[8:] = -30.0  # the update gate, a third of the three
    h = torch.randn(2, 4, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(cell(torch.ones(2, 3), h), h)


def test_symlog_keeps_small_numbers_and_can_be_undone() -> None:
    x = torch.tensor((-1000.0, -1e-3, 0.0, 1e-3, 1000.0))
    torch.testing.assert_close(symexp(symlog(x)), x)
    torch.testing.assert_close(symlog(x)[4], torch.tensor(1001.0).log())
    torch.testing.assert_close(symlog(x)[1:4], x[1:4], rtol=1e-3, atol=0.0)


def test_moments_in_parts_are_those_of_the_whole() -> None:
    rows = torch.randn(100, 3, generator=torch.Generator().manual_seed(0)) * 5 + 7
    moments = Moments(3)
    for part in rows.split(17):  # type: ignore[no-untyped-call]  # untyped in torch
        moments.update(part)
    expected = (rows - rows.mean(0)) / rows.std(0, unbiased=False)
    torch.testing.assert_close(moments.standardised(rows), expected)
    torch.testing.assert_close(moments.restored(expected), rows)


def test_numbers_that_never_change_stay_finite() -> None:
    moments = Moments(1)
    assert moments.standardised(torch.tensor([[2.0]])).item() == 2.0  # nothing was shown yet
    moments.update(torch.full((10, 1), 0.5))
    assert moments.standardised(torch.full((1, 1), 0.5)).item() == 0.0

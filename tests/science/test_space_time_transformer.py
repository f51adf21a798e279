"""The space-time transformer: causal in time whatever the tokens hold, and every token normed by itself."""

import pytest
import torch

from models.networks.initialisation import initialise
from models.networks.space_time_transformer import PastBias, SpaceTimeTransformer, normalised

WIDTH = 16


@pytest.fixture
def transformer() -> SpaceTimeTransformer:
    module = SpaceTimeTransformer(WIDTH, layers=2, heads=2, hidden=32, context=1)
    initialise(module, torch.Generator().manual_seed(0))
    return module


@pytest.mark.parametrize("frame", [1, 3, 5])
def test_no_frame_sees_a_later_one(transformer: SpaceTimeTransformer, frame: int) -> None:
    tokens = torch.randn(2, 6, 4, WIDTH, generator=torch.Generator().manual_seed(1))
    changed = tokens.clone()
    changed[:, frame:] *= -5.0
    with torch.no_grad():
        before, after = transformer(tokens), transformer(changed)
    assert torch.equal(before[:, :frame], after[:, :frame])
    assert not torch.allclose(before[:, frame], after[:, frame])


def test_a_frame_sees_all_of_its_tokens_and_as_far_back_as_its_layers_look(transformer: SpaceTimeTransformer) -> None:
    tokens = torch.randn(1, 6, 4, WIDTH, generator=torch.Generator().manual_seed(1)).requires_grad_()
    transformer(tokens)[0, 5, 0].square().sum().backward()
    assert tokens.grad is not None
    reached = (tokens.grad[0] != 0).any(-1)  # (T, N)
    assert reached[3:].all()  # two layers of one frame back each
    assert not reached[:3].any()


def test_segments_of_any_length_are_read_alike(transformer: SpaceTimeTransformer) -> None:
    """Only how long ago a frame was counts: a late window of a segment is read as if it were all of it."""
    tokens = torch.randn(1, 9, 4, WIDTH, generator=torch.Generator().manual_seed(2))
    with torch.no_grad():
        torch.testing.assert_close(transformer(tokens)[:, 6:], transformer(tokens[:, 4:])[:, 2:])


def test_what_may_not_be_seen_has_no_weight() -> None:
    bias = PastBias(heads=1, context=2)
    initialise(bias, torch.Generator().manual_seed(0))
    weights = (bias(5)[0] + 100.0 * torch.rand(5, 5, generator=torch.Generator().manual_seed(0))).softmax(1)
    seen = torch.ones(5, 5).tril() - torch.ones(5, 5).tril(-3)
    assert torch.equal(weights > 0, seen > 0)


def test_a_token_is_normed_by_itself() -> None:
    tokens = torch.randn(3, 4, WIDTH, generator=torch.Generator().manual_seed(3))
    louder = torch.cat((tokens[:, :1], 1000.0 * tokens[:, 1:]), 1)
    torch.testing.assert_close(normalised(louder)[:, 0], normalised(tokens)[:, 0])


def test_a_width_that_heads_cannot_share_is_refused() -> None:
    with pytest.raises(ValueError, match="multiple of heads, got 16 and 3"):
        SpaceTimeTransformer(WIDTH, layers=1, heads=3, hidden=32, context=1)

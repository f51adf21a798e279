"""Layers whose parameters come from a torch.Generator and never from the global one."""

import math
from typing import TypeVar

import torch
from torch import Tensor, nn
from torch.nn.utils import skip_init

Layer = TypeVar("Layer", nn.Linear, nn.Conv1d)


def linear(inputs: int, outputs: int, bias: bool = True) -> nn.Linear:
    """A linear layer with unset parameters; `initialise` sets them."""
    layer: nn.Linear = skip_init(nn.Linear, inputs, outputs, bias=bias)  # type: ignore[no-untyped-call]  # untyped in torch
    return layer


def convolution(inputs: int, outputs: int, kernel: int, stride: int = 1) -> nn.Conv2d:
    """A 2-D convolution of 1/stride of the size with unset parameters; `initialise` sets them."""
    layer: nn.Conv2d = skip_init(  # type: ignore[no-untyped-call]  # untyped in torch
        nn.Conv2d, inputs, outputs, kernel, stride=stride, padding=kernel // 2
    )
    return layer


def temporal_convolution(inputs: int, outputs: int, kernel: int, stride: int = 1) -> nn.Conv1d:
    """A 1-D convolution of 1/stride of the length with unset parameters; `initialise` sets them."""
    layer: nn.Conv1d = skip_init(  # type: ignore[no-untyped-call]  # untyped in torch
        nn.Conv1d, inputs, outputs, kernel, stride=stride, padding=kernel // 2
    )
    return layer


def halving_convolution(inputs: int, outputs: int) -> nn.Conv2d:
    """A convolution that halves the sides: (N, C, H, W) -> (N, D, H/2, W/2), no bias, unset weights."""
    layer: nn.Conv2d = skip_init(  # type: ignore[no-untyped-call]  # untyped in torch
        nn.Conv2d, inputs, outputs, 4, stride=2, padding=1, bias=False
    )
    return layer


def doubling_convolution(inputs: int, outputs: int, gain: float = 1.0) -> nn.ConvTranspose2d:
    """A transposed convolution that doubles the sides: (N, C, H, W) -> (N, D, 2H, 2W), no bias, unset weights.

    gain: of its weights at the start, over what keeps the scale of its input.
    """
    layer: nn.ConvTranspose2d = skip_init(  # type: ignore[no-untyped-call]  # untyped in torch
        nn.ConvTranspose2d, inputs, outputs, 4, stride=2, padding=1, bias=False
    )
    fan_in = 4 * inputs  # of the 16 taps, each output reads 4
    layer.weight.initial_scale = gain * math.sqrt(2.0 / fan_in)  # type: ignore[attr-defined]  # read back by initialise
    return layer


def weak(layer: Layer, scale: float) -> Layer:
    """The layer, whose weights are to be drawn from N(0, scale^2)."""
    layer.weight.initial_scale = scale  # type: ignore[attr-defined]  # read back by initialise
    return layer


def table(rows: int, size: int, scale: float = 1.0) -> nn.Parameter:
    """An embedding table (rows, size) with unset values; `initialise` draws them from N(0, scale^2)."""
    parameter = nn.Parameter(torch.empty(rows, size))
    parameter.initial_scale = scale  # type: ignore[attr-defined]  # read back by initialise
    return parameter


def initialise(module: nn.Module, generator: torch.Generator) -> None:
    """Draws all parameters in place: He normal (fan in) for weights, N(0, scale^2) for tables.

    Biases begin at 0 and the gains of layer norms at 1.
    """
    for name, parameter in module.named_parameters():
        scale = getattr(parameter, "initial_scale", None)
        if name.endswith(("bias", "gain")):
            nn.init.constant_(parameter, float(name.endswith("gain")))
        elif scale is None:
            nn.init.normal_(parameter, 0.0, math.sqrt(2.0 / parameter[0].numel()), generator=generator)
        else:
            nn.init.normal_(parameter, 0.0, scale, generator=generator)


def gumbel(shape: torch.Size, generator: torch.Generator, device: torch.device) -> Tensor:
    """Standard Gumbel noise -log(-log u), drawn on the generator's device and moved to `device`."""
    uniform = torch.rand(shape, generator=generator, device=generator.device).clamp_(1e-10, 1.0 - 1e-7)
    return -torch.log(-torch.log(uniform)).to(device)

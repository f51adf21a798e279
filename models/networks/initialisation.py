"""Layers whose parameters come from a torch.Generator and never from the global one."""

import math
from typing import TypeVar

import torch
from torch import Tensor, nn
from torch.nn.utils import skip_init

Layer = TypeVar("Layer", nn.Linear, nn.Conv1d)


def linear(inputs: int, outputs: int) -> nn.Linear:
    """A linear layer with unset parameters; `initialise` sets them."""
    layer: nn.Linear = skip_init(nn.Linear, inputs, outputs)  # type: ignore[no-untyped-call]  # untyped in torch
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
    """Draws all parameters in place: He normal (fan in) for weights, zeros for biases, N(0, scale^2) for tables."""
    for name, parameter in module.named_parameters():
        scale = getattr(parameter, "initial_scale", None)
        if name.endswith("bias"):
            nn.init.zeros_(parameter)
        elif scale is None:
            nn.init.normal_(parameter, 0.0, math.sqrt(2.0 / parameter[0].numel()), generator=generator)
        else:
            nn.init.normal_(parameter, 0.0, scale, generator=generator)


def gumbel(shape: torch.Size, generator: torch.Generator, device: torch.device) -> Tensor:
    """Standard Gumbel noise -log(-log u), drawn on the generator's device and moved to `device`."""
    uniform = torch.rand(shape, generator=generator, device=generator.device).clamp_(1e-10, 1.0 - 1e-7)
    return -torch.log(-torch.log(uniform)).to(device)

"""The convolutions and matrix products of a piece of work, noted as it runs, to be run again with nothing between."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

aten = torch.ops.aten
PRODUCTS = {aten.convolution.default, aten.convolution_backward.default, aten.mm.default, aten.addmm.default}
PRODUCTS |= {aten.bmm.default, aten.baddbmm.default}


class Shape(NamedTuple):
    """A tensor argument without its values."""

    sizes: tuple[int, ...]
    strides: tuple[int, ...]
    dtype: torch.dtype

    def tensor(self, device: torch.device) -> Tensor:
        """Random values in the same layout; a stride may be 0."""
        last = sum((size - 1) * stride for size, stride in zip(self.sizes, self.strides, strict=True))
        return torch.randn(last + 1, dtype=self.dtype, device=device).as_strided(self.sizes, self.strides)


class Product(NamedTuple):
    """An operation of PRODUCTS and its arguments, tensors as shapes."""

    operation: Any
    arguments: tuple[Any, ...]

    def prepared(self, device: torch.device) -> Callable[[], object]:
        """The bare operation on tensors that are already there."""
        arguments = [each.tensor(device) if isinstance(each, Shape) else _plain(each) for each in self.arguments]
        return lambda: self.operation(*arguments)


class Recorder(TorchDispatchMode):
    """Counts the products that run while it is entered, in the forward and in the backward pass."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]  # untyped in torch
        self.products: Counter[Product] = Counter()

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Sequence[Any] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        """Runs the operation, and notes it where it is a product."""
        if func in PRODUCTS:
            self.products[Product(func, tuple(_frozen(each) for each in args))] += 1
        return func(*args, **(kwargs or {}))


def bare(products: Mapping[Product, int], device: torch.device) -> Callable[[], None]:
    """All products, each as often as it was recorded, on tensors that are already there."""
    prepared = [(product.prepared(device), count) for product, count in products.items()]

    def run() -> None:
        for operation, count in prepared:
            for _ in range(count):
                operation()

    return run


def _frozen(argument: Any) -> Any:
    """Hashable: tensors as their shapes, lists as tuples."""
    if isinstance(argument, Tensor):
        return Shape(tuple(argument.shape), argument.stride(), argument.dtype)
    return tuple(argument) if isinstance(argument, list) else argument


def _plain(argument: Any) -> Any:
    return list(argument) if isinstance(argument, tuple) else argument

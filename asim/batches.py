"""Cutting what is to be sent into requests that the service takes."""

from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

Item = TypeVar("Item")


def batches(items: Iterable[Item], bytes_of: Callable[[Item], int], most: int, most_bytes: int) -> Iterator[list[Item]]:
    """Runs of at most `most` items and `most_bytes` bytes, in order; an item that is larger goes alone."""
    batch: list[Item] = []
    total = 0
    for item in items:
        size = bytes_of(item)
        if batch and (len(batch) == most or total + size > most_bytes):
            yield batch
            batch, total = [], 0
        batch.append(item)
        total += size
    if batch:
        yield batch

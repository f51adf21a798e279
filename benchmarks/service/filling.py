"""Pools of any size, through the product: trajectories of random MiniGrid observations, many a request."""

import io
from collections.abc import Iterator

import numpy as np

from api_schemas.environments import Environment
from api_schemas.projects import LabelingPolicy, Project, ProjectCreate
from api_schemas.strategies import StrategyName
from asim.client import Client

FILES, BYTES = 500, 16 * 2**20  # a request holds at most so many
CELL = (11, 6, 5)  # objects, colors and states of the MiniGrid code


def project_of(client: Client, name: str, strategy: StrategyName = "random") -> Project:
    """A project in which no round starts by itself; a random order needs no round and is acquired like any other."""
    policy = LabelingPolicy(strategy=strategy, round_labels=0)
    return client.create_project(ProjectCreate(name=name, environment=Environment(simulator="minigrid"), policy=policy))


def fill(client: Client, project: Project, segments: int, transitions: int = 50, seed: int = 0) -> None:
    """Upload trajectories of `transitions` until the pool has `segments` more; all of it is the pool's."""
    for files in _requests(segments, transitions, seed):
        client.add_files(project.id, files, split="pool")


def trajectory(generator: np.random.Generator, transitions: int, size: int = 6) -> bytes:
    """One npz file of random cells."""
    buffer = io.BytesIO()
    np.savez(
        buffer,
        grid=generator.integers(0, CELL, (transitions + 1, size, size, 3), dtype=np.uint8),
        carried=generator.integers(0, CELL, (transitions + 1, 3), dtype=np.uint8),
    )
    return buffer.getvalue()


def _requests(segments: int, transitions: int, seed: int) -> Iterator[dict[str, bytes]]:
    generator = np.random.default_rng(seed)
    files: dict[str, bytes] = {}
    for number, start in enumerate(range(0, segments, transitions)):
        files[f"{number}.npz"] = trajectory(generator, min(transitions, segments - start))
        if len(files) == FILES or sum(map(len, files.values())) > BYTES:
            yield files
            files = {}
    if files:
        yield files

"""Files of robot trajectories, as many as are asked for: pictures as a simulator draws them.

A few episodes are rendered. Each further trajectory is one of them, perhaps mirrored, perhaps backwards, with all grey
levels turned on by a number of its own: other bytes, which compress as the rendered ones do.
"""

import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import numpy as np

from service.store import codec
from workers.recording import Arrays, stacked
from workers.simulators.catalog import make_behavior, make_simulator

EPISODES, STEPS = 8, 100
SIMULATOR, TASK, BEHAVIOR = "maniskill", "PokeCube", "noisy_expert"


class Written(NamedTuple):
    """Files of a folder, and what the store's codec made of the same arrays: seconds by the clock and of processor
    time, its bytes and theirs."""

    files: list[Path]
    seconds: float
    processor: float
    encoded: int
    bytes: int


class Recordings:
    """Numbered trajectories of STEPS transitions."""

    def __init__(self) -> None:
        self._episodes = list(_rendered())

    def trajectory(self, number: int) -> Arrays:
        """(STEPS + 1, ...) of both cameras and proprioception; no two are equal for 256 * 4 * EPISODES numbers."""
        variant, episode = divmod(number, len(self._episodes))
        turned, form = divmod(variant, 4)
        changed = {}
        for name, stream in self._episodes[episode].items():
            played = stream[:: -1 if form & 1 else 1]
            image = name != "proprioception"
            changed[name] = played[:, :, :: -1 if form & 2 else 1] + np.uint8(turned) if image else played
        return {name: np.ascontiguousarray(stream) for name, stream in changed.items()}

    def write(self, folder: Path, first: int, count: int) -> Written:
        """As npz files, the codec's work on them measured: their name by content, and their bytes in the store."""
        files, seconds, processor, encoded, size = [], 0.0, 0.0, 0, 0
        for number in range(first, first + count):
            arrays = self.trajectory(number)
            files.append(folder / f"{number}.npz")
            np.savez(files[-1], **arrays)
            began, worked = time.perf_counter(), time.process_time()
            codec.content_id(arrays)
            encoded += len(codec.encode(arrays))
            seconds, processor = seconds + time.perf_counter() - began, processor + time.process_time() - worked
            size += sum(stream.nbytes for stream in arrays.values())
        return Written(files, seconds, processor, encoded, size)


def _rendered() -> Iterator[Arrays]:
    """Episodes that go on where the task is solved, so that all are of one length."""
    with closing(make_simulator(SIMULATOR, {"task": TASK})) as simulator:
        behavior = make_behavior(BEHAVIOR, simulator)
        for seed in range(EPISODES):
            rng, seen = np.random.default_rng(seed), [simulator.reset(seed)]
            behavior.reset(rng)
            while len(seen) <= STEPS:
                seen.append(simulator.step(behavior.act(simulator, rng)).observation)
            yield stacked(seen)

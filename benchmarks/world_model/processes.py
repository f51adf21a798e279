"""The small preset trained by one process and by two, which share every minibatch: loss curves and speed-up.

    python -m benchmarks.world_model.processes                              two processes of one thread
    python -m benchmarks.world_model.processes --devices cuda:0 cuda:1      two GPUs

By the clock, so the machine should have nothing else to do. Status 1 where the curves differ.
"""

import argparse
import time
from collections.abc import Sequence
from statistics import mean

import torch

from benchmarks.figures import Figure, finish
from benchmarks.world_model.step import SPACES, sequences
from models.families import ROBOT
from models.segments import concatenate
from models.training import begin
from workers.training_processes import TrainingProcesses

SLICE, SLICES = 5, 12  # steps between two looks at the loss, and looks


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--devices", nargs="+", default=["cpu", "cpu"], help="one process each")
    asked = parser.parse_args()
    (one, alone), (several, shared) = (_trained(devices) for devices in (asked.devices[:1], asked.devices))
    for name, curve in (("one process", one), (f"{len(asked.devices)} processes", several)):
        print(f"  {name}: {', '.join(f'{loss:.0f}' for loss in curve)}")
    half = SLICES // 2
    difference = abs(mean(several[half:]) / mean(one[half:]) - 1.0)
    finish(
        [
            Figure("loss_difference", difference, "of the mean loss of the second half", 0.1, "below"),
            Figure("step_of_one_process", alone, "s"),
            Figure(f"step_of_{len(asked.devices)}_processes", shared, "s"),
            Figure("speed_up", alone / shared, "times"),
        ]
    )


def _trained(devices: Sequence[str]) -> tuple[list[float], float]:
    """The loss after every slice, and seconds a step, those of starting left out."""
    generator = torch.Generator().manual_seed(0)
    dataset = concatenate([sequences(generator) for _ in range(4)])
    network = ROBOT.build_world_model(SPACES, None, generator)
    start = begin(network, ROBOT.training_config("world_model", dataset.size), generator)
    with TrainingProcesses(network, dataset, start, devices) as processes:
        curve, began = [processes.advance(SLICE)[1]], time.perf_counter()
        curve += [processes.advance(SLICE * (number + 1))[1] for number in range(1, SLICES)]
        return curve, (time.perf_counter() - began) / (SLICE * (SLICES - 1))


if __name__ == "__main__":
    main()

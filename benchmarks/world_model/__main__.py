"""A training step of the robots' world model at the paper preset, beside its bare convolutions and matrix products.

    python -m benchmarks.world_model                          one thread of a processor
    python -m benchmarks.world_model --device cuda --compile  a GPU, compiled and uncompiled

The bare products are those that a step was seen to do, forward and backward, of the same shapes and memory layouts, run
alone in the same process; step and products take turns, and medians are compared. Status 1 where a target is missed.
"""

import argparse
import time
from collections.abc import Callable
from statistics import median

import torch
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.figures import Figure, finish
from benchmarks.world_model.clock import seconds
from benchmarks.world_model.products import Recorder, bare
from benchmarks.world_model.step import PARTS, SEQUENCES, SPACES, Step, sequences, shares
from models.families import ROBOT_PAPER
from models.world_models.recurrent import PAPER


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--compile", action="store_true", help="measure the compiled step too")
    parser.add_argument("--repeats", type=int, default=3)
    asked = parser.parse_args()
    device = torch.device(asked.device)
    torch.set_num_threads(1)
    step = _step(device)
    step.run()  # memory and libraries are set up
    finish(_figures(step, device, asked.repeats, asked.compile))


def _step(device: torch.device) -> Step:
    generator = torch.Generator().manual_seed(0)
    model = ROBOT_PAPER.build_world_model(SPACES, None, generator).to(device)
    config = ROBOT_PAPER.training_config("world_model", 1000)
    return Step(model, sequences(generator).to(device), config, generator)


def _figures(step: Step, device: torch.device, repeats: int, compiled: bool) -> list[Figure]:
    recorder, counter = Recorder(), FlopCounterMode(display=False)
    with recorder:
        step.run()
    with counter:
        step.run()
    products = bare(recorder.products, device)
    taken, alone, parts = _alternated(step, products, device, repeats)
    whole = sum(parts.values())
    unit = "s of one processor" if device.type == "cpu" else "s"
    figures = [
        Figure("step", taken, unit),
        Figure("products", alone, unit),
        Figure("products_speed", counter.get_total_flops() / alone / 1e9, "GFLOP/s"),
        Figure("products_to_step", alone / taken, "ratio", 0.60),
        *(Figure(f"share_{part}", parts[part] / whole, "of a step") for part in PARTS),
    ]
    if compiled:
        step.model.compile()
        began = time.perf_counter()
        step.run()
        figures.append(Figure("compilation", time.perf_counter() - began, "s"))
        quick = median(seconds(step.run, device) for _ in range(repeats))
        figures += [Figure("compiled_step", quick, unit), Figure("products_to_compiled_step", alone / quick, "ratio")]
    print(f"{SEQUENCES} sequences of {PAPER.window} observations, {repeats} repeats, {_name(device)}")
    return figures


def _alternated(
    step: Step, products: Callable[[], None], device: torch.device, repeats: int
) -> tuple[float, float, dict[str, float]]:
    """Medians of a step, of its products alone, and of each part of a step."""
    steps, alone, parts = [], [], []
    with torch.no_grad():
        products()
    for _ in range(repeats):
        steps.append(seconds(step.run, device))
        with torch.no_grad():
            alone.append(seconds(products, device))
        parts.append(shares(step, device))
    return median(steps), median(alone), {part: median(each[part] for each in parts) for part in PARTS}


def _name(device: torch.device) -> str:
    return torch.cuda.get_device_name(device) if device.type == "cuda" else f"{torch.get_num_threads()} thread"


if __name__ == "__main__":
    main()

"""Speed and exactness of the robot simulators, and a picture of an episode of each task.

    python -m benchmarks.simulators                      figures, and results/simulators.png of the experts
    python -m benchmarks.simulators --behavior random    the picture of random actions

MUJOCO_GL=egl draws on a GPU. Status 1 where a target is missed.
"""

import argparse
from pathlib import Path

from benchmarks.figures import finish
from benchmarks.simulators.pictures import draw
from benchmarks.simulators.speed import RUNS, STEPS, TASKS, replay, speeds


def main() -> None:
    """Run, draw and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--behavior", default="expert", help="of the picture: expert or random")
    parser.add_argument("--out", type=Path, default=Path("results/simulators.png"), help="the picture")
    asked = parser.parse_args()
    figures = [figure for task in TASKS for measure in (speeds, replay) for figure in measure(task)]
    draw(asked.behavior, asked.out)
    print(f"{RUNS} runs of {STEPS} random steps a task; images: two cameras, 64 x 64; an expert's episode replayed")
    print(f"picture: {asked.out}")
    finish(figures)


if __name__ == "__main__":
    main()

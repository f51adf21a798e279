"""Figure 5: what a robot's world model is worth after two rounds of chosen labels.

    python -m benchmarks.paper.robots                     Lift and PullCube, five arms, 3 seeds; 75 minutes is the aim
    python -m benchmarks.paper.robots --profile quick     PullCube in numbers, hardly trained: does it work?
    python -m benchmarks.paper.robots --profile paper --task Lift --device cuda     everything, for a GPU

World models are warmed up on trajectories of the expert and of a diffusion policy's best stage, then learn from
segments that an arm chooses among those of the imperfect stages; one imperfect stage validates. Finished parts are not
repeated: a benchmark that was stopped goes on where it was. Status 1 where a target is missed.
"""

import argparse
import multiprocessing
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import get_args

import torch

from benchmarks.figures import Figure, finish
from benchmarks.paper.robots import cost, rollout_drawing
from benchmarks.paper.robots.acquisition import ArmRun
from benchmarks.paper.robots.acquisition_table import tell
from benchmarks.paper.robots.arms import RobotArm
from benchmarks.paper.robots.datasets import PolicyTraining, Recording, RecordingRun
from benchmarks.paper.robots.profiles import PAPER, PROFILES, SMALL, Profile
from benchmarks.paper.runs import ROBOT_CODE, code_digest, read, result_file, results, run_missing
from models.world_models.recurrent import Distance


def main(argv: Sequence[str] | None = None) -> list[Figure]:
    """Say how long it will take, do what is missing, tell it."""
    asked = _parser().parse_args(argv)
    profile, out = chosen(asked), asked.out / asked.profile
    runs, recordings = runs_of(profile, out, asked.device), recordings_of(profile)
    folder, kept = out / "data", out / (asked.distance or "")
    missing = [run for run in runs if read(result_file(kept, run)) is None]
    unmade = [each for each in recordings if not each.file(folder).exists()]
    torch.set_num_threads(asked.threads)
    if missing:
        print(cost.told(profile, missing, unmade, asked.device, asked.processes), flush=True)
        policies = list(dict.fromkeys(each.policy for each in recordings))
        run_missing([PolicyTraining(each, folder) for each in policies], folder, asked.processes, asked.threads)
        run_missing([RecordingRun(each, folder) for each in recordings], folder, asked.processes, asked.threads)
        run_missing(missing, kept, asked.processes, asked.threads)
    for path in pictures(runs, kept):
        print(path)
    return tell(results(runs, kept), len(runs), kept, targets=profile.shorter == 1)


def chosen(asked: argparse.Namespace) -> Profile:
    """The profile, or the part of it that was asked for."""
    profile = PROFILES[asked.profile]
    tasks = tuple(task for task in profile.tasks if not asked.task or task.name in asked.task)
    if not tasks:
        names = ", ".join(task.name for task in profile.tasks)
        raise SystemExit(f"Profile {profile.name} has the tasks {names}, got {', '.join(asked.task)}.")
    arms = tuple(asked.arms) if asked.arms else profile.arms
    name = f"{profile.name}-{asked.distance}" if asked.distance else profile.name
    return replace(
        profile, name=name, tasks=tasks, arms=arms, seeds=asked.seeds or profile.seeds, distance=asked.distance
    )


def runs_of(profile: Profile, out: Path, device: str) -> list[ArmRun]:
    """Seeds first, so that an unfinished benchmark has all arms and tasks of some."""
    networks = out / "networks" / code_digest(*ROBOT_CODE)
    return [
        ArmRun(profile, task, RobotArm.parse(arm), warm, seed, out / "data", networks, out / "rollouts", device)
        for warm in profile.warm
        for seed in range(profile.seeds)
        for arm in profile.arms
        for task in profile.tasks
    ]


def recordings_of(profile: Profile) -> list[Recording]:
    """Of all tasks."""
    return [recording for task in profile.tasks for recording in profile.recordings(task)]


def pictures(runs: Sequence[ArmRun], out: Path) -> list[Path]:
    """Of the first seed of every comparison; beside its results."""
    compared = dict[tuple[str, int], list[ArmRun]]()
    for run in runs:
        if run.seed == 0 and read(result_file(out, run)) is not None:
            compared.setdefault((run.task.name, run.warm), []).append(run)
    return [path for each in compared.values() for path in rollout_drawing.draw(each, out)]


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="benchmarks.paper.robots", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--profile", choices=tuple(PROFILES), default=SMALL.name)
    names = [task.name for task in PAPER.tasks]
    parser.add_argument("--task", choices=names, action="append", help="repeatable; default: all of the profile")
    parser.add_argument("--arms", nargs="+", help="strategy, strategy:rule or all; default: those of the profile")
    parser.add_argument("--seeds", type=int, help="default: those of the profile")
    parser.add_argument("--distance", choices=get_args(Distance), help="of world models; default: the preset's")
    parser.add_argument("--device", default="cpu", help="of training and scoring, cuda say")
    parser.add_argument("--processes", type=int, default=min(2, multiprocessing.cpu_count()))
    parser.add_argument("--threads", type=int, default=1, help="of torch, in each process")
    parser.add_argument("--out", type=Path, default=Path("results/paper/robots"))
    return parser


if __name__ == "__main__":
    finish(main())

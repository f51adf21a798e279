"""Noise schedules of diffusion policies: those of diffusers' schedulers, which is imported where a policy is used."""

from functools import cache
from importlib import import_module
from typing import Any

SCHEDULE = "squaredcos_cap_v2"  # Nichol and Dhariwal 2021: the share of noise grows evenly


class DiffusersMissing(ImportError):
    """Diffusion policies need a package that is not installed; the message names the command that installs it."""


@cache
def training_scheduler(noise_steps: int, prediction: str) -> Any:
    """A DDPMScheduler (Ho et al. 2020), whose `add_noise` is used. Raises DiffusersMissing."""
    return _scheduler("ddpm", "DDPMScheduler", noise_steps, prediction)


@cache
def acting_scheduler(noise_steps: int, acting_steps: int, prediction: str) -> Any:
    """A DDIMScheduler (Song et al. 2021) with its `timesteps` set; it adds no noise. Raises DiffusersMissing."""
    scheduler = _scheduler("ddim", "DDIMScheduler", noise_steps, prediction)
    scheduler.set_timesteps(acting_steps)
    return scheduler


def _scheduler(module: str, name: str, noise_steps: int, prediction: str) -> Any:
    try:
        kind = getattr(import_module(f"diffusers.schedulers.scheduling_{module}"), name)
    except ImportError as error:
        raise DiffusersMissing(
            f"Package 'diffusers' cannot be imported ({error}). Run `make setup-robots` in the environment of this "
            "process: it installs what diffusion policies need."
        ) from error
    return kind(num_train_timesteps=noise_steps, beta_schedule=SCHEDULE, prediction_type=prediction)

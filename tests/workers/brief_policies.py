"""Policies whose training is brief: their schedule, and a worker's process that trains them.

    python -m tests.workers.brief_policies --queues label

It is `workers.runner` in all but the schedule, for tests that kill it.
"""

from collections.abc import Callable
from dataclasses import replace
from unittest.mock import patch

from models.policies.diffusion import training_config
from models.spaces import Spaces
from models.training import TrainingConfig
from workers import policy_training, runner

STEPS = 300


def brief(steps: int) -> Callable[[Spaces], TrainingConfig]:
    """The default schedule, but of so many small steps."""
    return lambda spaces: replace(training_config(spaces), steps=steps, batch_size=8)


if __name__ == "__main__":
    with patch.multiple(policy_training, training_config=brief(STEPS), TRIALS=1):
        runner.main()

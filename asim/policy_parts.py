"""The parts of a robot project's data, as in the paper: what an expert and a policy at each stage of training do.

The expert and the best stage warm the models up, the imperfect stages are the pool, and one of them validates and is in
neither.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from uuid import UUID

import numpy as np

from api_schemas.collections import CollectionCreate, CollectionLabels
from api_schemas.policies import PREFIX, Policy
from asim.errors import AsimError

FEWEST = 3  # stages: the best one, one for the pool, one that validates
EXPERT = "expert"


@dataclass(frozen=True)
class Part:
    """What one behavior brings. Warm-up and validation are labeled whole, the pool is not."""

    name: str
    behavior: str
    trajectories: int

    def collection(self, project: UUID, seed: int, number: int, jobs: int) -> CollectionCreate:
        """The request for it. number: of the part, which makes its chance differ from the others'."""
        return CollectionCreate(
            project=project,
            behavior=self.behavior,
            trajectories=self.trajectories,
            seed=int(np.random.SeedSequence([seed, number]).generate_state(1)[0]) // 2,  # seeds have 31 bits
            split="held_out" if self.name == "validation" else "pool",
            labels=None if self.name == "pool" else CollectionLabels(all=True),
            shards=min(jobs, self.trajectories),
        )


def parts_of(policies: Sequence[Policy], trajectories: int) -> list[Part]:
    """All parts, each with as many of the trajectories as they can be shared out evenly.

    policies: of a project, oldest first; the stages of its last training count. The best stage is the last of those
    that succeed most often, and the validating one succeeds about half as often. Raises AsimError for too few stages or
    trajectories.
    """
    stages = [policy for policy in policies if policy.training == policies[-1].training]
    if len(stages) < FEWEST:
        raise AsimError(
            f"{len(stages)} stages of a policy are there, {FEWEST} are needed: asim policy train makes them"
        )
    if trajectories <= len(stages):
        raise AsimError(f"trajectories: {trajectories} cannot be shared among an expert and {len(stages)} stages")
    best = max(stages, key=lambda stage: (stage.success, stage.stage))
    imperfect = [stage for stage in stages if stage is not best]
    validating = min(imperfect, key=lambda stage: (abs(stage.success - best.success / 2), -stage.stage))
    named = [("warm-up", EXPERT), ("warm-up", PREFIX + best.id)]
    named += [("validation" if stage is validating else "pool", PREFIX + stage.id) for stage in imperfect]
    shares = [trajectories // len(named) + (number < trajectories % len(named)) for number in range(len(named))]
    return [Part(name, behavior, share) for (name, behavior), share in zip(named, shares, strict=True)]

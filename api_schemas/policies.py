"""Policies: how a robot acts at ten stages of learning a task, so that behavior covers good and bad."""

from typing import Annotated, Literal
from uuid import UUID

from pydantic import Field

from api_schemas.base import AS_JSON, Schema, Seed, Timestamp

PREFIX = "policy:"  # of the behavior that is a policy; its id follows
PolicyId = Annotated[str, Field(pattern="^[0-9a-f]{64}$", description="sha256 of the policy's weights")]
Form = Literal["state", "images"]


class PolicyCreate(Schema):
    """Train a diffusion policy on demonstrations of the task's scripted expert, and keep it at stages of training.

    demonstrations: episodes that the expert solved. stages: how many are kept, at steps that grow by the same factor;
    the last is the end of training. observations: what it acts by, the poses of everything (which a project with
    cameras does not show, but its simulator knows) or both cameras and proprioception.
    """

    project: UUID
    demonstrations: Annotated[int, Field(ge=1, le=1_000), AS_JSON] = 300
    stages: Annotated[int, Field(ge=1, le=20), AS_JSON] = 10
    observations: Form = "state"
    seed: Seed = 0


class Policy(Schema):
    """A policy at one stage of its training: after `steps` steps it solved the share `success` of `episodes` episodes
    that begin otherwise than the demonstrations.

    training: the job that trained it. As the behavior of a collection its name is `policy:` and its id.
    """

    id: PolicyId
    project: UUID
    training: UUID
    observations: Form
    stage: int
    stages: int
    steps: int
    success: float
    episodes: int
    bytes: int
    created_at: Timestamp

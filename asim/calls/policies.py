"""Policies."""

from collections.abc import Iterator

from api_schemas.jobs import Job
from api_schemas.policies import Policy, PolicyCreate
from asim.calls.base import Calls, Id


class PolicyCalls(Calls):
    """/policies."""

    def train_policy(self, policy: PolicyCreate) -> Job:
        """POST /policies: the job that trains."""
        return self._post("/policies", policy, Job)

    def policies(self, project: Id) -> Iterator[Policy]:
        """GET /policies, all pages, the oldest first."""
        return self._pages("/policies", Policy, project=project)

    def policy_weights(self, project: Id, policy: str) -> bytes:
        """GET /policies/{id}/weights: a safetensors file, for the labeler's scope."""
        return self._bytes(f"/policies/{policy}/weights", project=project)

"""Every endpoint asked by every kind of caller, for real. Writes docs/access.md:

python -m tests.service.access_table
"""

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from uuid import UUID

from fastapi.testclient import TestClient
from httpx2 import Response

from api_schemas.keys import Scope
from service import registry, rounds
from service.registry import TrainedModel
from service.settings import Settings
from service.store.tables import ProjectRow
from tests.service.kit import Json, Served, room, serve

DOCUMENT = Path(__file__).parents[2] / "docs" / "access.md"
SCOPES: tuple[Scope, ...] = ("read", "acquire", "label", "admin")
ELSEWHERE = ("192.0.2.7", 40000)
LETTER: Mapping[bool, str] = {True: "yes", False: "–"}
HEAD = """# Who may do what

Written by `python -m tests.service.access_table`, which asks every endpoint with every kind of key; a test asks again.
*Public*: without a key, from another machine. A key of one project does within it what its scopes say, where the last
column says so, and reaches nothing of another project.

| endpoint | public | read | acquire | label | admin | with a key of one project |
|---|---|---|---|---|---|---|
"""


@dataclass(frozen=True)
class Endpoint:
    """One method of one path. locked: the API's description says that it needs a key."""

    method: str
    path: str
    locked: bool

    @property
    def name(self) -> str:
        """As people write it."""
        return f"{self.method} {self.path}"


@dataclass(frozen=True)
class Things:
    """One project with one of everything, by the names that paths have for them."""

    project: str
    ids: Mapping[str, str]


def endpoints(served: Served) -> list[Endpoint]:
    """All that the API documents."""
    paths = served.app.openapi()["paths"]
    return [
        Endpoint(method.upper(), path, "security" in operation)
        for path, operations in paths.items()
        for method, operation in operations.items()
    ]


def fill(served: Served, name: str, seed: int) -> Things:
    """A project with a trajectory, a lease, a job, a round, a model and a policy of its own."""
    project = served.project(name=name)
    trajectory = served.upload(project, room(seed, transitions=8))[0]["id"]
    item: Json = {"trajectory": trajectory, "start": 0, "actions": [0]}
    assert served.label(project, [item]).status_code == 201
    batch = served.acquire(project, 1, strategy="random")
    weights = f"weights of {name}".encode()
    sha256 = served.services.blobs.put("weights", weights)
    with served.services.database.write() as session:
        asked = rounds.request(session, session.get_one(ProjectRow, UUID(project)), served.clock())
        trained = TrainedModel("world_model", 0, "grid", {"of": name}, sha256, len(weights), {})
        model = registry.register(session, UUID(project), asked.id, trained, 0, served.clock())
    key = served.client.post("/keys", json={"name": name, "scopes": ["read"], "project": project}).json()
    ids = {
        "project_id": project,
        "trajectory_id": trajectory,
        "acquisition_id": batch["id"],
        "round_id": str(asked.id),
        "model_id": str(model.id),
        "policy_id": served.policy(project, weights),
        "job_id": str(asked.job_id),
        "key_id": key["id"],
    }
    return Things(project, ids)


def ask(client: TestClient, endpoint: Endpoint, things: Things, headers: Mapping[str, str] | None = None) -> Response:
    """About one project's things, with a body that is not whole: whoever is let in is told what it lacks."""
    path = endpoint.path.format(**things.ids)
    body: Json | None = {"project": things.project} if endpoint.method in ("POST", "PATCH") else None
    return client.request(endpoint.method, path, params={"project": things.project}, json=body, headers=headers)


def let_in(answer: Response) -> bool:
    """The request was looked at, and was about something that is there; what came of it is another matter."""
    return answer.status_code not in (401, 403) and "unknown-resource" not in answer.text


def holder(served: Served, *scopes: Scope, project: str | None = None) -> dict[str, str]:
    """Headers of a new key."""
    answer = served.client.post("/keys", json={"name": "ada", "scopes": scopes, "project": project})
    assert answer.status_code == 201, answer.text
    return {"Authorization": f"Bearer {answer.json()['secret']}"}


def table(served: Served) -> str:
    """The document. What a request destroys is there anew for the next."""
    rows, kept = [], _callers(served, "rooms")
    for number, endpoint in enumerate(endpoints(served)):
        cells = []
        for place in range(len(SCOPES) + 2):
            lasting = endpoint.method != "DELETE"
            things, callers = kept if lasting else _callers(served, f"rooms {number} {place}")
            cells.append(LETTER[let_in(ask(stranger(served), endpoint, things, callers[place]))])
        rows.append(f"| `{endpoint.name}` | {' | '.join(cells)} |")
    return HEAD + "\n".join(rows) + "\n"


def _callers(served: Served, name: str) -> tuple[Things, list[dict[str, str]]]:
    """A project, and headers of everybody who may ask about it."""
    things = fill(served, name, 0)
    keys = [holder(served, scope) for scope in SCOPES]
    return things, [{}, *keys, holder(served, "admin", project=things.project)]


def stranger(served: Served) -> TestClient:
    """A client on another machine."""
    return TestClient(served.app, base_url="http://127.0.0.1", client=ELSEWHERE)


def main() -> None:
    """Write the document."""
    with tempfile.TemporaryDirectory() as folder:
        served = serve(Settings(data_folder=Path(folder)))
        try:
            DOCUMENT.write_text(table(served))
        finally:
            served.close()


if __name__ == "__main__":
    main()

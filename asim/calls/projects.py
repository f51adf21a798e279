"""Projects, trajectories, collections."""

import json
from collections.abc import Iterator, Mapping
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from api_schemas.collections import CollectionCreate
from api_schemas.errors import Problem
from api_schemas.jobs import CollectionStarted
from api_schemas.projects import Project, ProjectCreate, ProjectPatch
from api_schemas.trajectories import SplitChoice, TrajectoriesAdded, Trajectory
from asim.arrays import Arrays, pack, unpack
from asim.calls.base import Calls, Id
from asim.errors import NotFound


class ProjectCalls(Calls):
    """/projects, /trajectories, /collections."""

    def create_project(self, project: ProjectCreate) -> Project:
        """POST /projects."""
        return self._post("/projects", project, Project)

    def projects(self) -> Iterator[Project]:
        """GET /projects, all pages."""
        return self._pages("/projects", Project)

    def project(self, project: Id) -> Project:
        """GET /projects/{id}."""
        return self._get(f"/projects/{project}", Project)

    def find_project(self, name: str) -> Project:
        """The project of that name, or of that id. Raises NotFound."""
        for project in self.projects():
            if name in (project.name, str(project.id)):
                return project
        detail = f"no project is named {name!r} or has that id"
        raise NotFound(
            Problem(type="urn:asim:error:unknown-project", title="Unknown project", status=404, detail=detail)
        )

    def change_project(self, project: Id, patch: ProjectPatch) -> Project:
        """PATCH /projects/{id}: the fields that `patch` sets."""
        answer = self._transport.request("PATCH", f"/projects/{project}", body=patch)
        return Project.model_validate_json(answer.content)

    def add_trajectories(
        self, project: Id, files: Mapping[str, Mapping[str, NDArray[np.generic]]], split: SplitChoice = "auto"
    ) -> TrajectoriesAdded:
        """POST /trajectories: by file name, arrays by stream name, time first, T + 1 rows."""
        return self.add_files(project, {name: pack(arrays) for name, arrays in files.items()}, split)

    def add_files(
        self, project: Id, files: Mapping[str, bytes | BinaryIO], split: SplitChoice = "auto"
    ) -> TrajectoriesAdded:
        """POST /trajectories with npz files as they are; open ones are read while they are sent."""
        uploads = [("files", (name, content, "application/octet-stream")) for name, content in files.items()]
        params = {"project": project, "split": split}
        answer = self._transport.request("POST", "/trajectories", params=params, files=uploads)
        return TrajectoriesAdded.model_validate_json(answer.content)

    def trajectories(self, project: Id) -> Iterator[Trajectory]:
        """GET /trajectories, all pages."""
        return self._pages("/trajectories", Trajectory, project=project)

    def trajectory(self, project: Id, trajectory: str) -> Trajectory:
        """GET /trajectories/{id}."""
        return self._get(f"/trajectories/{trajectory}", Trajectory, project=project)

    def trajectory_content(
        self, project: Id, trajectory: str, start: int | None = None, length: int | None = None
    ) -> Arrays:
        """Observations `start` to `start + length`: `length` + 1 rows a stream. By default the whole trajectory."""
        path = f"/trajectories/{trajectory}/content"
        return unpack(self._bytes(path, project=project, start=start, length=length))

    def provenance(
        self, project: Id, trajectory: str, start: int | None = None, length: int | None = None
    ) -> tuple[Arrays, dict[str, object]]:
        """Simulator states of the same rows, and how they came about: simulator, options, behavior, seed,
        and the generator that the behavior began with."""
        path = f"/trajectories/{trajectory}/provenance"
        states = unpack(self._bytes(path, project=project, start=start, length=length))
        return states, json.loads(str(states.pop("__metadata__")))

    def collect(self, collection: CollectionCreate) -> CollectionStarted:
        """POST /collections: the job that runs the behavior, and the ids of all of them where there are shards."""
        return self._post("/collections", collection, CollectionStarted)

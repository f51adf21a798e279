"""Rounds of equal projects, one after the other, so that there is always a training to disturb."""

from collections import defaultdict
from uuid import UUID

from sqlalchemy import select

from api_schemas.rounds import Round
from service.store.tables import ModelVersionRow, RoundRow
from tests.crash.deployment import Deployment

KINDS = ("inverse_dynamics", "world_model")


class Rounds:
    """The rounds of the rooms. Equal rooms train equal networks in their n-th round, however often disturbed."""

    def __init__(self, deployment: Deployment) -> None:
        self._deployment = deployment
        self._rooms = [each.id for each in deployment.client.projects() if each.name.startswith("room")]
        self.asked: list[Round] = []

    @property
    def job(self) -> UUID:
        """The training of the newest round."""
        job = self.asked[-1].job
        assert job is not None
        return job

    def start(self) -> Round:
        """The next room's next round."""
        room = self._rooms[len(self.asked) % len(self._rooms)]
        self.asked.append(self._deployment.client.start_round(room))
        return self.asked[-1]

    def await_training(self) -> int:
        """The process that trains now; where no round is left to disturb, one is started."""
        while True:
            if not self.asked or self._deployment.job(self.job).state == "done":
                if self.asked:
                    self.finish()
                self.start()
            holder = self._deployment.await_holder(self.job)
            if holder:
                return holder

    def finish(self) -> Round:
        """The newest round, in use."""
        return self._deployment.await_round(self.asked[-1])

    def check_networks(self) -> int:
        """The same networks, bit for bit, whatever happened meanwhile; returns how many rounds could be compared."""
        statement = select(RoundRow.number, ModelVersionRow.kind, ModelVersionRow.sha256).join(
            RoundRow, RoundRow.id == ModelVersionRow.round_id
        )
        trained: dict[tuple[int, str], list[str]] = defaultdict(list)
        with self._deployment.database.read() as session:
            asked = statement.where(RoundRow.id.in_([each.id for each in self.asked]))
            for number, kind, sha256 in session.execute(asked):
                trained[number, kind].append(sha256)
        assert {kind for _, kind in trained} == set(KINDS)
        for (number, kind), found in trained.items():
            assert len(set(found)) == 1, f"round {number}: {len(set(found))} different networks {kind}"
        return sum(len(found) for found in trained.values()) // len(KINDS)

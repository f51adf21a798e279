"""A simulator in a process of its own: what hangs or kills it costs that item, and the others are labeled all the same.

The process is struck from outside between two items, so that the next one is asked of a process that does not answer.
"""

import multiprocessing
import os
import signal
from collections.abc import Iterator

import numpy as np
import pytest

from api_schemas.acquisitions import Acquisition
from api_schemas.collections import CollectionCreate
from api_schemas.projects import LabelingPolicy, ProjectCreate
from asim.client import Client
from asim.served import served
from asim.simulator_labeling import in_own_process
from tests.loop.processes import command_of
from tests.workers.conftest import ROOM
from workers.answering import SimulatorAnswerer
from workers.labeling import run_labeling
from workers.simulators.base import SimulatorUnavailable
from workers.unanswerable import ProcessEnded

ITEMS = 6
SECONDS = 20.0  # a busy machine takes long for what is no hang


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    """Of a service with the project "rooms"."""
    with served(tmp_path_factory.mktemp("served")) as url, Client(url) as found:
        policy = LabelingPolicy(round_labels=0, label_budget=200)
        project = found.create_project(ProjectCreate(name="rooms", environment=ROOM, policy=policy))
        asked = CollectionCreate(project=project.id, transitions=300, seed=1, split="pool")
        found.wait_for_job(found.collect(asked).id)
        yield found


@pytest.fixture
def batch(client: Client) -> Acquisition:
    """ITEMS segments under a lease."""
    return client.acquire(client.find_project("rooms").id, ITEMS, strategy="random")


class Strikes:
    """Signals the simulator's process when so many items are done."""

    def __init__(self, number: signal.Signals, *after: int) -> None:
        self._number, self._after, self.struck = number, after, list[int]()

    def __call__(self, done: int, of: int) -> None:
        if done in self._after:
            (child,) = (each for each in multiprocessing.active_children() if each.name == "simulator")
            assert child.pid is not None
            self.struck.append(child.pid)
            os.kill(child.pid, self._number)


def label(client: Client, batch: Acquisition, strikes: Strikes, seconds: float = SECONDS) -> None:
    opened = in_own_process(client.base_url, None, seconds)
    run_labeling(client, batch, np.random.default_rng(0), strikes, open_answerer=opened)


def unanswered(client: Client, batch: Acquisition) -> list[int]:
    """Ranks of the items that are not labeled, none of which is held any more."""
    found = client.acquisition(batch.id)
    assert found.status != "leased"
    assert client.find_project("rooms").budget.reserved == 0
    return [item.rank for item in found.items if not item.labeled]


def test_what_hangs_the_simulator_is_given_back_and_the_rest_is_labeled(client: Client, batch: Acquisition) -> None:
    strikes = Strikes(signal.SIGSTOP, 2)
    hung = batch.items[2]
    sentence = f"^segment {hung.trajectory}:{hung.start} took longer than 5 s .*--item-seconds"
    with pytest.raises(ProcessEnded, match=sentence):
        label(client, batch, strikes, 5.0)
    assert unanswered(client, batch) == [2]
    assert command_of(strikes.struck[0]) == ""  # it was killed
    assert not [each for each in multiprocessing.active_children() if each.name == "simulator"]


def test_what_crashes_the_simulator_is_given_back_and_the_rest_is_labeled(client: Client, batch: Acquisition) -> None:
    dead = batch.items[1]
    sentence = f"^segment {dead.trajectory}:{dead.start} was not answered: the simulator's process died of SIGSEGV"
    with pytest.raises(ProcessEnded, match=sentence):
        label(client, batch, Strikes(signal.SIGSEGV, 1))
    assert unanswered(client, batch) == [1]


def test_where_one_item_after_another_ends_it_the_others_are_given_back_untried(
    client: Client, batch: Acquisition
) -> None:
    with pytest.raises(ProcessEnded) as raised:
        label(client, batch, Strikes(signal.SIGKILL), 0.0)  # no answer comes so soon
    assert unanswered(client, batch) == list(range(ITEMS))
    told = [str(raised.value), *raised.value.__notes__]
    assert ["took longer" in line for line in told] == [True] * 3 + [False] * 3
    assert all("was not tried" in line for line in told[3:])


def test_answers_are_those_of_a_simulator_in_this_process(client: Client, batch: Acquisition) -> None:
    project = client.find_project("rooms")
    here, there = SimulatorAnswerer(client, project), in_own_process(client.base_url, None, SECONDS)(client, project)
    assert here.name == there.name
    generators = [np.random.default_rng(3) for _ in range(2)]
    for item in batch.items:
        assert here.answer(item, generators[0]) == there.answer(item, generators[1])
    assert len({str(generator.bit_generator.state) for generator in generators}) == 1
    here.close()
    there.close()
    assert batch.token is not None
    client.release(batch.id, batch.token)


def test_a_simulator_that_does_not_start_gives_everything_back(client: Client, batch: Acquisition) -> None:
    opened = in_own_process("http://127.0.0.1:9", None, SECONDS)  # where nobody answers
    with pytest.raises(SimulatorUnavailable, match=r"http://127\.0\.0\.1:9"):
        run_labeling(client, batch, np.random.default_rng(0), open_answerer=opened)
    assert unanswered(client, batch) == list(range(ITEMS))

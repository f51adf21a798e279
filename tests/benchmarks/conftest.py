"""Small rooms for figure 4d."""

import pytest

from benchmarks.paper.minigrid.rooms import Rooms


@pytest.fixture(scope="session")
def small_rooms(tmp_path_factory: pytest.TempPathFactory) -> Rooms:
    """For tuning: 700 transitions of a pool, 8 an action and 200 at natural frequency to test on."""
    folder = tmp_path_factory.mktemp("rooms")
    return Rooms(folder, tuning=True, pool_transitions=700, per_action=8, natural_transitions=200)

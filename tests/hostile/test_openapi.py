"""What /openapi.json describes is what the service answers, whatever it is sent: schemathesis asks."""

import os

import pytest

from tests.figures import Figures
from tests.hostile.conftest import Exposed, schemathesis

CASES = 5000
SEED = os.environ.get("ASIM_TEST_SEED", "1")


def test_nobody_and_an_administrator_are_answered_as_described(exposed: Exposed) -> None:
    made = [
        schemathesis(exposed, who, "--phases", "fuzzing", "--max-examples", "4", "--seed", SEED)
        for who in ("admin", "nobody")
    ]
    assert min(made) >= 60, made


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_every_kind_of_key_is_answered_as_described(exposed: Exposed, figures: Figures) -> None:
    made = {who: schemathesis(exposed, who, "--max-examples", "25", "--seed", SEED) for who in exposed.keys}
    figures.add("schemathesis cases", sum(made.values()), "cases", target=CASES)
    figures.note(f"ASIM_TEST_SEED={SEED}: {made}")

"""A PostgreSQL that is killed or restarted while labels are uploaded. Crash test 8."""

import random
import signal
import time
from collections import Counter

import pytest
from sqlalchemy import func, select

from service.store.tables import AcquisitionItemRow, LabelRow
from tests.crash.conftest import REPEAT, Deploy, Prepared
from tests.crash.deployment import Deployment
from tests.crash.hammer import Hammer, ask_again
from tests.figures import Figures
from tests.private_servers import PrivatePostgres

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]
RESTARTS = max(3, REPEAT // 5)
BATCH = 10


def test_8_an_upload_that_a_restart_interrupts_is_whole_or_not_there(
    deploy: Deploy, prepared: Prepared, postgres: PrivatePostgres, figures: Figures, chance: random.Random
) -> None:
    deployment = deploy()
    names = {each.id: each.name for each in deployment.client.projects()}
    hammers = {
        project: Hammer(deployment.url, deployment.key, project, count=BATCH, pause=0.2, seed=seed)
        for seed, project in enumerate(names)
    }
    for hammer in hammers.values():
        hammer.start()
    done: Counter[str] = Counter()
    for _ in range(RESTARTS):
        time.sleep(chance.uniform(0.0, 1.5))
        number = chance.choice((signal.SIGKILL, signal.SIGQUIT, signal.SIGINT))
        postgres.end(number)
        time.sleep(chance.uniform(0.2, 1.0))
        postgres.start()
        done.update([number.name])
        _check_batches(deployment)
    for hammer in hammers.values():
        hammer.finish()
    told = {project: prepared.labeled[name] + hammers[project].acknowledged for project, name in names.items()}
    for hammer in hammers.values():
        ask_again(deployment.url, deployment.key, hammer.labelers.answers[-10:])
    deployment.check(told)
    figures.note(f"PostgreSQL ended by {', '.join(f'{name} {count} times' for name, count in sorted(done.items()))}")
    figures.none("labels lost or doubled", deployment.lost_or_doubled(told))
    figures.add("labels acknowledged", sum(len(each.acknowledged) for each in hammers.values()), "labels")
    unavailable = sum(each.labelers.unavailable for each in hammers.values())
    figures.add("answers 503 with Retry-After", unavailable, "answers", target=1)
    silences = Counter(silence for each in hammers.values() for silence in each.labelers.silences)
    figures.note(f"without an answer: {dict(silences)}")
    figures.none("requests that went unanswered", sum(each.labelers.unanswered for each in hammers.values()))
    figures.add("answers to what had been done before", sum(each.replays for each in hammers.values()), "replays")


def _check_batches(deployment: Deployment) -> None:
    """Of a batch that hammers acquired all segments are labeled, or none."""
    deployment.check_rows()
    labels = select(LabelRow.acquisition_id, func.count()).group_by(LabelRow.acquisition_id)
    items = select(AcquisitionItemRow.acquisition_id, func.count()).group_by(AcquisitionItemRow.acquisition_id)
    with deployment.database.read() as session:
        given = dict(iter(session.execute(items)))
        for acquisition, count in session.execute(labels):
            whole = acquisition is None or count == given[acquisition]
            assert whole, f"acquisition {acquisition}: {count} labels of a batch"

"""A scaled-out service on an empty PostgreSQL database of the shared server, with a Redis of its own."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from api_schemas.keys import KeyCreate
from service import keys
from service.clock import utc_now
from service.store.database import migrate, open_database
from tests.crash.deployment import Deployment
from tests.private_servers import PrivateRedis

Deploy = Callable[..., Deployment]
SETTINGS = {  # the product's own values, where the crash tests have short ones
    "ASIM_JOB_LEASE_SECONDS": "15",
    "ASIM_CHECKPOINT_SECONDS": "10",
    "ASIM_RESEND_SECONDS": "15",
    "ASIM_CANARY_SECONDS": "60",
    "ASIM_QUEUE_LENGTH": "2000",
    "ASIM_POLL_SECONDS": "0.2",
}


@pytest.fixture
def deploy(postgres_url: str, tmp_path: Path) -> Iterator[Deploy]:
    """Starts an API on the empty database; workers are started on what it returns. All of it is killed at the end."""
    with ExitStack() as stack:

        def start(**settings: str) -> Deployment:
            redis = stack.enter_context(PrivateRedis())
            folder = tmp_path / "data"
            folder.mkdir()
            made = Deployment(folder, postgres_url, redis, admin_key(postgres_url), **{**SETTINGS, **settings})
            stack.callback(made.close)
            made.start_api()
            return made

        yield start


def admin_key(database_url: str) -> str:
    """The newest schema, and the secret of a key that may do everything."""
    migrate(database_url)
    database = open_database(database_url)
    with database.write() as session:
        secret = keys.create(session, KeyCreate(name="scale", scopes=["admin"]), utc_now()).secret
    database.close()
    return secret

"""A real S3-compatible server for tests: moto's, a process of its own on a free port, with one bucket."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import httpx
from obstore.store import S3Store

from tests.loop.processes import eventually, free_port

START_SECONDS = 60.0
BUCKET = "asim"


@dataclass
class ObjectStore:
    """The server; it may be stopped. What it held is lost then, as it keeps everything in memory."""

    port: int = field(default_factory=free_port)
    process: "subprocess.Popen[bytes] | None" = None

    @property
    def url(self) -> str:
        """Where it listens."""
        return f"http://127.0.0.1:{self.port}"

    @property
    def environment(self) -> dict[str, str]:
        """What a process needs to reach it, beside an s3:// URL: exactly what the README names."""
        return {
            "AWS_ENDPOINT_URL": self.url,
            "AWS_ALLOW_HTTP": "true",
            "AWS_REGION": "us-east-1",
            "AWS_ACCESS_KEY_ID": "asim",
            "AWS_SECRET_ACCESS_KEY": "not-secret",
        }

    def start(self) -> None:
        """Start, wait until it answers, make the bucket."""
        command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(self.port)]
        self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        eventually(self._answers, START_SECONDS, f"the S3 server does not answer on {self.url}")
        httpx.put(f"{self.url}/{BUCKET}", trust_env=False).raise_for_status()

    def stop(self) -> None:
        """End it, if it runs."""
        if self.process is not None:
            self.process.kill()
            self.process.wait(START_SECONDS)
            self.process = None

    def listed(self, bucket: str = BUCKET) -> list[str]:
        """Names of all objects of a bucket, as another S3 client lists them."""
        listing = httpx.get(f"{self.url}/{bucket}", params={"list-type": "2"}, trust_env=False).raise_for_status().text
        return [part.partition("</Key>")[0] for part in listing.split("<Key>")[1:]]

    def overwrite(self, key: str, data: bytes) -> None:
        """Put an object behind the product's back."""
        store = S3Store(
            BUCKET,
            endpoint=self.url,
            region="us-east-1",
            access_key_id="asim",
            secret_access_key="not-secret",  # noqa: S106  (the test's own server takes any)
            client_options={"allow_http": True},
        )
        store.put(key, data)

    def _answers(self) -> bool:
        assert self.process is not None
        assert self.process.poll() is None, f"the S3 server ended with status {self.process.returncode}"
        try:
            return httpx.get(f"{self.url}/moto-api/data.json", trust_env=False).is_success
        except httpx.TransportError:
            return False


@contextmanager
def object_store() -> Iterator[ObjectStore]:
    """A server for the time of the block."""
    server = ObjectStore()
    try:
        server.start()
        yield server
    finally:
        server.stop()

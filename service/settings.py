"""The only place that reads the environment: ASIM_* variables, or the defaults of embedded mode."""

import os
from pathlib import Path

from pydantic import Field
from pydantic_settings import BaseSettings, PydanticBaseSettingsSource, SecretsSettingsSource, SettingsConfigDict

POOL_SIZE = 48  # more than the 40 threads that handle requests


class Settings(BaseSettings):
    """Where things are kept and how long a worker may be silent.

    data_folder: everything of embedded mode lives here, unless a URL below says otherwise.
    provenance_url: simulator states and behavior provenance; "" for a process that must not reach them (training and
    scoring workers are started so).
    broker_url: Redis or RabbitMQ; set, jobs are carried by Celery, unset, by the embedded runner.
    """

    model_config = SettingsConfigDict(env_prefix="ASIM_", frozen=True)

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,
        file_secret_settings: PydanticBaseSettingsSource,
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """ASIM_SECRETS names a folder with a file for each setting that must not stand in the environment."""
        folder = os.environ.get("ASIM_SECRETS")
        secrets = (SecretsSettingsSource(settings_cls, secrets_dir=folder),) if folder else ()
        return (init_settings, env_settings, *secrets)

    data_folder: Path = Path("asim-data")
    database_url: str = ""
    blobs_url: str = ""
    provenance_url: str | None = None
    broker_url: str = ""
    relay: bool = Field(default=True, description="API processes send jobs to workers; false: asim scheduler does")
    celery_prefix: str = "asim"
    traces_url: str = Field(
        default="", description="OTLP collector, as http://collector:4318/v1/traces; empty: no traces"
    )
    job_lease_seconds: float = Field(default=15.0, gt=0)
    job_max_attempts: int = Field(default=3, ge=1)
    checkpoint_seconds: float = Field(default=10.0, gt=0, description="a stage of training is kept this often")
    silence_seconds: float = Field(default=600.0, gt=0, description="a job that is silent for longer is hung and ended")
    canary_seconds: float = Field(default=60.0, gt=0, description="ready while a canary of each queue is this young")
    resend_seconds: float = Field(default=15.0, gt=0, description="a sent job that nobody claimed may be sent again")
    visibility_seconds: float = Field(default=900.0, gt=0, description="after it, Redis returns a lost message")
    idempotency_hours: float = Field(default=168.0, gt=0, description="a key of a request is remembered this long")
    poll_seconds: float = Field(default=0.2, gt=0)
    queue_length: int = Field(default=2000, ge=1, description="ranked segments kept ready in the database")
    shard_transitions: int = Field(default=100_000, ge=1)
    torch_threads: int = Field(default=1, ge=1)
    devices: str = Field(
        default="cpu",
        pattern=r"^(cpu|cuda(:\d+)?)(,(cpu|cuda(:\d+)?))*$",
        description="where networks are trained: cpu, cuda, or several as cuda:0,cuda:1, a process each",
    )
    training_bytes: int = Field(
        default=2 * 2**30, ge=2**20, description="of the pool's observations that are kept in memory in training"
    )
    pool_size: int = Field(
        default=POOL_SIZE, ge=1, description="connections to the database that the API holds at most"
    )
    allowed_hosts: tuple[str, ...] = ("127.0.0.1", "localhost", "[::1]")
    max_body_bytes: int = Field(default=256 * 2**20, ge=1)
    keyless: bool = Field(default=True, description="embedded mode needs no key from programs of this machine")
    max_labels_bytes: int = Field(default=32 * 2**20, ge=1)
    max_json_bytes: int = Field(default=4 * 2**20, ge=1, description="of every body that brings no data")
    failed_keys_per_minute: int = Field(default=100, ge=1, description="of one address; raise it behind a proxy")
    failures_per_key: int = Field(default=10, ge=1, description="a minute, of one key at one address")
    min_free_bytes: int = Field(default=2**30, ge=0, description="of a disk; asim doctor warns below it")

    def make_data_folder(self) -> Path:
        """The data folder; a new one is this user's alone."""
        self.data_folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        return self.data_folder.absolute()

    @property
    def training_devices(self) -> tuple[str, ...]:
        """Of training, in order."""
        return tuple(self.devices.split(","))

    @property
    def embedded(self) -> bool:
        """True where no broker carries jobs."""
        return not self.broker_url

    @property
    def redis_broker(self) -> bool:
        """True where the broker is Redis, whose transport has options of its own."""
        return self.broker_url.startswith(("redis", "sentinel", "valkey"))

    def resolved_database_url(self) -> str:
        """The given URL, or a SQLite file in the data folder."""
        return self.database_url or f"sqlite:///{(self.data_folder / 'asim.db').absolute()}"

    def resolved_blobs_url(self) -> str:
        """The given URL, or a folder in the data folder."""
        return self.blobs_url or str((self.data_folder / "blobs").absolute())

    def resolved_provenance_url(self) -> str | None:
        """The given URL, or a folder in the data folder; None where this process may not reach provenance."""
        if self.provenance_url == "":
            return None
        return self.provenance_url or str((self.data_folder / "provenance").absolute())

"""Settings of the service: environment variables `SGSST_...`, each with a default that suits one machine."""

from __future__ import annotations

import ipaddress
from functools import cached_property
from pathlib import Path

from pydantic import Field
from pydantic_settings import BaseSettings, SettingsConfigDict

MB, GB = 1_000_000, 1_000_000_000


def is_loopback(host: str) -> bool:
    """Return whether a host is `localhost` or a loopback address; no other name counts, wherever it leads."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


class ServiceSettings(BaseSettings):
    """What API and dispatcher share; both read the same environment.

    Attributes:
        data: folder of database, inputs and results.
        database: SQLAlchemy URL; None for SQLite in `data`. PostgreSQL: `postgresql+psycopg://user@host/name`.
        artifacts: fsspec URL of the store of files: results, and inputs unless it is a local folder; None for a folder
            in `data`. S3: `s3://bucket/prefix`.
        file_cache_bytes: of inputs that a host keeps of what is in the store of files.
        host, port: where the API listens.
        require_keys: whether requests need an API key; None: unless the API is bound to loopback.
        max_request_bytes: of one request's body; uploads in parts may be larger.
        max_upload_bytes: of one file.
        max_gaussians, max_views, max_pixels: of a job; pixels are those of all views together.
        max_image_pixels: of the style and of each photo.
        max_photos: files in one job.
        max_jobs_per_key: unfinished jobs of one key.
        max_jobs_a_day_per_key, max_gpu_seconds_a_day_per_key, max_bytes_per_key, max_requests_a_second_per_key: quotas
            of keys that have none of their own (`service.store.quotas`); None for no bound.
        max_connections: to one process of the API at the same time, watchers included.
        trusted_proxies: Addresses and networks of reverse proxies, separated by commas, whose `X-Forwarded-For` and
            `X-Forwarded-Proto` are believed; empty for none.
        min_free_bytes: nothing is taken in once the disk has less left.
        inspection_seconds, inspection_bytes: what checking a job's files may take, processor time and memory; their
            size adds to both (`service.inspection.inspector`).
        dry_run_seconds: processor time that planning without running may take; Gaussians and views add to it.
        receive_seconds: a request's body that stands still for so long is given up.
        session_days: that a browser stays signed in which has shown a key.
        upload_hours: after which an unfinished upload, or a finished one that no job uses, expires.
        retention_days: after which a finished job's results expire; the job's record stays as long again.
        lease_seconds: after which another dispatcher takes a job over that has not been heard of.
        max_attempts: of a job in a row that come no further, before it fails for good.
        retry_seconds: wait before the second attempt; doubles with each.
        parallel_jobs: jobs side by side; None: one for each GPU, or one.
        cluster_gpus: GPUs of the Ray cluster at RAY_ADDRESS that this dispatcher may give to jobs.
        start_seconds: for which a process that starts waits for a database server that does not answer yet.
        checkpoint_seconds: how often a running job saves its state.
        preview_seconds: how often it shows a picture of it, and its log where that has grown.
        stop_seconds: what a job may take to stop before it is killed.
        webhooks: whether jobs may name a URL that is told when they end.
        webhook_private_addresses: whether such URLs may lead to private networks.
        log_format: "json" or "text".
    """

    model_config = SettingsConfigDict(env_prefix="SGSST_", extra="ignore", frozen=True)

    data: Path = Path("sgsst-data")
    database: str | None = None
    artifacts: str | None = None
    host: str = "127.0.0.1"
    port: int = Field(8000, ge=0, le=65535)
    require_keys: bool | None = None

    max_request_bytes: int = Field(4 * GB, gt=0)
    max_upload_bytes: int = Field(16 * GB, gt=0)
    max_gaussians: int = Field(20_000_000, gt=0)
    max_views: int = Field(2_000, gt=0)
    max_pixels: int = Field(20_000_000_000, gt=0)
    max_image_pixels: int = Field(100_000_000, gt=0)
    max_photos: int = Field(2_000, gt=0)
    max_jobs_per_key: int = Field(100, gt=0)
    max_jobs_a_day_per_key: int | None = Field(None, ge=0)
    max_gpu_seconds_a_day_per_key: float | None = Field(None, ge=0)
    max_bytes_per_key: int | None = Field(None, ge=0)
    max_requests_a_second_per_key: float | None = Field(None, gt=0)
    max_connections: int = Field(10_000, gt=0)
    trusted_proxies: str = ""
    min_free_bytes: int = Field(2 * GB, ge=0)
    file_cache_bytes: int = Field(50 * GB, ge=0)
    inspection_seconds: float = Field(120, gt=0)
    inspection_bytes: int = Field(8 * GB, gt=0)
    dry_run_seconds: float = Field(600, gt=0)
    receive_seconds: float = Field(60, gt=0)

    session_days: float = Field(7, gt=0)
    upload_hours: float = Field(24, gt=0)
    retention_days: float = Field(30, gt=0)

    lease_seconds: float = Field(30, gt=0)
    max_attempts: int = Field(3, gt=0)
    retry_seconds: float = Field(5, ge=0)
    parallel_jobs: int | None = Field(None, gt=0)
    cluster_gpus: int = Field(0, ge=0)
    start_seconds: float = Field(60, ge=0)
    checkpoint_seconds: float = Field(60, gt=0)
    preview_seconds: float = Field(20, gt=0)
    stop_seconds: float = Field(20, gt=0)
    poll_seconds: float = Field(0.5, gt=0)

    webhooks: bool = False
    webhook_private_addresses: bool = False
    log_format: str = "text"

    @cached_property
    def folder(self) -> Path:
        """`data`, absolute: processes may have different working folders."""
        return self.data.expanduser().absolute()

    @property
    def database_url(self) -> str:
        """The database's URL, SQLite's in `data` by default."""
        return self.database or f"sqlite:///{self.folder / 'sgsst.db'}"

    @property
    def artifacts_url(self) -> str:
        """The results' URL, a folder in `data` by default."""
        return self.artifacts or f"file://{self.folder / 'artifacts'}"

    @property
    def session_seconds(self) -> float:
        """`session_days`, in seconds."""
        return self.session_days * 86_400.0

    @property
    def retention_seconds(self) -> float:
        """`retention_days`, in seconds."""
        return self.retention_days * 86_400.0

    @property
    def on_loopback(self) -> bool:
        """Whether only programs of this machine can reach the API."""
        return is_loopback(self.host)

    @property
    def keys_required(self) -> bool:
        """Whether a request without an API key is refused."""
        return not self.on_loopback if self.require_keys is None else self.require_keys

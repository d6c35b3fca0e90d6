"""Settings of the service: environment variables `SGSST_...`, with defaults for a single machine."""

from __future__ import annotations

import ipaddress
import re
from functools import cached_property
from pathlib import Path

from pydantic import Field, field_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

from service.outgoing import parse_origins

GB = 1_000_000_000
#: Maximum number of characters of a path at which a proxy offers the service.
_MAX_SUBPATH = 200


def is_loopback(host: str) -> bool:
    """Return whether a host is `localhost` or a loopback address; other names are not resolved."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def is_subpath(text: str) -> bool:
    """Return whether a text can be the path at which a proxy offers the service, such as "/tools/sgsst"."""
    return len(text) <= _MAX_SUBPATH and re.fullmatch(r"(/[A-Za-z0-9_~-][A-Za-z0-9._~-]*)+", text) is not None


class ServiceSettings(BaseSettings):
    """Settings that API and dispatcher read from the same environment.

    Attributes:
        data: Folder of database, inputs and results.
        database: SQLAlchemy URL; None for SQLite in `data`. PostgreSQL: `postgresql+psycopg://user@host/name`.
        artifacts: fsspec URL of the file store. It holds the results and, unless it is a local folder, the inputs; None
            for a folder in `data`. S3: `s3://bucket/prefix`.
        file_cache_bytes: Size limit of a host's cache of inputs from the file store.
        host, port: Address the API listens on.
        require_keys: Whether requests need an API key; None requires keys unless the API is bound to loopback.
        max_request_bytes: Size limit of one request body; multipart uploads may be larger.
        max_upload_bytes: Size limit of one file.
        max_gaussians, max_views, max_pixels: Limits per job; pixels are those of all views together.
        max_image_pixels: Pixel limit of each style image and each photo.
        max_photos: Maximum number of photos per job.
        max_jobs_per_key: Maximum number of unfinished jobs per key.
        max_jobs_a_day_per_key, max_gpu_seconds_a_day_per_key, max_bytes_per_key, max_requests_a_second_per_key: Quotas
            of keys without their own (`service.store.quotas`); None for no limit.
        max_connections: Maximum number of concurrent connections per API process, including event streams.
        trusted_proxies: Addresses and networks of reverse proxies, separated by commas, whose `X-Forwarded-For`,
            `X-Forwarded-Proto` and `X-Forwarded-Prefix` are trusted; empty for none.
        root_path: Path at which a reverse proxy offers the service, such as `/sgsst`; replaces `X-Forwarded-Prefix`.
        min_free_bytes: Free disk space below which the service accepts no data.
        inspection_seconds, inspection_bytes: Base limits of CPU time and memory for checking a job's files; both grow
            with the size of the files (`service.inspection.inspector`).
        dry_run_seconds: Base limit of CPU time for a dry run; it grows with Gaussians and views.
        receive_seconds: Time without new bytes after which a request body is abandoned, or without reading a response.
        answer_seconds: Time without progress after which a request is answered with 503, or its response ended.
        session_days: Lifetime of a browser session that was started with a key.
        upload_hours: Time after which an unfinished upload, or a finished one that no job uses, expires.
        retention_days: Time after which the results of a finished job expire; the job's record is deleted after another
            such period.
        lease_seconds: Time without heartbeat after which another dispatcher takes over a job.
        max_attempts: Consecutive attempts without progress after which a job fails.
        retry_seconds: Delay before the second attempt; it doubles with each further one.
        parallel_jobs: Maximum number of concurrent jobs; None for one per GPU (one in total if there are no GPUs).
        cluster_gpus: GPUs of the Ray cluster at RAY_ADDRESS that this dispatcher may assign to jobs.
        start_seconds: Time that a starting process waits for a database server that does not respond yet.
        checkpoint_seconds: Interval between checkpoints of a running job.
        preview_seconds: Interval between preview images of a running job; its log is updated as often if it has grown.
        stop_seconds: Time that a job has for stopping before it is killed.
        poll_seconds: Interval between a dispatcher's searches for jobs to start, stop or clean up after.
        webhooks: Whether jobs may name a URL that gets messages about them.
        webhook_private_addresses: Whether webhook URLs may lead to private networks.
        url_hosts: Hosts that inputs named by URL may be fetched from, separated by commas; empty for none. `HOST` means
            `https://HOST`; other schemes and ports are written out, as in `http://minio:9000`.
        url_bytes: Size limit of all inputs that one request names by URL.
        url_seconds: Time limit for fetching all inputs of one request, from the first name lookup to the last byte.
        url_private_addresses: Whether `url_hosts` may have addresses in private networks.
        embed_origins: Origins whose pages may show shared results in a frame, separated by commas, as in `url_hosts`;
            empty for none.
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
    root_path: str = ""
    min_free_bytes: int = Field(2 * GB, ge=0)
    file_cache_bytes: int = Field(50 * GB, ge=0)
    inspection_seconds: float = Field(120, gt=0)
    inspection_bytes: int = Field(8 * GB, gt=0)
    dry_run_seconds: float = Field(600, gt=0)
    receive_seconds: float = Field(60, gt=0)
    answer_seconds: float = Field(30, gt=0)

    session_days: float = Field(7, gt=0)
    upload_hours: float = Field(24, gt=0)
    retention_days: float = Field(30, gt=0)

    lease_seconds: float = Field(30, gt=0, le=1800)  # far below the hour at which `store.queue` finds times implausible
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
    url_hosts: str = ""
    url_bytes: int = Field(1 * GB, gt=0)
    url_seconds: float = Field(120, gt=0)
    url_private_addresses: bool = False
    embed_origins: str = ""
    log_format: str = "text"

    @field_validator("url_hosts", "embed_origins")
    @classmethod
    def _check_hosts(cls, text: str) -> str:
        parse_origins(text)
        return text

    @field_validator("root_path")
    @classmethod
    def _check_root_path(cls, text: str) -> str:
        path = text.rstrip("/")
        if path and not is_subpath(path):
            raise ValueError("must be a path such as /sgsst, of letters, digits and - . _ ~")
        return path

    @cached_property
    def folder(self) -> Path:
        """Absolute path of `data`, because processes may have different working directories."""
        return self.data.expanduser().absolute()

    @property
    def database_url(self) -> str:
        """URL of the database; SQLite in `data` by default."""
        return self.database or f"sqlite:///{self.folder / 'sgsst.db'}"

    @property
    def artifacts_url(self) -> str:
        """URL of the file store; a folder in `data` by default."""
        return self.artifacts or f"file://{self.folder / 'artifacts'}"

    @property
    def session_seconds(self) -> float:
        """Duration of `session_days` in seconds."""
        return self.session_days * 86_400.0

    @property
    def retention_seconds(self) -> float:
        """Duration of `retention_days` in seconds."""
        return self.retention_days * 86_400.0

    @property
    def frame_ancestors(self) -> str:
        """Sources of Content-Security-Policy that may show shared results in a frame."""
        origins = sorted(parse_origins(self.embed_origins))
        return " ".join(f"{scheme}://{host}:{port}" for scheme, host, port in origins) or "'none'"

    @property
    def on_loopback(self) -> bool:
        """Whether only programs on this machine can reach the API."""
        return is_loopback(self.host)

    @property
    def keys_required(self) -> bool:
        """Whether a request without an API key is rejected."""
        return not self.on_loopback if self.require_keys is None else self.require_keys

"""Settings of the service: environment variables `SGSST_...`, with defaults for a single machine.

In addition, what every process does at its start: set up its log, the permissions of its files, and the check of the
network weights.
"""

import ipaddress
import json
import logging
import os
import re
import stat
import sys
import textwrap
import time
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Literal

from pydantic import Field, ValidationError, field_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

from service import problems
from service.outgoing import parse_origins
from sgsst_core.errors import SettingsError
from sgsst_core.features.weight_files import damaged_weights
from sgsst_core.settings import reason

_log = logging.getLogger(__name__)

GB = 1_000_000_000
#: Maximum number of characters of a path at which a proxy offers the service.
_MAX_SUBPATH = 200
#: Drivers of the databases that the store knows.
_DRIVERS = ("pysqlite", "psycopg")


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
    """Settings that API and dispatcher read from the same environment; docs/operations.md describes each."""

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
    max_photos: int = Field(2_000, gt=0, le=30_000)  # SQLite's statements have at most 32,766 values
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
    log_format: Literal["text", "json"] = "text"

    @field_validator("data")
    @classmethod
    def _check_data(cls, path: Path) -> Path:
        try:
            return path.expanduser()
        except RuntimeError as error:
            raise ValueError("its home folder is unknown") from error

    @field_validator("database")
    @classmethod
    def _check_database(cls, url: str | None) -> str | None:
        """Check the URL as SQLAlchemy and the driver parse it."""
        from sqlalchemy.engine import make_url

        try:
            parsed = make_url(url or "sqlite://")
            dialect = parsed.get_dialect()()
            if dialect.driver not in _DRIVERS:
                raise ValueError(f"the driver {dialect.driver!r} is not supported")
            driver = dialect.import_dbapi()
            if dialect.driver == "psycopg":
                driver.conninfo.make_conninfo("", **dialect.create_connect_args(parsed)[1])
        except Exception as error:
            known = "postgresql+psycopg://USER@HOST/NAME (extra `postgresql`) or sqlite:////PATH"
            raise ValueError(f"{str(error).strip()}. Give a URL such as {known}") from error
        return url

    @field_validator("artifacts")
    @classmethod
    def _check_artifacts(cls, url: str | None) -> str | None:
        """Check the URL as fsspec and its file systems parse it."""
        from fsspec.core import url_to_fs

        try:
            url_to_fs(url or "file:///")
        except Exception as error:
            raise ValueError(f"{error}. Give a URL such as s3://BUCKET/PREFIX (extra `s3`) or file:///PATH") from error
        return url

    @field_validator("trusted_proxies")
    @classmethod
    def _check_proxies(cls, text: str) -> str:
        for part in filter(None, map(str.strip, text.split(","))):
            if part != "*":
                ipaddress.ip_network(part)  # another text would never match
        return text

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
        return self.data.absolute()

    @property
    def database_url(self) -> str:
        """URL of the database; SQLite in `data` by default."""
        return self.database or f"sqlite:///{self.folder / 'sgsst.db'}"

    @property
    def artifacts_url(self) -> str:
        """URL of the file store; a folder in `data` by default."""
        return self.artifacts or f"file://{self.folder / 'artifacts'}"

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


def read_settings() -> ServiceSettings:
    """Return the settings from the environment.

    Raises:
        SettingsError: If one cannot be used; the message names its variable.
    """
    try:
        return ServiceSettings()
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(str(part) for part in first["loc"])
        value = "" if name in ("database", "artifacts") else f" = {first['input']!r}"  # URLs may hold passwords
        raise SettingsError(f"Environment variable SGSST_{name.upper()}{value}: {reason(first)}.") from error


def check_weights() -> None:
    """Verify the installed weights, and log each damaged file once, with instructions for the operator.

    Raises:
        DamagedWeightsError: If any weights are damaged.
    """
    if damages := damaged_weights():
        for damage in damages:
            _log_once(damage)
        raise problems.WEIGHTS_DAMAGED()


@lru_cache
def _log_once(damage: str) -> None:
    _log.error("weights damaged, no job is accepted or started: %s", damage)


_FIELDS = ("job", "attempt", "method", "path", "status", "seconds", "request_id", "owner")


class JsonFormatter(logging.Formatter):
    """Formatter that writes one JSON object per line."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the record as a JSON object."""
        entry = {
            "time": time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(record.created)) + f".{int(record.msecs):03d}Z",
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        entry |= {name: getattr(record, name) for name in _FIELDS if hasattr(record, name)}
        if record.exc_info:
            entry["exception"] = self.formatException(record.exc_info)
        return json.dumps(entry)


class TextFormatter(logging.Formatter):
    """Formatter that writes time, level, message, and the job if there is one.

    Every record starts on a new line, and all its further lines are indented. Text from a request therefore cannot
    forge a record.
    """

    def format(self, record: logging.LogRecord) -> str:
        """Return the record as a line of text, followed by the indented traceback if there is one."""
        own = " ".join(f"{name}={_value(getattr(record, name))}" for name in _FIELDS if hasattr(record, name))
        line = f"{self.formatTime(record, '%H:%M:%S')} {record.levelname.lower():<7} {record.getMessage()}"
        line = _printable(f"{line}  {own}" if own else line)
        if record.exc_info:
            trace = "\n".join(_printable(part) for part in self.formatException(record.exc_info).split("\n"))
            line += "\n" + textwrap.indent(trace, "  ")
        return line


def _value(value: object) -> str:
    """Return a value as a single word, quoted if it contains spaces, quotes, backslashes or unprintable characters."""
    text = str(value)
    return text if text.isprintable() and re.fullmatch(r'[^\s"\\]+', text) else json.dumps(text)


def _printable(text: str) -> str:
    """Escape characters that would end the line, control a terminal, or change the text direction."""
    return "".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in text)


def set_up(log_format: str) -> None:
    """Log records of level INFO and above to stderr in the format "json" or "text"."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonFormatter() if log_format == "json" else TextFormatter())
    logging.basicConfig(level=logging.INFO, handlers=[handler], force=True)
    for noisy in ("httpx2", "httpcore", "alembic", "botocore", "uvicorn.access"):
        logging.getLogger(noisy).setLevel(logging.WARNING)


def start() -> ServiceSettings:
    """Return the settings of this process, once its log and its files are set up; end it if they cannot be used."""
    try:
        settings = read_settings()
    except SettingsError as error:
        sys.exit(f"error: {error}")
    set_up(settings.log_format)
    keep_private(settings)
    return settings


def keep_private(settings: ServiceSettings) -> None:
    """Create the data folder, restrict it and that of results to the owner, and set a umask for all that is written.

    Folders that belong to another user and cannot be restricted are logged.
    """
    from fsspec.core import split_protocol

    os.umask(0o077)
    settings.folder.mkdir(parents=True, exist_ok=True)
    protocol, artifacts = split_protocol(settings.artifacts_url)
    paths = [settings.folder, *([Path(artifacts)] if protocol in (None, "file", "local") else [])]
    for path in filter(Path.exists, paths):
        mode = stat.S_IMODE(path.stat().st_mode)
        if mode & 0o077:
            try:
                path.chmod(mode & 0o700)
            except PermissionError:
                _log.warning("folder readable by other users, and owned by another user: path=%s", path)

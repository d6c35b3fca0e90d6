"""Tables of the store; times are seconds since 1970 (UTC), and ids sort by creation."""

from typing import Any

from sqlalchemy import JSON, BigInteger, Boolean, Float, ForeignKey, Index, Integer, MetaData, String, Text, text
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column

#: SQLite numbers rows automatically only with INTEGER; PostgreSQL needs BIGINT for large numbers.
Sequence = BigInteger().with_variant(Integer, "sqlite")


class Base(DeclarativeBase):
    """Base class with fixed names of constraints, so that migrations can refer to them on every database."""

    metadata = MetaData(
        naming_convention={
            "ix": "ix_%(table_name)s_%(column_0_name)s",
            "uq": "uq_%(table_name)s_%(column_0_name)s",
            "fk": "fk_%(table_name)s_%(column_0_name)s",
            "pk": "pk_%(table_name)s",
        }
    )
    type_annotation_map = {dict[str, Any]: JSON, list[Any]: JSON}  # noqa: RUF012 (SQLAlchemy reads it)


class JobRow(Base):
    """Job.

    `lease_epoch` counts its leases; every write of a dispatcher names the epoch that it holds. `failures` counts
    consecutive failed attempts without progress. `saved_step` is the step of the newest checkpoint, and `failed_step`
    its value at the last failure. `finish_requested` is set once its user has ended the job early. `swept` is set once
    the job has ended and has no files without database rows.
    """

    __tablename__ = "jobs"

    id: Mapped[str] = mapped_column(String(40), primary_key=True)
    owner: Mapped[str] = mapped_column(String(40))
    name: Mapped[str] = mapped_column(String(200))
    status: Mapped[str] = mapped_column(String(12))
    priority: Mapped[int] = mapped_column(Integer, default=0)
    parameters: Mapped[dict[str, Any]]
    inputs: Mapped[list[Any]] = mapped_column(deferred=True)  # may be long; see `service.store.jobs`
    created_at: Mapped[float] = mapped_column(Float)
    queued_at: Mapped[float] = mapped_column(Float)
    not_before: Mapped[float] = mapped_column(Float)
    started_at: Mapped[float | None] = mapped_column(Float)
    finished_at: Mapped[float | None] = mapped_column(Float)
    expires_at: Mapped[float | None] = mapped_column(Float)
    attempt: Mapped[int] = mapped_column(Integer, default=0)
    failures: Mapped[int] = mapped_column(Integer, default=0)
    saved_step: Mapped[int | None] = mapped_column(Integer)
    failed_step: Mapped[int | None] = mapped_column(Integer)
    finish_requested: Mapped[bool] = mapped_column(Boolean, default=False)
    swept: Mapped[bool] = mapped_column(Boolean, default=False)
    progress: Mapped[dict[str, Any] | None]
    result: Mapped[dict[str, Any] | None]
    error: Mapped[dict[str, Any] | None]
    webhook: Mapped[str | None] = mapped_column(Text)
    webhook_events: Mapped[list[Any] | None]
    viewpoints: Mapped[dict[str, Any] | None]
    lease_epoch: Mapped[int] = mapped_column(Integer, default=0)
    lease_owner: Mapped[str | None] = mapped_column(String(120))
    lease_expires_at: Mapped[float | None] = mapped_column(Float)

    __table_args__ = (
        Index("ix_jobs_queue", "status", "priority", "queued_at", "id"),  # covers counting a queue position
        # finds the first job of each owner without reading other jobs (`service.store.queue`)
        Index("ix_jobs_turns", "status", "owner", text("priority DESC"), "queued_at", "id"),
        Index("ix_jobs_lease_expires_at", "lease_expires_at"),
        Index("ix_jobs_owner_id", "owner", "id"),
        Index("ix_jobs_owner_status", "owner", "status", "id"),
        Index("ix_jobs_expires_at", "expires_at"),
        Index("ix_jobs_swept", "swept", "status"),
    )


class AttemptRow(Base):
    """Attempt at a job under one lease; `outcome` is None while it runs.

    It has held `gpus` GPUs since `gpus_since`; None without a GPU.
    """

    __tablename__ = "attempts"

    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True)
    number: Mapped[int] = mapped_column(Integer, primary_key=True)
    epoch: Mapped[int] = mapped_column(Integer)
    dispatcher: Mapped[str] = mapped_column(String(120))
    started_at: Mapped[float] = mapped_column(Float)
    finished_at: Mapped[float | None] = mapped_column(Float)
    outcome: Mapped[str | None] = mapped_column(String(20))
    gpus: Mapped[int] = mapped_column(Integer, default=0)
    gpus_since: Mapped[float | None] = mapped_column(Float)
    error: Mapped[dict[str, Any] | None]


class DispatcherRow(Base):
    """Live dispatcher with its last heartbeat and its capacity: GPUs, or slots for jobs."""

    __tablename__ = "dispatchers"

    name: Mapped[str] = mapped_column(String(120), primary_key=True)
    seen_at: Mapped[float] = mapped_column(Float)
    slots: Mapped[int] = mapped_column(Integer)
    free: Mapped[int] = mapped_column(Integer)


class TurnRow(Base):
    """Turn of an owner: the serial number of the last lease of its jobs. The owner with the lowest number is next."""

    __tablename__ = "turns"

    owner: Mapped[str] = mapped_column(String(40), primary_key=True)
    served: Mapped[int] = mapped_column(Sequence)


class EventRow(Base):
    """Event of a job; event streams resume from an `id`."""

    __tablename__ = "events"

    id: Mapped[int] = mapped_column(Sequence, primary_key=True, autoincrement=True)
    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"))
    kind: Mapped[str] = mapped_column(String(20))
    data: Mapped[dict[str, Any]]
    created_at: Mapped[float] = mapped_column(Float)

    __table_args__ = (Index("ix_events_job_id", "job_id", "id"), {"sqlite_autoincrement": True})


class ProgressPointRow(Base):
    """Point of a job's loss history: its progress at one moment, with a column for each member that queries use."""

    __tablename__ = "progress_points"

    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True)
    attempt: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=False)
    step: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=False)
    seconds: Mapped[float] = mapped_column(Float)
    progress: Mapped[dict[str, Any]]


class ArtifactRow(Base):
    """Published file of a job; it is visible as soon as this row exists."""

    __tablename__ = "artifacts"

    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True)
    name: Mapped[str] = mapped_column(String(200), primary_key=True)
    location: Mapped[str] = mapped_column(Text)
    size: Mapped[int] = mapped_column(BigInteger)
    sha256: Mapped[str] = mapped_column(String(64))
    created_at: Mapped[float] = mapped_column(Float)


class BlobRow(Base):
    """Content of an input, shared by all jobs and uploads with it; `location` is the file's name among the blobs."""

    __tablename__ = "blobs"

    sha256: Mapped[str] = mapped_column(String(64), primary_key=True)
    location: Mapped[str] = mapped_column(String(120), unique=True)
    size: Mapped[int] = mapped_column(BigInteger)
    touched_at: Mapped[float] = mapped_column(Float)


class BlobUseRow(Base):
    """Reference to a blob from its holder, `job:ID` or `upload:ID`."""

    __tablename__ = "blob_uses"

    holder: Mapped[str] = mapped_column(String(60), primary_key=True)
    sha256: Mapped[str] = mapped_column(ForeignKey("blobs.sha256"), primary_key=True, index=True)


class UploadRow(Base):
    """Multipart upload or receipt (`service.store.files`); `sha256` is set once an upload is complete."""

    __tablename__ = "uploads"

    id: Mapped[str] = mapped_column(String(40), primary_key=True)
    owner: Mapped[str] = mapped_column(String(40))
    length: Mapped[int] = mapped_column(BigInteger)
    offset: Mapped[int] = mapped_column(BigInteger, default=0)
    filename: Mapped[str] = mapped_column(String(200))
    metadata_header: Mapped[str] = mapped_column(Text)
    sha256: Mapped[str | None] = mapped_column(String(64))
    created_at: Mapped[float] = mapped_column(Float)
    expires_at: Mapped[float] = mapped_column(Float, index=True)


class UploadPartRow(Base):
    """Bytes of an unfinished upload, stored as an object in the file store."""

    __tablename__ = "upload_parts"

    upload_id: Mapped[str] = mapped_column(ForeignKey("uploads.id", ondelete="CASCADE"), primary_key=True)
    start: Mapped[int] = mapped_column(BigInteger, primary_key=True, autoincrement=False)
    size: Mapped[int] = mapped_column(BigInteger)
    location: Mapped[str] = mapped_column(Text)


class KeyRow(Base):
    """API key; only its SHA-256 is stored. The key of an operator sees the usage of all keys."""

    __tablename__ = "api_keys"

    id: Mapped[str] = mapped_column(String(40), primary_key=True)
    name: Mapped[str] = mapped_column(String(100))
    sha256: Mapped[str] = mapped_column(String(64), unique=True)
    priority: Mapped[int] = mapped_column(Integer, default=0)
    operator: Mapped[bool] = mapped_column(Boolean, default=False)
    created_at: Mapped[float] = mapped_column(Float)
    revoked_at: Mapped[float | None] = mapped_column(Float)
    quotas: Mapped[dict[str, Any] | None]


class UsageRow(Base):
    """Usage of an owner on one day; `day` is the number of days since 1970 (UTC).

    `cpu_seconds` are those of attempts without a GPU, and `bytes` those of the inputs and results of jobs.
    """

    __tablename__ = "usage"

    owner: Mapped[str] = mapped_column(String(40), primary_key=True)
    day: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=False)
    jobs: Mapped[int] = mapped_column(Integer, default=0)
    gpu_seconds: Mapped[float] = mapped_column(Float, default=0.0)
    cpu_seconds: Mapped[float] = mapped_column(Float, default=0.0)
    bytes: Mapped[int] = mapped_column(BigInteger, default=0)


class SessionRow(Base):
    """Browser session of an API key; only the SHA-256 of the cookie's secret is stored."""

    __tablename__ = "sessions"

    sha256: Mapped[str] = mapped_column(String(64), primary_key=True)
    key_id: Mapped[str] = mapped_column(ForeignKey("api_keys.id", ondelete="CASCADE"))
    created_at: Mapped[float] = mapped_column(Float)
    expires_at: Mapped[float] = mapped_column(Float, index=True)

    __table_args__ = (Index("ix_sessions_key_id", "key_id", "created_at"),)


class ShareRow(Base):
    """Link to the result of a job; only the SHA-256 of its token is stored."""

    __tablename__ = "shares"

    id: Mapped[str] = mapped_column(String(40), primary_key=True)
    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"), index=True)
    sha256: Mapped[str] = mapped_column(String(64))
    created_at: Mapped[float] = mapped_column(Float)
    expires_at: Mapped[float] = mapped_column(Float)


class IdempotencyRow(Base):
    """Idempotency-Key of a client with the id of the object that its request created."""

    __tablename__ = "idempotency_keys"

    owner: Mapped[str] = mapped_column(String(40), primary_key=True)
    key: Mapped[str] = mapped_column(String(200), primary_key=True)
    fingerprint: Mapped[str] = mapped_column(String(64))
    created_id: Mapped[str] = mapped_column(String(40))
    created_at: Mapped[float] = mapped_column(Float)


class InspectionRow(Base):
    """Result of inspecting an input, so that the same content is not inspected twice."""

    __tablename__ = "inspections"

    key: Mapped[str] = mapped_column(String(80), primary_key=True)
    result: Mapped[dict[str, Any]]
    created_at: Mapped[float] = mapped_column(Float, index=True)


class DeliveryRow(Base):
    """Webhook message that is still to be delivered."""

    __tablename__ = "deliveries"

    id: Mapped[str] = mapped_column(String(40), primary_key=True)
    job_id: Mapped[str] = mapped_column(String(40), index=True)
    url: Mapped[str] = mapped_column(Text)
    body: Mapped[dict[str, Any]]
    tries: Mapped[int] = mapped_column(Integer, default=0)
    next_at: Mapped[float] = mapped_column(Float, index=True)


class CounterRow(Base):
    """Monotonic counter for monitoring; `labels` is the part in braces of the Prometheus format."""

    __tablename__ = "counters"

    name: Mapped[str] = mapped_column(String(80), primary_key=True)
    labels: Mapped[str] = mapped_column(String(120), primary_key=True)
    value: Mapped[float] = mapped_column(Float, default=0.0)


class SecretRow(Base):
    """Secret created by the service itself, such as the one that signs webhooks."""

    __tablename__ = "secrets"

    name: Mapped[str] = mapped_column(String(40), primary_key=True)
    value: Mapped[str] = mapped_column(Text)

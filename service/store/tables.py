"""The tables. Times are seconds since 1970 (UTC), ids sort by creation."""

from __future__ import annotations

from typing import Any

from sqlalchemy import JSON, BigInteger, Boolean, Float, ForeignKey, Index, Integer, MetaData, String, Text, false
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column

#: SQLite counts rows up by itself only for INTEGER, PostgreSQL needs BIGINT to count far enough.
Sequence = BigInteger().with_variant(Integer, "sqlite")


class Base(DeclarativeBase):
    """Names of constraints are fixed, so that migrations can name them on every database."""

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
    """A job.

    `lease_epoch` counts how often it was leased; every write of a dispatcher names the epoch it holds. `failures`
    counts failed attempts in a row without progress: `saved_step` is the farthest of a checkpoint, `failed_step` what
    it was at the last failure. `swept`: the job has ended, and no file is left that no row refers to.
    """

    __tablename__ = "jobs"

    id: Mapped[str] = mapped_column(String(40), primary_key=True)
    owner: Mapped[str] = mapped_column(String(40))
    name: Mapped[str] = mapped_column(String(200))
    status: Mapped[str] = mapped_column(String(12))
    priority: Mapped[int] = mapped_column(Integer, default=0)
    parameters: Mapped[dict[str, Any]]
    inputs: Mapped[list[Any]]
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
    swept: Mapped[bool] = mapped_column(Boolean, default=False, server_default=false())
    progress: Mapped[dict[str, Any] | None]
    result: Mapped[dict[str, Any] | None]
    error: Mapped[dict[str, Any] | None]
    webhook: Mapped[str | None] = mapped_column(Text)
    lease_epoch: Mapped[int] = mapped_column(Integer, default=0)
    lease_owner: Mapped[str | None] = mapped_column(String(120))
    lease_expires_at: Mapped[float | None] = mapped_column(Float)

    __table_args__ = (
        Index("ix_jobs_queue", "status", "priority", "queued_at", "id"),  # a place in the queue is counted in it alone
        Index("ix_jobs_owner_id", "owner", "id"),
        Index("ix_jobs_owner_status", "owner", "status", "id"),
        Index("ix_jobs_expires_at", "expires_at"),
        Index("ix_jobs_swept", "swept", "status"),
    )


class AttemptRow(Base):
    """One lease of a job, and how it ended; `outcome` is None while it runs."""

    __tablename__ = "attempts"

    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True)
    number: Mapped[int] = mapped_column(Integer, primary_key=True)
    epoch: Mapped[int] = mapped_column(Integer)
    dispatcher: Mapped[str] = mapped_column(String(120))
    started_at: Mapped[float] = mapped_column(Float)
    finished_at: Mapped[float | None] = mapped_column(Float)
    outcome: Mapped[str | None] = mapped_column(String(20))
    error: Mapped[dict[str, Any] | None]


class DispatcherRow(Base):
    """A dispatcher that is at work, when it was last heard of, and what room it has: GPUs, or places for jobs."""

    __tablename__ = "dispatchers"

    name: Mapped[str] = mapped_column(String(120), primary_key=True)
    seen_at: Mapped[float] = mapped_column(Float)
    places: Mapped[int] = mapped_column(Integer)
    free: Mapped[int] = mapped_column(Integer)


class TurnRow(Base):
    """When an owner's job was leased last, as a number that counts leases: who has waited longest is next."""

    __tablename__ = "turns"

    owner: Mapped[str] = mapped_column(String(40), primary_key=True)
    served: Mapped[int] = mapped_column(Sequence)


class EventRow(Base):
    """Something that happened to a job; `id` is what a stream of events resumes from."""

    __tablename__ = "events"

    id: Mapped[int] = mapped_column(Sequence, primary_key=True, autoincrement=True)
    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"))
    kind: Mapped[str] = mapped_column(String(20))
    data: Mapped[dict[str, Any]]
    created_at: Mapped[float] = mapped_column(Float)

    __table_args__ = (Index("ix_events_job_id", "job_id", "id"), {"sqlite_autoincrement": True})


class ProgressPointRow(Base):
    """A point of the course of a job's loss; `scales` has the loss of each scale, None where one took no part."""

    __tablename__ = "progress_points"

    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True)
    attempt: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=False)
    step: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=False)
    total: Mapped[int] = mapped_column(Integer)
    stage: Mapped[str] = mapped_column(String(20))
    seconds: Mapped[float] = mapped_column(Float)
    loss: Mapped[float] = mapped_column(Float)
    scales: Mapped[list[Any] | None]
    updated_at: Mapped[float] = mapped_column(Float)


class ArtifactRow(Base):
    """A published file of a job; it is there as soon as this row is, and not before."""

    __tablename__ = "artifacts"

    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True)
    name: Mapped[str] = mapped_column(String(200), primary_key=True)
    location: Mapped[str] = mapped_column(Text)
    size: Mapped[int] = mapped_column(BigInteger)
    sha256: Mapped[str] = mapped_column(String(64))
    created_at: Mapped[float] = mapped_column(Float)


class BlobRow(Base):
    """The content of an input, once for all who use it; `location` is the file's name among the blobs."""

    __tablename__ = "blobs"

    sha256: Mapped[str] = mapped_column(String(64), primary_key=True)
    location: Mapped[str] = mapped_column(String(120), unique=True)
    size: Mapped[int] = mapped_column(BigInteger)
    touched_at: Mapped[float] = mapped_column(Float)


class BlobUseRow(Base):
    """Who needs a blob: `job:ID` or `upload:ID`."""

    __tablename__ = "blob_uses"

    holder: Mapped[str] = mapped_column(String(60), primary_key=True)
    sha256: Mapped[str] = mapped_column(ForeignKey("blobs.sha256"), primary_key=True, index=True)


class UploadRow(Base):
    """A file that arrives in parts; `sha256` is set once it is whole."""

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
    """Bytes of an unfinished upload that are in the store of files as an object of their own."""

    __tablename__ = "upload_parts"

    upload_id: Mapped[str] = mapped_column(ForeignKey("uploads.id", ondelete="CASCADE"), primary_key=True)
    start: Mapped[int] = mapped_column(BigInteger, primary_key=True, autoincrement=False)
    size: Mapped[int] = mapped_column(BigInteger)
    location: Mapped[str] = mapped_column(Text)


class KeyRow(Base):
    """An API key: its SHA-256, never the key."""

    __tablename__ = "api_keys"

    id: Mapped[str] = mapped_column(String(40), primary_key=True)
    name: Mapped[str] = mapped_column(String(100))
    sha256: Mapped[str] = mapped_column(String(64), unique=True)
    priority: Mapped[int] = mapped_column(Integer, default=0)
    created_at: Mapped[float] = mapped_column(Float)
    revoked_at: Mapped[float | None] = mapped_column(Float)


class SessionRow(Base):
    """A browser that has shown an API key: the SHA-256 of what its cookie holds, never the key."""

    __tablename__ = "sessions"

    sha256: Mapped[str] = mapped_column(String(64), primary_key=True)
    key_id: Mapped[str] = mapped_column(ForeignKey("api_keys.id", ondelete="CASCADE"))
    created_at: Mapped[float] = mapped_column(Float)
    expires_at: Mapped[float] = mapped_column(Float, index=True)

    __table_args__ = (Index("ix_sessions_key_id", "key_id", "created_at"),)


class IdempotencyRow(Base):
    """The answer to a request that created something, under the key that its sender gave it."""

    __tablename__ = "idempotency_keys"

    owner: Mapped[str] = mapped_column(String(40), primary_key=True)
    key: Mapped[str] = mapped_column(String(200), primary_key=True)
    fingerprint: Mapped[str] = mapped_column(String(64))
    created_id: Mapped[str] = mapped_column(String(40))
    created_at: Mapped[float] = mapped_column(Float)


class InspectionRow(Base):
    """What checking an input has found; the same content is not looked at twice."""

    __tablename__ = "inspections"

    key: Mapped[str] = mapped_column(String(80), primary_key=True)
    result: Mapped[dict[str, Any]]
    created_at: Mapped[float] = mapped_column(Float, index=True)


class DeliveryRow(Base):
    """A webhook message that is still to be delivered."""

    __tablename__ = "deliveries"

    id: Mapped[str] = mapped_column(String(40), primary_key=True)
    job_id: Mapped[str] = mapped_column(String(40))
    url: Mapped[str] = mapped_column(Text)
    body: Mapped[dict[str, Any]]
    tries: Mapped[int] = mapped_column(Integer, default=0)
    next_at: Mapped[float] = mapped_column(Float, index=True)


class CounterRow(Base):
    """A count that only grows, for monitoring; `labels` is the part between braces of the Prometheus form."""

    __tablename__ = "counters"

    name: Mapped[str] = mapped_column(String(80), primary_key=True)
    labels: Mapped[str] = mapped_column(String(120), primary_key=True)
    value: Mapped[float] = mapped_column(Float, default=0.0)


class SecretRow(Base):
    """Secrets that the service has made for itself, such as the one that signs webhooks."""

    __tablename__ = "secrets"

    name: Mapped[str] = mapped_column(String(40), primary_key=True)
    value: Mapped[str] = mapped_column(Text)

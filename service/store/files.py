"""Rows of blobs, uploads and inspections; their files are managed by `service.files.blobs`."""

import hashlib
from collections.abc import Sequence
from typing import Any

from sqlalchemy import bindparam, delete, exists, func, select, update
from sqlalchemy.orm import Session

from service import problems
from service.store.database import Database, idempotency_row, new_id, upsert
from service.store.keys import IS_RECEIPT, NO_QUOTAS, RECEIPT, Quotas, check_bytes, lock_owner
from service.store.tables import Base, BlobRow, BlobUseRow, InspectionRow, UploadPartRow, UploadRow

#: Folders of inputs and of unfinished uploads, in the file store (in the data folder if the file store is local). All
#: other folders of the file store belong to jobs.
BLOBS, UPLOADS = "blobs", "uploads"
#: Lifetime of an unreferenced blob in seconds: the request that uploaded it may not have created its job yet.
GRACE_SECONDS = 3600.0
#: Maximum number of unfinished uploads per key.
MAX_OPEN_UPLOADS = 1000
#: Lifetime of an input's inspection result in seconds.
_INSPECTION_SECONDS = 30 * 86_400.0

# Built once, because building a query takes longer than running it.
_BLOBS = select(Base.metadata.tables["blobs"]).where(BlobRow.sha256.in_(bindparam("digests", expanding=True)))
_UPLOADS = select(Base.metadata.tables["uploads"]).where(
    UploadRow.id.in_(bindparam("ids", expanding=True)),
    UploadRow.owner == bindparam("owner"),
    UploadRow.expires_at >= bindparam("now"),
)
_INSPECTION = select(Base.metadata.tables["inspections"].c.result).where(InspectionRow.key == bindparam("key"))


def check_offset(upload: UploadRow, offset: int) -> None:
    """Raise ConflictError if an upload's next byte is at a different offset."""
    if upload.offset != offset:
        raise problems.WRONG_OFFSET(given=offset, offset=upload.offset)


class InputRows:
    """Database rows of blobs, uploads, receipts and inspections."""

    def __init__(self, database: Database) -> None:
        self.database = database

    def add_blob(self, sha256: str, location: str, size: int, upload_id: str | None = None) -> str:
        """Register a file's content and return its location; known content keeps its earlier location.

        Args:
            location: Name of its file among the blobs.
            upload_id: Upload or receipt that the content came with; it holds the blob from now on.

        Raises:
            NotFoundError: If the upload or receipt is gone.
        """
        now = self.database.clock()
        with self.database.writing() as session:
            if upload_id is not None:
                _lock_upload(session, upload_id)
            insert = upsert(session)(BlobRow).values(sha256=sha256, location=location, size=size, touched_at=now)
            session.execute(insert.on_conflict_do_update(index_elements=["sha256"], set_={"touched_at": now}))
            if upload_id is not None:
                _hold_for_upload(session, upload_id, sha256, size)
            return session.get_one(BlobRow, sha256, populate_existing=True).location

    def hold(self, digests: Sequence[str]) -> dict[str, BlobRow]:
        """Return blobs by digest, and protect them from collection for nine tenths of `GRACE_SECONDS` at least.

        Raises:
            NotFoundError: If a blob is gone.
        """
        blobs, now = self.blobs(digests), self.database.clock()
        if any(blob.touched_at < now - GRACE_SECONDS / 10 for blob in blobs.values()):
            with self.database.writing() as session:
                held = BlobRow.sha256.in_(digests)
                # the same lock order as in `release_blobs`
                session.execute(select(BlobRow.sha256).where(held).order_by(BlobRow.sha256).with_for_update())
                session.execute(update(BlobRow).where(held).values(touched_at=now))
            blobs = self.blobs(digests)
        missing = next((sha256 for sha256 in digests if sha256 not in blobs), None)
        if missing is not None:
            raise problems.NOT_FOUND(f"There is no file with SHA-256 {missing}.")
        return blobs

    def blobs(self, digests: Sequence[str]) -> dict[str, BlobRow]:
        """Return blobs by digest; missing ones are left out."""
        with self.database.reading_rows() as connection:
            rows = connection.execute(_BLOBS, {"digests": list(digests)})
            return {row.sha256: BlobRow(**row._mapping) for row in rows}

    def collect(self) -> list[str]:
        """Delete the rows of blobs that have been unused for a while; return their locations for removing the files."""
        before = self.database.clock() - GRACE_SECONDS
        used = exists().where(BlobUseRow.sha256 == BlobRow.sha256)
        with self.database.writing() as session:
            query = select(BlobRow).where(BlobRow.touched_at < before, ~used).limit(1000)
            rows = session.scalars(query.with_for_update(skip_locked=True)).all()
            for row in rows:
                session.delete(row)
            return [row.location for row in rows]

    def file_names(self) -> set[str]:
        """Return the names of the files of all blobs and unfinished uploads, in a data folder and in a file store."""
        unfinished = select(UploadRow.id).where(UploadRow.sha256.is_(None))
        with self.database.reading() as session:
            names = {f"{BLOBS}/{location}" for location in session.scalars(select(BlobRow.location))}
            names.update(f"{UPLOADS}/{upload_id}.part" for upload_id in session.scalars(unfinished))
            names.update(session.scalars(select(UploadPartRow.location)))
        return names

    def create_upload(
        self,
        owner: str,
        length: int,
        filename: str,
        header: str,
        seconds: float,
        idempotency_key: str | None = None,
        quotas: Quotas = NO_QUOTAS,
        most: int = MAX_OPEN_UPLOADS,
    ) -> UploadRow:
        """Create an upload that expires after `seconds` without new bytes.

        Raises:
            ConflictError: If the owner has `most` unfinished uploads.
            IDEMPOTENCY_KEY_REUSED: If the key was used for a different upload.
            QUOTA_EXCEEDED: If its bytes would exceed the owner's quota.
        """
        now = self.database.clock()
        with self.database.writing() as session:
            lock_owner(session, owner)
            used_key = None
            if idempotency_key is not None:
                fingerprint = hashlib.sha256(f"{length} {header}".encode()).hexdigest()
                used_key = idempotency_row(session, owner, f"upload:{idempotency_key}", fingerprint, now)
                known = session.get(UploadRow, used_key.created_id) if used_key.created_id else None
                if known is not None:
                    return known
            unfinished = (UploadRow.owner == owner, UploadRow.sha256.is_(None), ~IS_RECEIPT)
            if (session.scalar(select(func.count()).select_from(UploadRow).where(*unfinished)) or 0) >= most:
                raise problems.TOO_MANY_UPLOADS(limit=most)
            row = UploadRow(id=new_id("upl", now), owner=owner, length=length, offset=0, filename=filename)
            row.metadata_header, row.created_at, row.expires_at = header, now, now + seconds
            session.add(row)
            session.flush()
            check_bytes(session, owner, quotas)
            if used_key is not None:
                used_key.created_id = row.id
        return row

    def upload(self, upload_id: str, owner: str) -> UploadRow:
        """Return an upload of this owner that has not expired.

        Raises:
            NotFoundError: If there is no such upload.
        """
        row = self.uploads([upload_id], owner).get(upload_id)
        if row is None:
            raise problems.NO_UPLOAD(upload_id=upload_id)
        return row

    def uploads(self, upload_ids: Sequence[str], owner: str) -> dict[str, UploadRow]:
        """Return uploads of this owner by id; missing and expired ones are left out."""
        parameters = {"ids": list(upload_ids), "owner": owner, "now": self.database.clock()}
        with self.database.reading_rows() as connection:
            return {row.id: UploadRow(**row._mapping) for row in connection.execute(_UPLOADS, parameters)}

    def advance_upload(
        self, upload_id: str, start: int, size: int, seconds: float, location: str | None = None
    ) -> float:
        """Record newly saved bytes of an upload and return its new expiry.

        Args:
            start: Offset of the first new byte.
            size: Number of new bytes.
            seconds: Time until the upload expires.
            location: Name of the object with the bytes; None for the upload's local file.

        Raises:
            ConflictError: If another request has saved bytes at this offset meanwhile.
        """
        expires = self.database.clock() + seconds
        with self.database.writing() as session:
            row = _lock_upload(session, upload_id)
            check_offset(row, start)
            if location is not None:
                session.add(UploadPartRow(upload_id=upload_id, start=start, size=size, location=location))
            row.offset, row.expires_at = start + size, expires
        return expires

    def parts(self, upload_id: str) -> list[UploadPartRow]:
        """Return the parts of an unfinished upload in order."""
        query = select(UploadPartRow).where(UploadPartRow.upload_id == upload_id).order_by(UploadPartRow.start)
        with self.database.reading() as session:
            return list(session.scalars(query))

    def finish_upload(self, upload_id: str, sha256: str, seconds: float) -> None:
        """Link an upload to the blob made from its bytes."""
        with self.database.writing() as session:
            row = _lock_upload(session, upload_id)
            row.offset, row.sha256, row.expires_at = row.length, sha256, self.database.clock() + seconds
            session.execute(delete(UploadPartRow).where(UploadPartRow.upload_id == upload_id))
            _hold_for_upload(session, upload_id, sha256)

    def delete_upload(self, upload_id: str, owner: str) -> list[str]:
        """Delete an upload; a blob made from it remains for the jobs that use it.

        Returns:
            Locations of blobs that are no longer used, for `Blobs.remove`.
        """
        with self.database.writing() as session:
            row = session.get(UploadRow, upload_id, with_for_update=True)
            if row is None or row.owner != owner:
                raise problems.NO_UPLOAD(upload_id=upload_id)
            session.delete(row)
            return release_blobs(session, f"upload:{upload_id}")

    # --- receipts: charges for the bytes of requests, until a job takes over their files -----------------------------

    def open_receipt(self, owner: str, size: int, quotas: Quotas) -> str:
        """Charge an owner for the bytes of an incoming request and return the id of the receipt.

        The receipt holds the blobs made from the request's files. It expires like an upload unless it is renewed.

        Raises:
            QUOTA_EXCEEDED: If the bytes would exceed the owner's quota.
        """
        now = self.database.clock()
        row = UploadRow(id=new_id(RECEIPT, now), owner=owner, length=size, offset=0, filename="", metadata_header="")
        row.created_at, row.expires_at = now, now + GRACE_SECONDS
        with self.database.writing() as session:
            lock_owner(session, owner)
            session.add(row)
            session.flush()
            check_bytes(session, owner, quotas)
        return row.id

    def grow_receipt(self, receipt: str, size: int, owner: str, quotas: Quotas) -> None:
        """Charge further bytes for a request that did not declare its size.

        Raises:
            QUOTA_EXCEEDED: If the bytes would exceed the owner's quota.
            NotFoundError: If the receipt has expired.
        """
        with self.database.writing() as session:
            lock_owner(session, owner)
            _lock_upload(session, receipt).length += size
            session.flush()
            check_bytes(session, owner, quotas)

    def renew_receipts(self, receipts: Sequence[str]) -> None:
        """Extend the receipts of active requests."""
        with self.database.writing() as session:
            expires = self.database.clock() + GRACE_SECONDS
            session.execute(update(UploadRow).where(UploadRow.id.in_(receipts)).values(expires_at=expires))

    def end_receipt(self, receipt: str) -> list[str]:
        """Delete the receipt of a request that ended without a job.

        Returns:
            Locations of blobs that are no longer used, for `Blobs.remove`.
        """
        with self.database.writing() as session:
            session.execute(delete(UploadRow).where(UploadRow.id == receipt))
            return release_blobs(session, f"upload:{receipt}")

    def expire_uploads(self) -> list[str]:
        """Delete expired uploads and return their ids for removing their bytes."""
        now = self.database.clock()
        with self.database.writing() as session:
            query = select(UploadRow).where(UploadRow.expires_at < now).limit(500)
            rows = session.scalars(query.with_for_update(skip_locked=True)).all()
            for row in rows:
                session.execute(delete(BlobUseRow).where(BlobUseRow.holder == f"upload:{row.id}"))
                session.delete(row)
            return [row.id for row in rows]

    def inspection(self, key: str) -> dict[str, Any] | None:
        """Return the result of an earlier inspection of the same content; None if there is none."""
        with self.database.reading_rows() as connection:
            result: dict[str, Any] | None = connection.execute(_INSPECTION, {"key": key}).scalar()
            return result

    def add_inspection(self, key: str, result: dict[str, Any]) -> None:
        """Store the result of an inspection, and delete old results."""
        now = self.database.clock()
        with self.database.writing() as session:
            insert = upsert(session)(InspectionRow).values(key=key, result=result, created_at=now)
            session.execute(insert.on_conflict_do_nothing())
            session.execute(delete(InspectionRow).where(InspectionRow.created_at < now - _INSPECTION_SECONDS))


def release_blobs(session: Session, holder: str) -> list[str]:
    """Release a holder's blobs and delete the rows of those without other holders.

    Returns:
        Locations of the deleted blobs. The caller removes their files once the transaction is committed.
    """
    held = select(BlobUseRow.sha256).where(BlobUseRow.holder == holder)
    # lock blobs in a fixed order before deleting their uses: of two concurrent releases, the second one then sees that
    # no other use remains
    rows = session.scalars(
        select(BlobRow).where(BlobRow.sha256.in_(held)).order_by(BlobRow.sha256).with_for_update()
    ).all()
    session.execute(delete(BlobUseRow).where(BlobUseRow.holder == holder))
    digests = [row.sha256 for row in rows]
    used = set(session.scalars(select(BlobUseRow.sha256).where(BlobUseRow.sha256.in_(digests))))
    unused = [row for row in rows if row.sha256 not in used]
    for row in unused:
        session.delete(row)
    return [row.location for row in unused]


def close_receipt(session: Session, receipt: str) -> None:
    """Delete a receipt whose blobs are now held by a job created in this transaction."""
    session.execute(delete(BlobUseRow).where(BlobUseRow.holder == f"upload:{receipt}"))
    session.execute(delete(UploadRow).where(UploadRow.id == receipt))


def _lock_upload(session: Session, upload_id: str) -> UploadRow:
    """Lock and return an upload's row; call this before locking rows of blobs, so that no deadlock occurs."""
    row = session.get(UploadRow, upload_id, with_for_update=True)
    if row is None:
        raise problems.NO_UPLOAD(upload_id=upload_id)
    return row


def _hold_for_upload(session: Session, upload_id: str, sha256: str, size: int = 0) -> None:
    """Hold a blob for an upload or receipt; a receipt's charge of `size` moves from the incoming bytes to the blob."""
    use = upsert(session)(BlobUseRow).values(holder=f"upload:{upload_id}", sha256=sha256)
    session.execute(use.on_conflict_do_nothing())
    receipt = update(UploadRow).where(UploadRow.id == upload_id, IS_RECEIPT).values(length=UploadRow.length - size)
    session.execute(receipt.execution_options(synchronize_session=False))

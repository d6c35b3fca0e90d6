"""Agreement of files and database: periodic housekeeping by dispatchers, and the check and repair by `sgsst fsck`.

Files of failed attempts are swept once their job has ended. Orphaned files come from interrupted attempts that stored
another file after the job had already ended elsewhere, and from processes that died. Both are safe while the service is
running.
"""

import math
import secrets
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Literal, TypeVar

from sqlalchemy import ColumnElement, Select, and_, delete, exists, false, select, tuple_
from sqlalchemy.orm import InstrumentedAttribute

from service.files.blobs import Blobs, open_blobs
from service.files.objects import Artifacts, ObjectStore
from service.inputs import CHECKPOINT
from service.problems import NotFoundError
from service.settings import ServiceSettings
from service.states import UNFINISHED
from service.store import Store
from service.store.files import BLOBS, UPLOADS
from service.store.tables import ArtifactRow, Base, BlobRow, BlobUseRow, UploadRow

#: Maximum number of jobs whose leftover files are looked for in one round.
_MAX_SWEEPS = 1000
#: Description of a file.
What = Literal["input", "result", "checkpoint", "upload"]


def clean_up(store: Store, artifacts: Artifacts, blobs: Blobs) -> None:
    """Delete what has expired, and leftovers of attempts at ended jobs."""
    for job_id in store.jobs.expire():
        artifacts.objects.remove_below(job_id)
    for job_id, epoch in store.jobs.unswept(_MAX_SWEEPS):
        for name in _strays(store, job_id, artifacts.objects.below(job_id), epoch):
            artifacts.objects.remove(name)
        store.jobs.mark_swept(job_id, epoch)
    blobs.collect()


def remove_orphans(store: Store, artifacts: Artifacts, blobs: Blobs) -> None:
    """Delete orphaned files."""
    for objects, _, name in orphans(store, artifacts, blobs):
        objects.remove(name)


def orphans(store: Store, artifacts: Artifacts, blobs: Blobs) -> Iterator[tuple[ObjectStore, What, str]]:
    """Yield old files that no database row refers to or will refer to, each with its store and what it is.

    Files are listed before rows are read, so that the row of every listed file is already visible.
    """
    objects, incoming = blobs.objects, ObjectStore(f"file://{blobs.incoming}")
    inputs, uploads = objects.old(BLOBS), objects.old(UPLOADS)
    known = store.inputs.file_names()
    yield from ((objects, "input", name) for name in inputs if name not in known)
    yield from ((objects, "upload", name) for name in uploads if name not in known)
    yield from ((incoming, "upload", name) for name in incoming.old(""))
    of_jobs: defaultdict[str, list[str]] = defaultdict(list)
    for name in artifacts.objects.old(""):
        of_jobs[name.partition("/")[0]].append(name)
    for job_id, names in of_jobs.items():
        if job_id.startswith("job_"):
            yield from ((artifacts.objects, "result", name) for name in _strays_of_job(store, job_id, names))


def _strays_of_job(store: Store, job_id: str, names: list[str]) -> list[str]:
    """Return the old files of a job that no database row refers to or will refer to."""
    try:
        job = store.jobs.get(job_id, None)
    except NotFoundError:
        return names
    # the running attempt may still write rows; earlier ones cannot. An older copy of the database does not know the
    # latest epochs of an ended job.
    return _strays(store, job_id, names, job.lease_epoch - 1 if job.status in UNFINISHED else math.inf)


def _strays(store: Store, job_id: str, names: Iterable[str], epoch: float) -> list[str]:
    """Return the files of a job that no database row refers to, except those of later leases than `epoch`."""
    known = {row.location for row in store.jobs.artifacts(job_id)}
    return [name for name in names if name not in known and int(name.split("/")[1]) <= epoch]


#: Rows per query, and number of files that are read concurrently.
_PAGE, _AT_A_TIME = 500, 4
#: Folder of a file store to which damaged files are moved.
QUARANTINE = "quarantine"

Kind = Literal["missing", "damaged", "orphaned"]
T = TypeVar("T")


@dataclass(frozen=True)
class Fault:
    """File that is inconsistent with the database.

    Attributes:
        name: Name of the file in the file store or in the data folder.
        mended: Description of the repair; empty if nothing was done.
    """

    kind: Kind
    what: What
    name: str
    holders: tuple[str, ...] = ()
    mended: str = ""


@dataclass(frozen=True)
class _File:
    """File that a row refers to.

    Attributes:
        table: Table of the row.
        row: Condition for the row as long as it refers to the file.
        size: Minimum size in bytes.
        sha256: Expected SHA-256; None for the bytes of an unfinished upload, which have none.
        holder: Job or upload of the row; empty for an input, which any number of them may hold.
    """

    what: What
    objects: ObjectStore
    name: str
    table: type[Base]
    row: ColumnElement[bool]
    size: int
    sha256: str | None = None
    holder: str = ""

    def fault(self) -> Literal["missing", "damaged"] | None:
        """Read the file, and return its fault; None if it is intact."""
        if self.sha256 is not None:
            return self.objects.fault(self.name, self.sha256)
        return None if self.objects.size(self.name) >= self.size else "missing"


class FileCheck:
    """Check of all files of a database and its file stores."""

    def __init__(self, settings: ServiceSettings, store: Store) -> None:
        self._store, self._database = store, store.database
        self._artifacts = Artifacts(settings.artifacts_url)
        self._blobs = open_blobs(settings, store.inputs, self._artifacts)
        self._objects = self._blobs.objects
        #: Number of files read so far.
        self.checked = 0

    def findings(self, *, mend: bool = False) -> Iterator[Fault]:
        """Yield all files that are inconsistent with the database.

        Args:
            mend: Whether to repair: move damaged files to `QUARANTINE`, delete unused rows whose files are gone, and
                delete orphans.
        """
        with ThreadPoolExecutor(_AT_A_TIME) as pool:
            for files in self._pages():
                for finding in pool.map(lambda file: self._examine(file, mend=mend), files):
                    self.checked += 1
                    if finding is not None:
                        yield finding
        for objects, what, name in orphans(self._store, self._artifacts, self._blobs):
            if mend:
                objects.remove(name)
            yield Fault("orphaned", what, name, mended="deleted" if mend else "")

    def _examine(self, file: _File, *, mend: bool) -> Fault | None:
        # The second check rules out that a running service has just replaced or removed the file and its row.
        kind = file.fault() and self._is_current(file) and file.fault()
        if not kind:
            return None
        finding = Fault(kind, file.what, file.name, self._holders(file))
        if not mend:
            return finding
        done = ""
        if kind == "damaged":
            target = f"{QUARANTINE}/{file.name.replace('/', '_')}-{secrets.token_hex(3)}"
            file.objects.move(file.name, target)
            done = f"moved to {target}; "
        return replace(finding, mended=done + self._forget(file))

    def _is_current(self, file: _File) -> bool:
        with self._database.reading() as session:
            return bool(session.scalar(select(exists().where(file.row))))

    def _holders(self, file: _File) -> tuple[str, ...]:
        if file.holder:
            return (file.holder,)
        query = select(BlobUseRow.holder).where(BlobUseRow.sha256 == file.sha256).order_by(BlobUseRow.holder)
        with self._database.reading() as session:
            return tuple(session.scalars(query))

    def _forget(self, file: _File) -> str:
        """Delete the row of a lost file, unless it is an input that somebody holds, and return what happened."""
        held = exists().where(BlobUseRow.sha256 == file.sha256) if file.table is BlobRow else false()
        with self._database.writing() as session:
            deleted = session.execute(delete(file.table).where(file.row, ~held))
            if file.table is UploadRow and deleted.rowcount:  # type: ignore[attr-defined]  # a blob may be made already
                session.execute(delete(BlobUseRow).where(BlobUseRow.holder == file.holder))
            return "its row is deleted" if deleted.rowcount else "it comes back when it is sent again"  # type: ignore[attr-defined]

    # --- files that rows refer to ----------------------------------------------------------------------------------

    def _pages(self) -> Iterator[Sequence[_File]]:
        """Yield files page by page in row order, so that a table of any length takes bounded memory."""
        unfinished = UploadRow.sha256.is_(None) & (UploadRow.offset > 0)
        for blobs in self._rows(select(BlobRow), BlobRow.sha256):
            yield [self._input(row) for row in blobs]
        for artifacts in self._rows(select(ArtifactRow), ArtifactRow.job_id, ArtifactRow.name):
            yield [self._result(row) for row in artifacts]
        for uploads in self._rows(select(UploadRow).where(unfinished), UploadRow.id):
            yield [file for row in uploads for file in self._parts(row)]

    def _rows(self, query: Select[T], *key: InstrumentedAttribute[str]) -> Iterator[Sequence[T]]:
        """Yield pages of the rows that a query selects, ordered by columns that identify a row."""
        after = ("",) * len(key)
        while rows := self._page(query.where(tuple_(*key) > after).order_by(*key).limit(_PAGE)):
            yield rows
            after = tuple(getattr(rows[-1], column.key) for column in key)

    def _page(self, query: Select[T]) -> Sequence[T]:
        with self._database.reading() as session:
            return session.scalars(query).all()

    def _input(self, row: BlobRow) -> _File:
        same = and_(BlobRow.sha256 == row.sha256, BlobRow.location == row.location)
        return _File("input", self._objects, f"{BLOBS}/{row.location}", BlobRow, same, row.size, row.sha256)

    def _result(self, row: ArtifactRow) -> _File:
        what: What = "checkpoint" if row.name == CHECKPOINT else "result"
        objects, holder = self._artifacts.objects, f"job:{row.job_id}"
        named = and_(ArtifactRow.job_id == row.job_id, ArtifactRow.name == row.name)
        same = and_(named, ArtifactRow.location == row.location)
        return _File(what, objects, row.location, ArtifactRow, same, row.size, row.sha256, holder)

    def _parts(self, row: UploadRow) -> list[_File]:
        """Return the files that hold the bytes of an unfinished upload."""
        parts = [(f"{UPLOADS}/{row.id}.part", row.offset)]
        if not self._objects.local:
            parts = [(each.location, each.size) for each in self._store.inputs.parts(row.id)]
        same, holder = and_(UploadRow.id == row.id, UploadRow.sha256.is_(None)), f"upload:{row.id}"
        return [_File("upload", self._objects, name, UploadRow, same, size, holder=holder) for name, size in parts]

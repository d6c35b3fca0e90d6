"""Backup and restoration of a service's database and file store.

    python deploy/backup.py save FOLDER        # the service may be running
    python deploy/backup.py restore FOLDER     # into an empty database, before API and dispatchers start

Run it in the service's own environment (`SGSST_DATABASE`, `SGSST_ARTIFACTS`, `AWS_...`). PostgreSQL also needs
`pg_dump` and `pg_restore` of the server's version or later. Files that FOLDER already contains from an earlier backup
are not copied again, because stored files never change. The exception is unfinished uploads in a local store.

Files are copied twice, before and after the database is saved, so each file that a row refers to is in one of the two
copies. The exception is a checkpoint that was created and replaced in between: if one is missing, the database is saved
again, up to three times in total. A job whose checkpoint is still missing restarts from the first step.
"""

import argparse
import os
import sqlite3
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from sqlalchemy import delete, inspect, select
from sqlalchemy.engine import URL

from service.files.objects import ObjectStore
from service.inputs import CHECKPOINT
from service.settings import ServiceSettings, read_settings
from service.store import Store
from service.store.files import BLOBS
from service.store.tables import ArtifactRow, BlobRow, JobRow, UploadPartRow
from sgsst_core.errors import SgsstError

#: Number of files copied concurrently.
_AT_A_TIME = 8
#: Maximum number of times the database is saved if checkpoints that it refers to are missing.
_ATTEMPTS = 3
#: Folders beside a local result store: input files, and unfinished uploads, whose files still grow.
_LOCAL_FOLDERS, _GROWING = ("blobs", "uploads"), "uploads"
#: File name prefix of incomplete files.
_HALF = ".half-"


class BackupError(Exception):
    """Failure of a backup or restoration; the message says what to do."""


def main() -> int:
    """Run the command, and return the exit status: 0 on success."""
    parser = argparse.ArgumentParser(description="Back up a service, or restore it.")
    parser.add_argument("what", choices=("save", "restore"))
    parser.add_argument("folder", type=Path)
    options = parser.parse_args()
    os.umask(0o077)
    try:
        settings = read_settings()
        (save if options.what == "save" else restore)(settings, options.folder)
    except (BackupError, SgsstError, OSError, subprocess.CalledProcessError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


def save(settings: ServiceSettings, folder: Path) -> None:
    """Save the database and all stored files to a folder."""
    store = Store(settings)
    folder.mkdir(parents=True, exist_ok=True)
    files = folder / "files"
    copied = _copy_all(settings, files)
    for _ in range(_ATTEMPTS):
        before = _checkpoints(store)
        _dump(store, folder)
        after = _checkpoints(store)
        copied += _copy_all(settings, files)
        if before == after and all((files / "store" / location).exists() for location in after):
            break
    store.close()
    print(f"saved the database and {copied} new files in {folder}")


def restore(settings: ServiceSettings, folder: Path) -> None:
    """Restore files and database from a folder, and delete database rows of checkpoints whose files are missing."""
    if not (folder / "database").exists():
        raise BackupError(f"{folder} holds no backup.")
    store = Store(settings)
    if inspect(store.database.engine).has_table(JobRow.__tablename__):
        raise BackupError("The database has jobs' tables already. Restore into an empty one.")
    stores = _stores(settings)
    restored = 0
    for name, objects in stores.items():
        backup = ObjectStore(f"file://{(folder / 'files' / name).absolute()}")
        objects.make_bucket()
        restored += _copy(backup, objects)
    _load(store, folder)
    missing = _missing(store, stores)
    store.close()
    print(f"restored the database and {restored} files; {len(missing)} files are missing")
    for name in missing:
        print(f"missing: {name}", file=sys.stderr)


def _checkpoints(store: Store) -> set[str]:
    """Return the locations of all checkpoints in the database."""
    with store.database.reading() as session:
        return set(session.scalars(select(ArtifactRow.location).where(ArtifactRow.name == CHECKPOINT)))


def _stores(settings: ServiceSettings) -> dict[str, ObjectStore]:
    """Return the file stores by the names of their folders in a backup."""
    store = ObjectStore(settings.artifacts_url)
    if not store.local:
        return {"store": store}
    folders = {name: ObjectStore(f"file://{settings.folder / name}") for name in _LOCAL_FOLDERS}
    return {"store": store, **folders}


def _copy_all(settings: ServiceSettings, files: Path) -> int:
    copied = 0
    for name, objects in _stores(settings).items():
        (files / name).mkdir(parents=True, exist_ok=True)
        copied += _copy(objects, ObjectStore(f"file://{(files / name).absolute()}"))
    return copied


def _copy(source: ObjectStore, target: ObjectStore) -> int:
    """Copy the files that the target lacks, and return their number. Files that are deleted meanwhile are skipped."""
    there = set() if Path(source.root).name == _GROWING else set(target.below(""))
    wanted = sorted(name for name in source.below("") if name not in there and not Path(name).name.startswith(_HALF))
    with ThreadPoolExecutor(_AT_A_TIME) as pool:
        return sum(pool.map(lambda name: _copy_one(source, target, name), wanted))


def _copy_one(source: ObjectStore, target: ObjectStore, name: str) -> bool:
    local = source if source.local else target
    path = Path(local.root, name)
    try:
        if source.local:
            if target.local:
                Path(target.root, name).parent.mkdir(parents=True, exist_ok=True)
            target.put(path, name)
        else:
            half = path.with_name(f"{_HALF}{path.name}")
            half.parent.mkdir(parents=True, exist_ok=True)
            source.get(name, half)
            # only complete files get their final name, so an interrupted copy is repeated next time
            half.replace(path)
    except FileNotFoundError:
        return False
    return True


def _dump(store: Store, folder: Path) -> None:
    new = folder / "database.new"
    new.unlink(missing_ok=True)
    if store.database.sqlite:
        with sqlite3.connect(str(store.database.url.database)) as source, sqlite3.connect(new) as target:
            source.backup(target)
    else:
        _run("pg_dump", "--format=custom", "--no-owner", f"--file={new}", url=store.database.url)
    new.replace(folder / "database")


def _load(store: Store, folder: Path) -> None:
    if store.database.sqlite:
        target_file = str(store.database.url.database)
        with sqlite3.connect(folder / "database") as source, sqlite3.connect(target_file) as target:
            source.backup(target)
    else:
        words = ("--no-owner", "--exit-on-error", "--single-transaction", str(folder / "database"))
        _run("pg_restore", f"--dbname={store.database.url.database}", *words, url=store.database.url)


def _run(program: str, *words: str, url: URL) -> None:
    """Run a PostgreSQL program, with the server's address and password in environment variables."""
    where = {"PGHOST": url.host, "PGPORT": url.port, "PGUSER": url.username, "PGPASSWORD": url.password}
    where |= {"PGDATABASE": url.database, "PGPASSFILE": url.query.get("passfile")}
    environment = {**os.environ, **{name: str(value) for name, value in where.items() if value is not None}}
    try:
        subprocess.run([program, *words], env=environment, check=True)
    except FileNotFoundError as error:
        raise BackupError(f"{program} is missing: it comes with PostgreSQL's client.") from error


def _missing(store: Store, stores: dict[str, ObjectStore]) -> list[str]:
    """Return the missing files that database rows refer to, except checkpoints, whose rows are deleted instead."""
    there = {name: set(objects.below("")) for name, objects in stores.items()}
    remote = "blobs" not in there
    blobs = {name.removeprefix(f"{BLOBS}/") for name in there["store"]} if remote else there["blobs"]
    missing = []
    with store.database.writing() as session:
        for row in session.scalars(select(ArtifactRow)).all():
            if row.location not in there["store"]:
                if row.name == CHECKPOINT:
                    session.execute(
                        delete(ArtifactRow).where(ArtifactRow.job_id == row.job_id, ArtifactRow.name == row.name)
                    )
                else:
                    missing.append(row.location)
        missing += [row.location for row in session.scalars(select(BlobRow)) if row.location not in blobs]
        if remote:
            parts = session.scalars(select(UploadPartRow))
            missing += [row.location for row in parts if row.location not in there["store"]]
    return missing


if __name__ == "__main__":
    sys.exit(main())

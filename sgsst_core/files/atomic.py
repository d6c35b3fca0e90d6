"""Output files: whole or not at all."""

from __future__ import annotations

import errno
import hashlib
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sgsst_core.errors import OutputError

#: What the system says when there is no room left; everything else that goes wrong inside `atomic_path` keeps its type.
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@contextmanager
def atomic_path(target: Path) -> Iterator[Path]:
    """Yield a temporary path beside `target`; it becomes `target` when the block ends, and is removed if it raises.

    The temporary file exists already (empty), has the target's suffix and lies in the same folder. It is
    flushed to disk, then renamed over the target, then the folder is flushed: after a power cut there is the old
    file or the new one. A symbolic link keeps pointing where it did: what it points at is replaced. An existing
    target's permissions are kept.

    Raises:
        OutputError: the folder is missing or not writable, the target is a folder, or the disk is full.
    """
    final = Path(os.path.realpath(target))
    if final.is_dir():
        raise OutputError(f"{final}: is a folder. Name a file.")
    temporary = _reserve(final)
    try:
        yield temporary
        if final.exists():
            shutil.copymode(final, temporary)
        _flush(temporary)
        temporary.replace(final)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        if error.errno in _NO_ROOM:
            raise OutputError(
                f"{target}: cannot be written: {error.strerror}. Free some space and run again."
            ) from error
        raise
    except BaseException:  # KeyboardInterrupt too: nothing half-written stays
        temporary.unlink(missing_ok=True)
        raise
    _flush_folder(final.parent)


def remove_leftovers(target: Path) -> None:
    """Delete what writers of `target` that were killed have left beside it. Nobody may be writing it now."""
    final = Path(os.path.realpath(target))
    for path in final.parent.glob(f".sgsst-{_tag(final)}-*.part*"):
        path.unlink(missing_ok=True)


def ensure_writable_folder(path: Path) -> None:
    """Create the folder where it is missing, and prove by a trial file that it can be written to.

    Raises:
        OutputError: it cannot be created, is not a folder, or is not writable.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = "there is a file of that name" if isinstance(error, FileExistsError) else error.strerror
        raise OutputError(f"{path}: cannot be used as output folder: {reason}. Choose another folder.") from error
    # os.access says yes to root, and on network mounts that are read-only: only writing tells.
    _reserve(path / "trial").unlink()


def _reserve(final: Path) -> Path:
    """Create an empty file beside `final`, with the permissions that a newly written file gets."""
    temporary = final.with_name(f".sgsst-{_tag(final)}-{secrets.token_hex(6)}.part{final.suffix}")
    try:
        os.close(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
    except OSError as error:
        raise OutputError(
            f"{final.parent}: is not writable: {error.strerror}. Create the folder, or name another place."
        ) from error
    return temporary


def _tag(final: Path) -> str:
    """What temporary files of a target have in common; its name itself may be as long as names can be."""
    return hashlib.sha256(os.fsencode(final.name)).hexdigest()[:8]


def _flush(path: Path) -> None:
    descriptor = os.open(path, os.O_RDWR)  # read-only is not enough for fsync on every system
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _flush_folder(folder: Path) -> None:
    """Make the rename itself durable, where the system can: the file is in place and whole either way."""
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError:  # folders cannot be opened on Windows, nor without read permission
        return
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno != errno.EINVAL:  # file systems without fsync of folders
            raise
    finally:
        os.close(descriptor)

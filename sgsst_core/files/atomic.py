"""Atomic writing of output files."""

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

#: Error numbers of a full disk. Other errors in an `atomic_path` block are raised unchanged.
_DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@contextmanager
def atomic_path(target: Path) -> Iterator[Path]:
    """Yield the path of a temporary file that replaces `target` at the end of the block.

    The temporary file is created empty in the folder of the target, with the same suffix. If the block raises, it is
    deleted. Otherwise it is flushed to disk and renamed over the target, then the folder is flushed. After a power
    failure, the target is therefore either the old or the new file.

    If the target is a symbolic link, the file it points to is replaced. An existing target's permissions are retained.

    Raises:
        OutputError: If the folder is missing or not writable, the target is a folder, or the disk is full.
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
        if error.errno in _DISK_FULL:
            raise OutputError(
                f"{target}: cannot be written: {error.strerror}. Free some space and run again."
            ) from error
        raise
    except BaseException:  # includes KeyboardInterrupt: no partial file may remain
        temporary.unlink(missing_ok=True)
        raise
    _flush_folder(final.parent)


def remove_leftovers(target: Path) -> None:
    """Delete temporary files that killed processes left for `target`; no process may be writing `target` meanwhile."""
    final = Path(os.path.realpath(target))
    for path in final.parent.glob(f".sgsst-{_tag(final)}-*.part*"):
        path.unlink(missing_ok=True)


def ensure_writable_folder(path: Path) -> None:
    """Create a folder if it is missing, and check with a temporary file that it is writable.

    Raises:
        OutputError: If it cannot be created, is not a folder, or is not writable.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = "there is a file of that name" if isinstance(error, FileExistsError) else error.strerror
        raise OutputError(f"{path}: cannot be used as output folder: {reason}. Choose another folder.") from error
    # os.access is unreliable: it returns True for root, and for read-only network mounts.
    _reserve(path / "trial").unlink()


def _reserve(final: Path) -> Path:
    """Create an empty file beside `final`, with the default permissions of a new file."""
    temporary = final.with_name(f".sgsst-{_tag(final)}-{secrets.token_hex(6)}.part{final.suffix}")
    try:
        os.close(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
    except OSError as error:
        raise OutputError(
            f"{final.parent}: is not writable: {error.strerror}. Create the folder, or name another one."
        ) from error
    return temporary


def _tag(final: Path) -> str:
    """Return the common part of the names of a target's temporary files.

    It is a hash of the target's name, because the name plus a suffix could exceed the maximum length of file names.
    """
    return hashlib.sha256(os.fsencode(final.name)).hexdigest()[:8]


def _flush(path: Path) -> None:
    descriptor = os.open(path, os.O_RDWR)  # fsync requires write access on some systems
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _flush_folder(folder: Path) -> None:
    """Flush a folder to make a rename durable, if the system supports it. The file is complete either way."""
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError:  # on Windows and without read permission, folders cannot be opened
        return
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno != errno.EINVAL:  # raised by file systems that cannot flush folders
            raise
    finally:
        os.close(descriptor)

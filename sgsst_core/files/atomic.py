"""Atomic writing of output files, and their digests."""

import errno
import hashlib
import json
import os
import secrets
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sgsst_core.errors import OutputError

#: Error numbers of a full disk, of an exhausted quota and of a file that may not grow further.
DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
#: Seconds for which replacing a file is tried again while another program holds it open, which Windows forbids.
HELD_SECONDS = 5.0


@contextmanager
def atomic_path(target: Path) -> Iterator[Path]:
    """Yield the path of a temporary file that replaces `target` at the end of the block.

    The temporary file is created empty in the folder of the target, with the same suffix. If the block raises, it is
    deleted. Otherwise it is flushed to disk and renamed over the target, then the folder is flushed. After a power
    failure, the target is therefore either the old or the new file. On Windows, the target cannot be replaced
    while another program holds it open; see `replace`.

    If the target is a symbolic link, the file it points to is replaced. An existing target's permissions are retained.

    Raises:
        OutputError: If the folder is missing or not writable, the target is a folder or held open by another program,
            or the disk is full.
    """
    final = Path(os.path.realpath(target))
    if final.is_dir():
        raise OutputError(f"{final}: is a folder. Name a file.")
    temporary = _reserve(final)
    try:
        with disk_errors(target):
            yield temporary
            if final.exists():
                shutil.copymode(final, temporary)
            with temporary.open("r+b") as file:  # fsync requires write access on some systems
                os.fsync(file.fileno())
            replace(temporary, final)
    except HeldOpenError:
        raise
    except BaseException:  # includes KeyboardInterrupt: no partial file may remain
        temporary.unlink(missing_ok=True)
        raise
    flush_folder(final.parent)


class HeldOpenError(OutputError):
    """A file cannot be replaced, because another program holds it open; the new file is complete and kept beside it."""


def replace(temporary: Path, final: Path) -> None:
    """Rename a complete file over another one in its folder, which another program may hold open for a moment.

    Raises:
        HeldOpenError: If it cannot be replaced for `HELD_SECONDS`. The message names the new file.
    """
    deadline = time.monotonic() + HELD_SECONDS
    while True:
        try:
            temporary.replace(final)
            return
        except PermissionError as error:
            if time.monotonic() > deadline:
                new = temporary.rename(final.with_name(f"{final.stem}-{secrets.token_hex(3)}.new{final.suffix}"))
                raise HeldOpenError(
                    f"{final}: cannot be replaced: {error.strerror}. Another program may have it open. Nothing is "
                    f"lost: the new file is {new}."
                ) from error
        time.sleep(0.1)


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a file in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def write_json(path: Path, values: dict[str, Any]) -> None:
    """Write values as JSON, atomically.

    Raises:
        OutputError: If the file cannot be written.
    """
    with atomic_path(path) as temporary:
        # File names that are not valid Unicode contain lone surrogates, which JSON can only represent as escapes.
        text = json.dumps(values, indent=1, ensure_ascii=False) + "\n"
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


@contextmanager
def disk_errors(target: Path) -> Iterator[None]:
    """Report a full disk in the block, which writes a file or folder, as an OutputError; raise other errors unchanged.

    Raises:
        OutputError: If the disk is full.
    """
    try:
        yield
    except OSError as error:
        if error.errno not in DISK_FULL:
            raise
        raise OutputError(
            f"{target}: cannot be written: {error.strerror}. Free some space, or write to another disk."
        ) from error


def remove_leftovers(target: Path) -> None:
    """Delete temporary files that killed processes left for `target`; no process may be writing `target` meanwhile."""
    final = Path(os.path.realpath(target))
    for path in final.parent.glob(temporary_path(final, "*", "*").name):
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
    temporary = temporary_path(final, secrets.token_hex(6), final.suffix)
    try:
        os.close(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
    except OSError as error:
        folder = final.parent
        if not folder.exists():
            raise OutputError(f"{folder}: does not exist. Create the folder, or name another one.") from error
        reason = "" if error.errno == errno.ENOENT else f": {error.strerror}"  # as in /proc
        raise OutputError(f"{folder}: is not writable{reason}. Name another folder.") from error
    return temporary


def temporary_path(final: Path, unique: str, suffix: str = "") -> Path:
    """Return the path of a temporary file beside a target, given what only its name has.

    It has a hash of the target's name, because the name plus a suffix could exceed the maximum length of file names.
    """
    tag = hashlib.sha256(os.fsencode(final.name)).hexdigest()[:8]
    return final.with_name(f".sgsst-{tag}-{unique}.part{suffix}")


def flush_folder(folder: Path) -> None:
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

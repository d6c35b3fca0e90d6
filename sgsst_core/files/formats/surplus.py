"""Content of a scene file beyond what its header declares, which is counted and reported."""

from __future__ import annotations

import codecs
from pathlib import Path

from sgsst_core.errors import SceneError

#: Padding that programs leave after the data: zeros, blanks, and the end-of-file mark of DOS.
_BLANKS, _PADDING = b" \t\r\n\x1a", b"\0 \t\r\n\x1a"
#: Maximum bytes of padding, and of data that are searched for traces of a transfer as text.
_MAX_PADDING, _SAMPLE_BYTES = 1 << 16, 1 << 20
#: Least number of line ends that show a transfer as text if all of them are CR LF.
_LEAST_LINE_ENDS = 8


def is_padding(data: bytes) -> bool:
    """Return whether bytes after the data of a scene mean nothing."""
    return len(data) <= _MAX_PADDING and not data.strip(_PADDING)


def number_of(count: int, unit: str) -> str:
    """Return a number with its unit, such as "1 byte"."""
    return f"{count} {unit}" + "s" * (count != 1)


def about_surplus(surplus: str) -> str:
    """Return the note on content that a header does not declare, such as "12 bytes"."""
    return f"the file has {surplus} more than its header declares, which are not read; copy or export it again"


def surplus_note(path: Path, start: int, end: int, row_bytes: int | None = None) -> str:
    """Return the note on a part of a file that its header does not declare; empty if there is only padding.

    Args:
        path: Path of the file.
        start: Byte offset of the part.
        end: Byte offset of its end.
        row_bytes: Size of a row before the part; None if rows differ in size.
    """
    if start >= end or is_padding(_bytes(path, start, min(end, start + _MAX_PADDING + 1))):
        return ""
    surplus = number_of(end - start, "byte")
    if row_bytes and (end - start) % row_bytes == 0:
        surplus += f" ({number_of((end - start) // row_bytes, 'row')})"
    return about_surplus(surplus)


def refuse_text_transfer(path: Path, header_bytes: int, newline: bytes, start: int, end: int) -> None:
    """Raise a SceneError if a binary file looks as if a transfer as text made it longer than declared.

    Args:
        path: Path of the file.
        header_bytes: Size of its header.
        newline: Line end of its header.
        start: Byte offset of the end of the declared data.
        end: Size of the file.
    """
    if start >= end:
        return
    data = _bytes(path, header_bytes, min(start, header_bytes + _SAMPLE_BYTES))
    line_ends = data.count(b"\n")
    changed = newline == b"\r\n" or (line_ends == data.count(b"\r\n") and line_ends >= _LEAST_LINE_ENDS)
    blank = not _bytes(path, start, min(end, start + _MAX_PADDING)).strip(_BLANKS)
    if (changed and not blank) or _is_utf8(data):
        surplus = number_of(end - start, "byte")
        raise SceneError(
            f"{path}: has {surplus} more than its header declares. Was it transferred as text, which changes line ends "
            "and other bytes? Copy it again in binary mode."
        )


def _is_utf8(data: bytes) -> bool:
    """Return whether data is UTF-8 beyond ASCII, which binary numbers never are; its end may cut off a character."""
    try:
        return not codecs.getincrementaldecoder("utf-8")().decode(data).isascii()
    except UnicodeDecodeError:
        return False


def _bytes(path: Path, start: int, end: int) -> bytes:
    """Return the bytes of a part of a file."""
    with path.open("rb") as file:
        file.seek(start)
        return file.read(end - start)

"""PNG files as Pillow reads them safely: metadata before the pixels, and none that Pillow refuses for its length.

Pillow refuses color profiles and compressed texts of more than 1 MiB, and finds metadata that follow the pixels only by
decoding all of them.
"""

from __future__ import annotations

import io
import os
import struct
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from sgsst_core.errors import ImageError
from sgsst_core.files.color_profiles import MAX_PROFILE_BYTES

SIGNATURE = b"\x89PNG\r\n\x1a\n"
#: Maximum length of all compressed texts together.
MAX_TEXT_BYTES = 16 << 20
#: Chunks before the pixels that determine them, or the number of frames.
_COPIED = (b"IHDR", b"PLTE", b"tRNS", b"acTL", b"fcTL")
#: Texts that may hold the orientation.
_USED_TEXTS = (b"XML:com.adobe.xmp", b"Raw profile type exif")
#: Additional bytes of a compressed value that is as long as the limit.
_OVERHEAD = 1 << 16
_END = struct.pack(">I4sI", 0, b"IEND", zlib.crc32(b"IEND"))


@dataclass
class _Metadata:
    """Metadata of a file.

    Attributes:
        chunks: Chunks for Pillow, complete.
        profile: Color profile, of which at most one byte more than allowed is inflated; None if there is none.
        text_left: Bytes of compressed texts that are still allowed.
    """

    chunks: list[bytes] = field(default_factory=list)
    profile: bytes | None = None
    text_left: int = MAX_TEXT_BYTES


def open_png(path: Path, *, pixels: bool) -> tuple[io.BytesIO, bytes | None]:
    """Return a PNG for Pillow, and its color profile; None if it has none that can be inflated.

    Args:
        path: File that starts with `SIGNATURE`.
        pixels: Whether the pixels are needed; without them, the file is only good for its header.

    Raises:
        ImageError: If the file has too much compressed text.
        ValueError: If a chunk is beyond the end of the file.
        OSError: If the file cannot be read.
    """
    metadata, start, stop = _Metadata(), 0, 0
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        position = file.seek(len(SIGNATURE))
        while position < size:
            file.seek(position)
            header = file.read(8)
            length, kind = struct.unpack(">I4s", header) if len(header) == 8 else (0, b"")
            stop_of_chunk = position + 12 + length
            if kind == b"IDAT":
                start, stop = start or position, stop_of_chunk
            elif kind == b"IEND" or (start and stop_of_chunk > size):
                break
            elif stop_of_chunk > size:
                raise ValueError("its header is incomplete")
            elif kind in _COPIED and not start:
                metadata.chunks.append(header + file.read(length + 4))
            else:
                _read_chunk(path, kind, length, file, metadata)
            position = stop_of_chunk
        file.seek(start)
        data = file.read(stop - start if pixels else 8) if start else b""
    end = _END if start and stop <= size else b""
    return io.BytesIO(b"".join([SIGNATURE, *metadata.chunks, data, end])), metadata.profile


def _read_chunk(path: Path, kind: bytes, length: int, file: BinaryIO, metadata: _Metadata) -> None:
    """Read EXIF data, a color profile, or a text that may hold the orientation; other chunks are skipped."""
    if kind == b"eXIf":
        metadata.chunks.append(_chunk(kind, b"", file.read(length)))
    elif kind == b"iCCP":
        value = file.read(min(length, MAX_PROFILE_BYTES + _OVERHEAD)).partition(b"\0")[2]
        metadata.profile = _inflated(value[1:], MAX_PROFILE_BYTES) or metadata.profile
    elif kind in (b"tEXt", b"zTXt", b"iTXt"):
        keyword, _, value = file.read(min(length, MAX_TEXT_BYTES + _OVERHEAD)).partition(b"\0")
        compressed = kind == b"zTXt"
        if kind == b"iTXt":
            compressed, value = value[:1] == b"\1", value[2:].partition(b"\0")[2].partition(b"\0")[2]
        elif compressed:
            value = value[1:]
        if compressed:
            value = _inflated(value, metadata.text_left) or b""
            metadata.text_left -= len(value)
        if metadata.text_left < 0:
            raise ImageError(
                f"{path}: holds more than {MAX_TEXT_BYTES >> 20} MiB of compressed text. Save it without its metadata."
            )
        if keyword in _USED_TEXTS and len(value) <= MAX_TEXT_BYTES:
            xmp = keyword == _USED_TEXTS[0]
            metadata.chunks.append(_chunk(*(b"iTXt", keyword + bytes(5)) if xmp else (b"tEXt", keyword + b"\0"), value))


def _inflated(data: bytes, limit: int) -> bytes | None:
    """Return inflated data, at most one byte more than a limit; None if it is broken."""
    try:
        return zlib.decompressobj().decompress(data, limit + 1)
    except zlib.error:
        return None


def _chunk(kind: bytes, head: bytes, value: bytes) -> bytes:
    data = head + value
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

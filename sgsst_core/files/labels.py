"""Names of images as text, whatever their encoding."""

from __future__ import annotations


def label(name: bytes) -> str:
    """Return a name as text that can be printed and stored.

    A name that is not UTF-8, such as one in CP949 or GBK, gets one character per byte (ISO 8859-1): different names
    stay different.
    """
    try:
        return name.decode()
    except UnicodeDecodeError:
        return name.decode("latin-1")

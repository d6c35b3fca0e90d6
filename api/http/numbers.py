"""Numbers in headers and query parameters."""

from __future__ import annotations

import re
from typing import Annotated

from pydantic import BeforeValidator


def _digits(text: object) -> object:
    """Return a text of decimal digits as it is.

    Raises:
        ValueError: The text has anything else: a sign, spaces, underscores, or digits of another script, all of which
            `int` accepts and other servers in front of this one may read as another number.
    """
    if isinstance(text, str) and not re.fullmatch("[0-9]+", text):
        raise ValueError("Input should be decimal digits")
    return text


#: A whole number that is written in decimal digits and nothing else.
Digits = Annotated[int, BeforeValidator(_digits)]

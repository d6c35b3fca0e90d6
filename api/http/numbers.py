"""Numbers in headers and query parameters."""

from __future__ import annotations

import re
from typing import Annotated

from pydantic import BeforeValidator


def _digits(text: object) -> object:
    """Check that a text has decimal digits only, and return it.

    Raises:
        ValueError: If the text contains anything else, such as a sign, spaces, underscores, or digits of another
            script. `int` accepts all of these, but a proxy in front of the service may read them as another number.
    """
    if isinstance(text, str) and not re.fullmatch("[0-9]+", text):
        raise ValueError("Input should be decimal digits")
    return text


#: A whole number, written in decimal digits only.
Digits = Annotated[int, BeforeValidator(_digits)]

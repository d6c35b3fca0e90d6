"""Messages from the process of an attempt to its dispatcher, as lines of JSON."""

from __future__ import annotations

from typing import Any, Literal, TypedDict


class Message(TypedDict, total=False):
    """Message with its `kind` and the fields of that kind."""

    kind: Literal["stage", "prepared", "left-out", "stored", "progress", "preview", "done", "interrupted", "failed"]
    stage: str
    step: int
    total: int
    loss: float
    seconds: float
    seconds_left: float | None
    scales: list[float | None] | None
    path: str
    gpus: list[str]
    file: dict[str, Any]
    result: dict[str, Any]
    error: dict[str, Any]
    permanent: bool
    detail: str

"""References to files that a new job needs not send: inputs of other jobs by their paths in the API, and uploads."""

from __future__ import annotations

import base64
import re
from typing import Any

from api.http.addresses import subpath
from service import problems
from service.states import JobStatus
from service.store.jobs import Jobs
from service.store.tables import JobRow

#: Path of an input, as in the API. The groups are the id of the job, and the input.
_PATH = re.compile(r"/v1/jobs/(job_[0-9a-f]{20,40})/inputs/([a-z]{1,10}(?::[0-9]{1,6})?)", re.ASCII)
_INPUT = re.compile(r"([a-z]{1,10})(?::([0-9]{1,6}))?", re.ASCII)


def parse_reference(text: str) -> tuple[str, str] | None:
    """Return the job's id and the input that a path of the API refers to, or None if it is not such a path."""
    match = _PATH.fullmatch(text.removeprefix(subpath.get()))
    return (match[1], match[2]) if match else None


def parse_input(name: str) -> tuple[str, int] | None:
    """Return role and index of an input such as "scene" or "style:1", or None if it is not such a name."""
    match = _INPUT.fullmatch(name)
    return (match[1], int(match[2] or 0)) if match else None


def find_input(jobs: Jobs, job: JobRow, name: str) -> dict[str, Any] | None:
    """Return a job's entry for an input such as "scene" or "style:1"; None if it is missing or was released."""
    place = parse_input(name)
    return None if place is None or job.status == JobStatus.EXPIRED else jobs.input(job.id, *place)


def uploaded_name(metadata: str) -> str:
    """Return the `filename` in an `Upload-Metadata` header, which has the format `key base64, key base64`.

    Raises:
        MALFORMED_BODY: If it is not base64 of UTF-8.
    """
    for pair in metadata.split(","):
        key, _, value = pair.strip().partition(" ")
        if key in ("filename", "name"):
            try:
                return base64.b64decode(value, validate=True).decode()
            except ValueError as error:  # raised for non-ASCII characters too
                raise problems.MALFORMED_BODY(f"Upload-Metadata: {key!r} is not base64 of UTF-8.") from error
    return ""

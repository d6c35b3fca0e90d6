"""Inputs of jobs, in bounded pieces: a job may have thousands of photos, whose names take a quarter of a megabyte."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cache
from typing import Any

from sqlalchemy import Connection, TextClause, bindparam, text

#: Roles of few files, which are shown with every job.
NAMED_ROLES = ("scene", "style", "cameras")

#: Table of the entries in `jobs.inputs`, and expressions for the position, the JSON and the role of an entry.
_ENTRIES = {
    "sqlite": ("json_each(jobs.inputs) AS entry", "entry.key", "entry.value", "json_extract(entry.value, '$.role')"),
    "postgresql": (
        "json_array_elements(jobs.inputs) WITH ORDINALITY AS entry(value, number)",
        "entry.number - 1",
        "CAST(entry.value AS TEXT)",
        "entry.value ->> 'role'",
    ),
}


def counts_and_named(
    connection: Connection, job_ids: Sequence[str]
) -> tuple[dict[str, dict[str, int]], dict[str, list[dict[str, Any]]]]:
    """Return the number of files by role of each job, and its entries of scene, style images and camera files."""
    counts: dict[str, dict[str, int]] = {job_id: {} for job_id in job_ids}
    named: dict[str, list[dict[str, Any]]] = {job_id: [] for job_id in job_ids}
    if job_ids:
        of_jobs = {"ids": list(job_ids)}
        for job_id, role, number in connection.execute(_query(connection, "counts"), of_jobs):
            counts[job_id][role] = number
        for job_id, entry in connection.execute(_query(connection, "named"), {**of_jobs, "roles": list(NAMED_ROLES)}):
            named[job_id].append(json.loads(entry))
    return counts, named


def page(connection: Connection, job_id: str, start: int, limit: int) -> list[tuple[int, dict[str, Any]]]:
    """Return a job's entries from a position on, each with its index among those of its role."""
    rows = connection.execute(_query(connection, "page"), {"ids": [job_id], "start": start, "most": limit})
    return [(index, json.loads(entry)) for index, entry in rows]


def one(connection: Connection, job_id: str, role: str, index: int) -> dict[str, Any] | None:
    """Return a job's entry by its role and its index among those of the role; None if there is none."""
    parameters = {"ids": [job_id], "roles": [role], "index": index}
    entry = connection.execute(_query(connection, "one"), parameters).scalar()
    return None if entry is None else dict(json.loads(entry))


def _query(connection: Connection, name: str) -> TextClause:
    return _queries(connection.dialect.name)[name]


@cache
def _queries(dialect: str) -> dict[str, TextClause]:
    table, position, value, role = _ENTRIES[dialect]
    of_jobs = f"FROM jobs, {table} WHERE jobs.id IN :ids"
    of_role = f"{of_jobs} AND {role} IN :roles ORDER BY jobs.id, {position}"
    index = f"row_number() OVER (PARTITION BY {role} ORDER BY {position}) - 1"
    texts = {
        "counts": f"SELECT jobs.id, {role}, count(*) {of_jobs} GROUP BY jobs.id, {role}",
        "named": f"SELECT jobs.id, {value} {of_role}",
        "one": f"SELECT {value} {of_role} LIMIT 1 OFFSET :index",
        "page": f"SELECT number, value FROM (SELECT {position} AS position, {value} AS value, {index} AS number "
        f"{of_jobs}) AS entries WHERE position >= :start ORDER BY position LIMIT :most",
    }
    lists = {name: [each for each in ("ids", "roles") if f":{each}" in text_] for name, text_ in texts.items()}
    return {
        name: text(text_).bindparams(*(bindparam(each, expanding=True) for each in lists[name]))
        for name, text_ in texts.items()
    }

"""Files of `api/static` with the program's tables filled in, for the service and for exported pages."""

from __future__ import annotations

import json
from pathlib import Path

from service.optional import installed_extras
from service.states import ACTIONS, STEPPING, TITLES, UNFINISHED, WORKING
from sgsst_core.files.formats import FORMATS, RESULT_FORMATS
from sgsst_core.options import STRENGTHS

FOLDER = Path(__file__).with_name("static")


def read_static(folder: Path = FOLDER) -> dict[str, bytes]:
    """Return the content of each file by its path in the folder."""
    contents = {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not any(part.startswith(".") for part in path.relative_to(folder).parts)
    }
    for name, (placeholder, value) in _filled_modules().items():
        if name in contents:
            contents[name] = contents[name].replace(placeholder, json.dumps(value).encode())
    return contents


def _filled_modules() -> dict[str, tuple[bytes, object]]:
    """Return the placeholder in each module that contains a table of the server, with the table as JSON."""
    formats = [
        {
            "name": each.name,
            "suffix": each.suffix,
            "title": each.title,
            "result": each in RESULT_FORMATS,
        }
        for each in FORMATS
    ]
    actions = [
        {"name": name, "title": name.capitalize(), "statuses": action.statuses} for name, action in ACTIONS.items()
    ]
    groups = {"unfinished": UNFINISHED, "working": WORKING, "stepping": STEPPING}
    states = {"titles": TITLES, **groups, "actions": actions}
    return {
        "scene_formats.js": (b'"{{scene_formats}}"', formats),
        "installed.js": (b'"{{installed_extras}}"', installed_extras()),
        "strength.js": (b'"{{strengths}}"', STRENGTHS),
        "statuses.js": (b'"{{job_states}}"', states),
    }

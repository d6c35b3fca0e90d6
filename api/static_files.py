"""Files of `api/static` with the program's tables filled in, for the service and for exported pages."""

import json
import posixpath
import re
from functools import cache
from pathlib import Path

from service.states import ACTIONS, STEPPING, TITLES, UNFINISHED, WORKING, installed_extras
from sgsst_core.files.formats import DOWNLOADS, FORMATS, RESULT_FORMATS
from sgsst_core.settings import STRENGTHS

FOLDER = Path(__file__).with_name("static")
_IMPORT = re.compile(r'^import \{ (.*) \} from "(.*)";$', re.MULTILINE)
_EXPORT = re.compile(r"^export (\{.*\};$)?", re.MULTILINE)
#: Arguments with which the viewer starts its worker.
_WORKER_START = 'new URL("./scene_worker.js", import.meta.url), { type: "module" }'


def read_static(folder: Path = FOLDER) -> dict[str, bytes]:
    """Return the content of each file by its path in the folder."""
    tables = {f'"{{{{{name}}}}}"'.encode(): json.dumps(table).encode() for name, table in _tables().items()}
    return {
        path.relative_to(folder).as_posix(): _filled(path.read_bytes(), tables)
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not any(part.startswith(".") for part in path.relative_to(folder).parts)
    }


def _filled(content: bytes, tables: dict[bytes, bytes]) -> bytes:
    for placeholder, table in tables.items():
        content = content.replace(placeholder, table)
    return content


def _tables() -> dict[str, object]:
    """Return the tables of the server that modules contain, by the names of their placeholders."""
    return {
        "scene_formats": [
            {"name": each.name, "suffix": each.suffix, "title": each.title, "result": each in RESULT_FORMATS}
            for each in FORMATS
        ],
        "downloads": [{"name": name, "title": title} for name, title in DOWNLOADS.items()],
        "installed_extras": installed_extras(),
        "strengths": STRENGTHS,
        "job_states": {
            "titles": TITLES,
            "unfinished": UNFINISHED,
            "working": WORKING,
            "stepping": STEPPING,
            "actions": [
                {"name": name, "title": name.capitalize(), "statuses": action.statuses}
                for name, action in ACTIONS.items()
            ],
        },
    }


@cache
def exported_viewer() -> dict[str, str]:
    """Return the sources of a page that shows a scene without a server (`worker.derived`).

    `document` is its HTML with placeholders, `style` its style sheet, `page` and `worker` are scripts.
    """
    files = read_static()
    texts = {"document": files["exported.html"].decode(), "style": files["page.css"].decode()}
    return {**texts, "page": _script(files, "exported.js"), "worker": _script(files, "viewer/scene_worker.js")}


def _script(files: dict[str, bytes], entry: str) -> str:
    """Return a module and all those that it imports as one script: browsers load no modules from a local file."""
    codes: dict[str, str] = {}  # each module after those that it imports
    imported: dict[str, set[str]] = {entry: set()}

    def add(name: str) -> None:
        def refer(statement: re.Match[str]) -> str:
            other = posixpath.normpath(posixpath.join(posixpath.dirname(name), statement[2]))
            if other not in codes:
                add(other)
            imported.setdefault(other, set()).update(part.split(" as ")[0] for part in statement[1].split(", "))
            return f"const {{ {statement[1].replace(' as ', ': ')} }} = modules[{json.dumps(other)}];"

        codes[name] = _EXPORT.sub("", _IMPORT.sub(refer, files[name].decode()))

    add(entry)
    parts = [
        f"modules[{json.dumps(name)}] = (() => {{\n{code}\nreturn {{ {', '.join(sorted(imported[name]))} }};\n}})();"
        for name, code in codes.items()
    ]
    return "\n".join(['"use strict";', "const modules = {};", *parts]).replace(_WORKER_START, "exported.worker")

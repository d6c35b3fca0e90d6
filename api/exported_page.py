"""One HTML file that shows a scene in 3D without a server or a network: viewer, geometry and one or two color sets.

The file has the modules of `api/static` that the viewer imports, and the scene as SOG. Its second color set are the
bytes and the codebook of another SOG of the same geometry, which has its Gaussians in the same order.
"""

from __future__ import annotations

import base64
import gzip
import html
import io
import json
import posixpath
import re
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from api.static_files import read_static
from sgsst_core.errors import SceneError
from sgsst_core.files.atomic import atomic_path
from sgsst_core.files.blending import check_same_shape, common_rests
from sgsst_core.files.formats.sog import META_NAME, SOG
from sgsst_core.files.scene_file import SceneFile, encode_scene
from sgsst_core.orbit.subject import find_subject, find_up
from sgsst_core.scene.gaussians import Scene

_PAGE, _ENTRY, _WORKER = "exported.html", "exported.js", "viewer/scene_worker.js"
_IMPORT = re.compile(r'^import \{ (.*) \} from "(.*)";$', re.MULTILINE)
_EXPORT = re.compile(r"^export (\{.*\};$)?", re.MULTILINE)
#: Arguments with which the viewer starts its worker.
_WORKER_START = 'new URL("./scene_worker.js", import.meta.url), { type: "module" }'
#: Largest relative difference of spherical harmonics that are those of the original times a factor.
_TOLERANCE = 1e-3


def write_page(out: Path, stylized: SceneFile, original: SceneFile | None, title: str) -> None:
    """Write a scene as an HTML file, atomically.

    Args:
        out: File to write.
        stylized: Scene to show.
        original: Scene of the same Gaussians to show beside it, with a wipe and a blend; None for none.
        title: Title of the page.

    Raises:
        SceneError: If the scenes differ in more than their colors and an SH attenuation.
        OutputError: If the file cannot be written.
    """
    shown = original or stylized
    fade = 0.0 if original is None else _fade(stylized, original)
    data = {"page": gzip.compress(_script(_ENTRY).encode(), mtime=0)}
    data |= {"worker": gzip.compress(_script(_WORKER).encode(), mtime=0), "scene": _sog(shown.scene, out)}
    data["colors"] = b"" if original is None else gzip.compress(_indexed_colors(stylized.scene, out), mtime=0)
    up = find_up(find_subject(shown.scene)).direction.tolist()
    sizes = {name: len(content) for name, content in data.items()}
    about = json.dumps({"title": title, "up": up, "fade": fade, "bytes": sizes}).replace("<", "\\u003c")
    files = read_static()
    values = {"title": html.escape(title), "style": files["page.css"].decode(), "about": about}
    values |= {name: _base85(content) for name, content in data.items()}
    page = re.sub(r"\{\{(\w+)\}\}", lambda match: values[match[1]], files[_PAGE].decode())
    with atomic_path(out) as temporary:
        temporary.write_text(page, encoding="utf-8")


def _fade(stylized: SceneFile, original: SceneFile) -> float:
    """Return the fraction by which the harmonics of the stylized scene are smaller than those of the original."""
    check_same_shape(original, stylized)
    before, after = common_rests([original.scene, stylized.scene])
    if torch.equal(before, after):
        return 0.0
    factor = float((before.double() * after.double()).sum() / before.double().square().sum())
    if not torch.allclose(after, factor * before, rtol=0, atol=_TOLERANCE * float(before.abs().max())):
        raise SceneError(
            f"{stylized.path}: its view-dependent colors are not those of {original.path}. Give the scene that was "
            "stylized, in the same format."
        )
    return 1 - factor


def _script(entry: str) -> str:
    """Return a module and all those that it imports as one script: browsers load no modules from a local file."""
    files = read_static()
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
    script = "\n".join(['"use strict";', "const modules = {};", *parts])
    return script.replace(_WORKER_START, "exported.worker")


def _sog(scene: Scene, out: Path) -> bytes:
    stream = io.BytesIO()
    encode_scene(stream, scene, SOG, out)
    return stream.getvalue()


def _indexed_colors(scene: Scene, out: Path) -> bytes:
    """Return the codebook of a scene's colors as 256 halves, and 3 bytes for each Gaussian, in the order of its SOG."""
    flat = replace(scene, sh_rest=torch.zeros(len(scene), 0, 3))  # harmonics would only take time
    with zipfile.ZipFile(io.BytesIO(_sog(flat, out))) as archive:
        meta: dict[str, Any] = json.loads(archive.read(META_NAME))
        with Image.open(archive.open(meta["sh0"]["files"][0])) as image:
            indices = np.asarray(image.convert("RGBA")).reshape(-1, 4)[: meta["count"], :3]
    return np.array(meta["sh0"]["codebook"], "<f2").tobytes() + indices.tobytes()


def _base85(data: bytes) -> str:
    """Encode bytes so that they can stand in a script element: "<", which would end it, becomes a comma."""
    return base64.b85encode(data, pad=True).decode().replace("<", ",")

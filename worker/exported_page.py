"""One HTML file that shows a scene in 3D without a server or a network: viewer, geometry and one or two color sets.

The file has the viewer (`api.static_files.exported_viewer`), and the scene as SOG. Its second color set are the bytes
and the codebook of another SOG of the same geometry, which has its Gaussians in the same order.
"""

from __future__ import annotations

import base64
import gzip
import html
import io
import json
import re
import zipfile
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from sgsst_core.errors import SceneError
from sgsst_core.files.atomic import atomic_path
from sgsst_core.files.blending import check_same_shape, common_rests
from sgsst_core.files.formats.sog import META_NAME, SOG
from sgsst_core.files.formats.streamed_sog import STREAMED_SOG
from sgsst_core.files.images import Color
from sgsst_core.files.scene_file import SceneFile, encode_scene
from sgsst_core.orbit.choice import find_upright_subject
from sgsst_core.scene.gaussians import Scene

#: Largest relative difference of spherical harmonics that are those of the original times a factor.
_TOLERANCE = 1e-3


def write_page(
    out: Path,
    viewer: Mapping[str, str],
    stylized: SceneFile,
    original: SceneFile | None,
    title: str,
    *,
    background: Color = (0.0, 0.0, 0.0),
    up: list[float] | None = None,
    in_place: bool = False,
) -> None:
    """Write a scene as an HTML file, atomically.

    Args:
        viewer: Sources of the viewer; see `api.static_files.exported_viewer`.
        original: Scene of the same Gaussians to show beside it, with a wipe and a blend; None for none.
        background: Color behind the scene, in 0..1.
        up: Up direction; None to estimate it.
        in_place: Whether to write directly to the existing file, because no temporary file can be created beside it.

    Raises:
        SceneError: If the scenes differ in more than their colors and an SH attenuation.
        OutputError: If the file cannot be written.
    """
    shown = original or stylized
    fade = 0.0 if original is None else _fade(stylized, original)
    data = {name: gzip.compress(viewer[name].encode(), mtime=0) for name in ("page", "worker")}
    data["scene"] = _sog(shown.scene, out)
    data["colors"] = b"" if original is None else gzip.compress(_indexed_colors(stylized.scene, out), mtime=0)
    upright = up or find_upright_subject(shown.scene, None)[1].direction.tolist()
    sizes = {name: len(content) for name, content in data.items()}
    sog = shown.format in (SOG.name, STREAMED_SOG.name)
    facts = {"title": title, "up": upright, "fade": fade, "sog": sog, "background": background, "bytes": sizes}
    about = json.dumps(facts).replace("<", "\\u003c")
    values = {"title": html.escape(title), "style": viewer["style"], "about": about}
    values |= {name: _base85(content) for name, content in data.items()}
    page = re.sub(r"\{\{(\w+)\}\}", lambda match: values[match[1]], viewer["document"])
    with nullcontext(out) if in_place else atomic_path(out) as temporary:
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

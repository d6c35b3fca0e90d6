"""Render modes that scene files state: as comments of a PLY, or as a field of another format.

Comments are Brush's `SplatRenderMode: mip` (also of splat-transform and gsplat), Postshot's `antialiased 1`, fVDB's
`fvdb_ply_af_8198767135antialias|int64|1` and `...eps2d|double|0.3`, and our own `eps2d 0.1`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

from sgsst_core.constants import EPS2D
from sgsst_core.files.formats.ply_header import PlyHeader, comment_of
from sgsst_core.scene.rendering import CLASSIC, MAX_EPS2D, Rendering

#: Property of Mip-Splatting: deviation of the 3D filter of each Gaussian, in world units.
FILTER_3D = "filter_3D"
#: Blur of Mip-Splatting and of Brush's antialiased scenes.
_MIP_EPS2D = 0.1

_MODES = {"mip": "antialiased", "default": "classic", "2dgs": "2dgs"}
_MODE = re.compile(r"splatrendermode:\s*(\S+)\s*", re.IGNORECASE)
_FLAG = re.compile(r"(?:antialiased\s+|fvdb_ply_\w+antialias\|int64\|)([01])\s*", re.IGNORECASE)
_EPS2D = re.compile(r"(?:eps2d\s+|fvdb_ply_\w+eps2d\|double\|)([\d.eE+-]+)\s*", re.IGNORECASE)
_UNSCENTED = re.compile(r"\b3dgr?ut\b|\b3dgrt\b|\bunscented", re.IGNORECASE)


@dataclass(frozen=True)
class RenderTag:
    """Render mode that a scene file states.

    Attributes:
        rendering: Stated render mode, else classic.
        reason: Part of the file that states it, such as "the file's flag"; empty if none does.
        warnings: Pairs of texts: how the scene is drawn, and why renders may differ from those of its trainer.
    """

    rendering: Rendering = CLASSIC
    reason: str = ""
    warnings: tuple[tuple[str, str], ...] = ()


#: Tag of files that state nothing.
UNTAGGED = RenderTag()


def ply_tag(header: PlyHeader) -> RenderTag:
    """Return the render mode that the comments and properties of a PLY state; the last comment counts."""
    names = {prop.name for prop in header.vertex.properties}
    mode, eps2d, reasons, warnings = None, None, [], []
    for comment in header.comments:
        if match := _MODE.fullmatch(comment):
            mode = _MODES.get(match[1].lower(), mode)
            if match[1].lower() not in _MODES:
                warnings.append(("classic unless stated otherwise", f"the comment {comment!r} is unknown"))
                continue
        elif match := _FLAG.fullmatch(comment):
            mode = "antialiased" if match[1] == "1" else "classic"
        elif match := _EPS2D.fullmatch(comment):
            eps2d = _usable_eps2d(match[1])
        elif _UNSCENTED.search(comment):
            warnings.append(_unscented(f"the comment {comment!r}"))
            continue
        else:
            continue
        reasons.append(f"the comment {comment!r}")
    if mode is None and FILTER_3D in names:
        mode = "antialiased"
        reasons.append(f"the property {FILTER_3D} of Mip-Splatting")
    if is_flat(names):
        mode = "2dgs"
        reasons.append("the missing property scale_2")
    usual = _MIP_EPS2D if FILTER_3D in names or "Exported from Brush" in header.comments else EPS2D
    if eps2d is None:
        eps2d = usual if mode == "antialiased" else EPS2D
    return stated(mode or "classic", ", ".join(reasons), eps2d, tuple(warnings))


def is_flat(names: Collection[str]) -> bool:
    """Return whether properties are those of 2D Gaussian Splatting, whose Gaussians have no third axis."""
    return "scale_1" in names and "scale_2" not in names and "scale" not in names


def stated(mode: str, reason: str, eps2d: float | None = None, warnings: tuple[tuple[str, str], ...] = ()) -> RenderTag:
    """Return the tag of a file that states a render mode, with a warning if the scene can only be approximated.

    Args:
        mode: Stated mode, one of `Rendering.mode`. Any other is read as classic, with a warning.
        reason: Part of the file that states it.
        eps2d: Stated blur; None for the default.
        warnings: Further warnings.
    """
    if mode not in ("classic", "antialiased", "2dgs"):
        warnings = (*warnings, ("classic", f"{reason} is unknown"))
        mode = "classic"
    if mode == "2dgs":
        flat = "projected Gaussians of 2D Gaussian Splatting are approximated; its trainer intersects them with rays"
        warnings = (*warnings, ("as Gaussians without thickness", f"{reason}; {flat}"))
    return RenderTag(Rendering(mode, eps2d or EPS2D), reason, warnings)  # type: ignore[arg-type]


def extras_tag(extras: object, where: str) -> RenderTag:
    """Return the render mode that a JSON document states in the fields that `extras_of` writes.

    Args:
        extras: Value that should be a JSON object.
        where: Name of the document in messages.
    """
    members = extras if isinstance(extras, dict) else {}
    model, eps2d = members.get("model", "default"), members.get("eps2d")
    eps2d = _usable_eps2d(eps2d) if type(eps2d) in (int, float) else None
    if model == "default" and eps2d is None:
        return UNTAGGED
    return stated("classic" if model == "default" else str(model), f"the model {str(model)[:40]!r} in {where}", eps2d)


def extras_of(rendering: Rendering) -> dict[str, Any]:
    """Return the fields of a JSON document that state a render mode; empty for the default mode."""
    model = {} if rendering.mode == CLASSIC.mode else {"model": rendering.mode}
    return model if rendering.eps2d == EPS2D else {**model, "eps2d": rendering.eps2d}


def _unscented(where: str) -> tuple[str, str]:
    return (
        "by linearized projection (EWA)",
        f"{where} names another projection; renders differ where Gaussians are large or lenses were distorted",
    )


def _usable_eps2d(value: Any) -> float | None:
    """Return a stated blur as a float; None if it is not a number or out of range."""
    try:
        number = float(value)
    except (ValueError, OverflowError):
        return None
    return number if math.isfinite(number) and 0 < number <= MAX_EPS2D else None


def comment_lines(rendering: Rendering) -> list[str]:
    """Return the lines of a PLY header that state a render mode; empty for the default mode."""
    mode, eps2d = _stating(rendering)
    return [*([] if rendering.mode == "classic" else [mode]), *([] if rendering.eps2d == EPS2D else [eps2d])]


def retagged(raw: bytes, header: PlyHeader, rendering: Rendering) -> bytes:
    """Add comments that state a render mode to the bytes of a PLY header, unless the header already states that mode.

    Args:
        raw: Bytes of the header, which may differ from those of `header` in the number of Gaussians.
        header: Parsed header.
        rendering: Render mode to state.
    """
    if ply_tag(header).rendering == rendering:
        return raw
    lines = [line for line in raw.split(header.newline) if not _states_mode(line)]
    after_format = next(i for i, line in enumerate(lines) if line.startswith(b"format")) + 1
    lines[after_format:after_format] = [line.encode() for line in _stating(rendering)]
    return header.newline.join(lines)


def _stating(rendering: Rendering) -> tuple[str, str]:
    """Return the lines of a PLY header that state mode and blur."""
    name = next(name for name, mode in _MODES.items() if mode == rendering.mode)
    return f"comment SplatRenderMode: {name}", f"comment eps2d {rendering.eps2d!r}"


def _states_mode(line: bytes) -> bool:
    """Return whether a line of a PLY header is a comment that states mode or blur."""
    comment = comment_of(line)
    return comment is not None and any(pattern.fullmatch(comment) for pattern in (_MODE, _FLAG, _EPS2D))

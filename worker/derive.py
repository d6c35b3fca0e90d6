"""Files derived from scenes, for the command line and, in confinement, for the service: conversions and blends.

`worker.video` renders videos in the same way.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

from sgsst_core.errors import OutputError
from sgsst_core.files.atomic import atomic_path
from sgsst_core.files.blending import blend_scenes, encode_blend
from sgsst_core.files.formats import format_of_name, read_scene_header, scene_path
from sgsst_core.files.formats.ply import PLY
from sgsst_core.files.formats.scene_format import SceneFormat
from sgsst_core.files.formats.sog import META_NAME
from sgsst_core.files.formats.streamed_sog import INDEX_NAME, STREAMED_SOG
from sgsst_core.files.library import load_scene
from sgsst_core.files.scene_file import encode_scene, losses, read_scene, write_levels, write_sog_folder
from sgsst_core.files.trainer_checkpoints import TrainerCheckpoint
from sgsst_core.files.usd import USD_SUFFIXES, check_usd, write_usd
from sgsst_core.progress import Decision
from sgsst_core.quality.scene_difference import CompressionLoss, measure_compression
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.rendering import CLASSIC
from sgsst_core.settings import Settings
from worker.capture import about_notes, about_rendering, choose_axes, read_capture
from worker.job import SceneRequest
from worker.outputs import check_is_not_input, result_format
from worker.prepare import describe_scene

#: Number of views of an orbit that a converted scene is compared in.
_COMPARED_VIEWS = 3


@dataclass(frozen=True)
class Converted:
    """Result of a conversion.

    Attributes:
        scene: Text about the scene, with contents that were not read, or not read as stored.
        decisions: Decisions about the scene's axes and the cameras.
        loss: Difference of the written scene; None if it was not measured.
    """

    scene: str
    decisions: tuple[Decision, ...]
    loss: CompressionLoss | None


def convert(
    source: SceneRequest,
    out: Path,
    *,
    compare: bool,
    images: Path | None = None,
    settings: Settings | None = None,
    levels_of: Path | None = None,
    pad_sh: bool = False,
    in_place: bool = False,
) -> Converted:
    """Write a scene in the format that the name of a file determines. Colors and order may change by its rounding.

    Args:
        source: Scene or checkpoint of a trainer, and cameras for the comparison; without cameras, views are those of an
            orbit.
        out: File to write: a scene, the meta.json of an unpacked SOG, the lod-meta.json or archive of a streamed SOG,
            or a USD file, which cannot be compared.
        compare: Whether to read the file back and compare renders.
        images: Folder of photos, for cameras whose file states no sizes.
        settings: Settings of a job, whose views and background the renders have; None for those of the cameras, on
            black.
        levels_of: Streamed SOG that the scene is the finest level of, with other colors; None for the scene itself.
        pad_sh: Whether a PLY has spherical harmonics of degree 3 in any case.
        in_place: Whether to write directly to the existing file, because no temporary file can be created beside it.

    Raises:
        InvalidInputError: If scene, cameras or output cannot be used.
    """
    is_usd = out.suffix.lower() in USD_SUFFIXES
    streamed = out.name == INDEX_NAME or format_of_name(out.name) is STREAMED_SOG
    if is_usd:
        check_usd(out)
        if compare:
            raise OutputError(f"{out}: USD can only be written, so it cannot be compared. Omit --compare.")
    elif streamed and not levels_of and read_scene_header(source.scene).format is not STREAMED_SOG:
        raise OutputError(
            f"{out}: needs the levels of a streamed SOG. Give the one that the scene is from: --levels-of."
        )
    elif levels_of and not streamed:
        raise OutputError(f"{out}: has no levels of detail. Name a {INDEX_NAME} or a .zip, or omit --levels-of.")
    elif out.name != META_NAME and not streamed:
        result_format(out)
    if pad_sh and format_of_name(out.name) is not PLY:
        raise OutputError(f"{out}: only a PLY can be padded. Name a .ply, or omit --pad-sh.")
    for path in filter(None, (source.scene, levels_of)):
        check_is_not_input(out, scene_path(path))
    if compare and source.cameras is None and source.orbit is None:
        source = source.model_copy(update={"orbit": _COMPARED_VIEWS})
    axes, decisions = choose_axes(source, images)
    loaded = load_scene(source.scene, drop_invalid=source.drop_invalid, spz_axes=axes)
    file = loaded.scene_file() if isinstance(loaded, TrainerCheckpoint) else loaded
    file = file.rendered(source.render_mode, source.eps2d)
    scene, decisions = file.scene, [*about_notes(file), *decisions, *about_rendering(file)]
    cameras: list[Camera] = []
    if source.cameras or source.orbit:
        capture = read_capture(source, scene, images)
        capture = (capture.fitted(settings) if settings else capture).checked(scene, source.near)
        cameras, decisions = capture.cameras, [*decisions, *capture.decisions]
    out.parent.mkdir(parents=True, exist_ok=True)
    size = None
    if streamed:
        size = write_levels(out, scene, levels_of or source.scene)
    elif out.name == META_NAME:
        size = write_sog_folder(out.parent, scene)
    elif is_usd:
        write_usd(out, scene)
    else:
        with _written(out, in_place=in_place) as stream:
            encode_scene(stream, scene, result_format(out), out, pad_sh=pad_sh, axes=file.axes)
    stated = CLASSIC if is_usd else read_scene_header(out).tag.rendering
    if stated != scene.rendering:
        reason = f"its format cannot state {scene.rendering.text}"
        decisions += [Decision("rendering", f"warning: {out.name} will be drawn {stated.text}", reason)]
    decisions += [] if is_usd or compare else about_losses(scene, read_scene_header(out).format, out)
    loss = None
    if compare:
        background = settings.background if settings else (0.0, 0.0, 0.0)
        loss = measure_compression(out, scene, cameras, background=background, near=source.near, axes=file.axes)
        loss = replace(loss, size=size or loss.size)
    return Converted(describe_scene(file), tuple(decisions), loss)


def about_losses(scene: Scene, format: SceneFormat, out: Path) -> list[Decision]:
    """Return warnings about what a format cannot hold of a scene."""
    return [Decision("scene", f"warning: {out.name} loses detail", note) for note in losses(scene, format)]


def blend(parts: Sequence[tuple[SceneRequest, float]], out: Path, *, in_place: bool = False) -> list[Decision]:
    """Write the weighted mean of scenes that differ only in color, and return warnings about what is lost.

    Args:
        parts: Scenes with their weights, which are divided by their sum. Cameras are not used.
        out: Scene file to write.
        in_place: See `convert`.

    Raises:
        InvalidInputError: If the weights, a scene or the output cannot be used.
    """
    format = result_format(out)
    for source, _ in parts:
        check_is_not_input(out, source.scene)
    files = [
        read_scene(source.scene, drop_invalid=source.drop_invalid, spz_axes=source.spz_axes) for source, _ in parts
    ]
    blended = blend_scenes(files, [weight for _, weight in parts])
    out.parent.mkdir(parents=True, exist_ok=True)
    with _written(out, in_place=in_place) as stream:
        encode_blend(stream, blended, format, out)
    return about_losses(blended.scene, format, out)


@contextmanager
def _written(out: Path, *, in_place: bool) -> Iterator[BinaryIO]:
    """Open a file to write, which replaces `out` at the end unless it is written in place."""
    if in_place:
        with out.open("wb") as stream:
            yield stream
        return
    with atomic_path(out) as temporary, temporary.open("wb") as stream:
        yield stream

"""Implementation of `sgsst study`: a blind comparison of stylized scenes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.table import Table
from torch import Tensor

from api.cli.arguments import local_path
from sgsst_core.errors import OutputError
from sgsst_core.files.images import load_image
from sgsst_core.quality.study import VoteShare, check_names, write_study
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scene.camera import Camera, resized
from sgsst_core.scene.spherical_harmonics import scene_colors
from worker.inputs import check_something_seen, read_scene_and_capture
from worker.job import SceneRequest, check_choice

#: Longer side in pixels of the views on the page, unless the request has another.
STUDY_SIDE = 960


def key_path(page: Path) -> Path:
    """Return the path of the key of a study, given its page."""
    return page.with_suffix(".key.json")


def make_study(
    variants: Sequence[str], source: SceneRequest, style: Path, background: tuple[float, float, float], page: Path
) -> None:
    """Render all variants at the same views, and write the page of a study and its key.

    Args:
        variants: Scenes to compare, each as FILE or NAME=FILE.
        source: Cameras and view options; its scene is replaced by each variant. An orbit is placed around the first.
        page: HTML file to write; the key goes beside it.

    Raises:
        InvalidInputError: If an input cannot be used; the first one is reported.
    """
    scenes = [named(text) for text in variants]
    check_names([name for name, _ in scenes])
    if page.suffix.lower() not in (".html", ".htm"):
        raise OutputError(f"{page}: not the name of an HTML file. Give one, such as study.html.")
    sources = [source.model_copy(update={"scene": path}) for _, path in scenes]
    for each in sources:
        check_choice(each)
    image = load_image(style)
    side = source.resolution or STUDY_SIDE
    cameras = [resized(camera, min(side, camera.side)) for camera in read_scene_and_capture(sources[0])[1].cameras]

    def render(index: int) -> list[Tensor]:
        return _render(sources[index], cameras, background)

    page.parent.mkdir(parents=True, exist_ok=True)
    write_study(page, key_path(page), [name for name, _ in scenes], image, len(cameras), render)


def named(text: str) -> tuple[str, Path]:
    """Return the name and the path of a variant, given as NAME=FILE, or as FILE, which is its own name."""
    name, equals, path = text.partition("=")
    return (name, local_path(path)) if equals and not Path(text).exists() else (text, local_path(text))


def _render(source: SceneRequest, cameras: Sequence[Camera], background: tuple[float, float, float]) -> list[Tensor]:
    """Return the image [H, W, 3] of a scene at each camera."""
    scene = read_scene_and_capture(source)[0].scene
    rasterizer = make_rasterizer("cpu", scene, background=background, near=source.near, memory=0)
    check_something_seen(scene, cameras, rasterizer)
    return [rasterizer.render(scene_colors(scene, camera), camera) for camera in cameras]


def share_table(shares: Sequence[VoteShare]) -> Table:
    """Return a table with each variant's fraction of the votes and its 95 % interval."""
    table = Table("variant", "votes", "share", "95 % interval", title=f"{shares[0].total} votes")
    for share in shares:
        interval = f"{share.low:.1%} to {share.high:.1%}"
        table.add_row(share.variant, str(share.votes), f"{share.votes / share.total:.1%}", interval)
    return table

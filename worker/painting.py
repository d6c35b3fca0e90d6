"""Painted views of a scene: a picture to paint on, and the scene that follows what was painted."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from torch import Tensor

from sgsst_core.errors import CameraError, ImageError, OutputError
from sgsst_core.files.atomic import atomic_path
from sgsst_core.files.images import load_image, to_image
from sgsst_core.files.library import save
from sgsst_core.files.scene_file import SceneFile
from sgsst_core.painting.solver import Painted, PaintedView, paint
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.rasterizer.base import Color, Rasterizer
from sgsst_core.scene.camera import Camera, resized, spread
from sgsst_core.scene.spherical_harmonics import scene_colors
from worker.inputs import read_scene_and_capture
from worker.job import SceneRequest
from worker.outputs import check_is_not_input, result_format

#: Text chunk of a PNG with the view that it shows.
_CHUNK = "sgsst-view"
#: Number of other views that tell how well the painted ones show a Gaussian.
_OTHERS = 12
#: A picture that states no view is compared with so many, at this longer side. It is refused if another one than it is
#: said to show fits better by so many dB. A picture less opaque than this on average shows paint, not the view.
_MOST_COMPARED, _COMPARED_SIDE, _CLEARLY, _OPAQUE = 100, 160, 3.0, 0.5


@dataclass(frozen=True)
class PaintRequest:
    """Request to paint a scene.

    Attributes:
        paintings: Painted pictures by the names of their views.
        out: Scene to write, in any format for results; a report goes beside it.
        background: Color behind the scene in the pictures, in 0..1.
    """

    source: SceneRequest
    paintings: Mapping[str, Path]
    out: Path
    background: Color = (0.0, 0.0, 0.0)

    @property
    def report(self) -> Path:
        """Path of the report."""
        return self.out.with_suffix(".report.json")


def export_view(source: SceneRequest, name: str, background: Color, out: Path) -> Camera:
    """Render a view as a PNG to paint on, which states its view in a text chunk. Return the camera.

    Raises:
        InvalidInputError: If scene or cameras cannot be used, no view has this name, or `out` is not a PNG's name.
    """
    if out.suffix.lower() != ".png":  # a mistyped path must not overwrite a scene
        raise OutputError(f"{out}: not the name of a PNG image. Give one, such as {name}.png.")
    file, capture = read_scene_and_capture(source)
    camera = _camera(capture.cameras, name)
    image = _render(make_rasterizer("cpu", file.scene, background=background, near=source.near), file, camera)
    metadata = PngInfo()
    metadata.add_text(_CHUNK, json.dumps(_description(camera)))
    with atomic_path(out) as temporary:
        to_image(image).save(temporary, format="PNG", pnginfo=metadata)
    return camera


def paint_scene(
    request: PaintRequest, show: Callable[[int, int], None] = lambda done, total: None
) -> tuple[SceneFile, Painted]:
    """Return a scene's file, and the colors with which it follows its painted views.

    Raises:
        InvalidInputError: If scene, cameras or a picture cannot be used, or the output would overwrite one of them.
    """
    result_format(request.out)
    inputs = {request.source.scene: "scene itself"} | dict.fromkeys(request.paintings.values(), "painted picture")
    if request.source.cameras is not None:
        inputs[request.source.cameras] = "camera file"
    for path, description in inputs.items():
        for out in (request.out, request.report):
            check_is_not_input(out, path, description)
    file, capture = read_scene_and_capture(request.source)
    named = [(_camera(capture.cameras, name), path) for name, path in request.paintings.items()]
    paintings = [(camera, path, *load_painting(path, camera)) for camera, path in named]
    rasterizer = make_rasterizer("cpu", file.scene, background=request.background, near=request.source.near)
    for camera, path, image, alpha in paintings:
        if _stated(path) != _description(camera) and float(alpha.mean()) >= _OPAQUE:
            _check_view(path, image, alpha, camera, capture.cameras, lambda camera: _render(rasterizer, file, camera))
    views = [PaintedView(camera, image, alpha) for camera, _, image, alpha in paintings]
    painted = paint(file.scene, views, rasterizer, others=spread(capture.cameras, _OTHERS), show=show)
    return file, painted


def load_painting(path: Path, camera: Camera) -> tuple[Tensor, Tensor]:
    """Read a painted picture of a view.

    Returns:
        Colors [h, w, 3] float32 in 0..1, and opacity [h, w] of the paint.

    Raises:
        ImageError: If the file is no image, is transparent everywhere, or has another size or view than the camera's.
    """
    on_black, on_white = (load_image(path, background=(gray,) * 3) for gray in (0.0, 1.0))
    height, width, _ = on_black.shape
    expected = f"the view {camera.name} has {camera.width}x{camera.height}"
    if (width, height) != (camera.width, camera.height):
        same = abs(width / height - camera.width / camera.height) < 1 / min(height, camera.height)
        shape = "" if same else ", which is another aspect ratio: do not crop the picture"
        raise ImageError(f"{path}: has {width}x{height} pixels, but {expected}{shape}. Export and paint in one size.")
    stated = _stated(path)
    if stated is not None and stated["name"] != camera.name:
        raise ImageError(f"{path}: is a picture of the view {stated['name']}, not of {camera.name}. Name that view.")
    alpha = 1 - (on_white - on_black).mean(dim=2).clamp(0, 1)
    if not bool((alpha > 0).any()):
        raise ImageError(f"{path}: is transparent everywhere, so it says nothing. Paint on it.")
    return (on_black / alpha.clamp_min(1 / 255)[:, :, None]).clamp(0, 1), alpha


def _camera(cameras: Sequence[Camera], name: str) -> Camera:
    """Return the camera of a name."""
    for camera in cameras:
        if camera.name == name:
            return camera
    some = ", ".join(camera.name for camera in cameras[:5])
    raise CameraError(f"No view is called {name}. There are {len(cameras)}: {some}{', ...' * (len(cameras) > 5)}.")


def _render(rasterizer: Rasterizer, file: SceneFile, camera: Camera) -> Tensor:
    return rasterizer.render(scene_colors(file.scene, camera), camera)


def _description(camera: Camera) -> dict[str, Any]:
    """Return what the text chunk of a picture states: the name and the parameters of its view."""
    parameters = [camera.fx, camera.fy, camera.cx, camera.cy, *camera.world_to_camera.flatten().tolist()]
    return {"name": camera.name, "size": [camera.width, camera.height], "camera": parameters}


def _stated(path: Path) -> dict[str, Any] | None:
    """Return the description of the view in a picture's text chunk; None if there is none."""
    with Image.open(path) as image:
        text = image.info.get(_CHUNK)
    try:
        stated = json.loads(text) if isinstance(text, str) else None
    except ValueError:
        return None
    return stated if isinstance(stated, dict) and isinstance(stated.get("name"), str) else None


def _check_view(
    path: Path,
    image: Tensor,
    alpha: Tensor,
    camera: Camera,
    cameras: Sequence[Camera],
    render: Callable[[Camera], Tensor],
) -> None:
    """Check that a picture that states no view shows the one that it is said to.

    Raises:
        ImageError: If another view fits it clearly better.
    """
    painting = torch.cat([image, alpha[:, :, None]], dim=2).permute(2, 0, 1)[None]

    def fit(other: Camera) -> float:
        """Return the PSNR of a view with the picture's colors, by the affine map that fits best."""
        small = resized(other, _COMPARED_SIDE)
        pixels = torch.nn.functional.interpolate(painting, (small.height, small.width), mode="area")
        colors, weight = pixels[0, :3].flatten(1).T.double(), pixels[0, 3].flatten().double()[:, None]
        terms = render(small).flatten(0, 1).double()
        terms = torch.cat([terms, torch.ones_like(terms[:, :1])], dim=1)
        ridge = 1e-6 * float(weight.sum()) * torch.eye(4, dtype=torch.float64)
        map = torch.linalg.solve((terms * weight).T @ terms + ridge, (terms * weight).T @ colors)
        error = ((terms @ map - colors).square() * weight).sum() / (3 * weight.sum())
        return float(-10 * torch.log10(error.clamp_min(1e-12)))

    best = max(spread(cameras, _MOST_COMPARED), key=fit)
    if fit(best) > fit(camera) + _CLEARLY:
        raise ImageError(f"{path}: does not look like the view {camera.name}, but like {best.name}. Name that view.")


def write_painted(request: PaintRequest, file: SceneFile, painted: Painted) -> None:
    """Write a painted scene, and beside it a report.

    Raises:
        OutputError: If a file cannot be written.
    """
    save(request.out, replace(file, scene=replace(file.scene, sh_dc=painted.sh_dc)))
    figures = {name: value for name, value in vars(painted).items() if name != "sh_dc"}
    with atomic_path(request.report) as temporary:
        temporary.write_text(json.dumps({"gaussians": len(file.scene), **figures}, indent=2) + "\n", "utf-8")

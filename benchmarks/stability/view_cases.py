"""Hard cases of views: sizes, fields of view, and views that see nothing."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import psutil
import torch

from benchmarks.stability.case import (
    PRECISIONS,
    Case,
    CaseResult,
    Way,
    camera,
    compare_losses,
    compare_rasterizers,
    in_ways,
    ordinary,
    repeated,
    texture,
)
from sgsst_core.errors import CameraError, TooManyIntersectionsError
from sgsst_core.planning.survey import survey_views
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene

_IMAGE = "image, coverage, gradient against float64"
_LOSS = "loss and pixel gradient, relative to float64"
#: Upper bound in bytes on memory growth when an allocation of tens of gigabytes is refused. It allows for the growth of
#: Python and caches.
_SMALL_MEMORY = 300 << 20


def cases() -> list[Case]:
    """Return all cases of this group."""
    sizes = [(1, 1), (15, 17), (16, 16), (3, 200), (33, 47), (4096, 16)]
    entries = [Case(name, "views", _IMAGE, partial(_rendered, make)) for name, make in _VIEWS.items()]
    for width, height in sizes:
        suited = [way for way in PRECISIONS if way.suits(height, width)]
        run = partial(_stylized_size, width, height)
        entries += in_ways(f"{width} x {height} pixels, stylized", "views", _LOSS, run, suited)
    return [
        *entries,
        Case("cameras that see nothing", "views", "views that were not left out", _blind),
        Case("more than 2^31 intersections", "views", "bytes taken before the error", _too_many_intersections),
        Case("intersections beyond the free memory", "views", "bytes taken before the error", _too_much_memory),
    ]


def _rendered(make: Callable[[], tuple[Scene, Camera]], full: bool) -> CaseResult:
    return compare_rasterizers(*make())


def _size(width: int, height: int) -> tuple[Scene, Camera]:
    return ordinary(200), camera(width, height, focal=max(width, height) / 2)


def _stylized_size(width: int, height: int, way: Way, full: bool) -> CaseResult:
    """Check the loss of a view of this size, without layers whose output is empty.

    Quick runs limit the width to 512 pixels.
    """
    width = width if full else min(width, 512)
    image, style, content = texture(height, width, 1), texture(40, 32, 2), texture(height, width, 3)
    return compare_losses(image, style, content, way=way, untiled=min(width, height) >= 16)


def _field_of_view(degrees: float) -> tuple[Scene, Camera]:
    """Return a scene and a camera with the given field of view.

    At 179.9 degrees the focal length is a thousandth of the width, so almost everything lies at the border.
    """
    view = camera()
    return ordinary(300, seed=1), camera(focal=view.width / 2 / math.tan(math.radians(degrees) / 2))


def _telescope() -> tuple[Scene, Camera]:
    scene = ordinary(300, seed=2)
    return replace(scene, means=scene.means * torch.tensor([1e-4, 1e-4, 1.0])), camera(focal=1e6)


def _principal_point(x: float, y: float) -> tuple[Scene, Camera]:
    scene = ordinary(300, seed=3)
    view = replace(camera(), cx=x, cy=y)
    depth = scene.means[:, 2]
    shift = torch.stack([(18 - x) / view.fx * depth, (14 - y) / view.fy * depth, torch.zeros(300)], dim=1)
    return replace(scene, means=scene.means + shift), view


def _empty() -> Scene:
    return Scene(
        torch.zeros(0, 3), torch.zeros(0, 4), torch.zeros(0, 3), torch.zeros(0), torch.zeros(0, 3), torch.zeros(0, 0, 3)
    )


_SIZES = [(1, 1), (15, 17), (16, 16), (17, 16), (31, 33), (1, 333), (333, 1), (4096, 16)]
_VIEWS: dict[str, Callable[[], tuple[Scene, Camera]]] = {
    **{f"{width} x {height} pixels, rendered": partial(_size, width, height) for width, height in _SIZES},
    "field of view of 170 degrees": partial(_field_of_view, 170),
    "field of view of 179.9 degrees": partial(_field_of_view, 179.9),
    "field of view of 179.99999 degrees": partial(_field_of_view, 179.99999),
    "field of view of 0.002 degrees": _telescope,
    "principal point 1e4 pixels to the side": partial(_principal_point, 1e4, 14.0),
    "principal point 1e6 pixels away": partial(_principal_point, -1e6, 1e6),
    "no Gaussian": lambda: (_empty(), camera()),
    "a single Gaussian": lambda: (repeated(1), camera()),
    "every Gaussian behind the camera": lambda: (repeated(20, mean=(0.0, 0.0, -4.0)), camera()),
    "every Gaussian too faint": lambda: (repeated(20, logit=-50.0), camera()),
}


def _blind(full: bool) -> CaseResult:
    """Check that views that see nothing are skipped, and that an error is raised if all views are skipped."""
    scene = repeated(5)
    rear_camera = replace(camera(), name="blind", world_to_camera=torch.diag(torch.tensor([1.0, -1, -1, 1]).double()))
    rasterizer = make_rasterizer("cpu", scene)
    wrong = len(set(survey_views(scene, [rear_camera, camera()], rasterizer).covered) ^ {1})
    try:
        survey_views(scene, [rear_camera], rasterizer)
        wrong += 1
    except CameraError:
        pass
    return CaseResult(float(wrong), 0.0, "left out; an error where no camera sees anything")


def _too_many_intersections(full: bool) -> CaseResult:
    """Check that 2100 Gaussians, each over all 1024 x 1024 raster tiles, are refused."""
    return _refused(repeated(2100, scale=50.0), camera(16384, 16384, focal=8000.0))


def _too_much_memory(full: bool) -> CaseResult:
    """Check that intersections are refused if 32-bit indices can address them but free memory cannot hold them.

    This is not checked on machines with more than 40 GB of free memory.
    """
    view = camera(16384, 16384, focal=8000.0)
    fitting = 2**31 // 1024**2 - 8
    if psutil.virtual_memory().available > 20 * fitting * 1024**2:
        return CaseResult(0.0, 0.0, "not tried: this machine has memory enough for 2^31 intersections")
    return _refused(repeated(fitting, scale=50.0), view)


def _refused(scene: Scene, view: Camera) -> CaseResult:
    before = psutil.Process().memory_info().rss
    try:
        make_rasterizer("cpu", scene).coverage(view)
        return CaseResult(math.inf, 0.0, "was not refused")
    except TooManyIntersectionsError as error:
        taken = psutil.Process().memory_info().rss - before
        return CaseResult(float(max(taken, 0)), float(_SMALL_MEMORY), str(error))

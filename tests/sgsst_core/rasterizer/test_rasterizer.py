"""Tests of all CPU rasterizers against the float64 reference, also for antialiased scenes."""

import math
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from sgsst_core.constants import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from sgsst_core.errors import SettingsError
from sgsst_core.files.camera_files import read_cameras
from sgsst_core.files.images import load_image
from sgsst_core.files.scene_file import read_scene
from sgsst_core.rasterizer import RASTERIZERS, Rasterizer, make_rasterizer
from sgsst_core.rasterizer.cpu import CpuRasterizer, project
from sgsst_core.rasterizer.triton import CachedRasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.rendering import CLASSIC, Rendering
from sgsst_core.scene.spherical_harmonics import rest_colors, view_colors
from tests.sgsst_core.rasterizer import references as independent
from tests.sgsst_core.rasterizer.references import assert_background, assert_close_outside_band, relative_error
from tests.sgsst_core.rasterizer.splat_reference import ReferenceRasterizer, splat
from tests.sgsst_core.splat_scenes import (
    camera,
    cloud,
    colors_of,
    needles,
    pixels_like,
    rotated_pose,
    single,
    together,
)

#: Relative distance from a cutoff within which float32 rounding may change the decision.
CLOSE = 2e-5
#: Rasterizers of the CPU; `test_triton.py` compares `cached`, which runs in Triton's interpreter here.
ALL: list[type[Rasterizer]] = [*(each for each in RASTERIZERS.values() if not each.on_gpu), ReferenceRasterizer]
ALL.remove(CachedRasterizer)
kinds = pytest.mark.parametrize("kind", ALL, ids=lambda kind: kind.name)

CASES: dict[str, Callable[[], tuple[Scene, Camera]]] = {
    "cloud": lambda: (cloud(), camera()),
    "rotated": lambda: (cloud(600, seed=1), camera(pose=rotated_pose())),
    "crowded": lambda: (
        replace(cloud(1500, seed=2, log_scale=-1.5), opacities=torch.full((1500,), 3.0)),
        camera(40, 33),
    ),
    "needles": lambda: (needles(200), camera(97, 61)),
    "huge": lambda: (cloud(60, seed=3, log_scale=3.0), camera(50, 31)),
    "tiny": lambda: (cloud(3000, seed=4, log_scale=-7.0), camera(80, 50)),
    "faint": lambda: (replace(cloud(seed=5), opacities=torch.linspace(-5.6, -5.4, 400)), camera()),
    "one pixel": lambda: (cloud(seed=6), camera(1, 1)),
    "one row": lambda: (cloud(seed=7), camera(333, 1)),
    "close by": lambda: (cloud(seed=8, depth=0.3), camera()),
    "antialiased": lambda: (replace(cloud(900, seed=14, log_scale=-4.0), rendering=Rendering("antialiased")), camera()),
    "other blur": lambda: (replace(needles(200), rendering=Rendering("antialiased", 0.1)), camera(97, 61)),
}


@pytest.fixture(params=CASES)
def case(request: pytest.FixtureRequest) -> tuple[Scene, Camera]:
    return CASES[request.param]()


def test_images_and_gradients_agree_with_reference(case: tuple[Scene, Camera]) -> None:
    scene, view = case
    assert_agree(scene, view, (1.0, 0.25, 0.5))


def test_survey_equals_coverage_and_gradient_of_ones(case: tuple[Scene, Camera]) -> None:
    scene, view = case
    reference = ReferenceRasterizer(scene)
    band = reference.near_cutoff(view, CLOSE)
    expected, summed = reference.survey(view)
    fast = CpuRasterizer(scene)
    coverage, weights = fast.survey(view)
    separate = Rasterizer.survey(fast, view)
    assert torch.equal(coverage, separate[0])
    assert torch.equal(weights, separate[1])
    assert_close_outside_band(coverage, expected, band, tolerance=1e-4)
    # At a pixel where a cutoff flips, a weight of at most 1 moves from one Gaussian to others.
    assert float((weights - summed).abs().max()) <= 1e-4 * float(summed.max()) + 2 * int(band.sum())


def assert_agree(scene: Scene, view: Camera, background: tuple[float, float, float]) -> None:
    """Assert that images agree within 1e-4 and gradients within 1e-5, except at pixels very close to a cutoff."""
    colors, pixels = colors_of(scene), pixels_like(view)
    reference = ReferenceRasterizer(scene, background=background)
    band = reference.near_cutoff(view, CLOSE)
    pixels[band] = 0
    image, coverage = reference.render(colors, view), reference.coverage(view)
    expected = reference.color_gradient(pixels, view)
    fast = CpuRasterizer(scene, background=background)
    assert_close_outside_band(fast.render(colors, view), image, band, tolerance=1e-4)
    assert_close_outside_band(fast.coverage(view), coverage, band, tolerance=1e-4)
    actual = fast.color_gradient(pixels, view)
    assert actual.dtype == torch.float32
    assert relative_error(actual, expected) < 1e-5
    assert float((actual - expected).abs().max()) <= 1e-5 * float(expected.abs().max())


def test_reference_agrees_with_a_loop_over_pixels() -> None:
    scene, view = cloud(80, seed=10, log_scale=-1.5), camera(19, 17, focal=15.0)
    colors, background = colors_of(scene).double(), torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    splats = splat(scene, view)
    image = torch.empty(view.height, view.width, 3, dtype=torch.float64)
    for y in range(view.height):
        for x in range(view.width):
            left, total = 1.0, torch.zeros(3, dtype=torch.float64)
            for i, gaussian in enumerate(splats.gaussians):
                dx, dy = x + 0.5 - float(splats.x[i]), y + 0.5 - float(splats.y[i])
                p, q = float(splats.w_scale[i]) ** -2, float(splats.skew[i]) * float(splats.w_scale[i]) ** -2
                det = p / float(splats.u_scale[i]) ** 2
                r = (det + q * q) / p
                power = (r * dx * dx - 2 * q * dx * dy + p * dy * dy) / det / 2
                alpha = min(ALPHA_MAX, float(splats.opacity[i]) * math.exp(-power))
                if alpha < ALPHA_MIN:
                    continue
                if left * (1 - alpha) <= TRANSMITTANCE_MIN:
                    break
                total += left * alpha * colors[gaussian]
                left *= 1 - alpha
            image[y, x] = total + left * background
    rendered = ReferenceRasterizer(scene, background=tuple(background.tolist())).render(colors, view)
    assert torch.allclose(rendered, image, atol=1e-12)


@kinds
def test_gradient_is_transpose_and_agrees_with_differences(kind: type[Rasterizer]) -> None:
    scene, view = cloud(seed=11), camera()
    rasterizer = kind(scene, background=(0.3, 0.6, 0.9))
    colors, pixels = colors_of(scene).double(), pixels_like(view).double()
    black = rasterizer.render(torch.zeros_like(colors), view).double()
    gradient = rasterizer.color_gradient(pixels, view).double()
    assert float((gradient * colors).sum()) == pytest.approx(
        float(((rasterizer.render(colors, view).double() - black) * pixels).sum()), rel=1e-5, abs=1e-4
    )
    # The image is linear in the colors, so a difference over a step of 1 is exact up to rounding.
    for gaussian in gradient.abs().sum(1).topk(5).indices.tolist():
        changed = colors.clone()
        changed[gaussian, 1] += 1
        difference = rasterizer.render(changed, view).double() - rasterizer.render(colors, view).double()
        assert float((difference * pixels).sum()) == pytest.approx(float(gradient[gaussian, 1]), rel=2e-4, abs=2e-4)


@kinds
@pytest.mark.parametrize(("row", "column"), [(7, 32), (16, 16), (32, 1)])
def test_crops_of_a_view_make_up_the_whole_view(kind: type[Rasterizer], row: int, column: int) -> None:
    """Gaussians near the border are large on screen, so that the slopes of their projections are clamped."""
    scene, view = cloud(seed=12, log_scale=-1.0), camera(focal=20.0)
    colors, pixels = colors_of(scene), pixels_like(view)
    rasterizer = kind(scene, background=(1, 1, 1))
    image, coverage = torch.zeros(view.height, view.width, 3), torch.zeros(view.height, view.width)
    gradient = torch.zeros(len(scene), 3, dtype=rasterizer.dtype)
    for top, bottom in ((0, row), (row, view.height)):
        for left, right in ((0, column), (column, view.width)):
            crop, area = view.cropped(top, left, bottom, right), (slice(top, bottom), slice(left, right))
            image[area] = rasterizer.render(colors, crop).float()
            coverage[area] = rasterizer.coverage(crop).float()
            gradient += rasterizer.color_gradient(pixels[area], crop)
    assert torch.allclose(image, rasterizer.render(colors, view).float(), atol=1e-6)
    assert torch.allclose(coverage, rasterizer.coverage(view).float(), atol=1e-6)
    assert relative_error(gradient, rasterizer.color_gradient(pixels, view)) < 1e-6


def test_results_do_not_depend_on_the_number_of_threads() -> None:
    scene, view = cloud(2000, seed=13), camera(200, 120)
    colors, pixels = colors_of(scene), pixels_like(view)
    before = torch.get_num_threads()
    results = []
    try:
        for threads in (1, 2, 2):
            torch.set_num_threads(threads)
            rasterizer = CpuRasterizer(scene)
            image, gradient = rasterizer.render(colors, view), rasterizer.color_gradient(pixels, view)
            results.append((image, gradient, *rasterizer.survey(view)))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(a, b) for other in results[1:] for a, b in zip(results[0], other, strict=True))


@kinds
@pytest.mark.parametrize(
    "scene",
    [cloud(0), single((0, 0, -3.0)), single((1e6, 0, 1.0)), single((0, 0, 3.0), opacity=0.003)],
    ids=["empty", "behind", "beside", "faint"],
)
def test_view_without_gaussians_is_background(kind: type[Rasterizer], scene: Scene) -> None:
    background = (0.5, 0.25, 0.125)
    assert_background(kind(scene, background=background), scene, camera(), background)


@kinds
def test_gaussian_that_would_saturate_a_pixel_is_not_blended(kind: type[Rasterizer]) -> None:
    """Two opaque Gaussians would leave (1 - 0.99)^2 = TRANSMITTANCE_MIN, so the second one is already skipped."""
    scene = together([((0, 0, z), 0.9999, (50.0,) * 3, (1, 0, 0, 0)) for z in (3.0, 4.0, 5.0)])
    image = kind(scene).render(torch.eye(3), camera(20, 20))
    assert float((image[..., 0] - 0.99).abs().max()) < 1e-6
    assert not image[..., 1:].any()
    assert float((kind(scene).coverage(camera(20, 20)) - 0.99).abs().max()) < 1e-6


def test_distant_center_keeps_its_precision() -> None:
    """The edge of a Gaussian of a billion pixels crosses the view; float32 offsets would be off by tens of pixels."""
    scene = single((-4e6, 0, 4.0), scales=(2e6, 1e-3, 1e-3), opacity=0.9)
    view = camera(64, 16, focal=1e3)
    # The perspective is linearized at the edge of the frustum, so only the agreement matters, not the image.
    assert_agree(scene, view, (0.0, 0.0, 0.0))
    assert float(CpuRasterizer(scene).coverage(view).max()) > 0


def test_tile_intersections_beyond_the_budget_are_cached_for_the_last_view_only() -> None:
    scene = cloud(300, seed=21)
    views = [camera(), camera(pose=rotated_pose(0.1)), camera(pose=rotated_pose(0.2))]
    first = CpuRasterizer(scene).intersections(views[0])
    cpu = CpuRasterizer(scene, max_intersection_bytes=first.nbytes)
    cached = [cpu.intersections(view) for view in views]
    assert cpu.intersections(views[0]) is cached[0]
    assert cpu.intersections(views[2]) is cached[2]
    assert cpu.intersections(views[1]) is not cached[1]


def test_unknown_rasterizers_and_devices_are_refused() -> None:
    with pytest.raises(SettingsError, match="no rasterizer is called 'fast'") as refused:
        make_rasterizer("fast", cloud(10))
    assert all(name in str(refused.value) for name in RASTERIZERS)
    with pytest.raises(SettingsError, match="runs on the CPU"):
        make_rasterizer("cpu", cloud(10), device="cuda")


@pytest.mark.slow
def test_kernels_run_without_a_writable_folder(tmp_path: Path) -> None:
    """If no folder is writable, machine code is kept in memory only; Numba itself would raise an error at import."""
    package = Path(__file__).resolve().parents[3]
    code = (
        "import numba.core.caching as c\n"
        "c.CacheImpl._locator_classes = []\n"
        "from sgsst_core.compiled import compiled\n"
        "@compiled()\n"
        "def twice(x):\n    return 2 * x\n"
        "assert twice(4) == 8\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(package)}
    script = tmp_path / "kernel.py"
    script.write_text(code)
    finished = subprocess.run(
        [sys.executable, str(script)], env=environment, capture_output=True, text=True, check=False
    )
    assert finished.returncode == 0, finished.stderr


def test_real_scene_looks_like_its_photo(shared_data: Path) -> None:
    """The test covers SH, projection, order and blending together; after training, 28 dB on average were measured."""
    scene = read_scene(shared_data / "scenes" / "snowmiku_plush" / "point_cloud.ply").scene
    view = read_cameras(shared_data / "scenes" / "snowmiku_plush" / "cameras.json")[0]
    colors = view_colors(scene.sh_dc, rest_colors(scene.sh_rest, scene.means, view))
    image = CpuRasterizer(scene).render(colors, view).clamp(0, 1)
    photo: Tensor = load_image(shared_data / "photos" / "snowmiku_plush" / "images" / f"{view.name}.jpg")
    assert photo.shape == image.shape
    psnr = -10 * math.log10(float((photo - image).square().mean()))
    assert psnr > 25


@pytest.mark.slow
def test_kernels_do_not_change_the_number_of_torch_threads() -> None:
    """In a fresh process, Numba's first kernel sets an OpenMP library that PyTorch may share to all cores."""
    code = (
        "import torch; torch.set_num_threads(1)\n"
        "from tests.sgsst_core.splat_scenes import camera, cloud\n"
        "from sgsst_core.rasterizer.cpu import CpuRasterizer\n"
        "CpuRasterizer(cloud()).coverage(camera())\n"
        "assert torch.get_num_threads() == 1, torch.get_num_threads()\n"
    )
    root = Path(__file__).resolve().parents[3]
    finished = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=False)
    assert finished.returncode == 0, finished.stderr


RENDERINGS = [CLASSIC, Rendering("antialiased"), Rendering("antialiased", 0.1), Rendering("classic", 0.1)]
texts = pytest.mark.parametrize("rendering", RENDERINGS, ids=lambda rendering: rendering.text)


@texts
@pytest.mark.parametrize("log_scale", [-2.5, -4.5])
def test_rasterizers_agree_with_an_independent_renderer(rendering: Rendering, log_scale: float) -> None:
    scene, view = cloud(500, log_scale=log_scale), camera(34, 25, focal=30.0, pose=rotated_pose())
    colors = colors_of(scene) / 2
    expected = independent.render(
        scene, view, colors.double().numpy(), antialiased=rendering.antialiased, eps2d=rendering.eps2d
    )
    assert expected.max() > 0.05
    compared: list[type[Rasterizer]] = [*ALL, CachedRasterizer]
    for kind in compared:
        image = kind(replace(scene, rendering=rendering)).render(colors, view)
        assert independent.psnr(image.double().numpy(), expected) > 60, kind.name


def test_extreme_shapes_are_drawn_or_dropped() -> None:
    """Gaussians without thickness, edge-on, without any extent, and beyond the range of float64."""
    at, upright = (0.0, 0.0, 4.0), (1.0, 0.0, 0.0, 0.0)
    sideways = (math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0)  # the thin axis lies in the image plane
    scene = together(
        [
            (at, 0.8, (0.5, 0.5, 1e-30), upright),
            (at, 0.8, (0.5, 0.5, 1e-30), sideways),
            (at, 0.8, (1e-30, 1e-30, 1e-30), upright),
            (at, 0.8, (1.0, 1.0, 1.0), upright),
        ]
    )
    scene.scales[3] = 500
    scene = replace(scene, rendering=Rendering("antialiased"))
    projection = project(scene, camera())
    assert projection.gaussians.tolist() == [0]
    assert splat(scene, camera()).gaussians.tolist() == [0]
    assert np.isfinite(projection.values).all()
    assert np.isfinite(make_rasterizer("cpu", scene).coverage(camera()).numpy()).all()


def test_derived_scenes_keep_the_rendering() -> None:
    scene = replace(cloud(20, degree=1), rendering=Rendering("antialiased", 0.1))
    for changed in (
        scene.subset(torch.arange(3)),
        scene.attenuated(0.5),
        scene.attenuated(1),
        scene.without_zero_bands(),
    ):
        assert changed.rendering == scene.rendering


def test_requested_rendering_overrides_mode_and_eps2d() -> None:
    mip, flat = Rendering("antialiased", 0.1), Rendering("2dgs")
    assert mip.requested("auto", None) == mip.requested("antialiased", None) == mip
    assert (mip.requested("classic", None), flat.requested("classic", None)) == (CLASSIC, flat)
    assert CLASSIC.requested("antialiased", None) == Rendering("antialiased", 0.3)
    assert CLASSIC.requested("auto", 0.2) == Rendering("classic", 0.2)

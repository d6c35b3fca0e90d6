"""Tests of the rasterizer `gsplat` against the reference with the same alpha limit, and of errors if it can't run."""

from __future__ import annotations

import importlib.util
from dataclasses import replace

import pytest
import torch

from sgsst_core.errors import SettingsError
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.rasterizer.cuda import CudaRasterizer, gsplat_alpha_max
from sgsst_core.rasterizer.reference import ReferenceRasterizer
from sgsst_core.rasterizer.trial import drawing_problem
from sgsst_core.scene.rendering import CLASSIC, Rendering
from tests.sgsst_core.rasterizer.boundary_band import assert_close_outside_band, relative_error
from tests.sgsst_core.splat_scenes import camera, cloud, colors_of, pixels_like, rotated_pose

HAS_GSPLAT = importlib.util.find_spec("gsplat") is not None
HAS_GPU = torch.cuda.is_available()
needs_gpu = pytest.mark.skipif(not HAS_GPU, reason="no CUDA GPU that PyTorch can use")
needs_gsplat = pytest.mark.skipif(not HAS_GSPLAT, reason="gsplat, the extra [cuda], is not installed")
#: gsplat projects in float32 and computes exponentials with the fast intrinsic.
CLOSE = 2e-3


@pytest.mark.gpu
@needs_gpu
@needs_gsplat
def test_gsplat_renders() -> None:
    assert drawing_problem("cuda") is None


@pytest.mark.gpu
@needs_gpu
@needs_gsplat
@pytest.mark.parametrize(
    ("seed", "rendering"), [(0, CLASSIC), (1, CLASSIC), (2, CLASSIC), (3, Rendering("antialiased", 0.1))]
)
def test_cuda_agrees_with_the_reference(seed: int, rendering: Rendering) -> None:
    scene, view = replace(cloud(800, seed=seed), rendering=rendering), camera(130, 75, pose=rotated_pose())
    background = (0.2, 0.5, 1.0)
    cuda = CudaRasterizer(scene, background=background)
    reference = ReferenceRasterizer(scene, background=background, alpha_max=cuda.alpha_max)
    band = reference.near_cutoff(view, CLOSE)
    colors, pixels = colors_of(scene), pixels_like(view)
    image = cuda.render(colors, view).cpu()
    assert_close_outside_band(image, reference.render(colors, view), band, tolerance=1e-4, largest_share=1e-2)
    assert_close_outside_band(
        cuda.coverage(view).cpu(), reference.coverage(view), band, tolerance=1e-4, largest_share=1e-2
    )
    pixels[band] = 0
    assert relative_error(cuda.color_gradient(pixels, view).cpu(), reference.color_gradient(pixels, view)) < 1e-4


@pytest.mark.gpu
@needs_gpu
@needs_gsplat
def test_crops_of_a_view_make_up_the_whole_view() -> None:
    scene, view = cloud(800, seed=3, log_scale=-1.0), camera(130, 75)
    colors, pixels = colors_of(scene), pixels_like(view)
    cuda = CudaRasterizer(scene)
    rows = [(0, 21), (21, 64), (64, 75)]
    crops = [view.cropped(start, 0, stop, 130) for start, stop in rows]
    parts = torch.cat([cuda.render(colors, crop) for crop in crops])
    assert torch.allclose(parts, cuda.render(colors, view), atol=1e-5)
    pairs = zip(rows, crops, strict=True)
    gradient = torch.stack([cuda.color_gradient(pixels[a:b], crop) for (a, b), crop in pairs]).sum(0)
    assert relative_error(gradient, cuda.color_gradient(pixels, view)) < 1e-4


@pytest.mark.skipif(HAS_GSPLAT, reason="gsplat is installed")
def test_error_without_gsplat_names_the_extra() -> None:
    with pytest.raises(SettingsError, match=r"sgsst-service\[cuda\]"):
        make_rasterizer("cuda", cloud(10))


@needs_gsplat
@pytest.mark.skipif(HAS_GPU, reason="there is a GPU")
def test_error_without_a_gpu_names_alternatives() -> None:
    with pytest.raises(SettingsError, match="choose 'cpu' or 'cached'"):
        make_rasterizer("cuda", cloud(10))


@pytest.mark.parametrize(
    ("version", "clamp"), [("1.5.3", 0.999), ("1.6.0", 0.99), ("1.6.0rc1+cu124", 0.99), ("2.0", 0.99)]
)
def test_limit_of_alpha_depends_on_gsplat_version(version: str, clamp: float) -> None:
    assert gsplat_alpha_max(version) == clamp


@pytest.mark.skipif(HAS_GPU and HAS_GSPLAT, reason="there is no problem")
def test_reason_why_gsplat_is_unusable_is_one_line() -> None:
    problem = drawing_problem("cuda")
    assert problem
    assert "\n" not in problem

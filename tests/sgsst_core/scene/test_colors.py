"""Tests of color constraints and of the image pyramid."""

import io

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from torch import Tensor

from sgsst_core.constants import COLOR_OFFSET, SH_C0
from sgsst_core.scales import scale_count
from sgsst_core.scene.colors import (
    LARGEST,
    WEIGHTS,
    ColorSubspace,
    add_upscaled_,
    color_subspace_of,
    downscale,
    gray,
    gray_gradient,
    luminance,
    on_screen,
    on_screen_by_luminance,
    style_size,
    with_chroma_of,
)
from sgsst_core.settings import make_settings
from sgsst_core.style import Style
from tests.sgsst_core.synthetic_images import synthetic_image


@pytest.mark.parametrize(
    ("size", "count"),
    [((1, 1), 1), ((511, 4000), 1), ((512, 512), 2), ((1023, 2000), 2), ((1024, 1024), 3), ((3361, 5187), 4)],
)
def test_scale_count_follows_from_the_shorter_side(size, count):
    assert (scale_count(*size), scale_count(*size[::-1])) == (count, count)
    if count > 1:
        assert 256 <= min(size) >> (count - 1) <= 511


@pytest.mark.parametrize("scale", [0, 1, 2, 3])
def test_downscale_is_box_average_and_upscale_its_adjoint(scale):
    image = torch.rand((37, 50, 3), dtype=torch.float64)
    small = downscale(image, scale)
    side = 2**scale
    assert small.shape == (37 // side, 50 // side, 3)
    block = image[side : 2 * side, 2 * side : 3 * side]
    torch.testing.assert_close(small[1, 2], block.mean(dim=(0, 1)), rtol=1e-14, atol=0)
    gradient = torch.rand_like(small)
    adjoint = torch.zeros_like(image)
    add_upscaled_(adjoint, gradient, scale, 0.5)
    assert float((adjoint * image).sum()) == pytest.approx(0.5 * float((gradient * small).sum()), rel=1e-13)


def test_style_is_downscaled_but_never_upscaled():
    sizes = [style_size(size, (500, 700)) for size in ((1520, 1920), (540, 900), (300, 200))]
    assert sizes == [(500, 632), (540, 900), (300, 200)]


def colors(count: int = 200, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return torch.randn(count, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64).to(dtype)


def test_gray_keeps_luminance_and_has_no_chroma() -> None:
    grays = gray(colors())
    assert sum(WEIGHTS) == pytest.approx(1, abs=1e-15)
    torch.testing.assert_close(grays[:, 0], colors() @ torch.tensor(WEIGHTS, dtype=torch.float64))
    assert torch.equal(grays[:, 0], grays[:, 1])
    assert torch.equal(grays[:, 0], grays[:, 2])
    torch.testing.assert_close(luminance(grays), grays[:, 0])
    assert grays.is_contiguous()


def test_gray_gradient_agrees_with_autograd() -> None:
    values, sent = colors().requires_grad_(), colors(200).flip(0)
    (wanted,) = torch.autograd.grad((gray(values) * sent).sum(), values)
    torch.testing.assert_close(gray_gradient(sent), wanted)


def test_chroma_comes_from_the_original() -> None:
    original = 3 * colors(dtype=torch.float32)
    shift = torch.linspace(-5, 5, 200)[:, None]
    noise = 1e-3 * colors(dtype=torch.float32).flip(0)
    result = with_chroma_of(original + shift + noise, original)
    change = result.double() - original.double()
    largest = torch.maximum(result.abs(), original.abs()).amax()
    assert float((change - change.mean(1, keepdim=True)).abs().max()) <= float(largest) * 2**-23
    torch.testing.assert_close(change.mean(1), (shift[:, 0] + noise.mean(1)).double(), rtol=0, atol=1e-5)


COLORED = synthetic_image(64, 48, seed=1).float()


def jpeg_of(image: Tensor) -> Tensor:
    """Return an image as a color JPEG of low quality stores it."""
    stored = io.BytesIO()
    Image.fromarray((255 * image).byte().numpy()).save(stored, "JPEG", quality=30)
    return torch.from_numpy(np.array(Image.open(stored))) / 255


LINES = jpeg_of(gray(COLORED))
SEPIA = LINES * torch.tensor([1.0, 0.95, 0.82])
FEW_HUES = COLORED[..., :1] * torch.tensor([0.5, 0.4, 0.25]) + COLORED[..., 1:2] * torch.tensor([0.1, 0.3, 0.5])


@pytest.mark.parametrize(
    ("style", "dimensions"),
    [
        (Style.of(LINES), 1),
        (Style.of(SEPIA), 1),
        (Style.of(FEW_HUES), 2),
        (Style.weighted([LINES, torch.zeros(8, 8, 3)], [1, 1]), 1),
        (Style.of(COLORED), None),
        (Style.weighted([LINES, COLORED], [1, 1]), None),
        (Style.of(torch.full((8, 8, 3), 0.3)), None),
        (Style.of(torch.rand((1, 1, 3))), None),
    ],
    ids=["gray", "sepia", "few hues", "gray and black", "colored", "gray and colored", "one color", "one pixel"],
)
def test_dimensions_are_those_of_the_colors(style: Style, dimensions: int | None) -> None:
    subspace = ColorSubspace.of(style)
    assert (subspace and subspace.dimensions) == dimensions


@pytest.mark.parametrize("image", [LINES, SEPIA, FEW_HUES], ids=["gray", "sepia", "few hues"])
def test_projection_is_the_nearest_color(image: Tensor) -> None:
    """It agrees with least squares in float64, and repeating it changes nothing."""
    subspace = ColorSubspace.of(Style.of(image))
    assert subspace is not None
    sh_dc = 2 * torch.randn((200, 3), generator=torch.Generator().manual_seed(2))
    projected = subspace.projected(sh_dc)
    pixels = image.reshape(-1, 3).double()
    axes = torch.linalg.svd(pixels - pixels.mean(dim=0), full_matrices=False).Vh[: subspace.dimensions].T
    colors = COLOR_OFFSET + SH_C0 * sh_dc.double() - pixels.mean(dim=0)
    expected = axes @ torch.linalg.lstsq(axes, colors.T).solution
    actual = COLOR_OFFSET + SH_C0 * projected.double() - pixels.mean(dim=0)
    torch.testing.assert_close(actual, expected.T, rtol=0, atol=1e-6)
    torch.testing.assert_close(subspace.projected(projected), projected, rtol=0, atol=1e-6)


def test_colors_are_free_where_the_settings_say_so() -> None:
    line, colored = Style.of(LINES), Style.of(COLORED)
    standard = make_settings("standard")
    assert color_subspace_of([line], standard) is not None
    assert color_subspace_of([line, colored], standard) is None
    assert color_subspace_of([line], make_settings("paper")) is None
    assert color_subspace_of([line], make_settings("standard", bounded=False)) is None
    assert color_subspace_of([line], make_settings("standard", preserve_colors="luminance")) is None


COEFFICIENT = st.floats(-1e6, 1e6, width=32)
COLOR = st.tuples(COEFFICIENT, COEFFICIENT, COEFFICIENT)
HIGHEST = 0.5 / SH_C0


def colors_of(sh_dc: torch.Tensor) -> torch.Tensor:
    return 0.5 + SH_C0 * sh_dc.double()


@given(st.lists(COLOR, min_size=1, max_size=8))
def test_channels_are_clamped_separately(rows: list[tuple[float, float, float]]) -> None:
    sh_dc = torch.tensor(rows, dtype=torch.float32)
    result = on_screen(sh_dc)
    shown = colors_of(result)
    assert float(shown.min()) >= 0
    assert float(shown.max()) <= 1
    inside = ((colors_of(sh_dc) >= 0) & (colors_of(sh_dc) <= 1)).all(dim=1)
    assert torch.equal(result[inside], sh_dc[inside])
    assert torch.allclose(shown, colors_of(sh_dc).clamp(0, 1), atol=1e-7)


@given(st.lists(COLOR, min_size=1, max_size=8))
def test_gray_shift_is_as_small_as_possible(rows: list[tuple[float, float, float]]) -> None:
    sh_dc = torch.tensor(rows, dtype=torch.float32).double()
    result = on_screen_by_luminance(sh_dc)
    shift = result - sh_dc
    size = 1 + sh_dc.abs().amax(dim=1)
    assert float(((shift - shift.mean(dim=1, keepdim=True)).abs().amax(dim=1) / size).max()) < 1e-12
    fits = sh_dc.amax(dim=1) - sh_dc.amin(dim=1) <= 2 * LARGEST * (1 - 1e-6)
    for before, after, fit in zip(sh_dc, result, fits, strict=True):
        outside = max(float(-LARGEST - before.min()), float(before.max() - LARGEST), 0.0)
        if fit:
            assert float(after.abs().max()) <= HIGHEST
            assert float((after - before).abs().max()) <= outside + 1e-5
        else:  # as far beyond white as beyond black
            assert float(after.min() + after.max()) == pytest.approx(0, abs=1e-9 * float(before.abs().max()))

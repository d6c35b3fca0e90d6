"""Tests of the line or plane that the colors of a style lie on."""

from __future__ import annotations

import io

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from sgsst_core.constants import COLOR_OFFSET, SH_C0
from sgsst_core.scene.colors import ColorSubspace, color_subspace_of, gray
from sgsst_core.settings import make_settings
from sgsst_core.style import Style
from tests.sgsst_core.synthetic_images import synthetic_image

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

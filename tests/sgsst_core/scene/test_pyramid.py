import pytest
import torch

from sgsst_core.scales import scale_count
from sgsst_core.scene.pyramid import add_upscaled_, downscale, style_size


@pytest.mark.parametrize(
    ("size", "count"),
    [((1, 1), 1), ((511, 4000), 1), ((512, 512), 2), ((1023, 2000), 2), ((1024, 1024), 3), ((3361, 5187), 4)],
)
def test_scale_count_follows_from_the_shorter_side(size, count):
    assert scale_count(*size) == count
    assert scale_count(*size[::-1]) == count
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


def test_downscaling_twice_equals_downscaling_once():
    image = torch.rand((64, 48, 3), dtype=torch.float64)
    torch.testing.assert_close(downscale(downscale(image, 1), 2), downscale(image, 3), rtol=1e-14, atol=0)


def test_style_is_downscaled_but_never_upscaled():
    assert style_size((1520, 1920), (500, 700)) == (500, 632)
    assert style_size((540, 900), (500, 700)) == (540, 900)
    assert style_size((300, 200), (500, 700)) == (300, 200)

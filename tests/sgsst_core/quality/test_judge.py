"""Tests of the judge and of LPIPS, against plain float64 formulas and on scenes with known outcomes."""

import numpy as np
import pytest
import scipy.linalg
import torch
import torch.nn.functional as F
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from skimage import data
from skimage.metrics import structural_similarity
from torch import Tensor

from benchmarks.methods import VggLpips
from sgsst_core.constants import SH_C0
from sgsst_core.errors import WeightsError
from sgsst_core.features.network_weights import load_perceptual
from sgsst_core.quality.judge import (
    JUDGED_SIDE,
    MIN_SIDE,
    Judge,
    Judgment,
    Lpips,
    load_lpips_or_none,
    saturated,
    ssim,
)
from sgsst_core.rasterizer.cpu import CpuRasterizer
from sgsst_core.regions import Region, Regions
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.colors import resize_area, style_size
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import reference_rest_colors
from sgsst_core.style import Style
from sgsst_core.stylizing.styles import JobStyles
from tests.sgsst_core.rasterizer.splat_reference import ReferenceRasterizer
from tests.sgsst_core.synthetic_images import synthetic_image
from tests.small_scenes import ball, blind_camera, cameras, style, wall

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def alex(vgg16_weights: object) -> Lpips:
    """Load LPIPS with AlexNet in float32. Its weights are installed together with VGG16's."""
    return Lpips()


def judge_of(lpips: Lpips, scene: Scene, views: list[Camera], style_image: Tensor | None = None) -> Judge:
    return Judge(lpips, style() if style_image is None else style_image, scene, CpuRasterizer(scene), views)


def judged(judge: Judge, sh_dc: Tensor) -> Judgment:
    judgment = judge.judge(sh_dc)
    assert judgment is not None
    return judgment


def plain(scene: Scene, sh_dc: Tensor, camera: Camera, style_image: Tensor) -> tuple[list[float], dict[str, float]]:
    """Compute a view's style distances on black and on white, and its other measures, in plain loops."""
    lpips = Lpips(dtype=torch.float64)
    rasterizer = ReferenceRasterizer(scene)
    rest = reference_rest_colors(scene.sh_rest, scene.means, camera, scene.sh_degree).double()
    coverage = rasterizer.coverage(camera).double()
    styles, palettes, contents, similarities = [], [], [], []
    for behind in (0.0, 1.0):
        shown = []
        for dc in (sh_dc, scene.sh_dc):
            image = rasterizer.render((0.5 + SH_C0 * dc.double() + rest).clamp_min(0), camera)
            shown.append((image + (1 - coverage)[..., None] * behind).clamp(0, 1))
        own = lpips.features(shown[0])
        wanted = lpips.features(resize_area(style_image, (58, 48)).double())  # the view's shorter side is 48
        distances = []
        for x, z in zip(own, wanted, strict=True):
            height, width = x.shape[:2]
            a = F.adaptive_avg_pool2d(coverage[None, None], (height, width))[0, 0]
            gram = sum(a[i, j] * torch.outer(x[i, j], x[i, j]) for i in range(height) for j in range(width)) / a.sum()
            target = torch.einsum("ijc,ijd->cd", z, z) / (z.shape[0] * z.shape[1])
            distances.append(float((gram - target).norm() / target.norm()))
        styles.append(float(np.mean(distances)))
        contents.append(float((lpips.distance(*shown) * coverage).sum() / coverage.sum()))
        similarities.append(np.average(published_ssim(*shown), weights=coverage.numpy()))
        mass = coverage.reshape(-1).numpy()
        pixels, others = shown[0].reshape(-1, 3).numpy(), style_image.double().reshape(-1, 3).numpy()
        mean, other = np.average(pixels, axis=0, weights=mass), others.mean(axis=0)
        spread, other_spread = np.cov(pixels.T, aweights=mass, bias=True), np.cov(others.T, bias=True)
        shared = scipy.linalg.sqrtm(spread @ other_spread).real
        palettes.append(255 * np.sqrt(((mean - other) ** 2).sum() + np.trace(spread + other_spread - 2 * shared)))
    measures = {"color_distance": palettes, "content": contents, "ssim": similarities}
    return styles, {name: float(np.mean(values)) for name, values in measures.items()}


def published_ssim(first: Tensor, second: Tensor) -> NDArray[np.float64]:
    """Return the map of SSIM with the published window and constants by scikit-image."""
    x, y = (image.double().numpy() @ [0.299, 0.587, 0.114] for image in (first, second))
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    return structural_similarity(x, y, data_range=1.0, full=True, **options)[1]


@pytest.mark.parametrize("scene", [wall(sh_degree=1), ball()], ids=["wall", "ball"])
def test_agrees_with_plain_formulas_in_float64(alex: Lpips, scene: Scene) -> None:
    view = cameras(1)[0]
    other = torch.randn(len(scene), 3, generator=torch.Generator().manual_seed(3))
    judgment = judged(judge_of(alex, scene, [view]), other)
    styles, others = plain(scene, other, view, style())
    assert judgment.style == pytest.approx(sum(styles) / 2, rel=1e-4)
    assert judgment.background_sensitivity == pytest.approx(abs(styles[0] - styles[1]), abs=1e-4)
    assert {name: getattr(judgment, name) for name in others} == pytest.approx(others, rel=1e-3)


def test_unstylized_scene_has_no_content_difference(alex: Lpips) -> None:
    scene = ball()
    judgment = judged(judge_of(alex, scene, cameras(2)), scene.sh_dc)
    assert (judgment.content, judgment.ssim) == (0, 1)
    assert judgment.background_sensitivity > 0  # an object has a background


def test_blind_views_are_skipped(alex: Lpips) -> None:
    scene = ball()
    assert [camera.name for camera in judge_of(alex, scene, [blind_camera(), *cameras(1)]).cameras] == ["view_0"]
    assert judge_of(alex, scene, [blind_camera()]).judge(scene.sh_dc) is None
    assert judge_of(alex, scene, cameras(1, 30, 20)).judge(scene.sh_dc) is None  # too small for AlexNet


def test_large_views_are_judged_at_a_fixed_size(alex: Lpips) -> None:
    camera = judge_of(alex, ball(), cameras(1, 3000, 2250)).cameras[0]
    assert (camera.width, camera.height) == (JUDGED_SIDE, JUDGED_SIDE * 3 // 4)


@pytest.mark.parametrize("style_image", [torch.full((1, 1, 3), 0.5), torch.zeros(40, 40, 3), torch.ones(5, 900, 3)])
def test_extreme_styles_give_finite_values(alex: Lpips, style_image: Tensor) -> None:
    """The styles are a single pixel, a black image without variance, and a line."""
    scene = ball()
    judgment = judged(judge_of(alex, scene, cameras(1), style_image), torch.full_like(scene.sh_dc, -50.0))
    assert all(value is None or np.isfinite(value) for value in vars(judgment).values())
    assert judgment.saturated == 1


def test_interior_features_do_not_depend_on_the_background(alex: Lpips) -> None:
    """A change of uncovered pixels changes every other feature of a layer, and none inside."""
    generator = torch.Generator().manual_seed(5)
    image, other = torch.rand(2, 200, 240, 3, generator=generator)
    coverage = torch.zeros(200, 240)
    coverage[10:190, 20:210] = 1
    changed = torch.where(coverage[..., None] > 0, image, other)
    for layer, least in enumerate(alex.min_coverage(coverage)):
        difference = (alex.features(image)[layer] - alex.features(changed)[layer]).abs().amax(dim=2)
        assert least.shape == difference.shape
        assert bool((least == 1).any())
        assert bool((difference[least == 1] == 0).all())
        if layer == 0:  # deeper, a change may vanish in a maximum
            assert bool((difference[least < 1] > 0).all())


def test_interior_measures_agree_with_plain_formulas(alex: Lpips) -> None:
    """A wall that covers its views has interior features; weights of a mixture count pixels, not images."""
    scene, view = wall(), cameras(1, 240, 180)[0]
    images = (style(), style().flip(0).flip(2))
    judge = judge_of(alex, scene, [view], Style(images, (0.75, 0.25)))  # type: ignore[arg-type]
    judgment = judged(judge, scene.sh_dc)
    lpips, renders = Lpips(dtype=torch.float64), judge.renders(scene.sh_dc, view)
    coverage = CpuRasterizer(scene).coverage(view)
    grams, sliced = [], []
    for image in renders:
        wanted = [
            lpips.features(resize_area(one, style_size((one.shape[0], one.shape[1]), (180, 240)))) for one in images
        ]
        for layer, (own, least) in enumerate(zip(lpips.features(image), lpips.min_coverage(coverage), strict=True)):
            inside = own[least >= 0.9].numpy()
            if len(inside) < 64:
                continue
            theirs = [one[layer].flatten(0, 1).numpy() for one in wanted]
            target = sum(w * x.T @ x / len(x) for x, w in zip(theirs, (0.75, 0.25), strict=True))
            grams.append(np.linalg.norm(inside.T @ inside / len(inside) - target) / np.linalg.norm(target))
            random = torch.randn(inside.shape[1], 64, generator=torch.Generator().manual_seed(0))
            axes = F.normalize(random, dim=0).double().numpy()
            mass = np.concatenate([np.full(len(x), w / len(x)) for x, w in zip(theirs, (0.75, 0.25), strict=True)])
            difference, size = 0.0, 0.0
            for axis in axes.T:
                levels = (np.arange(256) + 0.5) / 256
                first = np.quantile(inside @ axis, levels, method="inverted_cdf")
                second = np.quantile(
                    np.concatenate([x @ axis for x in theirs]), levels, method="inverted_cdf", weights=mass
                )
                difference, size = difference + np.abs(first - second).mean(), size + np.abs(second).mean()
            sliced.append(difference / size)
    assert len(grams) >= 6
    assert judgment.interior_style == pytest.approx(np.mean(grams), rel=1e-4)
    assert judgment.sliced_features == pytest.approx(np.mean(sliced), rel=1e-3)


def test_objects_smaller_than_receptive_fields_have_no_interior_measures(alex: Lpips) -> None:
    judgment = judged(judge_of(alex, ball(), cameras(1)), ball().sh_dc)
    assert judgment.interior_style is None
    assert judgment.sliced_features is None


def test_out_of_range_colors_are_saturated() -> None:
    colors = torch.tensor([[-0.01, 0.5, 0.5], [0.5, 0.5, 0.5], [0.2, 1.3, 0.4], [0.9, 0.1, 0.5]])
    assert saturated((colors - 0.5) / SH_C0) == 0.5


def regions_of(scene: Scene, left: Tensor, right: Tensor, *, freeze: bool = False) -> JobStyles:
    every = (Region("rest", freeze=freeze), Region("right"))
    labels = (scene.means[:, 0] > 0).to(torch.uint8)
    regions = Regions(every, labels).resolved(torch.ones(len(scene)).double())
    each = (right,) if freeze else (left, right)
    return JobStyles(Style.of(left), regions, tuple(map(Style.of, each)))


def test_regions_are_judged_by_their_own_styles(alex: Lpips) -> None:
    scene, views = wall(), cameras(2)
    dark, bright = torch.full((64, 64, 3), 0.1), torch.full((64, 64, 3), 0.9)
    right = (scene.means[:, 0] > 0)[:, None]
    colors = (torch.where(right, 0.9, 0.1).expand(-1, 3) - 0.5) / SH_C0
    judgments = [
        judged(Judge(alex, styles, scene, CpuRasterizer(scene), views), colors)
        for styles in (regions_of(scene, dark, bright), regions_of(scene, bright, dark))
    ]
    assert judgments[0].color_distance < 60  # colors mix at the border
    assert judgments[1].color_distance > 150
    assert judgments[0].content == judgments[1].content


def test_frozen_gaussians_are_not_judged_by_a_style(alex: Lpips) -> None:
    scene, views = wall(), cameras(2)
    bright = torch.full((64, 64, 3), 0.9)
    right = (scene.means[:, 0] > 0)[:, None]
    colors = (torch.where(right, 0.9, 0.1).expand(-1, 3) - 0.5) / SH_C0
    styles = regions_of(scene, bright, bright, freeze=True)
    assert judged(Judge(alex, styles, scene, CpuRasterizer(scene), views), colors).color_distance < 60
    assert judged(judge_of(alex, scene, views, bright), colors).color_distance > 80


Array = NDArray[np.float64]


def test_ssim_agrees_with_scikit_image() -> None:
    first, second = synthetic_image(37, 50, seed=1), synthetic_image(37, 50, seed=2)
    values = ssim(first, second)
    np.testing.assert_allclose(values.numpy(), published_ssim(first, second), rtol=1e-9)
    assert float(values.mean()) < 0.9
    assert bool((ssim(first, first) == 1).all())


@pytest.fixture(scope="module", params=[Lpips, VggLpips], ids=["alex", "vgg"])
def exact(request: pytest.FixtureRequest, vgg16_weights: object) -> Lpips:
    """Load LPIPS in float64, with AlexNet and with VGG16."""
    return request.param(dtype=torch.float64)


def photo(name: str) -> Tensor:
    """Return a photo [H, W, 3], float64 from 0 to 1."""
    return torch.from_numpy(getattr(data, name)()).double() / 255


def box_blurred(image: Tensor, side: int) -> Tensor:
    planes = image.permute(2, 0, 1)[None]
    blurred = F.avg_pool2d(planes, side, 1, side // 2, count_include_pad=False)
    return blurred[0].permute(1, 2, 0).contiguous()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("network", [Lpips, VggLpips])
def test_zero_for_equal_images_and_symmetric(vgg16_weights, network, dtype):
    lpips = network(dtype=dtype)
    first, second = synthetic_image(37, 50, seed=1), synthetic_image(37, 50, seed=2)
    same = lpips.distance(first, first)
    assert same.shape == (37, 50)
    assert not same.any()
    forth, back = lpips.distance(first, second), lpips.distance(second, first)
    assert float(forth.mean()) > 0.01
    assert torch.equal(forth, back)


def test_float32_agrees_with_float64(exact: Lpips):
    first, second = synthetic_image(45, 61, seed=3), synthetic_image(45, 61, seed=4)
    reference, result = exact.distance(first, second), type(exact)().distance(first, second)
    assert result.dtype == torch.float32
    torch.testing.assert_close(result.double(), reference, rtol=1e-4, atol=1e-6)


#: Photo that 150 x 120 pixels are taken from, image it is compared with, and values of the published PyTorch package
#: (`lpips` 0.1.4 with these weights, in float64) for each network.
PUBLISHED = [
    ("astronaut", lambda image: image**0.7, {"alex": 0.034148751276, "vgg": 0.034614063853}),
    ("astronaut", lambda image: box_blurred(image, 5), {"alex": 0.286169259936, "vgg": 0.231598830021}),
    ("coffee", lambda image: image**0.7, {"alex": 0.021160692171, "vgg": 0.016917227824}),
    ("coffee", lambda image: box_blurred(image, 5), {"alex": 0.166752439171, "vgg": 0.217724184752}),
]


@pytest.mark.parametrize(("name", "changed", "expected"), PUBLISHED, ids=["curve", "blur"] * 2)
def test_agrees_with_the_published_code(exact: Lpips, name, changed, expected):
    image, value = photo(name)[100:220, 150:300], expected[exact.network]
    result = exact.distance(image, changed(image))
    assert float(result.mean()) == pytest.approx(value, rel=2e-3)  # upsampling weighs the border differently


def test_agrees_with_a_direct_formulation_in_numpy(vgg16_weights):
    """Both networks have the same code for heads and maps, so that one suffices; `PUBLISHED` has values of both."""
    first, second = synthetic_image(47, 63, seed=5), synthetic_image(47, 63, seed=6)
    expected = lpips_directly(first.numpy(), second.numpy())
    result = Lpips(dtype=torch.float64).distance(first, second)
    np.testing.assert_allclose(result.numpy(), expected, rtol=1e-5, atol=1e-9)


def lpips_directly(first: Array, second: Array) -> Array:
    """Compute LPIPS by equation 1 of the paper, with input from -1 to 1 as in the published code."""
    tensors = {name: tensor.double().numpy() for name, tensor in load_perceptual().items()}
    spatial = np.zeros(first.shape[:2])
    scaled = [(2 * rgb - 1 - [-0.030, -0.088, -0.188]) / [0.458, 0.448, 0.450] for rgb in (first, second)]
    for layer, (x, y) in enumerate(zip(*(alexnet_directly(x, tensors) for x in scaled), strict=True), start=1):
        x, y = (f / (np.sqrt((f * f).sum(axis=2, keepdims=True)) + 1e-10) for f in (x, y))
        distances = ((x - y) ** 2 * tensors[f"linear{layer}.weight"]).sum(axis=2)
        spatial += upsampled(distances, first.shape[:2])
    return spatial


def alexnet_directly(x: Array, tensors: dict[str, Array]) -> list[Array]:
    outputs = []
    for layer, (stride, padding) in enumerate([(4, 2), (1, 2), (1, 1), (1, 1), (1, 1)], start=1):
        if layer in (2, 3):
            x = sliding_window_view(x, (3, 3), axis=(0, 1))[::2, ::2].max(axis=(3, 4))
        x = convolved(x, tensors[f"conv{layer}.weight"], tensors[f"conv{layer}.bias"], stride, padding)
        outputs.append(x)
    return outputs


def convolved(x: Array, weight: Array, bias: Array, stride: int, padding: int) -> Array:
    """Apply a convolution [out, in, k, k] and its ReLU to x [h, w, in]."""
    x = np.pad(x, ((padding, padding), (padding, padding), (0, 0)))
    windows = sliding_window_view(x, weight.shape[2:], axis=(0, 1))[::stride, ::stride]
    return np.maximum(np.tensordot(windows, weight, axes=([2, 3, 4], [1, 2, 3])) + bias, 0)


def upsampled(values: Array, size: tuple[int, ...]) -> Array:
    """Upsample bilinearly, with pixel centers at half-integers and replicated borders."""

    def matrix(cells: int, pixels: int) -> Array:
        positions = np.clip((np.arange(pixels) + 0.5) * cells / pixels - 0.5, 0, cells - 1)
        return np.maximum(0, 1 - np.abs(positions[:, None] - np.arange(cells)))

    return matrix(values.shape[0], size[0]) @ values @ matrix(values.shape[1], size[1]).T


def test_constant_images_are_finite(exact: Lpips):
    black, white = torch.zeros(40, 40, 3), torch.ones(40, 40, 3)
    for first, second in ((black, white), (black, black), (white, 0.5 * white)):
        assert exact.distance(first, second).isfinite().all()


def test_smallest_images_are_compared(exact: Lpips):
    first, second = synthetic_image(MIN_SIDE, 64, seed=7), synthetic_image(MIN_SIDE, 64, seed=8)
    assert float(exact.distance(first, second).mean()) > 0


def test_missing_weights_are_named(tmp_path):
    with pytest.raises(WeightsError, match="sgsst weights fetch vgg16"):
        Lpips(folder=tmp_path)


def test_lpips_is_skipped_without_installed_weights(vgg16_weights, tmp_path):
    assert load_lpips_or_none(folder=tmp_path) is None
    assert load_lpips_or_none() is not None
    (tmp_path / "lpips_alex.safetensors").write_bytes(b"no weights")
    with pytest.raises(WeightsError, match="damaged"):
        load_lpips_or_none(folder=tmp_path)

"""Tests of mixing several style images into one style, and of images that callers pass as arrays."""

from dataclasses import replace
from functools import reduce

import numpy as np
import pytest
import torch
from PIL import Image

from benchmarks.stability.sos_reference import layer_statistics_reference
from sgsst_core.errors import ImageError, SettingsError
from sgsst_core.features.statistics import merge
from sgsst_core.features.vgg import STYLE_LAYERS, FeatureNetwork
from sgsst_core.files.images import load_image
from sgsst_core.loss.sos import SosLoss
from sgsst_core.loss.terms import MAX_VECTORS, LayerTarget, positions_per_image
from sgsst_core.regions import Region, Regions
from sgsst_core.settings import make_settings
from sgsst_core.style import Style, image_of, mixed_moments, normalized
from sgsst_core.stylizing.stylizer import Stylizer
from tests.sgsst_core.synthetic_images import synthetic_image
from tests.small_scenes import cameras, wall


def features(seed, count=40, offset=0.0):
    generator = torch.Generator().manual_seed(seed)
    return offset + torch.rand((count, 5, 6), dtype=torch.float64, generator=generator)


def assert_same(actual, wanted, **tolerances):
    for name in ("gram", "mean", "std"):
        torch.testing.assert_close(getattr(actual, name), getattr(wanted, name), **tolerances)


def test_mixture_has_the_moments_of_all_positions():
    """Images with positions in proportion to their weights have the moments of their union."""
    parts = [features(1, 40), features(2, 10, offset=0.3)]
    statistics = [layer_statistics_reference(part) for part in parts]
    mixed = LayerTarget.mixed([LayerTarget.of(part) for part in statistics], normalized([4, 1]))
    assert_same(mixed, LayerTarget.of(reduce(merge, statistics)), rtol=1e-12, atol=1e-14)


def test_targets_use_each_image_at_its_own_size(tiny_weights):
    images, weights = [synthetic_image(300, 90, seed=1), synthetic_image(40, 64, seed=2)], [3.0, 1.0]
    loss = SosLoss(FeatureNetwork(tiny_weights, dtype=torch.float64), coarsest=40)
    mixed = loss.targets.of_style(Style.weighted(images, weights), (64, 80))
    single = [loss.targets.of_style(Style.of(each), (64, 80)) for each in images]
    for scale, (target,) in mixed.items():
        assert set(target.layers) == set(STYLE_LAYERS)
        for layer, statistics in target.layers.items():
            wanted = LayerTarget.mixed([each[scale][0].layers[layer] for each in single], [0.75, 0.25])
            assert_same(statistics, wanted, rtol=1e-13, atol=1e-15)


def test_tiny_image_is_ignored_in_layers_without_cells(tiny_weights):
    loss = SosLoss(FeatureNetwork(tiny_weights, dtype=torch.float64))
    large, tiny = synthetic_image(64, 64), synthetic_image(7, 7, seed=2)
    mixed = loss.targets.of_style(Style.weighted([large, tiny], [1, 9]), (64, 64))[0][0].layers
    alone = loss.targets.of_style(Style.of(large), (64, 64))[0][0].layers
    assert_same(mixed["relu4_1"], alone["relu4_1"], rtol=0, atol=0)
    assert not torch.equal(mixed["relu1_1"].mean, alone["relu1_1"].mean)


def test_number_of_vectors_is_limited_in_proportion_to_weights():
    cases = ([MAX_VECTORS, MAX_VECTORS], [0.75, 0.25]), ([3, 10**6], [0.9, 0.1]), ([3, 4], [0.1, 0.9])
    assert [positions_per_image(*case, MAX_VECTORS) for case in cases] == [[6144, 2048], [3, 819], [3, 4]]
    assert positions_per_image([10**6, 10**6], [1 - 1e-9, 1e-9], MAX_VECTORS)[1] == 1


@pytest.mark.parametrize("weights", [[], [1.0, 0.0], [1.0, -1.0], [float("nan")], [float("inf"), 1.0]])
def test_invalid_weights_are_refused(weights):
    with pytest.raises(SettingsError, match="style image"):
        normalized(weights)


def test_weights_of_any_size_are_normalized():
    assert normalized([1e308, 1e308]) == (0.5, 0.5)
    assert (normalized([1e-300, 3e-300]), normalized([0.3])) == (pytest.approx((0.25, 0.75)), (1.0,))


def test_mixture_has_the_color_moments_of_its_images():
    pixels = [torch.rand(30, 3, generator=torch.Generator().manual_seed(s)).double() for s in (1, 2)]
    moments = [(part.mean(0), part.T.cov(correction=0)) for part in pixels]
    mean, covariance = mixed_moments(moments, [0.5, 0.5])
    together = torch.cat(pixels)
    torch.testing.assert_close(mean, together.mean(0))
    torch.testing.assert_close(covariance, together.T.cov(correction=0))


BYTES = (synthetic_image(30, 20) * 255).round().to(torch.uint8)
FLOATS = BYTES / 255


@pytest.mark.parametrize(
    "given",
    [
        BYTES,
        BYTES.numpy(),
        FLOATS,
        FLOATS.double(),
        FLOATS.double().numpy().astype(">f8"),
        FLOATS.permute(2, 0, 1),
        BYTES.numpy()[:, :, ::-1][:, :, ::-1],
        FLOATS.clone().requires_grad_(),
        torch.cat([BYTES, torch.full((30, 20, 1), 255, dtype=torch.uint8)], dim=2),
    ],
    ids=["uint8", "numpy", "floats", "double", "big-endian", "CHW", "negative-strides", "gradient", "RGBA"],
)
def test_arrays_are_converted_to_float_images(given):
    converted = image_of(given)
    torch.testing.assert_close(converted, FLOATS, rtol=0, atol=1e-7)
    assert converted.is_contiguous()
    assert not converted.requires_grad


@pytest.mark.parametrize("mode", ["L", "RGB", "RGBA"])
def test_arrays_are_converted_as_by_load_image(tmp_path, mode):
    image = Image.fromarray(BYTES.numpy()).convert(mode)
    if mode == "RGBA":
        image.putalpha(Image.linear_gradient("L").resize(image.size))
    image.save(tmp_path / "style.png")
    read = load_image(tmp_path / "style.png")
    tolerance = 1 / 255 if mode == "RGBA" else 0  # files are composited in 8 bits
    torch.testing.assert_close(image_of(np.asarray(image)), read, rtol=0, atol=tolerance + 1e-7)


@pytest.mark.parametrize(
    ("given", "problem"),
    [
        (255 * FLOATS, "values from 60 to 201, .*Divide values in 0..255 by 255"),
        (FLOATS - 0.5, "values from -0.2647 .*clamp others"),
        (torch.full((4, 4, 3), torch.nan), "holds NaN"),
        (BYTES.long(), "dtype int64. Give uint8"),
        (np.zeros((4, 4, 3), bool), "dtype bool. Give uint8"),
        (np.array([[["a"]]]), "dtype <U1. Give uint8"),
        (FLOATS[None], r"shape \[1, 30, 20, 3\].*without a batch dimension"),
        (FLOATS[:, :, :2], r"shape \[30, 20, 2\]"),
        (FLOATS[:0], r"shape \[0, 20, 3\]"),
        ("style.jpg", "is a str.*Read files with `load_image`"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_invalid_arrays_are_refused_with_a_message(given, problem):
    with pytest.raises(ImageError, match=problem):
        image_of(given)


def test_styles_of_jobs_and_regions_are_checked(tiny_weights):
    """Values in 0..255 would make the scene white."""
    scene, settings = wall(), make_settings("preview", steps_sos=1)
    regions = Regions((Region("rest"), Region("left", style=Style((255 * FLOATS,)))), torch.ones(len(scene)).byte())
    for given, where in ((255 * FLOATS, None), (Style((FLOATS, 255 * FLOATS), (0.5, 0.5)), None), (FLOATS, regions)):
        with pytest.raises(ImageError, match="by 255"):
            Stylizer.planned(scene, cameras(1), given, settings, weights=tiny_weights, regions=where)
    own = replace(regions.every[1], style=Style((BYTES,)))
    regions = replace(regions, every=(regions.every[0], own))
    jobs = [
        Stylizer.planned(scene, cameras(1), given, settings, weights=tiny_weights, regions=where).job
        for given, where in ((BYTES.numpy(), None), (FLOATS, None), (FLOATS, regions))
    ]
    assert all(torch.equal(job.styles.own.images[0], FLOATS) for job in jobs)

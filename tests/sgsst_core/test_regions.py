"""Tests of regions: selection by masks, position, property and files of flags; content weights by region."""

import io
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from benchmarks.stability.sos_reference import sos_reference
from sgsst_core.errors import MaskError, SettingsError
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.vgg import FeatureNetwork
from sgsst_core.files.scene_file import SceneFile, read_scene
from sgsst_core.loss.sos import SosLoss, SosResult
from sgsst_core.quality.measure import Float32Reference
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.rasterizer.cpu import CpuRasterizer
from sgsst_core.rasterizer.reference import ReferenceRasterizer
from sgsst_core.regions import (
    ContentMaps,
    Region,
    Regions,
    check_regions,
    count_votes,
    decide_by_votes,
    in_box,
    in_half_space,
    in_sphere,
    read_mask,
    where_property,
)
from sgsst_core.settings import make_settings
from sgsst_core.style import Style
from sgsst_core.stylizing.loop import run
from sgsst_core.stylizing.stylizer import Stylizer
from tests.sgsst_core.synthetic_images import relative_error, synthetic_image
from tests.small_scenes import LFS_POINTER, ball, cameras, style, wall, write_files


def test_votes_are_blend_weights_in_white_mask_pixels():
    """The reference is the image of one Gaussian with color 1."""
    scene, views = wall(8, 6), cameras(2)
    rasterizer = make_rasterizer("cpu", scene)
    masks = [torch.rand(view.height, view.width, generator=torch.Generator().manual_seed(7)) for view in views]
    inside, total = count_votes(rasterizer, views, [lambda mask=mask: mask for mask in masks], len(scene))
    for index in (0, 20, 47):
        colors = torch.zeros(len(scene), 3)
        colors[index] = 1
        shown = [rasterizer.render(colors, view)[:, :, 0].double() for view in views]
        wanted = sum(float((own * mask).sum()) for own, mask in zip(shown, masks, strict=True))
        torch.testing.assert_close(float(inside[index]), wanted, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(float(total[index]), float(sum(own.sum() for own in shown)), rtol=1e-4, atol=1e-5)


def test_undecided_and_unseen_gaussians_follow_their_neighbors():
    places = torch.arange(12.0)[:, None] * torch.tensor([1.0, 0, 0])
    total = torch.ones(12, dtype=torch.float64)
    inside = torch.tensor([0.0] * 3 + [1.0] * 9, dtype=torch.float64)
    inside[10], inside[0] = 0.45, 0.55  # between
    total[11] = inside[11] = 0
    decided = decide_by_votes(places, inside, total)
    assert decided[1:].tolist() == [False, False, *[True] * 9]
    inside[5] = 0.39  # outvoted by a margin, whatever its neighbors are
    assert not bool(decide_by_votes(places, inside, total)[5])


def test_majority_decides_without_decided_neighbors():
    places = torch.randn(3, 3)
    inside, total = torch.tensor([0.55, 0.45, 0.0]).double(), torch.tensor([1.0, 1.0, 0.0]).double()
    assert decide_by_votes(places, inside, total).tolist() == [True, False, False]


NAN = float("nan")
MEANS = torch.tensor([[0.0, 0, 0], [1, 1, 1], [1, 2, 1], [-3, 0, 0], [NAN, 0, 0]])


@pytest.mark.parametrize(
    ("select", "numbers", "wanted"),
    [
        (in_box, (0, 0, 0, 1, 1, 1), [True, True, False, False, False]),
        (in_box, (1, 0, 1, 0, 1, 0), [True, True, False, False, False]),  # for any order of corners
        (in_sphere, (0, 0, 0, 3**0.5), [True, True, False, False, False]),
        (in_sphere, (0, 0, 0, 3), [True, True, True, True, False]),
        (in_half_space, (1, 0, 0, 1), [False, True, True, False, False]),  # on the side of its normal
        (in_half_space, (-2, 0, 0, 6), [False, False, False, True, False]),
    ],
)
def test_shapes_include_their_border(select, numbers, wanted):
    assert select(MEANS, numbers).tolist() == wanted


@pytest.mark.parametrize(
    ("sign", "wanted"),
    [
        (">", [False, False, True, False]),
        (">=", [False, True, True, False]),
        ("<", [True, False, False, False]),
        ("<=", [True, True, False, False]),
        ("=", [False, True, False, False]),
        ("!=", [True, False, True, False]),
    ],
)
def test_comparisons_use_float32_and_exclude_nan(sign, wanted):
    """0.1 is compared as float32 too; comparisons with NaN are false."""
    values = torch.tensor([0.0, 0.1, 0.2, NAN])
    assert where_property(values, sign, 0.1).tolist() == wanted
    assert where_property(values.double() * 10, sign, 1.0)[[0, 2, 3]].tolist() == [wanted[0], wanted[2], wanted[3]]


SIZE = (112, 150)

pytestmark = pytest.mark.usefixtures("one_thread")


# --- loss ----------------------------------------------------------------------------------------------------------


def images() -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return image, style, content, coverage and relative content weights, at most the coverage, of a view."""
    image, look, content, coverage = (synthetic_image(*SIZE, seed=seed) for seed in (1, 2, 3, 4))
    coverage = coverage[:, :, 0]
    coverage[:20] = 0
    weights = coverage * synthetic_image(*SIZE, seed=5)[:, :, 0] ** 4
    weights[:, :40] = 0
    return image, look, content, coverage, weights


def evaluate(
    network: FeatureNetwork, coverage: Tensor | None, weights: Tensor | None, tile_size: int | None
) -> SosResult:
    image, look, content, *_ = (each.to(network.dtype) for each in images())
    loss = SosLoss(network, content_weight=2e3, coarsest=60, tile_size=tile_size)
    view = loss.targets.of_view(content, coverage)
    view.content_weights = None if weights is None else loss.targets.position_weights(weights)
    return loss.evaluate(image, loss.targets.of_style(Style.of(look), SIZE), view)


@pytest.mark.parametrize(("tile_size", "covered"), [(None, False), (64, True)])
def test_loss_agrees_with_autograd(tiny_weights: BackboneWeights, tile_size: int | None, covered: bool) -> None:
    image, look, content, coverage, weights = images()
    given = coverage if covered else None
    expected, gradient = sos_reference(
        tiny_weights,
        image,
        look,
        content,
        content_weight=2e3,
        coverage=given,
        content_weights=weights,
        coarsest=60,
    )
    for dtype, bound in ((torch.float64, 1e-9), (torch.float32, 1e-5)):
        result = evaluate(FeatureNetwork(tiny_weights, dtype=dtype), given, weights, tile_size)
        assert result.loss == pytest.approx(expected, rel=bound)
        assert result.image_gradient is not None
        assert relative_error(result.image_gradient, gradient) < bound


def test_content_weight_of_1_everywhere_is_bit_identical_to_none(tiny_weights: BackboneWeights) -> None:
    coverage = images()[3]
    actual, wanted = (evaluate(FeatureNetwork(tiny_weights), coverage, own, None) for own in (coverage, None))
    assert torch.equal(actual.values, wanted.values)
    assert actual.image_gradient is not None
    assert wanted.image_gradient is not None
    assert torch.equal(actual.image_gradient, wanted.image_gradient)


# --- maps ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("weights", [(1.0, 3e4, 0.0), (1e-3, 1e12, 5.0)])
def test_maps_are_blended_weights(weights: tuple[float, ...]) -> None:
    """Small weights are accurate beside large ones, over any background."""
    scene, view = ball(), cameras()[0]
    labels = (torch.arange(len(scene)) % 7).clamp(max=2)
    by_gaussian = torch.tensor(weights)[labels]
    black = ReferenceRasterizer(scene)
    expected = torch.zeros(view.height, view.width, dtype=torch.float64)
    for label, weight in enumerate(weights):
        member = (labels == label).double()[:, None].expand(-1, 3).contiguous()
        expected += weight / max(weights) * black.render(member, view)[:, :, 0]
    for rasterizer in (ReferenceRasterizer, CpuRasterizer):
        maps = ContentMaps(by_gaussian, rasterizer(scene, background=(0.2, 0.4, 0.6))).render(view)
        assert maps.shape == (view.height, view.width, 1)
        torch.testing.assert_close(maps[:, :, 0].double(), expected, atol=1e-5, rtol=1e-4)
    background = black.coverage(view) == 0
    assert bool(background.any())
    assert bool((maps[background] == 0).all())


# --- regions -------------------------------------------------------------------------------------------------------


def protected(content_weight: float | None = 1e4, rest: Region | None = None, **treatment: Any) -> Regions:
    """Return regions of the wall whose right half has a content weight."""
    right = Region("right", content_weight=content_weight, **treatment)
    return Regions((rest or Region("rest"), right), (wall().means[:, 0] >= 0).to(torch.uint8))


@pytest.mark.parametrize(
    ("regions", "shares"),
    [
        (protected(), True),
        (protected(content_weight=0.0), True),
        (protected(content_weight=None), False),
        (protected(weight=2.0), False),
        (protected(weight=2.0, rest=Region("rest", weight=2.0)), True),
        (protected(style=Style.of(style())), False),
        (protected(rest=Region("rest", style=Style.of(style()))), False),
        (protected(rest=Region("rest", freeze=True)), False),
        (protected(rest=Region("rest", content_weight=5.0)), True),
    ],
)
def test_region_with_a_content_weight_alone_is_compared_together_with_the_rest(regions: Regions, shares: bool) -> None:
    assert torch.equal(regions.style_labels, torch.zeros_like(regions.labels) if shares else regions.labels)
    resolved = regions.resolved(torch.ones(len(regions.labels), dtype=torch.float64))
    frozen = regions.every[0].freeze
    assert resolved.active == ((0,) if shares else (1,) if frozen else (0, 1))
    assert torch.equal(resolved.labels, regions.labels)


def test_content_weight_of_each_gaussian() -> None:
    regions = protected(rest=Region("rest", content_weight=3.0))
    labels = regions.labels.bool()
    weights = regions.content_weights(1.0)
    assert weights is not None
    assert (weights[labels].unique().tolist(), weights[~labels].unique().tolist()) == ([1e4], [3.0])
    assert protected(content_weight=None).content_weights(1.0) is None
    assert protected(content_weight=7.0).content_weights(7.0) is None
    empty = replace(protected(), labels=torch.zeros_like(regions.labels))
    assert empty.content_weights(1.0) is None


def test_region_needs_a_content_term() -> None:
    with pytest.raises(SettingsError, match="--content-weight 0 disables the content term"):
        check_regions(protected(), content_weight=0.0)
    check_regions(protected(content_weight=None), content_weight=0.0)
    check_regions(protected(), content_weight=1.0)


# --- jobs ----------------------------------------------------------------------------------------------------------


def make(weights: BackboneWeights, regions: Regions | None, **values: Any) -> Stylizer:
    settings = make_settings(**{"steps_coarse": 2, "steps_sos": 4, "coarsest_side": 24, **values})
    return Stylizer.planned(wall(), cameras(), style(), settings, weights=weights, regions=regions)


@pytest.mark.slow
@pytest.mark.parametrize("treatment", [{"style": Style.of(style().flip(0, 2) ** 2)}])
def test_only_the_protected_region_stays_near_its_content(
    tiny_weights: BackboneWeights, treatment: dict[str, Any]
) -> None:
    scene = wall()
    options: dict[str, Any] = {"steps_sos": 25, "learning_rate_end": 0.02, "warm_start": False, "early_stop": False}
    plain, own = (make(tiny_weights, protected(weight, **treatment), **options) for weight in (1.0, 1e8))
    changes = []
    for stylizer in (plain, own):
        run(stylizer)
        changes.append((stylizer.stylized() - scene.sh_dc).square().sum(dim=1))
    seen, right = plain.job.plan.seen, scene.means[:, 0]
    parts = seen & (right > 0.7), seen & (right < -0.7)  # not near the border
    inside, outside = (float(changes[1][part].mean() / changes[0][part].mean()) for part in parts)
    assert inside < 0.8 * outside


def test_float32_reference_has_the_same_content_weights(tiny_weights: BackboneWeights) -> None:
    stylizer = make(tiny_weights, protected(), warm_start=False)
    scales = stylizer.job.scales(0)
    colors = torch.roll(wall().sh_dc, 1, dims=0)
    with stylizer.with_colors(colors):
        own = stylizer.gradient(0, scales)[0]
    exact = Float32Reference(stylizer).gradient(0, colors, scales)[0][stylizer.job.plan.seen]
    assert relative_error(own, exact) < 1e-6
    other = Float32Reference(make(tiny_weights, None, warm_start=False)).gradient(0, colors, scales)[0]
    assert relative_error(other[stylizer.job.plan.seen], exact) > 1e-2


def test_plan_and_report_state_the_content_weight(tiny_weights: BackboneWeights) -> None:
    stylizer = make(tiny_weights, protected())
    lines = {line.item: line.decision for line in stylizer.job.plan.decisions}
    assert lines["region right"].endswith("use the style, with content weight 10,000")
    assert "content weight" not in lines["region rest"]
    assert "regions" not in lines  # statistics are not weighted by region


@pytest.fixture
def file(tmp_path: Path) -> SceneFile:
    return read_scene(write_files(tmp_path, wall(5, 4))[0])


def npy(array: Any) -> bytes:
    content = io.BytesIO()
    np.save(content, array, allow_pickle=True)
    return content.getvalue()


def lying(shape: str, kind: str = "'|b1'") -> bytes:
    """Return a .npy file with 20 flags whose header declares this shape and type."""
    header = f"{{'descr': {kind}, 'fortran_order': False, 'shape': {shape}}}".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + bytes(20)


@pytest.mark.parametrize("kind", [bool, np.uint8, np.int64, np.float64])
def test_array_selects_its_rows(tmp_path: Path, file: SceneFile, kind: type) -> None:
    wanted = np.arange(20) % 3 == 0
    (tmp_path / "m.npy").write_bytes(npy(wanted.astype(kind)))
    assert read_mask(tmp_path / "m.npy", file).tolist() == wanted.tolist()


def test_lowest_bit_of_a_byte_is_its_first_gaussian(tmp_path: Path, file: SceneFile) -> None:
    (tmp_path / "m.BIN").write_bytes(bytes([0b00000011, 0b10000000, 0b00001000]))
    mask = read_mask(tmp_path / "m.BIN", file)
    assert (mask.dtype, mask.nonzero().flatten().tolist()) == (torch.bool, [0, 1, 15, 19])


@pytest.mark.parametrize("name", ["m.bin", "m.npy"])
def test_pointers_of_git_lfs_are_named(tmp_path: Path, file: SceneFile, name: str) -> None:
    (tmp_path / name).write_text(LFS_POINTER)
    with pytest.raises(MaskError, match=rf"{name}: is a pointer of Git LFS, not the file itself\. Run `git lfs pull`"):
        read_mask(tmp_path / name, file)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", r"has 0 bytes, but .* has 20 Gaussians. One bit for each makes 3 bytes"),
        (bytes(2), "has 2 bytes"),
        (bytes(1 << 20), "has 1,048,576 bytes"),
        (npy(np.zeros(20, bool)), "has 148 bytes"),
        (bytes([0, 0, 0b00010000]), "after that of the last of 20"),
        (b"\xff\xff\xff", "after that of the last of 20"),
        (None, "cannot be read: .*No such file"),
    ],
)
def test_invalid_bits_are_refused(tmp_path: Path, file: SceneFile, content: bytes | None, message: str) -> None:
    path = tmp_path / "m.bin"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(MaskError, match=message):
        read_mask(path, file)


def test_folder_is_no_mask(tmp_path: Path, file: SceneFile) -> None:
    for name in ("m.bin", "m.npy"):
        (tmp_path / name).mkdir()
        with pytest.raises(MaskError, match="cannot be read"):
            read_mask(tmp_path / name, file)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (npy(np.zeros(19)), r"has the shape \(19,\), but .* has 20 Gaussians"),
        (npy(np.zeros((20, 1))), r"has the shape \(20, 1\)"),
        (npy(np.full(20, 2)), "values other than 0 and 1"),
        (npy(np.full(20, np.nan)), "values other than 0 and 1"),
        (npy(np.array(["a"] * 20)), "does not hold an array of flags or numbers"),
        (npy(np.array([None] * 20)), "cannot be read as .npy"),
        (npy(np.zeros(20, [("a", "?")])), "does not hold an array of flags or numbers"),
        (lying("(99999999999,)"), "cannot be read as .npy"),
        (lying("(99999999999999999999999,)"), "cannot be read as .npy"),
        (lying("(-20,)"), "cannot be read as .npy"),
        (lying("(True,)"), "cannot be read as .npy"),
        (lying("()"), r"has the shape \(\)"),
        (lying("(" + "-" * 8000 + "20,)"), "cannot be read as .npy"),
        (lying("[" * 9000), "cannot be read as .npy"),
        (lying("(20,)", "'|O'"), "cannot be read as .npy"),
        (lying("(1,)", "('|b1', (20,))"), r"has the shape \(1, 20\)"),
        (lying("(2,)", "'<m8'"), "does not hold an array of flags or numbers"),
        (b"no npy at all", "cannot be read as .npy"),
        (b"PK\x03\x04", "cannot be read as .npy"),
        (b"\x93NUMPY\x01\x00\x02\x00{\n", "cannot be read as .npy"),
        (b"\x93NUMPY\x02\x00\xff\xff\xff\x7f{", "cannot be read as .npy"),
        (b"", "cannot be read as .npy"),
    ],
)
def test_invalid_arrays_are_refused(tmp_path: Path, file: SceneFile, content: bytes, message: str) -> None:
    (tmp_path / "m.npy").write_bytes(content)
    with pytest.raises(MaskError, match=message):
        read_mask(tmp_path / "m.npy", file)

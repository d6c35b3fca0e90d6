"""Tests of regions: selection, files of flags, content weights, and jobs with frozen regions or own styles."""

import io
import math
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from benchmarks.stability.sos_reference import sos_reference
from sgsst_core.constants import SH_C0
from sgsst_core.errors import MaskError, SettingsError
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.vgg import FeatureNetwork
from sgsst_core.files.scene_file import SceneFile, read_scene
from sgsst_core.loss.sos import SosLoss, SosResult
from sgsst_core.quality.measure import Float32Reference
from sgsst_core.rasterizer import Rasterizer, make_rasterizer
from sgsst_core.rasterizer.cpu import CpuRasterizer
from sgsst_core.rasterizer.triton import CachedRasterizer
from sgsst_core.regions import (
    ContentMaps,
    Region,
    RegionMaps,
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
from sgsst_core.scene.colors import resize_area, style_size
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import MAX_RESOLUTION, make_settings
from sgsst_core.style import Style
from sgsst_core.stylizing.checkpoint import Checkpoint, fingerprint, load_checkpoint, save_checkpoint, versions
from sgsst_core.stylizing.job import JobInputs, prepare_job
from sgsst_core.stylizing.loop import run
from sgsst_core.stylizing.styles import check_style_size, prepared_style, rotated
from sgsst_core.stylizing.stylizer import Stylizer
from tests.sgsst_core.rasterizer.splat_reference import ReferenceRasterizer
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


def test_float32_reference_has_the_same_content_weights(tiny_weights: BackboneWeights) -> None:
    stylizer = make(tiny_weights, wall(), protected(), warm_start=False)
    scales = stylizer.job.scales(0)
    colors = torch.roll(wall().sh_dc, 1, dims=0)
    own = stylizer.gradient(0, scales, colors[stylizer.job.plan.seen])[0]
    exact = Float32Reference(stylizer).gradient(0, colors, scales)[0][stylizer.job.plan.seen]
    assert relative_error(own, exact) < 1e-6
    other = Float32Reference(make(tiny_weights, wall(), None, warm_start=False)).gradient(0, colors, scales)[0]
    assert relative_error(other[stylizer.job.plan.seen], exact) > 1e-2


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


def other_style() -> Tensor:
    return style().flip(0, 2) ** 2


def halves(scene: Scene, left: Region | None = None, right: Region | None = None) -> Regions:
    """Return the regions left and right of x = 0, of which the left one is the background."""
    labels = (scene.means[:, 0] >= 0).to(torch.uint8)
    return Regions((left or Region("rest"), right or Region("right", style=Style.of(other_style()))), labels)


def make(weights: BackboneWeights, scene: Scene, regions: Regions | None, image: Tensor | None = None, **values: Any):
    settings = make_settings(**{"steps_coarse": 2, "steps_sos": 4, "coarsest_side": 24, **values})
    image = style() if image is None else image
    return Stylizer.planned(scene, cameras(), image, settings, weights=weights, regions=regions)


# --- maps ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "background"),
    [
        (CpuRasterizer, (0.0, 0.0, 0.0)),
        (CachedRasterizer, (0.3, 1.0, 0.1)),
        (ReferenceRasterizer, (0.3, 1.0, 0.1)),
    ],
)
def test_maps_sum_to_the_coverage(kind: type[Rasterizer], background: tuple[float, float, float]) -> None:
    scene, (view, *_) = ball(), cameras()
    labels = torch.arange(len(scene), dtype=torch.uint8) % 5
    labels[labels == 4] = 200
    rasterizer = kind(scene, background=background)
    maps = RegionMaps(labels, (0, 1, 2, 3, 200), rasterizer).render(view)
    assert maps.shape == (view.height, view.width, 5)
    torch.testing.assert_close(maps.sum(dim=2), rasterizer.coverage(view), atol=1e-5, rtol=0)
    black = make_rasterizer("cpu", scene)
    alone = black.render((labels == 200).float()[:, None].expand(-1, 3).contiguous(), view)[:, :, 0]
    torch.testing.assert_close(maps[:, :, 4].float(), alone, atol=1e-5, rtol=0)
    assert bool((maps[rasterizer.coverage(view) == 0] == 0).all())


# --- frozen regions ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("frozen_region", "values"),
    [
        ("rest", {"warm_start": True, "clamp_aware_gradient": True}),
        ("right", {"unseen": "neighbors", "views_per_step": 2, "background": (1.0, 0.5, 0.0)}),
        ("right", {"cached_weights": "half", "preserve_colors": "match", "style_loss": "mixed"}),
    ],
)
def test_frozen_gaussians_stay_bit_identical(
    tiny_weights: BackboneWeights, frozen_region: str, values: dict[str, Any]
) -> None:
    scene = wall(60, 40, sh_degree=1)  # extends beyond the views
    scene.sh_dc[::7] = -0.0
    keep = {"left": Region("rest", freeze=True)} if frozen_region == "rest" else {"right": Region("right", freeze=True)}
    regions = halves(scene, **keep)
    stylizer = make(tiny_weights, scene, regions, **values)
    assert run(stylizer) == "finished"
    bits, before = stylizer.stylized().view(torch.int32), scene.sh_dc.view(torch.int32)
    assert torch.equal(bits[regions.frozen], before[regions.frozen])
    changed = (bits != before).any(dim=1)
    assert bool(changed[stylizer.job.plan.optimized].all())
    assert bool(changed[~regions.frozen].all()) == (values.get("unseen") != "freeze")
    assert not bool((stylizer.job.plan.optimized & regions.frozen).any())


# --- styles of regions ---------------------------------------------------------------------------------------------


def test_region_of_everything_is_bit_identical_to_no_regions(tiny_weights: BackboneWeights) -> None:
    """Results are bit-identical, including unseen Gaussians."""
    scene = wall(60, 40, sh_degree=1)
    whole = Regions(
        (Region("rest"), Region("all", style=Style.of(other_style()))), torch.ones(len(scene), dtype=torch.uint8)
    )
    actual, wanted = make(tiny_weights, scene, whole), make(tiny_weights, scene, None, other_style())
    for stylizer in (actual, wanted):
        run(stylizer)
    assert torch.equal(actual.stylized(), wanted.stylized())
    assert [record.loss for record in actual.history] == [record.loss for record in wanted.history]


def test_each_region_approaches_its_own_style(tiny_weights: BackboneWeights) -> None:
    """A region does not approach another region's style; the styles are a uniform dark and a uniform bright image."""
    scene = wall()
    dark, bright = torch.full((40, 40, 3), 0.1), torch.full((40, 40, 3), 0.9)
    regions = halves(scene, right=Region("right", style=Style.of(bright)))
    stylizer = make(tiny_weights, scene, regions, dark, steps_sos=60, content_weight=0.0, early_stop=False)
    run(stylizer)
    labels, stylized = regions.labels[stylizer.job.plan.seen], stylizer.stylized()[stylizer.job.plan.seen]
    far = scene.means[stylizer.job.plan.seen][:, 0].abs() > 0.5  # features at the border see both regions
    left, right = (float((0.5 + 0.28209479 * stylized[(labels == place) & far]).mean()) for place in (0, 1))
    assert left < 0.4 < 0.6 < right


# --- resuming, reference and plan ----------------------------------------------------------------------------------


def test_resumed_job_is_bit_identical(tiny_weights: BackboneWeights, tmp_path: Path) -> None:
    scene = wall()
    regions = halves(scene, left=Region("rest", weight=2.0))
    whole, first = (make(tiny_weights, scene, regions) for _ in range(2))
    run(whole)
    for _ in range(3):
        first.run_step()
    save_checkpoint(tmp_path / "c", Checkpoint(first.state(), first.job.plan, 1, "r", versions()), "job")
    checkpoint = load_checkpoint(tmp_path / "c", "job")
    again = Stylizer(
        prepare_job(
            checkpoint.plan,
            JobInputs(scene, cameras(), Style.of(style()), first.job.settings, weights=tiny_weights, regions=regions),
        )
    )
    again.load_state(checkpoint.state)
    run(again)
    assert torch.equal(again.stylized(), whole.stylized())


_OTHER_TREATMENT: dict[str, Any] = {"weight": 2.0, "style": None, "freeze": True, "content_weight": 1.0}


def test_fingerprint_depends_on_regions() -> None:
    scene, views, settings = wall(), cameras(), make_settings()
    regions = halves(scene)
    moved = replace(regions, labels=1 - regions.labels)
    right = regions.every[1]
    others = [replace(right, **{name: value}) for name, value in _OTHER_TREATMENT.items()]
    every = [None, regions, moved, *(replace(regions, every=(regions.every[0], other)) for other in others)]
    fingerprints = [fingerprint(scene, views, Style.of(style()), settings, "w", "", each) for each in every]
    assert len(set(fingerprints)) == len(every)
    assert fingerprints[0] == fingerprint(scene, views, Style.of(style()), settings, "w")


def noise(height: int = 40, width: int = 60) -> torch.Tensor:
    return torch.rand(height, width, 3, generator=torch.Generator().manual_seed(0))


def ramp(height: int, width: int, slope_y: float, slope_x: float) -> torch.Tensor:
    """Return an image with a linear gradient and the value 0.5 at its center."""
    y = torch.arange(height) - (height - 1) / 2
    x = torch.arange(width) - (width - 1) / 2
    return (0.5 + slope_y * y[:, None] + slope_x * x).unsqueeze(2).expand(-1, -1, 3).contiguous()


def test_rotations_by_90_degrees_only_move_pixels() -> None:
    style = noise()
    assert torch.equal(rotated(style, 90), torch.rot90(style, 1, (0, 1)))
    assert torch.equal(rotated(style, -90), torch.rot90(style, -1, (0, 1)))
    assert torch.equal(rotated(style, 360), style)
    assert rotated(style, 180).is_contiguous()


@pytest.mark.parametrize("degrees", [1, 17, 45, 89, 107, -30, 200])
@pytest.mark.parametrize("size", [(80, 80), (60, 150), (150, 60)])
def test_brightness_ramp_rotates_with_the_image(degrees: float, size: tuple[int, int]) -> None:
    """Every pixel comes from inside the image: edges are not extended and nothing is filled in."""
    height, width = size
    image = rotated(ramp(height, width, 0.001, 0.002), degrees)[..., 0]
    angle = math.radians(degrees)
    # Counterclockwise, as seen with y pointing down: what was on the right moves up.
    slope_x = 0.002 * math.cos(angle) + 0.001 * math.sin(angle)
    slope_y = 0.001 * math.cos(angle) - 0.002 * math.sin(angle)
    wanted = ramp(image.shape[0], image.shape[1], slope_y, slope_x)[..., 0]
    shift = 0.0025  # the crop is half a pixel off center
    torch.testing.assert_close(image - image.mean(), wanted - wanted.mean(), atol=1e-4, rtol=0)
    assert abs(float(image.mean()) - 0.5) <= shift


def test_matched_colors_have_the_scenes_mean_and_covariance() -> None:
    generator = torch.Generator().manual_seed(1)
    colors = 0.5 + 0.08 * torch.randn(5000, 3, generator=generator) @ torch.tensor(
        [[1.0, 0.3, 0.0], [0.0, 1.0, 0.5], [0.0, 0.0, 0.4]]
    )
    weights = torch.rand(5000, generator=generator, dtype=torch.float64)
    settings = make_settings("standard", preserve_colors="match")
    style = 0.5 + 0.05 * torch.randn(64, 64, 3, generator=generator)
    (image,) = prepared_style(Style.of(style), settings, (colors - 0.5) / SH_C0, weights).images
    matched = image.reshape(-1, 3).double()
    share = (weights / weights.sum())[:, None]
    inside = colors.double().clamp(0, 1)
    mean = (share * inside).sum(dim=0)
    covariance = (share * (inside - mean)).T @ (inside - mean)
    torch.testing.assert_close(matched.mean(dim=0), mean, atol=1e-4, rtol=0)
    torch.testing.assert_close(matched.T.cov(correction=0), covariance, atol=1e-4, rtol=0)


def test_uniform_style_gets_the_mean_of_the_scene() -> None:
    settings = make_settings("standard", preserve_colors="match")
    gray = Style.of(torch.full((4, 4, 3), 0.9))
    (image,) = prepared_style(gray, settings, torch.zeros(10, 3), torch.ones(10).double()).images
    torch.testing.assert_close(image, torch.full((4, 4, 3), 0.5))


@pytest.mark.parametrize("scale", [0.5, 2.0])
def test_style_scale_uses_statistics_of_a_resized_style(tiny_weights: BackboneWeights, scale: float) -> None:
    style, view = noise(96, 120), (64, 96)
    size = style_size((96, 120), view, scale)
    assert size == (round(64 * scale), round(80 * scale))
    network = FeatureNetwork(tiny_weights)
    actual = SosLoss(network, style_scale=scale).targets.of_style(Style.of(style), view)[0][0]
    wanted = SosLoss(network).targets.of_style(Style.of(resize_area(style, size)), size)[0][0]
    for layer in actual.layers:
        torch.testing.assert_close(actual.layers[layer].gram, wanted.layers[layer].gram)


def test_style_size_has_the_limit_of_views() -> None:
    (view,) = cameras()[:1]
    line = Style.of(torch.zeros(1, 100, 3))
    most = MAX_RESOLUTION / 100
    check_style_size(line, [view], most)
    check_style_size(Style.of(torch.zeros(1, MAX_RESOLUTION + 1, 3)), [view], 1)  # the style is never enlarged
    with pytest.raises(SettingsError, match=rf"for views of {view.width} x {view.height}\. .* at most 16,384"):
        check_style_size(line, [view], most + 0.1)


def test_job_uses_the_prepared_style(tiny_weights: BackboneWeights) -> None:
    settings = make_settings("standard", style_rotation=90, preserve_colors="match", style_scale=2, coarsest_side=24)
    scene, style = wall(), noise()
    stylizer = Stylizer.planned(scene, cameras(), style, settings, weights=tiny_weights)
    (used,) = stylizer.job.styles.own.images
    assert used.shape == (60, 40, 3)
    assert stylizer.job.loss.style_scale == 2
    weights = stylizer.job.plan.survey.total_blend_weights
    (wanted,) = prepared_style(Style.of(style), settings, scene.sh_dc, weights).images
    assert torch.equal(used, wanted)
    stylizer.run_step()

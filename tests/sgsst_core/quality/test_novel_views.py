"""Tests of novel views: camera poses, Gram distances, and consistency on planes, whose warps are known exactly."""

import itertools
import math
import random
from collections.abc import Callable, Sequence
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from benchmarks.stability.sos_reference import box_average_reference, features_reference
from sgsst_core.constants import COARSEST_SHORTER_SIDE, COLOR_OFFSET, SH_C0
from sgsst_core.features.vgg import STYLE_LAYERS, FeatureNetwork, layer_stride
from sgsst_core.loss.sos import SosLoss
from sgsst_core.loss.terms import GRAM_WEIGHT
from sgsst_core.quality.judge import Lpips, shown
from sgsst_core.quality.novel_views import (
    Consistency,
    DepthMap,
    NovelViews,
    consistency,
    expected_depth,
    find_warp,
    neighbors,
    project_pixels,
    view_pairs,
)
from sgsst_core.rasterizer import Rasterizer, make_rasterizer
from sgsst_core.rasterizer.cpu import CpuRasterizer
from sgsst_core.scales import scale_count
from sgsst_core.scene.camera import Camera, between, look_at
from sgsst_core.scene.colors import resize_area, style_size
from sgsst_core.scene.gaussians import Scene, sampled
from sgsst_core.scene.spherical_harmonics import rest_colors, view_colors
from sgsst_core.style import Style
from tests.sgsst_core.objects import joined, ring
from tests.sgsst_core.rasterizer.splat_reference import ReferenceRasterizer
from tests.sgsst_core.splat_scenes import displaced
from tests.small_scenes import ball, blind_camera, cameras, style, wall

AXIS = torch.tensor([2.0, -1.0, 0.5], dtype=torch.float64)


def rotation(angle: float, axis: Tensor = AXIS) -> Tensor:
    """Return the matrix [3, 3] of the rotation by an angle about an axis, by Rodrigues' formula."""
    x, y, z = (axis / axis.norm()).tolist()
    cross = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    return torch.eye(3, dtype=torch.float64) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


def posed(orientation: Tensor, center: tuple[float, float, float] | Tensor, name: str = "a", width: int = 60) -> Camera:
    """Return a camera with a world-to-camera rotation `orientation` and a center."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = orientation
    pose[:3, 3] = -orientation @ torch.as_tensor(center, dtype=torch.float64)
    return Camera(name, width, 40, 55.0, 56.0, 31.0, 19.0, pose)


def cameras_between(views: list[Camera], covered: Sequence[int]) -> list[Camera]:
    """Return a camera between each pair of neighbors among the views with the indices `covered`."""
    return [between(*pair) for pair in neighbors([views[index] for index in covered])]


def angle_between(first: Camera, second: Camera) -> float:
    relative = first.world_to_camera[:3, :3] @ second.world_to_camera[:3, :3].T
    # Uses sine and cosine, so that small angles keep their digits.
    sine = torch.stack(
        [relative[2, 1] - relative[1, 2], relative[0, 2] - relative[2, 0], relative[1, 0] - relative[0, 1]]
    )
    return math.atan2(float(sine.norm()) / 2, (float(relative.trace()) - 1) / 2)


def names(novel: list[Camera]) -> list[str]:
    return [camera.name for camera in novel]


@pytest.mark.parametrize(
    ("first", "second", "middle"),
    [
        (0.2, 1.0, 0.6),
        (-0.4, 0.4, 0.0),
        (-0.1, 2 * math.pi - 0.3, -0.2),
        (0.0, math.pi - 1e-3, math.pi / 2 - 5e-4),
        (3.0, -3.0, math.pi),
    ],
)
def test_midpoint_halves_shortest_rotation_and_translation(first: float, second: float, middle: float):
    midpoint = between(
        posed(rotation(first), (1, -2, 3), "left"), posed(rotation(second), (2, 4, -5), "right", width=90)
    )
    assert midpoint.name == "left–right"
    torch.testing.assert_close(midpoint.world_to_camera[:3, :3], rotation(middle), rtol=0, atol=1e-13)
    torch.testing.assert_close(midpoint.center, torch.tensor([1.5, 1, -1], dtype=torch.float64), rtol=0, atol=1e-13)
    assert (midpoint.width, midpoint.height, midpoint.fx, midpoint.fy, midpoint.cx, midpoint.cy) == (
        60,
        40,
        55.0,
        56.0,
        31.0,
        19.0,
    )
    assert midpoint.world_to_camera[3].tolist() == [0, 0, 0, 1]


def test_one_novel_camera_lies_between_neighbors():
    row = cameras(5)
    for views, covered, between_names in (
        (row, range(5), [f"view_{i}–view_{i + 1}" for i in range(4)]),
        (row, [0, 1, 3], ["view_0–view_1", "view_1–view_3"]),
        (row[:2], [0, 1], ["view_0–view_1"]),
        *((views, range(len(views)), []) for views in (row[:1], [], [row[0]] * 3)),
        (row, [], []),
    ):
        assert names(cameras_between(views, covered)) == between_names
    assert names(cameras_between([row[0], *row], range(6)))[0] == "view_0–view_1"


def test_no_novel_camera_spans_a_jump_or_a_wide_rotation():
    near, far = ring(20), [replace(c, name="far " + c.name) for c in ring(20, radius=30)]
    between_names = names(cameras_between([*near[:8], *far[:8]], range(16)))
    assert between_names == [f"{i}–{i + 1}" for i in range(7)] + [f"far {i}–far {i + 1}" for i in range(7)]
    assert len(cameras_between(ring(6), range(6))) == 5  # 60 degrees between neighbors
    assert cameras_between(ring(5), range(5)) == []
    assert cameras_between([cameras(1)[0], blind_camera()], [0, 1]) == []
    upright = cameras(4)
    lying = [
        posed(rotation(math.pi / 2, torch.tensor([0.0, 0, 1])) @ c.world_to_camera[:3, :3], c.center)
        for c in upright[2:]
    ]
    assert names(cameras_between([*upright[:2], *lying], range(4))) == ["view_0–view_1", "a–a"]


@pytest.mark.parametrize("seed", range(5))
def test_unordered_cameras_are_sorted(seed: int):
    shuffled = ring(40)
    random.Random(seed).shuffle(shuffled)
    by_name = {camera.name: camera for camera in shuffled}
    novel = cameras_between(shuffled, range(40))
    assert len(novel) >= 38
    for camera in novel:
        parents = [by_name[name] for name in camera.name.split("–")]
        assert angle_between(*parents) < math.radians(3.5 * 360 / 40)
    following = [angle_between(*pair) for pair in itertools.pairwise(novel)]
    assert sum(angle < math.radians(2.5 * 360 / 40) for angle in following) >= 36


@pytest.fixture(scope="module")
def network(tiny_weights) -> FeatureNetwork:
    return FeatureNetwork(tiny_weights)


@pytest.fixture(scope="module")
def lpips(vgg16_weights) -> Lpips:
    return Lpips()


#: Shorter side of the coarsest scale in tests that need two scales of their small views.
COARSEST = 40


def novel_views(
    scene: Scene, views: list[Camera], network: FeatureNetwork, coarsest: int = COARSEST_SHORTER_SIDE, **options
) -> NovelViews:
    """Return the novel views of a job whose views all show the scene and have the same size."""
    loss = SosLoss(network, coarsest=coarsest)
    rasterizer = make_rasterizer("cpu", scene, background=(0.2, 0.3, 0.4))
    targets = {}

    def style_targets(camera: Camera):
        size = (camera.height, camera.width)
        if size not in targets:
            targets[size] = loss.targets.of_style(Style.of(style()), size)
        return targets[size]

    options = {"covered": range(len(views)), "weighted": False, **options}
    return NovelViews(views, scene=scene, rasterizer=rasterizer, loss=loss, style_targets=style_targets, **options)


def gram_reference(weights, image: Tensor, painting: Tensor, coverage: Tensor | None) -> dict[int, float]:
    """Compute for each scale the sum over layers of w_G mean((G - G_v)^2), in float64."""

    def gram(features: Tensor, position: Tensor | None) -> Tensor:
        flat = features.reshape(-1, features.shape[-1])
        a = torch.ones(len(flat), dtype=torch.float64) if position is None else position.reshape(-1)
        return (flat * a[:, None]).T @ flat / a.sum()

    result = {}
    for scale in range(scale_count(image.shape[0], image.shape[1], COARSEST)):
        side = 1 << scale
        seen, wanted = (
            features_reference(weights, box_average_reference(each.double(), side)) for each in (image, painting)
        )
        result[scale] = 0.0
        for layer in STYLE_LAYERS:
            position = None
            if coverage is not None:
                position = box_average_reference(coverage.double()[..., None], side * layer_stride(layer))[..., 0]
            error = gram(seen[layer], position) - gram(wanted[layer], None)
            result[scale] += GRAM_WEIGHT / error.shape[0] ** 2 * float(error.square().mean())
    return result


@pytest.mark.parametrize(("scene", "weighted"), [(wall(sh_degree=1), False), (ball(), True)], ids=["wall", "ball"])
def test_gram_distance_agrees_with_float64(tiny_weights, network, scene: Scene, weighted: bool):
    views = cameras(6)
    measured = novel_views(scene, views, network, coarsest=COARSEST, weighted=weighted)
    assert measured.views == [0, 1, 2, 3]
    sh_dc = 4 * scene.sh_dc  # colors far outside 0 to 1
    reference = ReferenceRasterizer(scene, background=(0.2, 0.3, 0.4))
    painting = resize_area(style(), style_size((96, 80), (48, 64)))
    expected: dict[int, float] = {0: 0.0, 1: 0.0}
    for first, second in itertools.pairwise(views[:5]):
        camera = between(first, second)
        image = reference.render(view_colors(sh_dc, rest_colors(scene.sh_rest, scene.means, camera)), camera)
        assert float(image.max()) > 1.2
        coverage = reference.coverage(camera) if weighted else None
        for scale, value in gram_reference(tiny_weights, image.clamp(0, 1), painting, coverage).items():
            expected[scale] += value / 4
    assert measured.measure(sh_dc).gram == pytest.approx(expected, rel=1e-4)


def test_gram_distance_is_relative_to_the_first_measurement(network):
    scene, views = wall(), cameras(4)
    measured = novel_views(scene, views, network)
    first = measured.measure(scene.sh_dc)
    assert first.gram_relative == 1.0
    assert measured.measure(scene.sh_dc) == first
    gray = measured.measure(torch.zeros_like(scene.sh_dc))
    assert gray.gram_relative == pytest.approx(gray.gram[0] / first.gram[0])
    assert abs(gray.gram_relative - 1) > 0.1


def test_view_that_sees_nothing_is_not_measured(network):
    up, middle = torch.tensor([0.0, -1.0, 0.0]), ball(400)
    sides = [torch.tensor([x, 0.0, 0.0]) for x in (-3.0, 3.0)]
    views = [
        look_at(str(i), side, side + torch.tensor([0.0, 0, 3]), up, width=64, height=48, focal=64)
        for i, side in enumerate(sides)
    ]
    two = joined(*(replace(middle, means=middle.means + side) for side in sides))
    measured = novel_views(two, views, network)
    assert (names(measured.cameras), measured.views) == (["0–1"], [])


def test_jobs_with_one_or_two_cameras_are_measured(network, lpips):
    scene = wall()
    alone = novel_views(scene, cameras(1), network)
    nothing = alone.measure(scene.sh_dc)
    assert (alone.cameras, alone.views) == ([], [])
    assert nothing.as_dict(0, 0.0) == {
        "step": 0,
        "seconds": 0.0,
        "gram": {},
        "gram_relative": None,
        "consistency": {"short": None, "long": None},
    }
    blind = novel_views(scene, [*cameras(1), blind_camera()], network, covered=[0])
    assert blind.views == []
    two = novel_views(scene, cameras(2), network, lpips=lpips).measure(scene.sh_dc)
    assert set(two.gram) == {0}
    assert two.short is two.long is None


def test_sample_of_a_large_scene_preserves_coverage_and_depth() -> None:
    """The sample of a ball of small Gaussians has about every fourth of them, at twice the size."""
    camera = cameras()[0]
    scene = ball(4001)
    scene = replace(scene, scales=scene.scales - 1.5)
    part = sampled(scene, 1001)
    assert len(part) == 1001
    looks = []
    for each in (scene, part):
        rasterizer = make_rasterizer("cpu", each)
        coverage, depth = rasterizer.coverage(camera), expected_depth(each, camera, rasterizer)
        looks.append((float(coverage.mean()), float(depth.depth[depth.known].median())))
    (covered, depth_of_all), (covered_by_part, depth_of_part) = looks
    assert covered_by_part == pytest.approx(covered, rel=0.25)
    assert depth_of_part == pytest.approx(depth_of_all, rel=0.1)
    whole = sampled(scene, len(scene))
    assert torch.equal(whole.means, scene.means)
    assert torch.equal(whole.scales, scene.scales)


#: A power of two, so that positions of planes stay exact when their world is moved by whole numbers.
SPACING = 1 / 16
DEPTH = 4.0


def plane(half_width: float, half_height: float, depth: float, color: Tensor | None = None) -> Scene:
    """Return opaque flat Gaussians on a rectangle around the z axis, with a smooth pattern or one color [3].

    Gaussians overlap, and nearer ones hide farther ones. A pixel therefore shows the pattern at a position that is
    shifted by up to two standard deviations toward the side of the plane that is nearer to the camera.
    """
    x = torch.arange(-half_width, half_width + SPACING / 2, SPACING)
    y = torch.arange(-half_height, half_height + SPACING / 2, SPACING)
    y, x = (t.flatten() for t in torch.meshgrid(y, x, indexing="ij"))
    means = torch.stack([x, y, torch.full_like(x, depth)], dim=1)
    pattern = torch.stack([torch.sin(1.6 * x), torch.sin(1.2 * y + 0.6 * x), torch.cos(x - 1.3 * y)], dim=1)
    rgb = 0.5 + 0.4 * pattern if color is None else color.expand(len(x), 3)
    scales = torch.tensor([SPACING, SPACING, SPACING / 100]).log().expand(len(x), 3)
    quats = torch.tensor([1.0, 0, 0, 0]).expand(len(x), 4)
    return Scene(means, quats, scales, torch.full_like(x, 8.0), (rgb - COLOR_OFFSET) / SH_C0, torch.zeros(len(x), 0, 3))


def camera(position: tuple[float, float, float], target: tuple[float, float, float] = (0, 0, DEPTH)) -> Camera:
    up = torch.tensor([0.0, -1.0, 0.0])
    return look_at("view", torch.tensor(position), torch.tensor(target), up, width=64, height=48, focal=70.0)


def arc(count: int) -> list[Camera]:
    """Return cameras on an arc in front of a plane, all of them nearer to the same side of it."""
    return [camera((0.12 * i + 0.3, 0.04 * i + 0.1, 0.02 * i)) for i in range(count)]


def renders(scene: Scene, cameras: list[Camera], rasterizer: Rasterizer):
    """Return a function that renders views of the scene in its own colors."""

    def image(index: int) -> Tensor:
        rest = rest_colors(scene.sh_rest, scene.means, cameras[index])
        return rasterizer.render(view_colors(scene.sh_dc, rest), cameras[index])

    return image


def consistency_of(
    images: Callable[[int], Tensor],
    cameras: list[Camera],
    rasterizer: Rasterizer,
    scene: Scene,
    gap: int,
    lpips: Lpips | None = None,
    at_most: int | None = None,
) -> Consistency:
    """Return the consistency of a scene's images over all pairs of views, or evenly spread ones."""

    def depth(index: int) -> DepthMap:
        return expected_depth(scene, cameras[index], rasterizer)

    return consistency(
        gap,
        view_pairs(len(cameras), gap, at_most),
        lambda index: shown(images(index), cameras[index], rasterizer.device),
        lambda first, second: find_warp(depth(second), cameras[second], depth(first), cameras[first]),
        lpips,
    )


def measure(scene: Scene, cameras: list[Camera], gap: int = 1, lpips: Lpips | None = None) -> Consistency:
    rasterizer = make_rasterizer("cpu", scene)
    return consistency_of(renders(scene, cameras, rasterizer), cameras, rasterizer, scene, gap, lpips)


def homography(camera: Camera, other: Camera) -> Tensor:
    """Return the homography [3, 3] from one view's pixels to another's, induced by the plane z = DEPTH.

    See Hartley and Zisserman, result 13.1.
    """

    def intrinsics(c: Camera) -> Tensor:
        return torch.tensor([[c.fx, 0, c.cx], [0, c.fy, c.cy], [0, 0, 1]], dtype=torch.float64)

    relative = other.world_to_camera @ torch.linalg.inv(camera.world_to_camera)
    normal = camera.world_to_camera[:3, :3] @ torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    distance = DEPTH - camera.center[2]
    motion = relative[:3, :3] + torch.outer(relative[:3, 3], normal) / distance
    return intrinsics(other) @ motion @ torch.linalg.inv(intrinsics(camera))


def pixel_centers(camera: Camera) -> Tensor:
    """Return homogeneous pixel centers [H, W, 3]."""
    y, x = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    return torch.stack([x + 0.5, y + 0.5, torch.ones(x.shape)], dim=-1).double()


@pytest.mark.parametrize(
    ("first", "tolerance"),
    [
        (camera((0.1, -0.2, 0), (0.1, -0.2, DEPTH)), 1e-4),  # parallel to the plane: all Gaussians have the same depth
        (camera((1.5, -0.5, 0)), 0.7),  # slanted: mean depths are biased to nearer Gaussians, by up to two deviations
    ],
    ids=["parallel", "slanted"],
)
@pytest.mark.parametrize("kind", [CpuRasterizer, ReferenceRasterizer])
def test_pixels_of_a_plane_move_by_its_homography(first: Camera, tolerance: float, kind: type[Rasterizer]):
    scene = plane(5, 4, DEPTH)
    other = replace(camera((-0.6, 0.4, 0.5)), width=80, height=40, fx=90.0, cx=37.0, cy=22.0)
    depth = expected_depth(scene, first, kind(scene))
    assert depth.known.all()
    x, y, z = project_pixels(depth.depth, 0, first, other)
    expected = pixel_centers(first) @ homography(first, other).T
    error = torch.stack([x, y], dim=-1) - expected[..., :2] / expected[..., 2:]
    assert float(error.abs().max()) < tolerance
    # Depth of the plane along the ray of each position in the other view.
    rays = torch.stack([(x - other.cx) / other.fx, (y - other.cy) / other.fy, torch.ones_like(x)], dim=-1)
    slope = (rays @ other.world_to_camera[:3, :3])[..., 2]
    torch.testing.assert_close(z, (DEPTH - other.center[2]) / slope, rtol=tolerance / 20, atol=0)


def test_pixels_hidden_in_the_other_view_are_masked():
    red, blue = torch.tensor([0.9, 0.1, 0.1]), torch.tensor([0.1, 0.1, 0.9])
    scene = joined(plane(6, 4, DEPTH, blue), plane(0.4, 0.4, 2.0, red))
    cameras = [camera((0, 0, 0)), camera((1, 0, 0), (1, 0, DEPTH))]
    rasterizer = make_rasterizer("cpu", scene)
    images = renders(scene, cameras, rasterizer)
    depths = [expected_depth(scene, c, rasterizer) for c in cameras]
    warped, valid = find_warp(depths[1], cameras[1], depths[0], cameras[0]).apply(images(1))
    # A point (X, Y, 4) of the plane is hidden from the camera at (c, 0, 0) if its ray meets the patch at z = 2.
    wall = (pixel_centers(cameras[0])[..., :2] - torch.tensor([32.0, 24.0])) / 70 * DEPTH

    def meets_patch(center: float, half: float) -> Tensor:
        return ((wall[..., 0] + center).abs() < 2 * half) & (wall[..., 1].abs() < 2 * half)

    edge = 3 * SPACING
    hidden = meets_patch(1, 0.4 - edge) & ~meets_patch(0, 0.4 + edge)
    visible = ~meets_patch(1, 0.4 + edge) & ~meets_patch(0, 0.4 + edge) & (wall[..., 0] > 1 - 31 / 70 * DEPTH)
    assert hidden.sum() > 50
    assert visible.sum() > 500
    assert not valid[hidden].any()
    assert valid[visible].all()
    careless, _ = find_warp(depths[1], cameras[1], depths[0], cameras[0], tolerance=1e9).apply(images(1))
    assert (careless - images(0))[hidden].abs().amax(-1).min() > 0.7  # the patch is painted onto the wall behind it
    assert measure(scene, cameras).rmse < 0.02
    assert float((warped - images(0))[valid].abs().max()) < 0.1


def test_inconsistent_colors_give_larger_values(lpips):
    scene = plane(5, 4, DEPTH)
    cameras = arc(3)
    rasterizer = make_rasterizer("cpu", scene)
    same = measure(scene, cameras, lpips=lpips)

    def flickering(index: int) -> Tensor:
        colors = torch.rand(len(scene), 3, generator=torch.Generator().manual_seed(index))
        return rasterizer.render(colors, cameras[index])

    different = consistency_of(flickering, cameras, rasterizer, scene, 1, lpips)
    assert same.rmse < 0.005
    assert same.lpips < 0.005
    assert different.rmse > 20 * same.rmse
    assert different.lpips > 5 * same.lpips
    assert different.compared == same.compared > 0.8


def test_rmse_covers_compared_pixels_of_clamped_images():
    scene = plane(5, 4, DEPTH)
    cameras = arc(2)
    rasterizer = make_rasterizer("cpu", scene)
    result = consistency_of(lambda i: torch.full((48, 64, 3), [0.25, 1.5][i]), cameras, rasterizer, scene, 1)
    assert result.rmse == pytest.approx(0.75, rel=1e-6)
    assert result.lpips is None


def test_pairs_without_overlap_have_no_value(lpips):
    scene = plane(2, 2, DEPTH)
    behind = camera((0, 0, 0), (0, 0, -DEPTH))  # looks away from the plane and sees nothing
    other_side = camera((0, 0, 3 * DEPTH))  # sees the plane from behind, which is the same surface
    cameras = [camera((0, 0, 0)), behind, behind, other_side, camera((0.1, 0, 3 * DEPTH))]
    result = measure(scene, cameras, lpips=lpips)
    last = measure(scene, cameras[3:], lpips=lpips)
    assert last.rmse is not None
    assert (result.pairs, result.rmse, result.lpips) == (4, last.rmse, last.lpips)
    assert result.compared == pytest.approx(last.compared / 4)
    nothing = measure(scene, cameras[:2], lpips=lpips)
    assert (nothing.rmse, nothing.lpips, nothing.compared) == (None, None, 0.0)


def test_distance_from_the_origin_does_not_change_values():
    scene = plane(5, 4, DEPTH)
    offset = torch.tensor([2.0**18, -(2.0**17), 2.0**19])
    far = [displaced(scene, view, offset) for view in arc(3)]
    near_result, far_result = measure(scene, arc(3)), measure(far[0][0], [view for _, view in far])
    assert far_result.rmse == pytest.approx(near_result.rmse, rel=1e-3)
    assert far_result.compared == pytest.approx(near_result.compared, abs=1e-3)


def test_pairs_are_all_or_evenly_spread():
    assert view_pairs(5, 2) == [(0, 2), (1, 3), (2, 4)]
    assert view_pairs(2, 2) == view_pairs(0, 1) == []
    assert view_pairs(97, 7, at_most=3) == [(15, 22), (45, 52), (75, 82)]
    assert view_pairs(4, 1, at_most=9) == view_pairs(4, 1)

"""Tests of novel views: their camera poses, and quality measurements on them."""

from __future__ import annotations

import itertools
import json
import math
import random
from collections.abc import Sequence
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from benchmarks.stability.sos_reference import box_average_reference, features_reference
from sgsst_core import Stylizer, make_settings, run
from sgsst_core.constants import COARSEST_SHORTER_SIDE
from sgsst_core.features.vgg import STYLE_LAYERS, FeatureNetwork, layer_stride
from sgsst_core.files.camera_files import read_cameras
from sgsst_core.files.images import load_image
from sgsst_core.files.scene_file import read_scene
from sgsst_core.loss.sos import SosLoss
from sgsst_core.loss.terms import GRAM_WEIGHT
from sgsst_core.quality.judge import Lpips
from sgsst_core.quality.novel_views import LONG_RANGE, MAX_VIEWS, SHORT_RANGE, NovelViews, expected_depth, neighbors
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scales import scale_count
from sgsst_core.scene.camera import Camera, between, look_at, resized, spread
from sgsst_core.scene.gaussians import TENSORS, Scene, sampled
from sgsst_core.scene.pyramid import resize_area, style_size
from sgsst_core.scene.spherical_harmonics import rest_colors, view_colors
from sgsst_core.style import Style
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


def ring(count: int, radius: float = 3.0) -> list[Camera]:
    """Return cameras on a circle around the origin that look at it."""
    origin, up = torch.zeros(3), torch.tensor([0.0, -1.0, 0.0])
    angles = [2 * math.pi * i / count for i in range(count)]
    return [
        look_at(
            str(i),
            torch.tensor([radius * math.sin(a), 0, radius * math.cos(a)]),
            origin,
            up,
            width=64,
            height=48,
            focal=60,
        )
        for i, a in enumerate(angles)
    ]


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


def test_midpoints_of_opposite_and_of_equal_cameras_are_valid():
    ends = posed(rotation(0.0), (0, 0, 0)), posed(rotation(math.pi), (2, 0, 0))
    midpoint = between(*ends)
    assert [angle_between(midpoint, end) for end in ends] == pytest.approx([math.pi / 2] * 2, abs=1e-7)
    orientation = midpoint.world_to_camera[:3, :3]
    torch.testing.assert_close(orientation @ orientation.T, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-14)
    assert float(torch.linalg.det(orientation)) == pytest.approx(1)
    assert midpoint.center.tolist() == pytest.approx([1, 0, 0])
    same = posed(rotation(2.0), (0.3, 0.2, 0.1))
    torch.testing.assert_close(between(same, same).world_to_camera, same.world_to_camera, rtol=0, atol=1e-14)


def test_midpoint_on_a_ring_looks_at_its_center():
    for midpoint in cameras_between(ring(9), range(9)):
        direction = midpoint.world_to_camera[2, :3]
        torch.testing.assert_close(direction, -midpoint.center / midpoint.center.norm(), rtol=0, atol=1e-7)
        assert float(midpoint.center.norm()) == pytest.approx(3 * math.cos(math.pi / 9))


def test_one_novel_camera_lies_between_neighbors():
    row = cameras(5)
    assert names(cameras_between(row, range(5))) == [f"view_{i}–view_{i + 1}" for i in range(4)]
    assert names(cameras_between(row, [0, 1, 3])) == ["view_0–view_1", "view_1–view_3"]
    assert names(cameras_between(row[:2], [0, 1])) == ["view_0–view_1"]
    assert cameras_between(row, [2]) == cameras_between(row, []) == cameras_between([], []) == []
    assert cameras_between([row[0]] * 3, range(3)) == []
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
    reference = make_rasterizer("reference", scene, background=(0.2, 0.3, 0.4))
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
    resumed = novel_views(scene, views, network, first=first.gram)
    assert resumed.measure(torch.zeros_like(scene.sh_dc)) == gray


def test_caching_does_not_change_measurements(network, lpips):
    scene, views = wall(sh_degree=1), cameras(10)
    cached = novel_views(scene, views, network, weighted=True, lpips=lpips)
    uncached = novel_views(scene, views, network, weighted=True, lpips=lpips, memory=0)
    moment = cached.measure(scene.sh_dc)
    assert moment == uncached.measure(scene.sh_dc) == cached.measure(scene.sh_dc)
    assert {gap: len(pairs) for gap, pairs in cached.pairs.items()} == {SHORT_RANGE: MAX_VIEWS, LONG_RANGE: 2}


def test_consistency_ignores_unseen_gaussians(network, lpips):
    front, back = wall(), wall()
    back = replace(back, means=back.means * torch.tensor([1.0, 1, -1]))  # behind all cameras
    both = Scene(*(torch.cat([getattr(front, f), getattr(back, f)]) for f in TENSORS))
    measured = novel_views(both, cameras(10), network, lpips=lpips)
    before = measured.measure(both.sh_dc)
    noise = torch.randn(len(back), 3, generator=torch.Generator().manual_seed(0))
    after = measured.measure(torch.cat([front.sh_dc, noise]))
    assert before == after
    assert before.short.compared > 0.5
    seen = measured.measure(torch.cat([noise, back.sh_dc]))
    assert seen.short.rmse != before.short.rmse


def test_view_dependent_colors_are_less_consistent(network, lpips):
    views = cameras(10)
    plain = wall(sh_degree=1)
    smooth = torch.sin(plain.means @ torch.tensor([[1.5, 0.3, -1], [0.5, 1, 1], [0, 0, 0]]))
    plain = replace(plain, sh_dc=smooth, sh_rest=torch.zeros_like(plain.sh_rest))
    generator = torch.Generator().manual_seed(3)
    noisy = replace(plain, sh_rest=1.5 * torch.randn(plain.sh_rest.shape, generator=generator))
    calm, rough = (novel_views(s, views, network, lpips=lpips).measure(s.sh_dc) for s in (plain, noisy))
    for before, after in ((calm.short, rough.short), (calm.long, rough.long)):
        assert after.compared == before.compared > 0.5
        assert after.rmse > 3 * before.rmse
        assert after.lpips > 2 * before.lpips
    assert rough.long.rmse > rough.short.rmse


def test_view_inside_an_object_is_not_measured(network):
    up = torch.tensor([0.0, -1.0, 0.0])
    positions = [(-0.65, 0, 0), (0.65, 0, 0), (0.65, 0.35, 0), (0.65, 0.7, 0)]
    views = [
        look_at(str(i), torch.tensor(p), torch.tensor([p[0], p[1], 3.0]), up, width=64, height=48, focal=64)
        for i, p in enumerate(positions)
    ]
    shell = ball(400)
    centered = shell.means - torch.tensor([0.0, 0, 3])
    shell = replace(shell, means=centered * (0.4 / 0.7), scales=torch.full_like(shell.scales, math.log(0.04)))
    background = wall()
    both = Scene(*(torch.cat([getattr(background, f), getattr(shell, f)]) for f in TENSORS))
    empty, filled = novel_views(background, views, network), novel_views(both, views, network)
    assert names(empty.cameras) == names(filled.cameras) == ["0–1", "1–2", "2–3"]
    assert (empty.views, empty.pairs[SHORT_RANGE]) == ([0, 1], [(0, 1), (1, 2)])
    assert (filled.views, filled.pairs[SHORT_RANGE]) == ([1], [(1, 2)])


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


def test_moment_is_plain_json(network, lpips):
    scene = wall()
    measured = novel_views(scene, cameras(9), network, lpips=lpips)
    moment = measured.measure(scene.sh_dc)
    values = json.loads(json.dumps(moment.as_dict(7, 1.5), allow_nan=False))
    assert list(values) == ["step", "seconds", "gram", "gram_relative", "consistency"]
    assert (values["step"], values["seconds"]) == (7, 1.5)
    assert values["gram"] == {"0": moment.gram[0]}
    assert values["consistency"]["short"] == {
        "gap": 1,
        "pairs": 4,
        "compared": moment.short.compared,
        "rmse": moment.short.rmse,
        "lpips": moment.short.lpips,
    }
    assert (values["consistency"]["long"]["gap"], values["consistency"]["long"]["pairs"]) == (7, 1)
    without = novel_views(scene, cameras(3), network).measure(scene.sh_dc).as_dict(0, 0.0)["consistency"]
    assert without["short"]["lpips"] is None
    assert without["short"]["rmse"] > 0
    assert without["long"] is None


@pytest.mark.slow
def test_real_scene_approaches_its_style_in_novel_views(shared_data, vgg16_weights, lpips):
    folder = shared_data / "scenes" / "snowmiku_plush"
    scene = read_scene(folder / "point_cloud.ply").scene
    views = [resized(camera, 120) for camera in spread(read_cameras(folder / "cameras.json"), 10)]
    painting = load_image(shared_data / "styles" / "starry_night.jpg")
    settings = make_settings(steps_coarse=0, steps_sos=10, learning_rate=0.2, learning_rate_end=0.1)
    stylizer = Stylizer.planned(scene, views, painting, settings, weights=vgg16_weights)
    measured = NovelViews(
        stylizer.job.views.cameras,
        stylizer.job.views.covered,
        scene,
        make_rasterizer("cpu", scene),
        stylizer.job.loss,
        stylizer.job.style_targets,
        weighted=stylizer.job.view_targets.weighted,
        lpips=lpips,
    )
    assert len(measured.cameras) >= 6
    assert len(measured.views) >= 3
    before = measured.measure(stylizer.stylized())
    assert run(stylizer) == "finished"
    after = measured.measure(stylizer.stylized())
    print(f"gram {after.gram_relative:.3f}, short {before.short} to {after.short}")
    assert after.gram_relative < 0.8
    assert after.short.compared == before.short.compared > 0.05
    assert 0 < before.short.rmse < 0.2
    assert after.short.rmse < 0.4


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

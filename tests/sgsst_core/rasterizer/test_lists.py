"""Tests that depth order and tile intersections match plain loops and do not depend on the number of threads."""

from __future__ import annotations

import gc
from collections.abc import Iterator

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from sgsst_core.rasterizer.cpu import CpuRasterizer
from sgsst_core.rasterizer.depth_order import depth_order
from sgsst_core.rasterizer.projection import project
from sgsst_core.rasterizer.raster_lists import RasterLists, build_raster_lists, lists_of_subset
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from tests.sgsst_core.splat_scenes import camera, cloud, turned_pose

_RANDOM = np.random.default_rng(0)
DEPTHS: dict[str, NDArray[np.float64]] = {
    "spread": np.exp(_RANDOM.normal(size=5000)),
    "many equal": _RANDOM.integers(1, 40, 5000).astype(np.float64),
    "all equal": np.full(3000, 3.0),
    "nearly equal": 1 + 1e-13 * _RANDOM.random(3000),
    "one far off": np.append(1 + 1e-6 * _RANDOM.random(3000), 1e300),
    "all magnitudes": 10.0 ** _RANDOM.uniform(-300, 300, 3000),
    "infinite": np.array([2.0, np.inf, 5e-324, np.inf, 1e300]),
    "one": np.array([2.0]),
}


@pytest.fixture(params=[1, 2])
def threads(request: pytest.FixtureRequest) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("name", DEPTHS)
def test_depth_order_is_that_of_a_stable_sort(name: str, threads: None) -> None:
    depths = DEPTHS[name]
    visible = np.flatnonzero(_RANDOM.random(len(depths)) < 0.8)
    found = depth_order(depths, visible)
    assert found.dtype == np.int32
    assert np.array_equal(found, visible[np.argsort(depths[visible], kind="stable")])


def test_values_are_in_order_of_depth(threads: None) -> None:
    scene, view = cloud(700, seed=31), camera()
    found = project(scene, view)
    pose = view.world_to_camera.double()
    depths = (scene.means.double() @ pose[2, :3] + pose[2, 3]).numpy()[found.gaussians]
    assert np.all(np.diff(depths) >= -1e-12)
    first = found.gaussians[0]
    alone = project(scene.subset(torch.tensor([int(first)])), view)
    assert np.array_equal(found.values[0], alone.values[0])


def listed_in_turn(scene: Scene, view: Camera) -> list[list[int]]:
    """Return the ranks in each raster tile, from the intersections of one Gaussian at a time."""
    gaussians = project(scene, view).gaussians
    tiles: list[list[int]] = [[] for _ in range(-(-view.width // 16) * -(-view.height // 16))]
    for rank, gaussian in enumerate(gaussians):
        alone = build_raster_lists(scene.subset(torch.tensor([int(gaussian)])), view)
        for tile in np.flatnonzero(np.diff(alone.starts)):
            tiles[tile].append(rank)
    return tiles


def check_slots(lists: RasterLists) -> None:
    """Check that every pair has a slot, and that those of a Gaussian are adjacent and ordered by tile."""
    order = np.argsort(lists.slots, kind="stable")
    assert np.array_equal(lists.slots[order], np.arange(len(lists.slots)))
    assert np.array_equal(
        lists.ranks[order], np.repeat(np.arange(len(lists.first_slots) - 1), np.diff(lists.first_slots))
    )


@pytest.mark.parametrize("count", [0, 1, 3, 150])
def test_lists_are_those_of_one_gaussian_after_the_other(count: int, threads: None) -> None:
    scene, view = cloud(count, seed=32), camera(97, 61)
    scene.scales[:10] += 4  # as large as the view
    lists = build_raster_lists(scene, view)
    expected = listed_in_turn(scene, view)
    assert np.array_equal(np.diff(lists.starts), [len(tile) for tile in expected])
    assert lists.ranks.tolist() == [rank for tile in expected for rank in tile]
    check_slots(lists)


def check_same(found: RasterLists, expected: RasterLists) -> None:
    """Check that all arrays are bit-identical."""
    for name in ("starts", "ranks", "slots", "first_slots"):
        own, other = getattr(found, name), getattr(expected, name)
        assert own.dtype == other.dtype
        assert np.array_equal(own, other), name
    assert np.array_equal(found.projection.gaussians, expected.projection.gaussians)
    assert np.array_equal(found.projection.values, expected.projection.values)


@pytest.mark.parametrize("share", [0.0, 0.03, 0.6, 1.0])
def test_lists_of_some_gaussians_are_those_that_would_be_built(share: float, threads: None) -> None:
    scene, view = cloud(900, seed=33), camera(97, 61)
    scene.scales[:10] += 4
    chosen = torch.rand(900, generator=torch.Generator().manual_seed(1)) < share
    places = torch.where(chosen, chosen.cumsum(0) - 1, -1).to(torch.int32).numpy()
    found = lists_of_subset(build_raster_lists(scene, view), places)
    check_same(found, build_raster_lists(scene.subset(chosen), view))


def test_lists_are_handed_on_once_and_stay_within_the_budget() -> None:
    scene = cloud(600, seed=34)
    views = [camera(97, 61, pose=turned_pose(angle)) for angle in (0.0, 0.1, 0.2, 0.3)]
    chosen = torch.arange(600) % 4 > 0
    sizes = [build_raster_lists(scene, view).nbytes for view in views]
    whole = CpuRasterizer(scene, max_list_bytes=sum(sizes[:3]))
    for view in views:
        whole.lists(view)
    budget = sum(sizes[:3])
    part = whole.of_subset(scene.subset(chosen), chosen, max_list_bytes=budget)
    assert [part.has_lists(view) for view in views] == [True, True, True, False]
    for done, view in enumerate(views):
        check_same(part.lists(view), build_raster_lists(scene.subset(chosen), view))
        assert part._lists.kept_bytes <= budget
        assert not whole.has_lists(view)
        assert [whole.has_lists(other) for other in views[done + 1 : 3]] == [True] * len(views[done + 1 : 3])
    assert part.lists(views[1]) is part.lists(views[1])
    with pytest.raises(ValueError, match="450 Gaussians are not the 600 chosen ones of 600"):
        whole.of_subset(scene.subset(chosen), torch.ones(600, dtype=torch.bool))


def test_lists_beyond_a_new_limit_are_let_go_the_last_ones_first() -> None:
    scene = cloud(300, seed=35)
    views = [camera(pose=turned_pose(angle)) for angle in (0.0, 0.1, 0.2)]
    cpu = CpuRasterizer(scene)
    sizes = [cpu.lists(view).nbytes for view in views]
    cpu.let_go_of_lists(views[0], sizes[1])
    assert [cpu.has_lists(view) for view in views] == [False, True, False]


def test_lists_beside_others_keep_what_these_leave_of_their_bytes() -> None:
    scene = cloud(300, seed=36)
    views = [camera(pose=turned_pose(angle)) for angle in (0.0, 0.1, 0.2)]
    sizes = [build_raster_lists(scene, view).nbytes for view in views]
    host = CpuRasterizer(scene, max_list_bytes=sum(sizes))
    guests = [CpuRasterizer(scene, beside=host) for _ in range(2)]

    def kept() -> list[list[bool]]:
        return [[one.has_lists(view) for view in views] for one in (host, *guests)]

    host.lists(views[0])
    guests[0].lists(views[1])
    guests[1].lists(views[2])
    guests[1].lists(views[0])  # uses up all bytes
    assert kept() == [[True, False, False], [False, True, False], [False, False, True]]
    check_same(guests[1].lists(views[0]), host.lists(views[0]))
    host.lists(views[1])
    host.lists(views[2])
    assert kept() == [[True] * 3, [False] * 3, [False] * 3]
    host.let_go_of_lists(views[0], sum(sizes))
    guests[0].lists(views[0])
    assert kept()[1] == [True, False, False]
    host.let_go_of_lists(views[1], sizes[2])
    assert kept()[:2] == [[False, False, True], [False] * 3]
    del guests[1]
    gc.collect()
    assert len(host._lists._guests) == 1

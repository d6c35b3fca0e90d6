"""Depth order and raster lists, built on all cores, against plain loops; any number of threads gives the same."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from sgsst_core.rasterizer.depth_order import depth_order
from sgsst_core.rasterizer.projection import project
from sgsst_core.rasterizer.raster_lists import RasterLists, build_raster_lists
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from tests.sgsst_core.splat_scenes import camera, cloud

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
    """Ranks of each raster tile: one Gaussian after the other, whose own lists tell which tiles it touches."""
    gaussians = project(scene, view).gaussians
    tiles: list[list[int]] = [[] for _ in range(-(-view.width // 16) * -(-view.height // 16))]
    for rank, gaussian in enumerate(gaussians):
        alone = build_raster_lists(scene.subset(torch.tensor([int(gaussian)])), view)
        for tile in np.flatnonzero(np.diff(alone.starts)):
            tiles[tile].append(rank)
    return tiles


def check_slots(lists: RasterLists) -> None:
    """Every pair has a slot of its own, those of a Gaussian side by side, from its first tile to its last."""
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

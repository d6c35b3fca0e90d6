import pytest
import torch

from sgsst_core.features.partition import (
    Rectangle,
    cached_tiles,
    choose_tile_size,
    computed_twice,
    covered_region,
    partition,
)
from sgsst_core.features.vgg import STYLE_LAYERS, layer_stride


@pytest.mark.parametrize("size", [(500, 730), (333, 517), (256, 1031), (64, 64), (15, 17), (1, 1)])
@pytest.mark.parametrize("tile_size", [64, 128, 272, None])
def test_every_cell_of_every_layer_has_one_owner(size, tile_size):
    tiles = partition(*size, tile_size, 64)
    for layer in STYLE_LAYERS:
        stride = layer_stride(layer)
        owners = torch.zeros((size[0] // stride, size[1] // stride), dtype=torch.int64)
        for tile in tiles:
            view, own = tile.owned_cells(layer, size)
            owners[view.slices] += 1
            assert (own.bottom - own.top, own.right - own.left) == (view.bottom - view.top, view.right - view.left)
            assert own.top >= 0
            assert own.left >= 0
            assert own.bottom <= (tile.outer.bottom - tile.outer.top) // stride
            assert own.right <= (tile.outer.right - tile.outer.left) // stride
        assert (owners == 1).all()


@pytest.mark.parametrize(("tile_size", "halo"), [(0, 64), (100, 64), (128, 70)])
def test_misaligned_partitions_are_refused(tile_size, halo):
    with pytest.raises(ValueError, match="multiples of 16"):
        partition(500, 730, tile_size, halo)


def test_view_is_partitioned_only_if_it_does_not_fit():
    assert choose_tile_size(512, 512, 64, held=512 * 512 * 1.5, working=0.5) is None
    for held in (4e6, 1e6, 3e5, 1e5):
        size = choose_tile_size(3361, 5187, 64, held=held, working=0.5)
        assert max(tile.outer.pixels for tile in partition(3361, 5187, size, 64)) * 1.5 <= held
    assert choose_tile_size(3361, 5187, 64, held=1, working=0.5) == 64


def test_tile_size_is_limited_even_if_more_pixels_fit():
    assert choose_tile_size(3361, 5187, 64, held=1e9, working=0.5, largest=3361 * 5187) is None
    for largest in (3361 * 5187 - 1, 10**6, 10**5):
        size = choose_tile_size(3361, 5187, 64, held=1e9, working=0.5, largest=largest)
        assert size is not None
        assert max(tile.outer.pixels for tile in partition(3361, 5187, size, 64)) <= largest


def test_covered_region_is_minimal_and_aligned():
    coverage = torch.zeros((100, 210))
    assert (covered_region(coverage).pixels, partition(100, 210, None, 64, covered_region(coverage))) == (0, [])
    coverage[33, 50] = 1e-6
    coverage[60, 205] = 1
    region = covered_region(coverage)
    assert region == Rectangle(32, 48, 64, 208)
    (tile,) = partition(100, 210, None, 16, region)
    assert (tile.inner, tile.outer) == (region, Rectangle(16, 32, 80, 210))
    tiles = partition(100, 210, 64, 16, region)
    assert sum(tile.inner.pixels for tile in tiles) == region.pixels


@pytest.mark.parametrize("held", [0.0, 90.0, 130.0, 250.0, 299.0, 1000.0])
@pytest.mark.parametrize("working", [0.0, 0.4])
def test_cached_tiles_fit_and_leave_no_space_for_another(held, working):
    areas = [40, 100, 60, 100]
    cached = cached_tiles(areas, held, working)
    total = sum(area for area, flag in zip(areas, cached, strict=True) if flag)
    others = [area for area, flag in zip(areas, cached, strict=True) if not flag]
    assert total == 0 or total + working * max(areas) <= held
    assert all(total + area + working * max(areas) > held for area in others)
    assert computed_twice(areas, cached) == sum(areas) - total

"""Tests of the gradient sum over ranks, which only exchange gradients of Gaussians that the view shows."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Mapping
from typing import Any

import pytest
import torch
from torch import Tensor

from benchmarks.iteration_work import moved
from sgsst_core.features.partition import Rectangle
from sgsst_core.features.vgg import HALO, STYLE_LAYERS
from sgsst_core.loss.terms import TERMS
from sgsst_core.parallel.collectives import ALONE, Collectives, ImageExchange, Traffic
from sgsst_core.parallel.division import Divider, Piece, Shares, Tiling, divide
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import make_settings
from sgsst_core.stylizing.stylizer import Stylizer
from sgsst_core.stylizing.views import Views
from tests.networks import CHANNELS, tiny_weights
from tests.sgsst_core.synthetic_images import relative_error
from tests.small_scenes import cameras, style, wall
from tests.worker.ranks.spawn import on_ranks

pytestmark = pytest.mark.usefixtures("one_thread")

WIDTH, HEIGHT = 128, 96
#: Two ranks render 80 columns each of a view of this size, and one rank a view of 15 rows.
TILING = Tiling(halo=16, held=math.inf, working=0.0, coarsest=511)


def make_views(collectives: Collectives, scene: Scene, camera: Camera, memory: int = 1 << 30) -> Views:
    """Return views with this memory budget for caches; they cache nothing if it is 0."""
    rasterizer, divider = make_rasterizer("cpu", scene), Divider(TILING, collectives)
    return Views(scene, [camera], rasterizer, covered=[0], memory=memory, divider=divider)


def pixels(camera: Camera, seed: int) -> Tensor:
    return torch.randn(camera.height, camera.width, 3, generator=torch.Generator().manual_seed(seed))


def both_ways(collectives: Collectives, scene: Scene, camera: Camera) -> dict[str, Any]:
    """Return color gradients [N, 3] of two visits, with exchanges of all values and of shown Gaussians' values only."""
    results: dict[str, Any] = {}
    for name, memory in (("whole", 0), ("shown", 1 << 30)):
        views = make_views(collectives, scene, camera, memory)
        colors = views.colors(0, scene.sh_dc)
        sent = [dict(collectives.sent)]
        results[name] = []
        for visit in range(2):
            make = functools.partial(pixels, seed=10 * visit + collectives.rank)
            results[name].append(views.gradient(0, views.window(0, make, 3), colors))
            sent.append(dict(collectives.sent))
        results[f"bytes {name}"] = [
            {kind: after[kind] - before[kind] for kind in after} for before, after in itertools.pairwise(sent)
        ]
    return results


def shown_of(scene: Scene, camera: Camera) -> Tensor:
    """Return whether the view shows each Gaussian, [N] bool."""
    ones = torch.ones(camera.height, camera.width, 3)
    return make_rasterizer("cpu", scene).color_gradient(ones, camera)[:, 0] > 0


def left(scene: Scene) -> Scene:
    """Return the Gaussians that project to the left third of the views."""
    return scene.subset(scene.means[:, 0] < -1)


@pytest.mark.parametrize(
    ("scene", "height"),
    [
        pytest.param(wall(sh_degree=1), HEIGHT, id="wall"),
        pytest.param(left(wall()), HEIGHT, id="nothing on the right"),
        pytest.param(wall(), 15, id="narrow"),
    ],
)
def test_exchange_of_shown_gaussians_is_bit_identical_to_all(scene: Scene, height: int) -> None:
    camera = cameras(1, WIDTH, height)[0]
    shown = int(shown_of(scene, camera).sum())
    assert 0 < shown < 0.7 * len(scene)
    results = on_ranks(2, both_ways, scene, camera)
    for result in results:
        for whole, packed, first in zip(result["whole"], result["shown"], results[0]["shown"], strict=True):
            assert packed.any()
            assert torch.equal(whole, packed)
            assert torch.equal(packed, first)
        assert [sent["gradient"] for sent in result["bytes whole"]] == [12 * len(scene)] * 2
        assert [sent["gradient"] for sent in result["bytes shown"]] == [len(scene) + 12 * shown, 12 * shown]


def coverage_sum(collectives: Collectives, scene: Scene, camera: Camera) -> float:
    views = make_views(collectives, scene, camera)
    return float(views.window(0, views.rasterizer.coverage).sum())


def test_second_rank_shows_no_gaussians() -> None:
    """Check the assumption of the second test case above."""
    first, second = on_ranks(2, coverage_sum, left(wall()), cameras(1, WIDTH, HEIGHT)[0])
    assert first > 0
    assert second == 0


def test_four_ranks_differ_by_rounding_only() -> None:
    """The index of a value determines the rank at which the ring starts to add, so only the rounding differs."""
    scene, camera = wall(), cameras(1, WIDTH, HEIGHT)[0]
    results = on_ranks(4, both_ways, scene, camera)
    for result in results:
        for whole, packed, first in zip(result["whole"], result["shown"], results[0]["shown"], strict=True):
            assert relative_error(packed, whole) < 1e-6
            assert torch.equal(packed, first)
            assert torch.equal(packed == 0, whole == 0)


def test_whole_gradient_is_sent_if_nearly_all_is_shown() -> None:
    camera = cameras(1, WIDTH, HEIGHT)[0]
    scene = wall().subset(shown_of(wall(), camera))
    for result in on_ranks(2, both_ways, scene, camera):
        for whole, packed in zip(result["whole"], result["shown"], strict=True):
            assert torch.equal(whole, packed)
        assert [sent["gradient"] for sent in result["bytes shown"]] == [13 * len(scene), 12 * len(scene)]


def quarters() -> list[Rectangle]:
    return [Rectangle(top, 0, top + 24, WIDTH) for top in range(0, HEIGHT, 24)]


def windows() -> list[Rectangle]:
    """Return the windows of four ranks: the whole image, nothing, the two lower quarters, and nothing."""
    nothing = Rectangle(0, 0, 0, 0)
    return [Rectangle(0, 0, HEIGHT, WIDTH), nothing, Rectangle(48, 0, HEIGHT, WIDTH), nothing]


def exchange_everything(collectives: Collectives) -> Mapping[Traffic, int]:
    exchange, own = ImageExchange(quarters(), windows()), windows()[collectives.rank]
    collectives.gather_parts([exchange], [torch.zeros(24, WIDTH, 3)], [torch.zeros(*own.shape, 3)])
    collectives.reduce_parts([exchange], [torch.zeros(*own.shape, 3)])
    collectives.all_reduce(torch.zeros(1000, 3))
    collectives.union(torch.zeros(300, dtype=torch.bool))
    pair = collectives.split_group(collectives.size // 2)
    pair.all_reduce(torch.zeros(500), "statistics")
    return dict(collectives.sent)


def test_sent_bytes_follow_ring_algorithms() -> None:
    """Parts are sent directly to the two ranks that need them, and their gradients back."""
    for sent, quarters_sent in zip(on_ranks(4, exchange_everything), (0 + 3, 1 + 0, 1 + 1, 2 + 0), strict=True):
        image = 12 * WIDTH * 24 * quarters_sent
        assert sent == {"image": image, "gradient": 6 * (12_000 + 300) // 4, "statistics": 2000}


def test_one_rank_sends_nothing() -> None:
    stylizer = Stylizer.planned(wall(), cameras(1), style(), make_settings(steps_coarse=0), weights=tiny_weights())
    assert stylizer.run_step().sent == {}
    assert set(ALONE.sent.values()) == {0}


def run_two_steps(collectives: Collectives) -> dict[str, Any]:
    own = {"coarsest_side": 40, "scale_sampling": 1}
    settings = make_settings("standard", steps_coarse=0, steps_sos=4, **own)
    camera = cameras(1, WIDTH, HEIGHT)
    stylizer = Stylizer.planned(wall(), camera, style(), settings, weights=tiny_weights(), collectives=collectives)
    scales = len(stylizer.job.scales(0))
    return {
        "steps": [stylizer.run_step().sent for _ in range(2)],
        "scales": scales,
    }


def test_step_record_has_sent_bytes() -> None:
    """Each of two ranks sends twice half of what they add. Of the image, only the coarser scales are exchanged."""
    layer = CHANNELS + 1 + CHANNELS * (CHANNELS + 1) // 2
    statistics = 8 * (len(STYLE_LAYERS) * layer + len(TERMS))
    halo = HALO[tiny_weights().name]
    for result in on_ranks(2, run_two_steps):
        sizes = [(HEIGHT >> scale, WIDTH >> scale) for scale in range(result["scales"])]
        pieces = tuple(Piece(scale, size, Rectangle(0, 0, *size)) for scale, size in enumerate(sizes))
        by_rank = divide(pieces, halo, 2)
        exchanges = Shares.of((HEIGHT, WIDTH), by_rank, halo).exchanges(by_rank, halo)
        assert [*exchanges] == [*range(1, result["scales"])]
        assert result["steps"][1] == {
            "image": 12 * sum(sum(moved(exchange, 0)) for exchange in exchanges.values()),
            "statistics": result["scales"] * statistics,
            "gradient": 12 * int(shown_of(wall(), cameras(1, WIDTH, HEIGHT)[0]).sum()),
        }

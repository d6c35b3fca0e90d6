"""Forecast of the time of a step on one H200, from counted operations, bytes and kernel launches.

python -m benchmarks.forecast [--launches 509]

Nothing here is measured on a GPU: peak rates come from the data sheet, and `SHARES` below contains assumed fractions of
them. The work of feature network, image pyramid, colors and content loss is counted by running the project's own code
on meta tensors, which have no values. The work of Triton kernels is counted from their source, that of the rasterizer
from the number of pairs of a Gaussian and a raster tile.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch

from benchmarks.machine import write_result
from benchmarks.work import Counted, Work, meta
from sgsst_core.budget import GPU_SHARE, measuring_memory, memory_for
from sgsst_core.constants import RASTER_TILE
from sgsst_core.features.network_sources import BLOCKS
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.partition import PartitionTile
from sgsst_core.features.statistics import TILE, matrix_precision, span_positions
from sgsst_core.features.vgg import CONTENT_LAYER, STYLE_LAYERS, FeatureNetwork
from sgsst_core.loss.content import ContentDifference
from sgsst_core.loss.sos import SosLoss
from sgsst_core.parallel.division import Size
from sgsst_core.planning.cost import content_bytes
from sgsst_core.scene.pyramid import add_upscaled_, downscale
from sgsst_core.scene.spherical_harmonics import view_colors, view_colors_gradient
from sgsst_core.settings import make_settings

#: Peak rates of the H200 SXM from the data sheet, without sparsity: operations per second by precision; memory
#: bandwidth in bytes per second; sizes of memory and L2 cache in bytes.
PEAKS = {"bfloat16": 989e12, "tf32": 495e12, "float32": 67e12}
BANDWIDTH, MEMORY, L2 = 4.8e12, 141e9, 50e6
#: Thread instructions per second: the data sheet counts a fused multiply-add as two float32 operations.
LANES = PEAKS["float32"] / 2
PRECISIONS = ("float32", "tf32", "bfloat16")
#: Kernel launches of a step on a fully cached view in bfloat16, as counted by `device_counts`.
LAUNCHES = 509
#: Launches to compute a view's tile intersections: two multi-pass sorts, a multi-pass sum, kernels and copies.
LIST_LAUNCHES = 40
#: Instructions per pixel for a pair of Gaussian and raster tile, from the source of `blend_weights` and its callers:
#: about 30 for the weight, including two functions at a quarter of the rate or less, and 15 for three color channels.
PIXEL_INSTRUCTIONS = 45
#: Fraction of the scene's Gaussians that are visible in a view. `Job.pairs_each` in `JOBS` was counted on the biker
#: scene (152,605 Gaussians) at widths of 980 and 5187 pixels. Most of its Gaussians are a few pixels wide, as in large
#: scenes. The Gaussians of the plush toy are larger and have 12.8 and 236 pairs each.
VISIBLE_SHARE = 0.5
#: Bytes of tile intersections per visible Gaussian, and per pair.
LIST_BYTES = (80, 8)


@dataclass(frozen=True)
class Shares:
    """Assumed fractions of the peak rates.

    Attributes:
        convolution: Fraction of `PEAKS` for convolutions, by precision.
        matrix: Fraction of `PEAKS` for Triton's feature products, in TF32 or float32 ("ieee").
        bandwidth: Fraction of the memory bandwidth.
        lanes: Fraction of `LANES` for the rasterizer.
        blended: Fraction of the pairs of Gaussian and tile that are blended before the tile is opaque.
        launch: CPU seconds per kernel launch.
    """

    convolution: Mapping[str, float]
    matrix: Mapping[str, float]
    bandwidth: float
    lanes: float
    blended: float
    launch: float

    def rates(self, precision: str) -> dict[str, float]:
        """Return the operations and bytes per second that `Work.seconds` expects."""
        product = matrix_precision(torch.bfloat16 if precision == "bfloat16" else torch.float32)
        return {
            "convolution": PEAKS[precision] * self.convolution[precision],
            "matrix": PEAKS["tf32" if product == "tf32" else "float32"] * self.matrix[product],
            "lanes": LANES * self.lanes / self.blended,
            "bytes": BANDWIDTH * self.bandwidth,
        }


def _shares(float32: float, tf32: float, bfloat16: float, ieee: float, product: float, *rest: float) -> Shares:
    convolution = {"float32": float32, "tf32": tf32, "bfloat16": bfloat16}
    return Shares(convolution, {"ieee": ieee, "tf32": product}, *rest)


SHARES = {
    "optimistic": _shares(0.85, 0.75, 0.75, 0.6, 0.5, 0.85, 0.5, 0.5, 3e-6),
    "likely": _shares(0.7, 0.6, 0.6, 0.4, 0.3, 0.7, 0.35, 0.7, 4e-6),
    "pessimistic": _shares(0.5, 0.4, 0.4, 0.25, 0.15, 0.55, 0.25, 1.0, 6e-6),
}


@dataclass(frozen=True)
class Job:
    """Scene and its views.

    Attributes:
        size: (height, width) of every view.
        gaussians: Number of Gaussians in the scene, with SH of degree 3.
        pairs_each: Number of raster tiles that a visible Gaussian touches.
        views: Number of views.
    """

    size: Size
    gaussians: int
    pairs_each: float
    views: int

    @property
    def visible(self) -> float:
        """Number of Gaussians in a view."""
        return VISIBLE_SHARE * self.gaussians

    @property
    def pairs(self) -> float:
        """Number of pairs of Gaussian and raster tile in a view."""
        return self.pairs_each * self.visible


#: Typical scene of Tanks and Temples, and the garden scene of Mip-NeRF 360 at full size, for which the paper reports
#: 25.5 hours on an A100.
JOBS = {
    "980x545": Job((545, 980), 2_500_000, 2.5, 250),
    "5187x3361": Job((3361, 5187), 5_800_000, 15.0, 185),
}


@dataclass(frozen=True)
class Part:
    """Part of a step: work of each launch, mean repetitions per step, and number of launches not in `LAUNCHES`."""

    works: Sequence[Work]
    visits: float = 1.0
    more_launches: int = 0


def shapes_of(name: str) -> BackboneWeights:
    """Return a network's weights as meta tensors, which have shapes but no values."""
    layers, channels = {}, 3
    for block, count in enumerate(BLOCKS[name], start=1):
        for index in range(1, count + 1):
            width = min(64 << (block - 1), 512)
            layers[f"conv{block}_{index}"] = meta(width, channels, 3, 3), meta(width)
            channels = width
    return BackboneWeights(name, "shapes", "0" * 64, layers, meta(3), meta(3))


def make_loss(precision: str) -> SosLoss:
    """Return the loss of VGG19 with the memory budget of a job on the device."""
    dtype = torch.bfloat16 if precision == "bfloat16" else torch.float32
    network = FeatureNetwork(shapes_of("vgg19"), dtype=dtype, device="meta", tf32=precision == "tf32")
    return SosLoss(network, memory=memory_for("activations", int(memory_limit())))


def memory_limit() -> float:
    """Return the memory limit in bytes that a job has by default (`budget.default_memory_limit`)."""
    return GPU_SHARE * MEMORY


class Passes:
    """Work of the parts of a view's loss at the given scales."""

    def __init__(self, loss: SosLoss, size: Size, scales: Sequence[int]) -> None:
        self.loss, self.size = loss, size
        self.sizes = {scale: (size[0] >> scale, size[1] >> scale) for scale in scales}
        tiles = {scale: loss.divider.tiles(scaled) for scale, scaled in self.sizes.items()}
        self.tiles = [(tile, self.sizes[scale]) for scale, own in tiles.items() for tile in own]
        self.cached = loss.tiling.cached([tile.outer.pixels for tile, _ in self.tiles])

    def network(self) -> tuple[list[Work], list[Work]]:
        """Return the work of forward pass and backward pass; the latter includes recomputing activations."""
        forward, backward = [], []
        for (tile, _), is_cached in zip(self.tiles, self.cached, strict=True):
            outer = tile.outer
            with Counted() as there:
                activations = self.loss.network.forward(meta(outer.bottom - outer.top, outer.right - outer.left, 3))
            with Counted() as back:
                self.loss.network.backward(activations, lambda *_: None)
            forward += there.works
            backward += back.works if is_cached else there.works + back.works
        return forward, backward

    def style(self) -> tuple[list[Work], list[Work]]:
        """Return the work of computing and comparing statistics, and that of the style gradient."""
        size = self.loss.network.dtype.itemsize
        pieces = [
            (self.loss.network.channels(layer), _cells(layer, tile, scaled))
            for tile, scaled in self.tiles
            for layer in STYLE_LAYERS
        ]
        return [statistics(*piece, size) for piece in pieces], [style_gradient(*piece, size) for piece in pieces]

    def content(self) -> list[Work]:
        """Return the work of the content loss and gradient, given the features."""
        channels, dtype = self.loss.network.channels(CONTENT_LAYER), self.loss.network.dtype
        works: list[Work] = []
        for tile, scaled in self.tiles:
            features = meta(1, _cells(CONTENT_LAYER, tile, scaled), channels, dtype=dtype)
            factor = meta(dtype=torch.float64)
            with Counted() as counted:
                ContentDifference.of(features, features, factor).loss()
                gradient = ContentDifference.of(features, features, factor).gradient()
                features += gradient
            works += counted.works
        return works

    def scaled(self) -> list[Work]:
        """Return the work of downscaling an image to all scales."""
        with Counted() as counted:
            for scale in self.sizes:
                downscale(meta(*self.size, 3), scale)
        return counted.works

    def added_up(self) -> list[Work]:
        """Return the work of adding the gradients of all scales to the image gradient."""
        with Counted() as counted:
            for scale, scaled in self.sizes.items():
                add_upscaled_(meta(*self.size, 3), meta(*scaled, 3), scale)
        return counted.works


def _cells(layer: str, tile: PartitionTile, size: Size) -> int:
    return tile.owned_cells(layer, size)[1].pixels


def statistics(channels: int, positions: int, size: int) -> Work:
    """Return the work of `statistics_kernels.shifted_moments` and its subsequent kernels.

    Args:
        channels: Number of channels of the layer.
        positions: Number of feature cells.
        size: Bytes per feature value.
    """
    tiles = -(-channels // TILE)
    pairs = tiles * (tiles + 1) // 2
    # Each pair of channel tiles reads both tiles, or one on the diagonal. Spans are the outer loop, so a layer larger
    # than the L2 cache is read from memory each time.
    reads = tiles if channels * positions * size > L2 else 1
    spans = -(-positions // span_positions(channels))
    moved = reads * channels * positions * size + 2 * spans * channels**2 * 4
    return Work(2.0 * min(TILE, channels) ** 2 * pairs * positions, moved, "matrix")


def style_gradient(channels: int, positions: int, size: int) -> Work:
    """Return the work of `statistics_terms_kernels.add_style_gradient`.

    Each channel tile reads all features, and reads and writes its own part of the gradient.
    """
    tiles = -(-channels // TILE)
    reads = tiles if channels * positions * size > L2 else 1
    return Work(2.0 * channels**2 * positions, (reads + 2.0) * channels * positions * size, "matrix")


def render(job: Job) -> list[Work]:
    """Return the work of a render with cached tile intersections.

    Each pair reads its depth-order index, eight float64 values and a color. Each pixel writes color and transmittance.
    """
    pixels = job.size[0] * job.size[1]
    return [Work(_blending(job), job.pairs * (4 + 64 + 8 + 12) + 16 * pixels, "lanes")]


def raster_gradient(job: Job) -> list[Work]:
    """Return the work of clearing, writing and summing the gradient slots of pairs, and of the gradient [N, 3]."""
    pixels = job.size[0] * job.size[1]
    return [
        Work(_blending(job), job.pairs * (8 + 64 + 24) + 12 * pixels, "lanes"),
        Work(0, 12 * (job.pairs + job.gaussians + job.visible)),
    ]


def _blending(job: Job) -> float:
    return job.pairs * RASTER_TILE**2 * PIXEL_INSTRUCTIONS


def lists(job: Job) -> list[Work]:
    """Return the work to compute tile intersections.

    The work consists of the projection and two radix sorts with 8-byte indices: one by 8-byte depths, one by 4-byte
    tile numbers. Each pass sorts by one byte of the key, and reads and writes all keys and indices.
    """
    depths, tiles = 8 * 2 * 16 * job.gaussians, 4 * 2 * 12 * job.pairs
    gathered = 40 * job.gaussians + 128 * job.visible + 36 * job.pairs
    return [Work(0, 120 * job.gaussians), Work(0, depths), Work(0, tiles), Work(0, gathered)]


def rest(job: Job) -> list[Work]:
    """Return the work of evaluating the frozen SH coefficients (degree 3): one launch, each coefficient read once."""
    return [Work(0, (15 * 12 + 12 + 12) * job.gaussians)]


def colors(job: Job) -> list[Work]:
    """Return the work of a view's colors, of their gradient, and of Adam, which reads four tensors and writes three."""
    values = meta(job.gaussians, 3)
    with Counted() as counted:
        view_colors(values, values)
        view_colors_gradient(values, values)
    return [*counted.works, Work(0, (3 + 7) * 12 * job.gaussians)]


def step_parts(job: Job, precision: str, *, coarse: bool = False, everything_cached: bool = False) -> dict[str, Part]:
    """Return the parts of a step.

    Args:
        job: Scene and views.
        precision: Precision of the feature network.
        coarse: Whether the step belongs to phase 1, which uses the coarsest scale alone.
        everything_cached: Whether content features, intersections and frozen colors of all views are cached.
    """
    loss = make_loss(precision)
    count = loss.tiling.scale_count(job.size)
    passes = Passes(loss, job.size, [count - 1] if coarse else range(count))
    forward, backward = passes.network()
    moments, style = passes.style()
    cached = (
        dict.fromkeys(("content", "lists", "colors"), 1.0) if everything_cached else cached_fractions(job, loss, coarse)
    )
    missing = {name: 1 - share for name, share in cached.items()}
    uncached = [*forward, *render(job), *passes.scaled()]
    frozen = rest(job)
    return {
        "convolutions forward": Part([work for work in forward if work.operations]),
        "convolutions backward": Part([work for work in backward if work.operations]),
        "ReLUs, pools, copies": Part([work for work in forward + backward if not work.operations]),
        "statistics": Part(moments),
        "style gradient": Part(style),
        "content loss": Part(passes.content()),
        "content features recomputed": Part(uncached, missing["content"], len(uncached)),
        "pyramid": Part(passes.scaled() + passes.added_up()),
        "render": Part(render(job)),
        "raster gradient": Part(raster_gradient(job)),
        "lists recomputed": Part(lists(job), missing["lists"], LIST_LAUNCHES),
        "colors and Adam": Part(colors(job)),
        "frozen colors recomputed": Part(frozen, missing["colors"] * (1 + missing["content"]), len(frozen)),
    }


def cached_fractions(job: Job, loss: SosLoss, coarse: bool) -> dict[str, float]:
    """Return the fractions of views whose content features, tile intersections and frozen colors fit the caches."""
    views = view_budget(job, loss)
    cell = loss.network.channels(CONTENT_LAYER) * loss.network.dtype.itemsize
    count = loss.tiling.scale_count(job.size)
    size = (job.size[0] >> count - 1, job.size[1] >> count - 1) if coarse else job.size
    of_a_view = {
        "content": (views / 2, content_bytes([size], loss.tiling, cell)),
        "lists": (
            memory_for("rasterizer", int(memory_limit())),
            LIST_BYTES[0] * job.visible + LIST_BYTES[1] * job.pairs,
        ),
        "colors": (views / 4, 12.0 * job.gaussians),
    }
    return {name: min(1.0, budget // each / job.views) for name, (budget, each) in of_a_view.items()}


def view_budget(job: Job, loss: SosLoss) -> int:
    """Return the memory in bytes for data of views, in a job with CUDA graphs that is measured (`cost.view_memory`)."""
    memory, network = int(memory_limit()), loss.network
    budget = memory_for("activations", memory)
    each = network.held_bytes_per_pixel() + network.working_bytes_per_pixel()
    once = min(int(job.size[0] * job.size[1] * each), budget)
    reference = 1 if network.precision == "float32" else 2
    needed = min(once * reference, budget) if network.precision == "bfloat16" else once
    spare = max(budget - needed - once, 0)
    return memory_for("views", memory) - reference * measuring_memory(memory) + spare


def step_seconds(parts: Mapping[str, Part], shares: Shares, precision: str, launches: int) -> dict[str, float]:
    """Return GPU seconds by part, CPU seconds, and the total: the maximum of both sums."""
    rates = shares.rates(precision)
    seconds = {name: part.visits * sum(w.seconds(rates) for w in part.works) for name, part in parts.items()}
    host = shares.launch * (launches + sum(part.visits * part.more_launches for part in parts.values()))
    return {**seconds, "host": host, "total": max(sum(seconds.values()), host)}


def forecast(job: Job, precision: str, launches: int) -> dict[str, Any]:
    """Return seconds per step in each phase, with and without complete caches, and the hours of the paper's job."""
    kinds: dict[str, dict[str, bool]] = {
        "sos": {},
        "coarse": {"coarse": True},
        "sos, all cached": {"everything_cached": True},
        "coarse, all cached": {"coarse": True, "everything_cached": True},
    }
    parts = {kind: step_parts(job, precision, **options) for kind, options in kinds.items()}
    forecasts: dict[str, Any] = {
        kind: {name: step_seconds(own, shares, precision, launches) for name, shares in SHARES.items()}
        for kind, own in parts.items()
    }
    paper = make_settings("paper")
    for hours, end in (("hours", ""), ("hours, all cached", ", all cached")):
        forecasts[hours] = {
            name: (
                paper.steps_coarse * forecasts[f"coarse{end}"][name]["total"]
                + paper.steps_sos * forecasts[f"sos{end}"][name]["total"]
            )
            / 3600
            for name in SHARES
        }
    forecasts["cached"] = cached_fractions(job, make_loss(precision), coarse=False)
    forecasts["teraflops"] = sum(w.operations for w in parts["sos"]["convolutions forward"].works) / 1e12
    return forecasts


def table(results: Mapping[str, Mapping[str, Any]]) -> str:
    """Return a Markdown table of milliseconds per step by precision: likely value, and range in parentheses."""
    lines = ["| part of a step, ms | " + " | ".join(results) + " |", "|---|" + "---:|" * len(results)]
    first = next(iter(results.values()))["sos"]["likely"]

    def row(name: str, kind: str, part: str, factor: float = 1e3, digits: int = 1) -> str:
        cells = []
        for each in results.values():
            values = {n: factor * (v[part] if part else v) for n, v in each[kind].items()}
            low, mid, high = (values[n] for n in ("optimistic", "likely", "pessimistic"))
            cells.append(f"{mid:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})")
        return f"| {name} | " + " | ".join(cells) + " |"

    lines += [row(part, "sos", part) for part in first if part != "total"]
    lines.append(row("**a step**", "sos", "total"))
    lines.append(row("a step, all cached", "sos, all cached", "total"))
    lines.append(row("a step of phase 1", "coarse", "total"))
    lines.append(row("10,000 and 10,000 steps, hours", "hours", "", 1, 2))
    lines.append(row("the same, all cached", "hours, all cached", "", 1, 2))
    return "\n".join(lines)


def main() -> None:
    """Compute the forecast, then print and store it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--launches", type=int, default=LAUNCHES, help="of a step")
    arguments = parser.parse_args()
    results = {
        name: {precision: forecast(job, precision, arguments.launches) for precision in PRECISIONS}
        for name, job in JOBS.items()
    }
    for name, result in results.items():
        print(f"\n{name}\n\n{table(result)}")
    assumptions = {
        "peaks": PEAKS,
        "bandwidth": BANDWIDTH,
        "memory": MEMORY,
        "shares": {name: asdict(shares) for name, shares in SHARES.items()},
        "jobs": {name: {**asdict(job), "pairs": job.pairs} for name, job in JOBS.items()},
        "launches": arguments.launches,
        "pixel_instructions": PIXEL_INSTRUCTIONS,
    }
    write_result("forecast", {"assumptions": assumptions, "forecast": results})


if __name__ == "__main__":
    main()

"""Forecast of the time of a step on one GPU, from counted operations, bytes and kernel launches.

python -m benchmarks.forecast

Peak rates come from data sheets; `SHARES` below contains assumed fractions of them, some of which were measured on an
H100. The work of feature network, image pyramid, colors and content loss is counted by running the project's own code
on meta tensors, which have no values. The work of Triton kernels is counted from their source, that of the rasterizer
from the number of pairs of a Gaussian and a raster tile, and from the instructions of its compiled kernels.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import asdict, dataclass
from typing import Any
from unittest import mock

import torch
from torch import Tensor

from benchmarks.machine import write_result
from benchmarks.work import Counted, Work, meta
from sgsst_core.budget import GPU_SHARE, content_fraction, measuring_memory, memory_for
from sgsst_core.constants import RASTER_TILE
from sgsst_core.features import first_layer, vgg
from sgsst_core.features.network_sources import BLOCKS
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.partition import PartitionTile
from sgsst_core.features.statistics import TILE, span_positions
from sgsst_core.features.vgg import CONTENT_LAYER, STYLE_LAYERS, FeatureNetwork
from sgsst_core.loss.sos import SosLoss
from sgsst_core.parallel.division import Size, Tiling
from sgsst_core.scales import EVEN, scale_count
from sgsst_core.scene.pyramid import add_upscaled_, downscale
from sgsst_core.scene.spherical_harmonics import view_colors, view_colors_gradient
from sgsst_core.settings import make_settings

PRECISIONS = ("float32", "tf32", "float16")
#: Kernel launches of a step with a fully cached view of 980x545 in bfloat16, and those of its loss at three scales.
LAUNCHES, LOSS_LAUNCHES = 485, 456
#: Launches to compute a view's tile intersections: two multi-pass sorts, a multi-pass sum, kernels and copies.
LIST_LAUNCHES = 40
#: Instructions per pixel for a pair of Gaussian and raster tile in render and gradient (compute capability 9.0), as
#: counted by `triton_targets`, and float64 instructions for each pair.
PIXEL_INSTRUCTIONS, PAIR_INSTRUCTIONS = (20.5, 22.2), 20
#: Fraction of the scene's Gaussians that are visible in a view. `Job.pairs_each` in `JOBS` assumes Gaussians of a few
#: pixels, as in large scenes. At widths of 980 and 5187 pixels, those of a comb (129,929 Gaussians, `orbit` of eight
#: views) have 3.3 and 22 pairs each in the first view, and the larger ones of the plush toy 12.8 and 236.
VISIBLE_SHARE = 0.5
#: Bytes of tile intersections per visible Gaussian, and per pair.
LIST_BYTES = (80, 8)


@dataclass(frozen=True)
class Device:
    """Data sheet of a GPU.

    Attributes:
        peaks: Operations per second by precision, without sparsity.
        bandwidth: Memory bandwidth in bytes per second.
        memory: Memory size in bytes.
    """

    peaks: Mapping[str, float]
    bandwidth: float
    memory: float

    @property
    def memory_limit(self) -> int:
        """Memory limit in bytes that a job has by default (`budget.default_memory_limit`)."""
        return int(GPU_SHARE * self.memory)


def _device(float16: float, tf32: float, float32: float, float64: float, *rest: float) -> Device:
    return Device({"float16": float16, "tf32": tf32, "float32": float32, "float64": float64}, *rest)


DEVICES = {
    "H200": _device(989e12, 495e12, 67e12, 34e12, 4.8e12, 141e9),
    "H100": _device(989e12, 495e12, 67e12, 34e12, 3.35e12, 80e9),
    "A100": _device(312e12, 156e12, 19.5e12, 9.7e12, 2.04e12, 80e9),
    "RTX 4090": _device(165e12, 82.6e12, 82.6e12, 1.29e12, 1.01e12, 24e9),
}


@dataclass(frozen=True)
class Shares:
    """Assumed fractions of the peak rates, and overheads of launches.

    Attributes:
        convolution: Fraction of `Device.peaks` for convolutions, by precision.
        matrix: Fraction of `Device.peaks` for Triton's products of features and matrices, in float16 or float32.
        moments: The same for products of features with each other.
        bandwidth: Fraction of the memory bandwidth.
        lanes: Fraction of the thread instructions per second for the rasterizer, whose loop has no memory accesses. A
            data sheet counts a fused multiply-add as two float32 operations.
        blended: Fraction of the pairs of Gaussian and tile that are blended before the tile is opaque.
        launch: CPU seconds per kernel launch.
        gap: GPU seconds between two kernels.
    """

    convolution: Mapping[str, float]
    matrix: Mapping[str, float]
    moments: Mapping[str, float]
    bandwidth: float
    lanes: float
    blended: float
    launch: float
    gap: float

    def rates(self, device: Device, precision: str) -> dict[str, float]:
        """Return the operations and bytes per second that `Work.seconds` expects."""
        product = "float16" if precision == "float16" else "float32"
        return {
            "convolution": device.peaks[precision] * self.convolution[precision],
            "matrix": device.peaks[product] * self.matrix[product],
            "moments": device.peaks[product] * self.moments[product],
            "lanes": device.peaks["float32"] / 2 * self.lanes / self.blended,
            "float64": device.peaks["float64"] / 2 * self.lanes / self.blended,
            "bytes": device.bandwidth * self.bandwidth,
        }


def _shares(
    convolution: tuple[float, float, float], matrix: tuple[float, float], moments: tuple[float, float], *rest: float
) -> Shares:
    """Return fractions for convolutions in float32, TF32 and float16, and for products in float32 and float16."""
    kinds = ("float32", "float16")
    convolutions = dict(zip(("float32", "tf32", "float16"), convolution, strict=True))
    return Shares(convolutions, dict(zip(kinds, matrix, strict=True)), dict(zip(kinds, moments, strict=True)), *rest)


#: The likely fractions of convolutions, products and bandwidth are those of a step at 5187x3361 on an H100, except that
#: of the style gradient in bfloat16, whose kernel was measured alone.
SHARES = {
    "optimistic": _shares((0.7, 0.75, 0.7), (0.6, 0.4), (0.6, 0.2), 0.9, 0.7, 0.5, 15e-6, 1e-6),
    "likely": _shares((0.46, 0.62, 0.65), (0.5, 0.3), (0.45, 0.12), 0.85, 0.5, 0.7, 25e-6, 1.5e-6),
    "pessimistic": _shares((0.35, 0.35, 0.4), (0.3, 0.15), (0.25, 0.08), 0.6, 0.35, 1.0, 40e-6, 2.5e-6),
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


#: Typical scene of Tanks and Temples; a smaller one, which `benchmarks.gpu` stylizes; and the garden scene of Mip-NeRF
#: 360 at full size, which it stylizes too, and for which the paper reports 25.5 hours on an A100.
JOBS = {
    "980x545": Job((545, 980), 2_500_000, 2.5, 250),
    "980x545, 1 million": Job((545, 980), 1_000_000, 2.5, 300),
    "5187x3361": Job((3361, 5187), 5_800_000, 15.0, 185),
}


@dataclass(frozen=True)
class Part:
    """Part of a step: work of each launch, mean repetitions per step, and number of launches not in `LAUNCHES`."""

    works: Sequence[Work]
    visits: float = 1.0
    more_launches: int = 0


def content_bytes(sizes: Iterable[Size], tiling: Tiling, cell: int) -> int:
    """Return the size in bytes of the content features of views at all scales, given the bytes per cell."""
    cells = sum(
        (height >> scale + 3) * (width >> scale + 3)
        for height, width in sizes
        for scale in tiling.scales((height, width))
    )
    return cells * cell


def shapes_of(name: str) -> BackboneWeights:
    """Return a network's weights as meta tensors, which have shapes but no values."""
    layers, channels = {}, 3
    for block, count in enumerate(BLOCKS[name], start=1):
        for index in range(1, count + 1):
            width = min(64 << (block - 1), 512)
            layers[f"conv{block}_{index}"] = meta(width, channels, 3, 3), meta(width)
            channels = width
    return BackboneWeights(name, "shapes", "0" * 64, layers, meta(3), meta(3))


def make_loss(device: Device, precision: str) -> SosLoss:
    """Return the loss of VGG19 with the memory budget of a job on the device."""
    dtype = torch.float16 if precision == "float16" else torch.float32
    network = FeatureNetwork(shapes_of("vgg19"), dtype=dtype, device="meta", tf32=precision == "tf32")
    return SosLoss(network, memory=memory_for("activations", device.memory_limit))


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
            with Counted() as there, _as_kernels(there):
                activations = self.loss.network.forward(meta(outer.bottom - outer.top, outer.right - outer.left, 3))
            with Counted() as back, _as_kernels(back):
                self.loss.network.backward(activations, lambda *_: True)  # the style gradient masks it
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
        return (
            [statistics(*piece, size) for piece in pieces],
            [style_gradient(*piece, size) for piece in pieces],
        )

    def content(self) -> list[Work]:
        """Return the work of the kernels of the content term.

        One reads features and their target; the other also reads and writes the gradient.
        """
        cell = self.loss.network.channels(CONTENT_LAYER) * self.loss.network.dtype.itemsize
        return [
            Work(0, tensors * cell * _cells(CONTENT_LAYER, tile, scaled))
            for tile, scaled in self.tiles
            for tensors in (2, 4)
        ]

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


def _as_kernels(counted: Counted) -> AbstractContextManager[Any]:
    """Count pooling, its backward pass with ReLU's, and the first layer as the kernels of a GPU; they need values."""

    def pool(source: Tensor) -> Tensor:
        _, channels, height, width = source.shape
        counted.works.append(Work(0, source.nbytes + source.nbytes // 4))
        return source.new_empty((1, channels, height // 2, width // 2))

    def pool_backward(gradient: Tensor, source: Tensor) -> Tensor:
        counted.works.append(Work(0, gradient.nbytes + 2 * source.nbytes))
        return torch.empty_like(source)

    def convolve(pixels: Tensor, weight: Tensor, bias: Tensor, *_: Tensor) -> Tensor:
        out = meta(1, len(bias), *pixels.shape[:2], dtype=weight.dtype)
        counted.works.append(Work(2.0 * weight.numel() * out[0, 0].numel(), pixels.nbytes + out.nbytes))
        return out

    def gradient(gradient: Tensor, weight: Tensor, scale: Tensor) -> Tensor:
        out = meta(*gradient.shape[2:], 3)
        counted.works.append(Work(2.0 * weight.numel() * gradient[0, 0].numel(), gradient.nbytes + 3 * out.nbytes))
        counted.works.append(Work(0, 4 * out.nbytes))
        return out

    stack = ExitStack()
    stack.enter_context(mock.patch.multiple(vgg, max_pool=pool, max_pool_backward=pool_backward))
    kernels: dict[str, Any] = {"has_kernels": lambda weight: weight.element_size() == 2, "convolve_pixels": convolve}
    stack.enter_context(mock.patch.multiple(first_layer, pixel_gradient=gradient, **kernels))
    return stack


def _cells(layer: str, tile: PartitionTile, size: Size) -> int:
    return tile.owned_cells(layer, size)[1].pixels


def statistics(channels: int, positions: int, size: int) -> Work:
    """Return the work of `statistics_kernels.shifted_moments` and its subsequent kernels.

    Programs that read the same features run at the same time, so that features are read from memory once.

    Args:
        channels: Number of channels of the layer.
        positions: Number of feature cells.
        size: Bytes per feature value.
    """
    tiles = -(-channels // TILE)
    pairs = tiles * (tiles + 1) // 2
    spans = -(-positions // span_positions(positions, channels))
    moved = channels * positions * size + 2 * spans * channels**2 * 4
    return Work(2.0 * min(TILE, channels) ** 2 * pairs * positions, moved, "moments")


def style_gradient(channels: int, positions: int, size: int) -> Work:
    """Return the work of `statistics_terms_kernels.add_style_gradient`.

    It reads the features, and reads and writes the gradient. Float16 features are multiplied by two matrices.
    """
    products = 2 if size == 2 else 1
    return Work(2.0 * products * channels**2 * positions, 3.0 * channels * positions * size, "matrix")


def render(job: Job) -> list[Work]:
    """Return the work of a render with cached tile intersections.

    Each pair reads its depth-order index, eight float64 values and a color. Each pixel writes color and transmittance.
    """
    pixels = job.size[0] * job.size[1]
    return _blending(job, PIXEL_INSTRUCTIONS[0], job.pairs * (4 + 64 + 8 + 12) + 16 * pixels)


def raster_gradient(job: Job) -> list[Work]:
    """Return the work of clearing, writing and summing the gradient slots of pairs, and of the gradient [N, 3]."""
    pixels = job.size[0] * job.size[1]
    return [
        *_blending(job, PIXEL_INSTRUCTIONS[1], job.pairs * (8 + 64 + 24) + 12 * pixels),
        Work(0, 12 * (job.pairs + job.gaussians + job.visible)),
    ]


def _blending(job: Job, instructions: float, moved: float) -> list[Work]:
    """Return the work of a compositing kernel: that of all pixels, and that of preparing the pairs."""
    return [
        Work(job.pairs * RASTER_TILE**2 * instructions, moved, "lanes"),
        Work(job.pairs * PAIR_INSTRUCTIONS, unit="float64"),
    ]


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


def step_parts(
    job: Job, device: Device, precision: str, *, coarse: bool = False, everything_cached: bool = False
) -> dict[str, Part]:
    """Return the parts of a step.

    Args:
        job: Scene and views.
        device: GPU.
        precision: Precision of the feature network.
        coarse: Whether the step belongs to phase 1, which uses the coarsest scale alone.
        everything_cached: Whether content features, intersections and frozen colors of all views are cached.
    """
    loss = make_loss(device, precision)
    count = loss.tiling.scale_count(job.size)
    passes = Passes(loss, job.size, [count - 1] if coarse else range(count))
    forward, backward = passes.network()
    moments, style = passes.style()
    cached = (
        dict.fromkeys(("content", "lists", "colors"), 1.0)
        if everything_cached
        else cached_fractions(job, device, loss, coarse)
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


def cached_fractions(job: Job, device: Device, loss: SosLoss, coarse: bool) -> dict[str, float]:
    """Return the fractions of views whose content features, tile intersections and frozen colors fit the caches."""
    views = view_budget(job, device, loss)
    cell = loss.network.channels(CONTENT_LAYER) * loss.network.dtype.itemsize
    count = loss.tiling.scale_count(job.size)
    size = (job.size[0] >> count - 1, job.size[1] >> count - 1) if coarse else job.size
    of_a_view = {
        "content": (
            views * content_fraction("cuda", weighted=False, has_maps=False),
            content_bytes([size], loss.tiling, cell),
        ),
        "lists": (
            memory_for("rasterizer", device.memory_limit),
            LIST_BYTES[0] * job.visible + LIST_BYTES[1] * job.pairs,
        ),
        "colors": (views / 4, 12.0 * job.gaussians),
    }
    return {name: min(1.0, budget // each / job.views) for name, (budget, each) in of_a_view.items()}


def view_budget(job: Job, device: Device, loss: SosLoss) -> int:
    """Return the memory in bytes for data of views, in a job with CUDA graphs that is measured (`cost.view_memory`)."""
    memory, network = device.memory_limit, loss.network
    budget = memory_for("activations", memory)
    each = network.held_bytes_per_pixel() + network.working_bytes_per_pixel()
    once = min(int(job.size[0] * job.size[1] * each), budget)
    reference = 1 if network.precision == "float32" else 2
    needed = min(once * reference, budget) if network.precision == "float16" else once
    spare = max(budget - needed - once, 0)
    return memory_for("views", memory) - reference * measuring_memory(memory) + spare


def step_seconds(
    parts: Mapping[str, Part],
    shares: Shares,
    device: Device,
    precision: str,
    launches: tuple[int, int] = (LAUNCHES, LOSS_LAUNCHES),
) -> dict[str, float]:
    """Return GPU seconds by part, CPU seconds, and the total: the maximum of both sums.

    Args:
        parts: Parts of the step.
        shares: Assumed fractions of the peak rates.
        device: GPU.
        precision: Precision of the feature network.
        launches: Number of kernels of a step, and how many of them the CUDA graph of the loss starts in one launch.
    """
    rates, (kernels, in_graph) = shares.rates(device, precision), launches
    seconds = {name: part.visits * sum(w.seconds(rates) for w in part.works) for name, part in parts.items()}
    more = sum(part.visits * part.more_launches for part in parts.values())
    seconds["gaps between kernels"] = shares.gap * (kernels + more)
    host = shares.launch * (kernels - in_graph + 1 + more)
    return {**seconds, "host": host, "total": max(sum(seconds.values()), host)}


def forecast(job: Job, device: Device, precision: str) -> dict[str, Any]:
    """Return seconds per step in each phase, with and without complete caches, and the time of jobs."""
    kinds: dict[str, dict[str, bool]] = {
        "sos": {},
        "coarse": {"coarse": True},
        "sos, all cached": {"everything_cached": True},
        "coarse, all cached": {"coarse": True, "everything_cached": True},
    }
    parts = {kind: step_parts(job, device, precision, **options) for kind, options in kinds.items()}
    forecasts: dict[str, Any] = {
        kind: {name: step_seconds(own, shares, device, precision) for name, shares in SHARES.items()}
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
    standard, count = make_settings("standard"), scale_count(*job.size)
    steps = standard.steps_sos * EVEN.sampled_cost(count, standard.scale_sampling)  # that cost as much on all scales
    forecasts["standard"] = {
        name: (standard.steps_coarse + standard.steps_sos - steps) * forecasts["coarse"][name]["total"]
        + steps * forecasts["sos"][name]["total"]
        for name in SHARES
    }
    forecasts["cached"] = cached_fractions(job, device, make_loss(device, precision), coarse=False)
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
    lines.append(row("all steps of `standard`, seconds", "standard", "", 1))
    lines.append(row("10,000 and 10,000 steps, hours", "hours", "", 1, 2))
    lines.append(row("the same, all cached", "hours, all cached", "", 1, 2))
    return "\n".join(lines)


def main() -> None:
    """Compute the forecast, then print and store it."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    results: dict[str, dict[str, Any]] = {}
    for name, job in JOBS.items():
        results[name] = {}
        for title, device in DEVICES.items():
            results[name][title] = {precision: forecast(job, device, precision) for precision in PRECISIONS}
            print(f"\n{name}, {title}\n\n{table(results[name][title])}", flush=True)
    assumptions = {
        "devices": {name: asdict(device) for name, device in DEVICES.items()},
        "shares": {name: asdict(shares) for name, shares in SHARES.items()},
        "jobs": {name: {**asdict(job), "pairs": job.pairs} for name, job in JOBS.items()},
        "launches": LAUNCHES,
        "loss_launches": LOSS_LAUNCHES,
        "pixel_instructions": PIXEL_INSTRUCTIONS,
        "pair_instructions": PAIR_INSTRUCTIONS,
    }
    write_result("forecast", {"assumptions": assumptions, "forecast": results})


if __name__ == "__main__":
    main()

"""Forecast of a step on one H200, from counted operations, bytes and launches, to hold a measurement against.

python -m benchmarks.forecast [--launches 494]

Nothing here is measured on a GPU: peaks are the data sheet's, and how much of them is reached are the `SHARES` below.
The feature network, the image pyramid, colors and the content loss are counted by running the project's own code on
tensors without values; Triton's kernels from their source; the rasterizer from pairs of Gaussian and raster tile.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch

from benchmarks.machine import write_result
from benchmarks.work import Counted, Work, meta
from sgsst_core.budget import GPU_SHARE, MEMORY_SHARES
from sgsst_core.constants import RASTER_TILE
from sgsst_core.features.fused_statistics import SPAN_VALUES, TILE, matrix_precision
from sgsst_core.features.network_sources import BLOCKS
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.partition import PartitionTile
from sgsst_core.features.vgg import CONTENT_LAYER, STYLE_LAYERS, FeatureNetwork
from sgsst_core.loss.sos import SosLoss
from sgsst_core.loss.terms import ContentDifference
from sgsst_core.parallel.division import Size
from sgsst_core.planning.choices import rasterizer_options
from sgsst_core.planning.cost import content_bytes
from sgsst_core.scene.pyramid import add_upscaled_, downscale
from sgsst_core.scene.spherical_harmonics import view_colors, view_colors_gradient
from sgsst_core.settings import make_settings

#: H200 SXM, data sheet, dense: operations a second by what is multiplied, bytes a second, bytes of memory and of L2.
PEAKS = {"bfloat16": 989e12, "tf32": 495e12, "float32": 67e12}
BANDWIDTH, MEMORY, L2 = 4.8e12, 141e9, 50e6
#: Instructions of single threads a second: a float32 operation of the data sheet is half a fused multiply-add.
LANES = PEAKS["float32"] / 2
PRECISIONS = ("float32", "tf32", "bfloat16")
#: Launches of a step in which all that is kept of a view is there: a scan's in bfloat16, as `device_counts` has them.
LAUNCHES = 494
#: Of a view's lists of raster tiles: two sorts in passes, a sum in passes, kernels and copies.
LIST_LAUNCHES = 40
#: Instructions a pixel of a pair of Gaussian and raster tile, as the source of `blend_weights` and of its callers has
#: them: about 30 for the weight, with two functions of a quarter of the rate or less, the rest for three colors.
PIXEL_INSTRUCTIONS = 45
#: Visible Gaussians, and pairs each: half of a scene; as the biker's 152,605 at widths of 980 and 5187, most of which
#: are a few pixels wide, as those of large scenes are. (The plush toy's, which are larger: 12.8 and 236.)
VISIBLE_SHARE = 0.5
#: Bytes that lists keep: of a visible Gaussian, and of a pair.
LIST_BYTES = (80, 8)


@dataclass(frozen=True)
class Shares:
    """How much of the peaks is reached.

    Attributes:
        convolution: by precision, of `PEAKS`.
        matrix: of the same, by Triton's products of features, in TF32 or float32 ("ieee").
        bandwidth: of memory.
        lanes: of `LANES`, by the rasterizer.
        blended: of the pairs of Gaussian and tile, those that come before the tile is opaque.
        launch: seconds of the host for each launch.
    """

    convolution: Mapping[str, float]
    matrix: Mapping[str, float]
    bandwidth: float
    lanes: float
    blended: float
    launch: float

    def rates(self, precision: str) -> dict[str, float]:
        """Operations and bytes a second, for `Work.seconds`."""
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
    "optimiztic": _shares(0.85, 0.75, 0.75, 0.6, 0.5, 0.85, 0.5, 0.5, 3e-6),
    "likely": _shares(0.7, 0.6, 0.6, 0.4, 0.3, 0.7, 0.35, 0.7, 4e-6),
    "pessimistic": _shares(0.5, 0.4, 0.4, 0.25, 0.15, 0.55, 0.25, 1.0, 6e-6),
}


@dataclass(frozen=True)
class Job:
    """A scene and its views.

    Attributes:
        size: (height, width) of every view.
        gaussians: in the scene, SH of degree 3.
        pairs_each: raster tiles that a visible Gaussian touches.
        views: of the job.
    """

    size: Size
    gaussians: int
    pairs_each: float
    views: int

    @property
    def visible(self) -> float:
        """Gaussians that a view shows."""
        return VISIBLE_SHARE * self.gaussians

    @property
    def pairs(self) -> float:
        """Of Gaussian and raster tile, in a view."""
        return self.pairs_each * self.visible


#: A scene of Tanks and Temples, and the garden of Mip-NeRF 360 at its full size: 25.5 hours on an A100 in the paper.
JOBS = {
    "980x545": Job((545, 980), 2_500_000, 2.5, 250),
    "5187x3361": Job((3361, 5187), 5_800_000, 15.0, 185),
}


@dataclass(frozen=True)
class Part:
    """Of a step: its launches, how many of them the host's count of `LAUNCHES` lacks, and how often a step has it."""

    works: Sequence[Work]
    visits: float = 1.0
    more_launches: int = 0


def shapes_of(name: str) -> BackboneWeights:
    """A network's weights, of which only the shapes are there."""
    layers, channels = {}, 3
    for block, count in enumerate(BLOCKS[name], start=1):
        for index in range(1, count + 1):
            width = min(64 << (block - 1), 512)
            layers[f"conv{block}_{index}"] = meta(width, channels, 3, 3), meta(width)
            channels = width
    return BackboneWeights(name, "shapes", "0" * 64, layers, meta(3), meta(3))


def make_loss(precision: str) -> SosLoss:
    """The loss of VGG19 with the memory that a job has on the device."""
    dtype = torch.bfloat16 if precision == "bfloat16" else torch.float32
    network = FeatureNetwork(shapes_of("vgg19"), dtype=dtype, device="meta", tf32=precision == "tf32")
    return SosLoss(network, memory=int(memory_limit() * MEMORY_SHARES["activations"]))


def memory_limit() -> float:
    """Bytes that a job plans with (`budget.default_memory_limit`)."""
    return GPU_SHARE * MEMORY


class Passes:
    """The parts of the loss of some scales of a view."""

    def __init__(self, loss: SosLoss, size: Size, scales: Sequence[int]) -> None:
        self.loss, self.size = loss, size
        self.sizes = {scale: (size[0] >> scale, size[1] >> scale) for scale in scales}
        tiles = {scale: loss.tiles(*scaled) for scale, scaled in self.sizes.items()}
        self.tiles = [(tile, self.sizes[scale]) for scale, own in tiles.items() for tile in own]
        self.kept = loss.tiling.kept([tile.outer.pixels for tile, _ in self.tiles])

    def network(self) -> tuple[list[Work], list[Work]]:
        """Forward; and backward with what has to go forward once more, because its activations do not fit."""
        forward, backward = [], []
        for (tile, _), kept in zip(self.tiles, self.kept, strict=True):
            outer = tile.outer
            with Counted() as there:
                activations = self.loss.network.forward(meta(outer.bottom - outer.top, outer.right - outer.left, 3))
            with Counted() as back:
                self.loss.network.backward(activations, lambda *_: None)
            forward += there.works
            backward += back.works if kept else there.works + back.works
        return forward, backward

    def style(self) -> tuple[list[Work], list[Work]]:
        """Statistics and comparison; and the gradient."""
        size = self.loss.network.dtype.itemsize
        pieces = [
            (self.loss.network.channels(layer), _cells(layer, tile, scaled))
            for tile, scaled in self.tiles
            for layer in STYLE_LAYERS
        ]
        return [statistics(*piece, size) for piece in pieces], [style_gradient(*piece, size) for piece in pieces]

    def content(self) -> list[Work]:
        """Of features that are there: loss and gradient."""
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
        """The scales of an image."""
        with Counted() as counted:
            for scale in self.sizes:
                downscale(meta(*self.size, 3), scale)
        return counted.works

    def added_up(self) -> list[Work]:
        """The scales' gradients, as one of the image."""
        with Counted() as counted:
            for scale, scaled in self.sizes.items():
                add_upscaled_(meta(*self.size, 3), meta(*scaled, 3), scale)
        return counted.works


def _cells(layer: str, tile: PartitionTile, size: Size) -> int:
    return tile.owned_cells(layer, size)[1].pixels


def statistics(channels: int, positions: int, size: int) -> Work:
    """`fused_kernels.shifted_moments` and what follows it.

    Args:
        channels: of the layer.
        positions: cells.
        size: bytes of a feature.
    """
    tiles = -(-channels // TILE)
    pairs = tiles * (tiles + 1) // 2
    # Each pair of tiles reads both of them, those on the diagonal one; spans are walked first, so that a layer larger
    # than the cache is read from memory every time.
    reads = tiles if channels * positions * size > L2 else 1
    spans = -(-positions // (SPAN_VALUES // channels))
    moved = reads * channels * positions * size + 2 * spans * channels**2 * 4
    return Work(2.0 * min(TILE, channels) ** 2 * pairs * positions, moved, "matrix")


def style_gradient(channels: int, positions: int, size: int) -> Work:
    """`fused_kernels.add_style_gradient`: every tile of channels reads all features, and its own gradient twice."""
    tiles = -(-channels // TILE)
    reads = tiles if channels * positions * size > L2 else 1
    return Work(2.0 * channels**2 * positions, (reads + 2.0) * channels * positions * size, "matrix")


def render(job: Job) -> list[Work]:
    """Of kept lists: rank, eight float64 and a color for each pair; image and transmittance."""
    pixels = job.size[0] * job.size[1]
    return [Work(_blending(job), job.pairs * (4 + 64 + 8 + 12) + 16 * pixels, "lanes")]


def raster_gradient(job: Job) -> list[Work]:
    """Slots, cleared, written and added up; the gradient [N, 3]."""
    pixels = job.size[0] * job.size[1]
    return [
        Work(_blending(job), job.pairs * (8 + 64 + 24) + 12 * pixels, "lanes"),
        Work(0, 12 * (job.pairs + job.gaussians + job.visible)),
    ]


def _blending(job: Job) -> float:
    return job.pairs * RASTER_TILE**2 * PIXEL_INSTRUCTIONS


def lists(job: Job) -> list[Work]:
    """Projection; a sort of 8-byte depths and one of 4-byte tiles, with 8-byte places, a byte of the key in each pass.

    Each pass reads and writes keys and places.
    """
    depths, tiles = 8 * 2 * 16 * job.gaussians, 4 * 2 * 12 * job.pairs
    gathered = 40 * job.gaussians + 128 * job.visible + 36 * job.pairs
    return [Work(0, 120 * job.gaussians), Work(0, depths), Work(0, tiles), Work(0, gathered)]


def rest(job: Job) -> list[Work]:
    """Colors' frozen part, from spherical harmonics of degree 3: every coefficient read once, in one launch."""
    return [Work(0, (15 * 12 + 12 + 12) * job.gaussians)]


def colors(job: Job) -> list[Work]:
    """Colors of a view whose frozen part is kept, and the way back; Adam: four tensors read, three written."""
    values = meta(job.gaussians, 3)
    with Counted() as counted:
        view_colors(values, values)
        view_colors_gradient(values, values)
    return [*counted.works, Work(0, (3 + 7) * 12 * job.gaussians)]


def step_parts(job: Job, precision: str, *, coarse: bool = False, everything_kept: bool = False) -> dict[str, Part]:
    """The parts of a step.

    Args:
        job: scene and views.
        precision: of the feature network.
        coarse: of phase 1, on the coarsest scale alone.
        everything_kept: as if the memory held content features, lists and frozen colors of all views.
    """
    loss = make_loss(precision)
    count = loss.scale_count(*job.size)
    passes = Passes(loss, job.size, [count - 1] if coarse else range(count))
    forward, backward = passes.network()
    moments, style = passes.style()
    kept = dict.fromkeys(("content", "lists", "colors"), 1.0) if everything_kept else kept_shares(job, loss, coarse)
    missing = {name: 1 - share for name, share in kept.items()}
    uncached = [*forward, *render(job), *passes.scaled()]
    frozen = rest(job)
    return {
        "convolutions forward": Part([work for work in forward if work.operations]),
        "convolutions backward": Part([work for work in backward if work.operations]),
        "ReLUs, pools, copies": Part([work for work in forward + backward if not work.operations]),
        "statistics": Part(moments),
        "style gradient": Part(style),
        "content loss": Part(passes.content()),
        "content features anew": Part(uncached, missing["content"], len(uncached)),
        "pyramid": Part(passes.scaled() + passes.added_up()),
        "render": Part(render(job)),
        "raster gradient": Part(raster_gradient(job)),
        "lists anew": Part(lists(job), missing["lists"], LIST_LAUNCHES),
        "colors and Adam": Part(colors(job)),
        "frozen colors anew": Part(frozen, missing["colors"] * (1 + missing["content"]), len(frozen)),
    }


def kept_shares(job: Job, loss: SosLoss, coarse: bool) -> dict[str, float]:
    """Of the views, those whose content features, lists and frozen colors fit the memory (`Views`, `KeptLists`)."""
    views = memory_limit() * MEMORY_SHARES["views"]
    cell = loss.network.channels(CONTENT_LAYER) * loss.network.dtype.itemsize
    count = loss.scale_count(*job.size)
    size = (job.size[0] >> count - 1, job.size[1] >> count - 1) if coarse else job.size
    of_a_view = {
        "content": (views / 2, content_bytes([size], loss.tiling, cell)),
        "lists": (
            rasterizer_options("triton", make_settings(), int(memory_limit()))["max_list_bytes"],
            LIST_BYTES[0] * job.visible + LIST_BYTES[1] * job.pairs,
        ),
        "colors": (views / 4, 12.0 * job.gaussians),
    }
    return {name: min(1.0, room // each / job.views) for name, (room, each) in of_a_view.items()}


def step_seconds(parts: Mapping[str, Part], shares: Shares, precision: str, launches: int) -> dict[str, float]:
    """Seconds by part, of the device; of the host's launches; and of the whole: what takes longer."""
    rates = shares.rates(precision)
    seconds = {name: part.visits * sum(w.seconds(rates) for w in part.works) for name, part in parts.items()}
    host = shares.launch * (launches + sum(part.visits * part.more_launches for part in parts.values()))
    return {**seconds, "host": host, "total": max(sum(seconds.values()), host)}


def forecast(job: Job, precision: str, launches: int) -> dict[str, Any]:
    """Seconds of a step of each phase, with and without all kept, and hours of the paper's job, by scenario."""
    kinds: dict[str, dict[str, bool]] = {
        "sos": {},
        "coarse": {"coarse": True},
        "sos, all kept": {"everything_kept": True},
        "coarse, all kept": {"coarse": True, "everything_kept": True},
    }
    parts = {kind: step_parts(job, precision, **options) for kind, options in kinds.items()}
    found: dict[str, Any] = {
        kind: {name: step_seconds(own, shares, precision, launches) for name, shares in SHARES.items()}
        for kind, own in parts.items()
    }
    paper = make_settings("paper")
    for hours, end in (("hours", ""), ("hours, all kept", ", all kept")):
        found[hours] = {
            name: (
                paper.steps_coarse * found[f"coarse{end}"][name]["total"]
                + paper.steps_sos * found[f"sos{end}"][name]["total"]
            )
            / 3600
            for name in SHARES
        }
    found["kept"] = kept_shares(job, make_loss(precision), coarse=False)
    found["teraflops"] = sum(w.operations for w in parts["sos"]["convolutions forward"].works) / 1e12
    return found


def table(found: Mapping[str, Mapping[str, Any]]) -> str:
    """Milliseconds of a step as Markdown, by precision: likely, and in brackets optimiztic and pessimistic."""
    lines = ["| part of a step, ms | " + " | ".join(found) + " |", "|---|" + "---:|" * len(found)]
    first = next(iter(found.values()))["sos"]["likely"]

    def row(name: str, kind: str, part: str, factor: float = 1e3, digits: int = 1) -> str:
        cells = []
        for each in found.values():
            values = {n: factor * (v[part] if part else v) for n, v in each[kind].items()}
            low, mid, high = (values[n] for n in ("optimiztic", "likely", "pessimistic"))
            cells.append(f"{mid:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})")
        return f"| {name} | " + " | ".join(cells) + " |"

    lines += [row(part, "sos", part) for part in first if part != "total"]
    lines.append(row("**a step**", "sos", "total"))
    lines.append(row("a step, all kept", "sos, all kept", "total"))
    lines.append(row("a step of phase 1", "coarse", "total"))
    lines.append(row("10,000 and 10,000 steps, hours", "hours", "", 1, 2))
    lines.append(row("the same, all kept", "hours, all kept", "", 1, 2))
    return "\n".join(lines)


def main() -> None:
    """Forecast, print and store."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--launches", type=int, default=LAUNCHES, help="of a step")
    arguments = parser.parse_args()
    results = {
        name: {precision: forecast(job, precision, arguments.launches) for precision in PRECISIONS}
        for name, job in JOBS.items()
    }
    for name, found in results.items():
        print(f"\n{name}\n\n{table(found)}")
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

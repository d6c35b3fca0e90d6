"""The loss of a view as a CUDA graph: some 400 small kernels in one launch.

On small views a GPU waits for the program to launch one kernel after the other. A graph holds them all, with the places
in memory that they work on: what changes from view to view is copied to those places first.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from sgsst_core.features.partition import PartitionTile
from sgsst_core.loss.sos import ScaleTarget, Share, SosLoss, SosResult, ViewTarget
from sgsst_core.loss.terms import TERMS
from sgsst_core.loss.tiling import Tiling
from sgsst_core.timing import Timer

#: Graphs that are kept at most. One takes about a megabyte beside the memory that all of them share.
MOST_GRAPHS = 256
#: Visits that make nothing faster: one that prepares what kernels need, and the one that is captured.
FIRST_VISITS = 2


def has_graphs(device: torch.device | str) -> bool:
    """Whether a device replays graphs: NVIDIA's. ROCm has them too, but nobody has tried ours there."""
    return torch.device(device).type == "cuda" and torch.version.hip is None


def can_be_captured(tiling: Tiling, areas: Sequence[int]) -> bool:
    """Whether the loss of a view, whose partition tiles have so many pixels, may become a graph.

    Its activations have a place of their own in memory, which nothing else can use: the same work without the graph
    must fit beside it.

    Args:
        areas: of every scale's only tile.
    """
    return tiling.keep_activations and 2 * max(areas, default=0) * (1 + tiling.working) <= tiling.held


@dataclass(frozen=True)
class _Key:
    """What is the same at every replay of a graph, beside the style's targets themselves."""

    size: tuple[int, ...]
    dtype: torch.dtype
    image_scale: int
    tiles: tuple[tuple[int, PartitionTile], ...]
    coverage: tuple[int, ...] | None
    regions: int
    style: int


@dataclass(frozen=True)
class _Graph:
    """A captured evaluation, with the tensors that it reads and writes.

    Attributes:
        graph: a `torch.cuda.CUDAGraph`.
        image, view: what it reads.
        result: what it writes.
    """

    graph: Any
    image: Tensor
    view: ViewTarget
    result: SosResult

    def replay(self, image: Tensor, view: ViewTarget) -> SosResult:
        """The result of an image and a view of the same kind."""
        scales = self.result.scales
        for place, value in zip(_inputs(self.image, self.view, scales), _inputs(image, view, scales), strict=True):
            place.copy_(value)
        self.graph.replay()
        return replace(self.result, values=self.result.values.clone())


class LossGraphs:
    """Evaluates the SOS loss of views as `SosLoss.evaluate` does, from a graph where one can be had.

    The first evaluation of a kind (size, scales, tiles, style) runs as ever, which compiles kernels and lets cuDNN try
    its algorithms; the second one is captured. Where that fails, all go on as ever.

    Args:
        loss: of one rank, on a device that `has_graphs`.
        most: graphs that are kept.

    Attributes:
        problem: why no graph could be captured; None as long as none has failed.
    """

    def __init__(self, loss: SosLoss, most: int = MOST_GRAPHS) -> None:
        if loss.collectives.size > 1:
            raise ValueError("a graph cannot hold what ranks tell each other")
        self.loss = loss
        self.problem: str | None = None
        self._most = most
        #: Style targets by kind, which they keep from becoming another's: their number is part of it.
        self._visited: dict[_Key, Mapping[int, ScaleTarget]] = {}
        self._graphs: dict[_Key, _Graph] = {}
        self._static: dict[tuple[object, ...], Tensor] = {}
        self._stream = torch.cuda.Stream(loss.network.device)
        self._pool: Any = torch.cuda.graph_pool_handle()

    @property
    def captured(self) -> int:
        """How many graphs there are."""
        return len(self._graphs)

    def evaluate(
        self,
        image: Tensor,
        style: Mapping[int, ScaleTarget],
        view: ViewTarget,
        scales: Sequence[int],
        *,
        image_scale: int = 0,
    ) -> SosResult:
        """As `SosLoss.evaluate`, with the gradient.

        The image gradient keeps its values until the next evaluation; `style` must never change in place.
        """
        key = self._key(image, style, view, scales, image_scale)
        graph = self._graphs.get(key) if key else None
        if graph is None and key in self._visited and self.problem is None and len(self._graphs) < self._most:
            assert key is not None
            graph = self._captured(key, image, style, view)
        if graph is None:
            if key and len(self._visited) < self._most:
                self._visited[key] = style
            return self.loss.evaluate(image, style, view, scales, image_scale=image_scale)
        with self.loss.timer("network"):
            return graph.replay(image, view)

    def _key(
        self,
        image: Tensor,
        style: Mapping[int, ScaleTarget],
        view: ViewTarget,
        scales: Sequence[int],
        image_scale: int,
    ) -> _Key | None:
        """The kind of an evaluation; None where it cannot be captured."""
        share = view.share
        if share is None or share.tiles.keys() != set(scales) or any(len(own) != 1 for own in share.tiles.values()):
            return None
        if self.loss.content_weight and any(scale not in view.content for scale in scales):
            return None
        tiles = tuple((scale, share.tiles[scale][0]) for scale in scales)
        if not can_be_captured(self.loss.tiling, [tile.outer.pixels for _, tile in tiles]):
            return None
        coverage = tuple(view.coverage[0].shape) if view.coverage else None
        regions = len(view.regions or ())
        return _Key(tuple(image.shape), image.dtype, image_scale, tiles, coverage, regions, id(style))

    def _captured(self, key: _Key, image: Tensor, style: Mapping[int, ScaleTarget], view: ViewTarget) -> _Graph | None:
        """The graph of a kind of evaluations; None where it fails."""
        try:
            found = self._graphs[key] = self._capture(key, image, style, view)
        except Exception as error:  # whatever it is, there is another way
            self.problem = f"{type(error).__name__}: {error}"
            self._graphs.clear()
            self._static.clear()
            return None
        return found

    def _capture(self, key: _Key, image: Tensor, style: Mapping[int, ScaleTarget], view: ViewTarget) -> _Graph:
        loss, device = self.loss, self.loss.network.device
        scales = [scale for scale, _ in key.tiles]
        own_image, own_view = self._places(key, image, view)
        values = torch.empty((len(scales), len(TERMS)), dtype=torch.float64, device=device)
        dtype = torch.promote_types(loss.network.dtype, torch.float32)
        gradient = self._place("gradient", torch.empty(image.shape, dtype=dtype, device=device))
        graph = torch.cuda.CUDAGraph()
        timer, loss.timer = loss.timer, Timer()  # a graph holds no events that time could be read from
        try:
            # The outer block leaves the stream again even where the capture has failed. Other threads may go on with
            # what no graph can hold.
            with (
                torch.cuda.stream(self._stream),
                torch.cuda.graph(graph, self._pool, self._stream, capture_error_mode="thread_local"),
            ):
                found = loss.evaluate(own_image, style, own_view, scales, image_scale=key.image_scale)
                assert found.image_gradient is not None
                # Into memory that no other graph takes for its activations.
                values.copy_(found.values)
                gradient.copy_(found.image_gradient)
        finally:
            loss.timer = timer
        return _Graph(graph, own_image, own_view, SosResult(found.scales, values, gradient, found.weights))

    def _places(self, key: _Key, image: Tensor, view: ViewTarget) -> tuple[Tensor, ViewTarget]:
        """Where an image and what it is compared with are copied to."""
        content = {
            scale: {tile: self._place(("content", scale), view.content[scale][tile])}
            for scale, tile in key.tiles
            if scale in view.content
        }
        coverage = view.coverage and [self._place(("coverage", k), level) for k, level in enumerate(view.coverage)]
        regions = view.regions and [
            [self._place(("region", number, k), level) for k, level in enumerate(pyramid)]
            for number, pyramid in enumerate(view.regions)
        ]
        tiles = {scale: [tile] for scale, tile in key.tiles}
        return self._place("image", image), ViewTarget(None, content, coverage, Share({}, tiles), regions)

    def _place(self, name: object, like: Tensor) -> Tensor:
        """A tensor that stays where it is. All graphs take the same one for the same purpose, shape and layout."""
        key = (name, like.shape, like.stride(), like.dtype)
        if key not in self._static:
            self._static[key] = torch.empty_like(like, device=self.loss.network.device)
        return self._static[key]


def _inputs(image: Tensor, view: ViewTarget, scales: Sequence[int]) -> list[Tensor]:
    """Everything that changes from one evaluation of a kind to the next, in a fixed order."""
    features = [part for scale in scales if scale in view.content for part in view.content[scale].values()]
    regions = [level for pyramid in view.regions or [] for level in pyramid]
    return [image, *features, *(view.coverage or []), *regions]

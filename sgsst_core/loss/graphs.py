"""CUDA graphs of the loss of a view, which combine about 400 small kernels in one launch.

For small views, the GPU would be idle between separate kernel launches. A graph replays all kernels on fixed memory
addresses, so inputs that differ between views are first copied to these addresses.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from sgsst_core.devices import Timer
from sgsst_core.loss.sos import SosLoss, SosResult
from sgsst_core.loss.terms import TERMS, StyleTargets, ViewTarget
from sgsst_core.parallel import Tiling

#: Maximum number of cached graphs. Each takes about 1 MB, in addition to the memory pool that all graphs share.
MAX_GRAPHS = 256
#: First version of PyTorch whose allocator recovers from a failed capture.
FIRST_TORCH = 2, 13


def can_use_graphs(device: torch.device | str) -> bool:
    """Return whether CUDA graphs are used on a device: on NVIDIA GPUs, the only ones known to replay them.

    Before PyTorch 2.13, the allocator stays in capture mode after a failed capture, so the process could not continue.
    """
    version = tuple(map(int, torch.__version__.split(".")[:2]))
    return torch.device(device).type == "cuda" and torch.version.hip is None and version >= FIRST_TORCH


def can_be_captured(tiling: Tiling, areas: Sequence[int]) -> bool:
    """Return whether the loss of a view can be captured as a graph.

    A graph reserves memory for its activations. The memory budget must have space for these and for the activations of
    an evaluation in eager mode.

    Args:
        areas: Pixel count of the single partition tile of each scale.
    """
    return 2 * max(areas, default=0) * (1 + tiling.working) <= tiling.held


#: Cache key of a graph: all properties that must match for a replay, among them the `id` of the style targets.
_Key = tuple[object, ...]
#: Scales to evaluate, or their weights in the gradient; see `SosLoss.evaluate`.
_Scales = Sequence[int] | Mapping[int, float]


@dataclass(frozen=True)
class _Graph:
    """Captured evaluation with its input and output tensors.

    Attributes:
        image, view: Static inputs; values are copied to them before a replay.
        result: Output; a replay overwrites its tensors.
    """

    graph: Any
    image: Tensor
    view: ViewTarget
    result: SosResult

    def replay(self, image: Tensor, view: ViewTarget) -> SosResult:
        """Evaluate an image and view whose key matches that of the graph."""
        scales = self.result.scales
        for slot, value in zip(_inputs(self.image, self.view, scales), _inputs(image, view, scales), strict=True):
            slot.copy_(value)
        self.graph.replay()
        return replace(self.result, values=self.result.values.clone())


class LossGraphs:
    """Evaluator of the SOS loss that replays CUDA graphs where possible, and otherwise calls `SosLoss.evaluate`.

    The first evaluation with a given key (size, scales, tiles, style) runs in eager mode, which compiles kernels and
    lets cuDNN benchmark its algorithms. The second evaluation is captured as a graph. If capturing fails, this and all
    later evaluations run in eager mode. PyTorch then keeps the memory of the failed capture until the process ends; it
    is at most the memory that `can_be_captured` reserves.

    Args:
        loss: Loss of a single rank, since graphs cannot contain communication, on a device that supports CUDA graphs
            (`can_use_graphs`).

    Attributes:
        problem: Reason why capturing failed; None if it has not failed.
    """

    def __init__(self, loss: SosLoss) -> None:
        self.loss = loss
        self.problem: str | None = None
        #: Style targets by key. A key contains their `id`, which Python could reuse if they were not referenced here.
        self._visited: dict[_Key, StyleTargets] = {}
        self._graphs: dict[_Key, _Graph] = {}
        self._static: dict[tuple[object, ...], Tensor] = {}
        self._stream = torch.cuda.Stream(loss.network.device)
        self._pool: Any = torch.cuda.graph_pool_handle()

    @property
    def captured(self) -> int:
        """Number of captured graphs."""
        return len(self._graphs)

    def clear(self) -> None:
        """Delete all graphs, for example because the partition is about to change."""
        self._graphs.clear()
        self._static.clear()
        self._visited.clear()

    def evaluate(self, image: Tensor, style: StyleTargets, view: ViewTarget, scales: _Scales) -> SosResult:
        """Evaluate the loss and its gradient, as `SosLoss.evaluate` does.

        The next evaluation overwrites the image gradient of the result. `style` must never be changed in place.
        """
        key = self._key(image, style, view, scales)
        graph = self._graphs.get(key) if key else None
        if graph is None and key in self._visited and self.problem is None and len(self._graphs) < MAX_GRAPHS:
            assert key is not None
            try:
                graph = self._graphs[key] = self._capture(image, style, view, scales)
            except Exception as error:  # any failure falls back to eager mode
                self.problem = f"{type(error).__name__}: {error}"
                self.clear()
        if graph is None:
            if key and len(self._visited) < MAX_GRAPHS:
                self._visited[key] = style
            return self.loss.evaluate(image, style, view, scales)
        with self.loss.timer("network"):
            return graph.replay(image, view)

    def _key(self, image: Tensor, style: StyleTargets, view: ViewTarget, scales: _Scales) -> _Key | None:
        """Return the graph key of an evaluation; None if the evaluation cannot be captured."""
        division = view.division
        if division is None or division.tiles.keys() != set(scales):
            return None
        if any(len(own) != 1 for own in division.tiles.values()):
            return None
        tiles = tuple((scale, division.tiles[scale][0]) for scale in scales)
        if not can_be_captured(self.loss.tiling, [tile.outer.pixels for _, tile in tiles]):
            return None
        coverage = tuple(view.coverage[0].shape) if view.coverage else None
        weights = tuple(scales.values()) if isinstance(scales, Mapping) else ()
        regions, weighted = len(view.regions or ()), view.content_weights is not None
        return tuple(image.shape), image.dtype, tiles, weights, coverage, regions, weighted, id(style)

    def _capture(self, image: Tensor, style: StyleTargets, view: ViewTarget, scales: _Scales) -> _Graph:
        loss, device = self.loss, self.loss.network.device
        static_image, static_view = self._static_tensor("image", image), self._static_view(view, scales)
        values = torch.empty((len(scales), len(TERMS)), dtype=torch.float64, device=device)
        dtype = torch.promote_types(loss.network.dtype, torch.float32)
        gradient = self._static_tensor("gradient", torch.empty(image.shape, dtype=dtype, device=device))
        graph = torch.cuda.CUDAGraph()
        timer, loss.timer = loss.timer, Timer()  # events inside a graph cannot be timed
        try:
            # The outer block restores the current stream even if capturing fails. `thread_local` lets other threads
            # keep calling functions that cannot be captured.
            with (
                torch.cuda.stream(self._stream),
                torch.cuda.graph(graph, self._pool, self._stream, capture_error_mode="thread_local"),
            ):
                result = loss.evaluate(static_image, style, static_view, scales)
                assert result.image_gradient is not None
                # Copy to memory that other graphs do not reuse for activations.
                values.copy_(result.values)
                gradient.copy_(result.image_gradient)
        finally:
            loss.timer = timer
        return _Graph(graph, static_image, static_view, SosResult(result.scales, values, gradient, result.weights))

    def _static_view(self, view: ViewTarget, scales: _Scales) -> ViewTarget:
        """Return uninitialized static tensors that match a view's targets in shape, layout and dtype."""

        def pyramid(name: str, levels: list[Tensor]) -> list[Tensor]:
            return [self._static_tensor((name, k), level) for k, level in enumerate(levels)]

        content = {
            scale: {tile: self._static_tensor(("content", scale), own) for tile, own in view.content[scale].items()}
            for scale in scales
            if scale in view.content
        }
        return replace(
            view,
            content=content,
            coverage=view.coverage and pyramid("coverage", view.coverage),
            regions=view.regions and [pyramid(f"region {n}", own) for n, own in enumerate(view.regions)],
            content_weights=view.content_weights and pyramid("content weights", view.content_weights),
        )

    def _static_tensor(self, name: object, like: Tensor) -> Tensor:
        """Return a tensor at a fixed address. Graphs share it if its name, shape, layout and dtype are the same."""
        key = (name, like.shape, like.stride(), like.dtype)
        if key not in self._static:
            self._static[key] = torch.empty_like(like, device=self.loss.network.device)
        return self._static[key]


def _inputs(image: Tensor, view: ViewTarget, scales: Sequence[int]) -> list[Tensor]:
    """Return all input tensors whose values may differ between evaluations with the same key, in a fixed order."""
    features = [tile for scale in scales if scale in view.content for tile in view.content[scale].values()]
    regions = [level for pyramid in view.regions or [] for level in pyramid]
    return [image, *features, *(view.coverage or []), *regions, *(view.content_weights or [])]

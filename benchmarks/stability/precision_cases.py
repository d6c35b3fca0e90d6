"""Hard cases of precision: long sums, and the order of summation over partition tiles."""

import math
from collections.abc import Callable
from functools import reduce

import numpy as np
import torch

from benchmarks.stability.case import Case, CaseResult, texture, vgg16
from benchmarks.stability.sos_reference import applied, layer_statistics_reference
from sgsst_core.features.statistics import LayerStatistics, layer_statistics, merge
from sgsst_core.features.vgg import FeatureNetwork
from sgsst_core.loss.sos import SosLoss, SosResult
from sgsst_core.loss.terms import LayerTarget, style_loss
from sgsst_core.style import Style

#: Relative error bound of a loss that is computed in partition tiles, for any number of tiles.
_TILES_BOUND = 1e-6
#: Relative error bound of results with longer sums. Squares of up to 4096 positions are summed in float32 by matrix
#: products, which some processors accumulate in longer chains than others. After a ReLU, most positions of a channel
#: are 0, so the same addend is rounded the same way repeatedly, and errors do not average out. For an undivided view,
#: the errors of gradient and loss are 4e-7 and 1.5e-7 with AVX2, and 1.2e-6 and 1.3e-6 with AVX-512 on a Xeon.
_SUMS_BOUND = 2e-6


def cases() -> list[Case]:
    """Return all cases of this group."""
    entries: list[tuple[str, str, Callable[[bool], CaseResult]]] = [
        ("Gram matrix of 17 million pixels", "Gram, mean, sigma, relative to float64", _long_sum),
        ("statistics of 1, 2, 7 and 64 tiles", "loss and feature gradient, relative", _statistics_of_tiles),
        ("statistics of tiles in any order", "loss and feature gradient, relative", _order_of_tiles),
        ("whole loss of 1, 2, 7 and 64 tiles", "loss, relative to float64", _tiles),
    ]
    return [Case(name, "precision", measure, measured) for name, measure, measured in entries]


def _long_sum(full: bool) -> CaseResult:
    """Check the statistics of 67 partition tiles of 512 x 512 pixels, as many pixels as in a view of 5187 x 3361.

    The note gives the error of sequential summation in float32.
    """
    generator = torch.Generator().manual_seed(0)
    channels = torch.linspace(1, 300, 64)
    actual, exact = LayerStatistics.zero(64), LayerStatistics.zero(64)
    one_by_one = np.float32(0)
    for _ in range(67 if full else 3):
        features = channels * (1 + torch.randn((512, 512, 64), generator=generator)).relu_()
        actual = merge(actual, layer_statistics(features))
        exact = merge(exact, layer_statistics_reference(features))
        squares = features[..., -1].square().numpy().reshape(-1)
        one_by_one = np.cumsum(np.concatenate([[one_by_one], squares]), dtype=np.float32)[-1]
    pairs = [(actual.gram(), exact.gram()), (actual.std(), exact.std()), (actual.mean, exact.mean)]
    error = max(float(((own - wanted).abs() / wanted).max()) for own, wanted in pairs)
    off = abs(float(one_by_one) / float(exact.count * exact.gram()[-1, -1]) - 1)
    return CaseResult(
        error, 1e-6, f"{int(exact.count):,} positions; float32 added one after the other is off by {off:.1e}"
    )


def _split(height: int, width: int, tiles: int) -> list[tuple[slice, slice]]:
    """Split a view into 1, 2 or 7 strips, or into 8 x 8 rectangles."""
    down, across = (8, 8) if tiles == 64 else (1, tiles)
    rows, columns = (np.linspace(0, side, parts + 1).astype(int) for side, parts in ((height, down), (width, across)))
    return [
        (slice(rows[i], rows[i + 1]), slice(columns[j], columns[j + 1])) for i in range(down) for j in range(across)
    ]


def _agreement(features: torch.Tensor, parts: dict[str, list[LayerStatistics]], target: LayerTarget) -> CaseResult:
    """Return the largest difference of loss and feature gradient between ways to sum up statistics of one layer."""
    results = {name: style_loss(reduce(merge, statistics), target) for name, statistics in parts.items()}
    losses = [float(terms.sum()) for terms, _ in results.values()]
    gradients = [applied(gradient, features) for _, gradient in results.values()]
    error = max(abs(loss / losses[0] - 1) for loss in losses)
    off = max(float((gradient - gradients[0]).norm() / gradients[0].norm()) for gradient in gradients)
    # The loss has the narrower bound, so its error is scaled to the common one.
    error *= _SUMS_BOUND / _TILES_BOUND
    return CaseResult(max(error, off), _SUMS_BOUND, ", ".join(parts))


def _features() -> tuple[torch.Tensor, LayerTarget]:
    """Return real features [160, 224, 64] float32, and the target of a clearly different image.

    The loss of similar images is a small difference of large values, which magnifies rounding errors.
    """
    network = FeatureNetwork(vgg16(), ("relu1_1",))
    style = network.forward(texture(100, 100, 5) ** 3, cache=False).features["relu1_1"]
    return network.forward(texture(160, 224, 4), cache=False).features["relu1_1"], LayerTarget.of(
        layer_statistics(style)
    )


def _statistics_of_tiles(full: bool) -> CaseResult:
    features, target = _features()
    parts = {
        f"{tiles} tile{'s' * (tiles > 1)}": [
            layer_statistics(features[index]) for index in _split(features.shape[0], features.shape[1], tiles)
        ]
        for tiles in (1, 2, 7, 64)
    }
    return _agreement(features, parts, target)


def _order_of_tiles(full: bool) -> CaseResult:
    features, target = _features()
    parts = [layer_statistics(features[index]) for index in _split(features.shape[0], features.shape[1], 64)]
    shuffled = [parts[i] for i in torch.randperm(64, generator=torch.Generator().manual_seed(0)).tolist()]
    return _agreement(features, {"as they come": parts, "backwards": parts[::-1], "shuffled": shuffled}, target)


def _tiles(full: bool) -> CaseResult:
    """Check the whole loss with the view in 1, 2, 7 and 64 tiles.

    The forward pass differs too, because the network sees each tile separately. Flipped max-pool decisions are not
    errors.
    """
    size = (16, 1024) if full else (16, 448)
    counts = {1: None, 2: 512, 7: 160, 64: 16} if full else {1: None, 2: 224, 7: 64}
    exact = _loss_of(size, None, torch.float64)[0].loss
    losses, gradients = [], []
    for tiles, tile_size in counts.items():
        result, actual = _loss_of(size, tile_size, torch.float32)
        if actual != tiles:
            return CaseResult(math.inf, 0.0, f"{actual} tiles where {tiles} were meant")
        assert result.image_gradient is not None
        losses.append(result.loss)
        gradients.append(result.image_gradient)
    # The bound of the undivided view, which has the longest sums, is _SUMS_BOUND. The bound of tiles is _TILES_BOUND,
    # so their error is scaled.
    whole, *tiled = (abs(loss / exact - 1) for loss in losses)
    error = max(whole, max(tiled) * _SUMS_BOUND / _TILES_BOUND)
    off = max(float((gradient - gradients[0]).norm() / gradients[0].norm()) for gradient in gradients)
    names = ", ".join(map(str, counts))
    return CaseResult(error, _SUMS_BOUND, f"{names} tiles; pixel gradient, with flipped decisions, within {off:.1e}")


def _loss_of(size: tuple[int, int], tile_size: int | None, dtype: torch.dtype) -> tuple[SosResult, int]:
    """Return the whole loss of an image, and its number of partition tiles."""
    image, style, content = (texture(*size, seed).to(dtype) for seed in (1, 2, 3))
    loss = SosLoss(FeatureNetwork(vgg16(), dtype=dtype), tile_size=tile_size)
    return loss.evaluate(image, loss.targets.of_style(Style.of(style), size), loss.targets.of_view(content)), len(
        loss.tiling.tiles(size)
    )

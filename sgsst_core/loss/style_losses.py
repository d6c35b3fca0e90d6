"""Available style losses, and the layers of the feature network that each of them reads.

`sos` is the paper's loss: Gram matrices, means and standard deviations of `STYLE_LAYERS`. `nnfm` replaces them with the
nearest-neighbor term (`nearest`); `mixed` uses both. Every scale of the SOS loss has the same terms.

If the weights have a factor for `PIXELS` (`feature_scale`), the mean and standard deviation of the pixels are compared
too.
"""

from __future__ import annotations

from sgsst_core.features.network_sources import BLOCKS
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.vgg import CONTENT_LAYER, PIXELS, STYLE_LAYERS
from sgsst_core.loss.terms import MEAN_WEIGHT, PAPERS_WEIGHTS, STD_WEIGHT, TermWeights
from sgsst_core.settings import StyleLossName

#: Factor from features of ImageNet-normalized input, for which ARF's weights are meant, to features of a 0-255 input.
_FEATURE_UNITS = 255 * 0.226
#: w_n for `nnfm`. With content_weight 1, the nearest-neighbor and content terms are balanced as in ARF for 360-degree
#: scenes (content weight 5e-3 in units of ImageNet-normalized features: github.com/Kai-46/ARF-svox2, opt/try_tnt.sh).
NNFM_WEIGHT = _FEATURE_UNITS**2 / 5e-3
#: w_n for `mixed`. Within 20 to 30 steps, the color gradient of the statistics terms falls to a tenth. With this
#: weight, the color gradient of the nearest-neighbor term then has the same norm. Four pairs of scene and painting need
#: 1.8e8 to 1.7e9; the constant is their geometric mean. It does not depend on the scene, so that a job has the same
#: loss wherever it runs or resumes.
MIXED_WEIGHT = 5e8
#: w_n of each loss for features in units of a 0-255 input; 0 if the loss matches no features.
NEAREST_WEIGHTS: dict[StyleLossName, float] = {"sos": 0.0, "nnfm": NNFM_WEIGHT, "mixed": MIXED_WEIGHT}


def nearest_weight(style_loss: StyleLossName, unit: float = 1.0) -> float:
    """Return w_n, the weight of the nearest-neighbor term.

    It is scaled by the square of the feature unit (`FeatureNetwork.unit`), because the terms that it is balanced
    against grow by this factor.
    """
    return NEAREST_WEIGHTS[style_loss] * unit**2


def has_statistics(style_loss: StyleLossName) -> bool:
    """Return whether a loss compares Gram matrices, means and standard deviations."""
    return style_loss != "nnfm"


def nearest_layers(style_loss: StyleLossName, network: str) -> tuple[str, ...]:
    """Return the layers whose features are matched: all of the third block, as in ARF, or none.

    Args:
        style_loss: Style loss.
        network: "vgg16" or "vgg19".
    """
    count = BLOCKS[network][2] if NEAREST_WEIGHTS[style_loss] else 0
    return tuple(f"relu3_{index}" for index in range(1, count + 1))


def statistics_layers(style_loss: StyleLossName, weights: BackboneWeights) -> tuple[str, ...]:
    """Return the layers whose statistics a loss compares; empty if it compares none."""
    if not has_statistics(style_loss):
        return ()
    return (PIXELS, *STYLE_LAYERS) if PIXELS in weights.scales else STYLE_LAYERS


def term_weights(layer: str, pixel_weight: float) -> TermWeights:
    """Return the weights of a layer's terms.

    They are the paper's weights, except that `PIXELS` has no Gram term, and its other terms are multiplied by
    `pixel_weight`.
    """
    if layer != PIXELS:
        return PAPERS_WEIGHTS
    return TermWeights(0.0, MEAN_WEIGHT * pixel_weight, STD_WEIGHT * pixel_weight)


def layers_of(style_loss: StyleLossName, weights: BackboneWeights, *, content: bool) -> tuple[str, ...]:
    """Return every layer that a loss reads from a network.

    Args:
        style_loss: Style loss.
        weights: Weights of the network.
        content: Whether the loss has a content term.
    """
    statistics = statistics_layers(style_loss, weights)
    nearest = nearest_layers(style_loss, weights.name)
    return tuple(dict.fromkeys((*statistics, *nearest, *((CONTENT_LAYER,) if content else ()))))

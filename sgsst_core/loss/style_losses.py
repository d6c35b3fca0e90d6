"""What views are compared with a style by, and which layers of the feature network each of these losses reads.

`sos` is the paper's: Gram matrices, means and standard deviations of `STYLE_LAYERS`. `nnfm` puts the nearest-neighbor
term (`nearest`) in their place, `mixed` adds it to them. Every scale of the SOS loss has the same terms.

Where weights have a factor for `PIXELS` (`feature_scale`), means and standard deviations of these are compared as well.
"""

from __future__ import annotations

from sgsst_core.features.network_sources import BLOCKS
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.vgg import CONTENT_LAYER, PIXELS, STYLE_LAYERS
from sgsst_core.loss.terms import MEAN_WEIGHT, PAPERS_WEIGHTS, STD_WEIGHT, TermWeights
from sgsst_core.settings import StyleLossName

#: What brings ImageNet-normalized features, in which ARF's weights are meant, to the units of a 0-255 input.
_FEATURE_UNITS = 255 * 0.226
#: w_n: with content_weight 1, nearest neighbors and content are weighted as ARF does it for scenes seen from all sides
#: (content weight 5e-3 in the units of ImageNet-normalized features: github.com/Kai-46/ARF-svox2, opt/try_tnt.sh).
NNFM_WEIGHT = _FEATURE_UNITS**2 / 5e-3
#: w_n beside the statistics, whose gradient falls to a tenth in 20 to 30 steps: with this weight the gradients
#: of both, with respect to the colors, are as long as each other then. For four pairs of scene and painting that takes
#: 1.8e8 to 1.7e9, of which this is the geometric mean: scenes are as different as that, but the same job has the same
#: loss, whoever runs or resumes it.
MIXED_WEIGHT = 5e8
#: w_n of each loss, for features in units of a 0-255 input; 0 where nothing is matched.
NEAREST_WEIGHTS: dict[StyleLossName, float] = {"sos": 0.0, "nnfm": NNFM_WEIGHT, "mixed": MIXED_WEIGHT}


def nearest_weight(style_loss: StyleLossName, unit: float = 1.0) -> float:
    """w_n: what it is weighed against grows with the square of the features' unit (`FeatureNetwork.unit`)."""
    return NEAREST_WEIGHTS[style_loss] * unit**2


def has_statistics(style_loss: StyleLossName) -> bool:
    """Whether a loss compares Gram matrices, means and standard deviations."""
    return style_loss != "nnfm"


def nearest_layers(style_loss: StyleLossName, network: str) -> tuple[str, ...]:
    """The layers whose features are matched, as ARF has it: all of the third block; none where nothing is matched.

    Args:
        network: "vgg16" or "vgg19".
    """
    count = BLOCKS[network][2] if NEAREST_WEIGHTS[style_loss] else 0
    return tuple(f"relu3_{index}" for index in range(1, count + 1))


def statistics_layers(style_loss: StyleLossName, weights: BackboneWeights) -> tuple[str, ...]:
    """The layers whose statistics are compared, by a loss on a network; none where it has none."""
    if not has_statistics(style_loss):
        return ()
    return (PIXELS, *STYLE_LAYERS) if PIXELS in weights.scales else STYLE_LAYERS


def term_weights(layer: str, pixel_weight: float) -> TermWeights:
    """Weights of a layer's terms: the paper's, and of `PIXELS` no Gram matrix and the others times `pixel_weight`."""
    if layer != PIXELS:
        return PAPERS_WEIGHTS
    return TermWeights(0.0, MEAN_WEIGHT * pixel_weight, STD_WEIGHT * pixel_weight)


def layers_of(style_loss: StyleLossName, weights: BackboneWeights, *, content: bool) -> tuple[str, ...]:
    """Every layer that a loss reads of a network.

    Args:
        content: it has a content term.
    """
    statistics = statistics_layers(style_loss, weights)
    nearest = nearest_layers(style_loss, weights.name)
    return tuple(dict.fromkeys((*statistics, *nearest, *((CONTENT_LAYER,) if content else ()))))

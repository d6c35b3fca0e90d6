"""Terms of the loss of one scale, and the layers of the feature network that they read.

The style loss `sos` is the paper's: Gram matrices, means and standard deviations of `STYLE_LAYERS`. `nnfm` replaces
them with the nearest-neighbor term; `mixed` uses both. Every scale has the same terms.

If the weights have a factor for `PIXELS` (`feature_scale`), the mean and standard deviation of the pixels are compared
too.
"""

from __future__ import annotations

import operator
from collections.abc import Iterator, Mapping
from functools import reduce

from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.loss.content import ContentTerm
from sgsst_core.loss.nearest import NearestTerm
from sgsst_core.loss.position_term import Objective, PositionTerm
from sgsst_core.loss.statistics_terms import STATISTICS_TERMS, statistics_layers
from sgsst_core.settings import Settings, StyleLossName, make_settings

#: Terms that are sums over positions.
POSITION_TERMS: tuple[type[PositionTerm], ...] = (ContentTerm, NearestTerm)
#: Terms whose sum is the loss of a scale: name in files and reports, and display name. Summation, display and chart
#: colors follow this order.
TERMS = STATISTICS_TERMS | {term.name: term.label for term in POSITION_TERMS}


def layers_of(
    style_loss: StyleLossName, weights: BackboneWeights, *, content: bool, settings: Settings | None = None
) -> tuple[str, ...]:
    """Return every layer that a loss reads from a network; settings other than the defaults may add terms."""
    objective = Objective(weights.name, style_loss, float(content), settings or make_settings())
    read = [term.layers(objective) for term in POSITION_TERMS]
    layers = (*statistics_layers(style_loss, weights), *(layer for every in read for layer in every))
    return tuple(dict.fromkeys(layers))


class LossTerms(Mapping[str, float]):
    """Immutable mapping from every name in `TERMS` to its value: the loss of one scale, split into terms.

    Args:
        values: Values by name; missing terms are 0.

    Raises:
        TypeError: If a name is not in `TERMS`.
    """

    __slots__ = ("_values",)

    def __init__(self, **values: float) -> None:
        unknown = ", ".join(values.keys() - TERMS.keys())
        if unknown:
            raise TypeError(f"the loss has no term {unknown}; it has {', '.join(TERMS)}")
        self._values = {name: values.get(name, 0.0) for name in TERMS}

    @property
    def total(self) -> float:
        """Sum of all terms, the loss to minimize."""
        # `sum` rounds differently from Python 3.12 on, so results would depend on the interpreter.
        return reduce(operator.add, self._values.values())

    def __getitem__(self, name: str) -> float:
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def __add__(self, other: LossTerms) -> LossTerms:
        return LossTerms(**{name: value + other[name] for name, value in self.items()})

    def __truediv__(self, count: int) -> LossTerms:
        """Divide every term by a count, which turns a sum into a mean."""
        return LossTerms(**{name: value / count for name, value in self.items()})

    def __repr__(self) -> str:
        return f"LossTerms({', '.join(f'{name}={value!r}' for name, value in self.items())})"

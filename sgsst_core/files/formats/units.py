"""Units of a scene's values: logarithms of scales, logits of opacities, and SH coefficients of colors.

Programs confuse them with the values themselves, which gives plausible numbers. Formats that store deviations and
opacities convert them here, and all scenes are checked after they were read.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sgsst_core.errors import SceneError
from sgsst_core.files.formats.scene_format import Arrays

#: Fraction of values outside their range, above which they have other units.
_MAX_OUTSIDE = 0.2
#: Number of Gaussians below which values in an unusual range say nothing, and maximum number that is sampled.
_MIN_GAUSSIANS, _SAMPLE = 16, 100_000
#: SH coefficient of degree 0 above which colors are not those of 3DGS: eight times as bright as white.
_LARGEST_COLOR = 26.0
#: Range of the largest logit that is doubtful if none is negative: more than trainers reach, at most a byte.
_DOUBTFUL_LOGITS = (40.0, 255.0)
#: Ends of the range that coefficients fill if they are colors of 0 to 1.
_COLOR_ENDS = (0.1, 0.9)
_HINT = "Export the scene again with logarithms of scales and logits of opacities, as 3DGS trainers write them."


def logarithms(path: Path, deviations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the logarithms of stored standard deviations; those of negative ones are NaN.

    Raises:
        SceneError: If many are negative, because they are logarithms themselves.
    """
    if (deviations < 0).mean() > _MAX_OUTSIDE:
        raise SceneError(
            f"{path}: its scales are negative, so they are logarithms, but the format stores standard deviations. "
            "Export the scene again."
        )
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # invalid values are reported later
        result: NDArray[np.float64] = np.log(deviations)
    return result


def logits(path: Path, opacities: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the logits of stored opacities; those outside 0..1 are NaN.

    Raises:
        SceneError: If many are outside, because they are logits themselves.
    """
    if ((opacities < 0) | (opacities > 1)).mean() > _MAX_OUTSIDE:
        raise SceneError(
            f"{path}: its opacities are not in 0..1, so they are logits, but the format stores opacities. "
            "Export the scene again."
        )
    with np.errstate(divide="ignore", invalid="ignore"):
        result: NDArray[np.float64] = np.log(opacities) - np.log1p(-opacities)
    return result


def check_units(path: Path, arrays: Arrays, flat: float, *, logits_stored: bool) -> tuple[str, ...]:
    """Check that values are logarithms, logits and SH coefficients, and return notes on doubtful ones.

    Args:
        arrays: Arrays of the scene, whose invalid Gaussians are ignored.
        flat: Log scale of axes that the file does not have.
        logits_stored: Whether the format stores logits. Opacities of others may be in any part of 0..1.

    Raises:
        SceneError: If scales, opacities or colors were stored as they are.
    """
    if len(arrays["means"]) < _MIN_GAUSSIANS:
        return ()
    scales, opacities, colors = (_range(arrays[name]) for name in ("scales", "opacities", "sh_dc"))
    axes = arrays["scales"][:, [axis for axis in range(3) if arrays["scales"][:1, axis] != flat]]
    scales = _range(axes) if axes.shape[1] else scales
    activated = opacities[0] >= 0 and 0 < opacities[1] <= 1
    large = scales[0] >= 0 and scales[1] > 0
    if large and (activated or _fits_as_deviations(arrays["means"], axes)):
        also = f", and its opacities from {opacities[0]:.3g} to {opacities[1]:.3g}" if activated else ""
        raise SceneError(
            f"{path}: its log scales go from {scales[0]:.3g} to {scales[1]:.3g}{also}: they seem to be stored as they "
            f"are (activated). {_HINT}"
        )
    if activated and logits_stored:
        raise SceneError(
            f"{path}: its logits of opacities go from {opacities[0]:.3g} to {opacities[1]:.3g}: they seem to be "
            f"opacities (activated). {_HINT}"
        )
    if colors[0] >= 0 and colors[1] > _LARGEST_COLOR:
        raise SceneError(
            f"{path}: its colors (f_dc) go from {colors[0]:.3g} to {colors[1]:.3g}: they seem to be colors of 0 to "
            "255, not SH coefficients. Export the scene again with (color / 255 - 0.5) / 0.2821."
        )
    notes = []
    if opacities[0] >= 0 and _DOUBTFUL_LOGITS[0] < opacities[1] <= _DOUBTFUL_LOGITS[1]:
        notes.append(
            f"logits of opacities go from {opacities[0]:.3g} to {opacities[1]:.3g}, which is opaque; if they are "
            "opacities of 0 to 100 or 255, export the scene again with logits"
        )
    if 0 <= colors[0] < _COLOR_ENDS[0] and _COLOR_ENDS[1] < colors[1] <= 1:
        notes.append(
            f"colors (f_dc) go from {colors[0]:.3g} to {colors[1]:.3g}, which is gray to light; if they are colors of "
            "0 to 1, export the scene again with (color - 0.5) / 0.2821"
        )
    return tuple(notes)


def _range(values: NDArray[np.float32]) -> tuple[float, float]:
    """Return the smallest and the largest of values that are not NaN."""
    with np.errstate(invalid="ignore"):
        return float(np.fmin.reduce(values, axis=None)), float(np.fmax.reduce(values, axis=None))


def _fits_as_deviations(means: NDArray[np.float32], scales: NDArray[np.float32]) -> bool:
    """Return whether sizes fit the distance between neighbors better as they are than as logarithms.

    Args:
        means: Positions [N, 3].
        scales: Scales [N, axes], at least 0.
    """
    step = -(-len(means) // _SAMPLE)
    low, high = np.nanquantile(means[::step], (0.05, 0.95), axis=0)
    extent = float((high - low).max())
    size = float(np.nanmedian(scales[::step].max(axis=1)))
    if not 0 < size < extent:
        return False
    distance = np.log(extent / np.sqrt(len(means)))
    return bool(abs(np.log(size) - distance) < abs(size - distance))

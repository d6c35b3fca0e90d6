"""Arrays of a scene that is being read, and the invalid values found in them."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sgsst_core.constants import COLOR_OFFSET, SH_C0
from sgsst_core.errors import SceneError
from sgsst_core.files.formats.ply import PROPERTIES, RGB, PlySceneHeader
from sgsst_core.files.formats.ply_header import FILTER_3D, is_flat
from sgsst_core.files.formats.quantized import OPACITY_LOGITS
from sgsst_core.files.formats.scene_format import SceneHeader
from sgsst_core.scene.stored_harmonics import RowLayout

#: Order of the properties in messages; f_rest_* follow.
_ORDER = (*itertools.chain(*PROPERTIES.values()), "opacity")
#: Log scale of the missing axis of flat Gaussians. In any scene, their thickness is far below rounding errors.
FLAT = -40.0
#: Rounding error of positions, relative to the median standard deviation of Gaussians, above which it is noted.
MAX_ROUNDED = 0.1


class _Flaws(NamedTuple):
    """Invalid values in a block of rows.

    Attributes:
        start: First row of the block.
        valid: Mask [n] bool of rows with valid values only.
        counts: Numbers of NaN and of infinite values, for each property that has any.
        unrotated: Rows with a quaternion of length 0, which is not a rotation.
    """

    start: int
    valid: NDArray[np.bool_]
    counts: dict[str, NDArray[np.int64]]
    unrotated: NDArray[np.int64]


def about_rounded_positions(means: NDArray[Any], scales: NDArray[Any]) -> tuple[str, ...]:
    """Return a note if positions in double precision are too large for float32.

    Args:
        means: Positions [N, 3] float32.
        scales: Log scales [N, 3].
    """
    with np.errstate(over="ignore"):
        error = 0.5 * float(np.spacing(np.nanmedian(np.abs(means), axis=0)).max())
        fraction = error / max(float(np.exp(np.nanmedian(scales))), 1e-30)
    if not fraction > MAX_ROUNDED:
        return ()
    return (
        f"positions are rounded to float32 by up to {error:.2g}, {fraction:.1f} times the size of a typical Gaussian; "
        "subtract an offset from the positions of Gaussians and cameras first",
    )


class SceneColumns:
    """Arrays of a scene, filled block by block from the rows of a file, and the invalid values found in them.

    Args:
        stored: Layout of SH coefficients that stay in the file and are only checked; None if there are none.

    Attributes:
        arrays: float32 arrays by the names of the scene's tensors.
        flaws: Invalid values of each block that contains any.
        clamped: Number of infinite opacities in each block that contains any. They are replaced by the logits of
            almost 0 and 1 that compressed formats use, because exporters write an alpha of 255 as infinity.
    """

    def __init__(self, header: SceneHeader, stored: RowLayout | None) -> None:
        ply = header if isinstance(header, PlySceneHeader) else None
        names = set(ply.ply.vertex.kinds) if ply else set()
        count, coefficients = header.count, 0 if stored else header.coefficients
        self._stored = stored
        self._sources = ply.sources if ply else {}
        self.arrays: dict[str, NDArray[Any]] = {
            name: np.empty((count, len(columns)), np.float32) for name, columns in PROPERTIES.items()
        }
        self.arrays["opacities"] = np.empty(count, np.float32)
        self.arrays["sh_rest"] = np.empty((count, coefficients, 3), np.float32)
        self._targets = {
            prop: self.arrays[name][:, i] for name, columns in PROPERTIES.items() for i, prop in enumerate(columns)
        }
        self._targets["opacity"] = self.arrays["opacities"]
        stride = ply.stored_coefficients if ply else coefficients
        for channel, i in itertools.product(range(3), range(coefficients)):
            self._targets[f"f_rest_{channel * stride + i}"] = self.arrays["sh_rest"][:, i, channel]
        self._filtered = FILTER_3D in names
        if is_flat(names) and "scale_2" not in self._sources:
            self._targets.pop("scale_2")[:] = FLAT
        self.flaws: list[_Flaws] = []
        self.clamped: list[int] = []

    def take(self, start: int, rows: NDArray[Any]) -> None:
        """Copy a structured block of rows to the arrays from row `start` on. Thread-safe for different blocks."""
        block = slice(start, start + len(rows))
        with np.errstate(over="ignore"):  # a double too large for float32 becomes infinite and is reported as such
            for name, target in self._targets.items():
                source = self._sources.get(name, name)
                target[block] = (rows[source] / 255 - COLOR_OFFSET) / SH_C0 if source in RGB else rows[source]
        if self._filtered:
            apply_filter(self.arrays["scales"][block], self.arrays["opacities"][block], rows[FILTER_3D])
        self.check(start, len(rows), rows)

    def check(self, start: int, count: int, rows: NDArray[Any] | None = None) -> None:
        """Record invalid values of `count` rows from `start` on.

        `rows` is required if SH coefficients stay in the file.
        """
        opacities = self.arrays["opacities"][start : start + count]
        infinite = np.isinf(opacities)
        if infinite.any():
            self.clamped.append(int(infinite.sum()))
            np.clip(opacities, OPACITY_LOGITS[0], OPACITY_LOGITS[-1], out=opacities, where=infinite)
        arrays = [array[start : start + count] for array in self.arrays.values()]
        if self._stored is not None and rows is not None:
            table = rows.view(np.uint8).view("<f4").reshape(len(rows), -1)
            first = self._stored.column // 4
            arrays.append(table[:, first : first + 3 * self._stored.coefficients])
        rotated = (self.arrays["quats"][start : start + count] != 0).any(axis=1)
        if not (rotated.all() and all(bool(np.isfinite(array).all()) for array in arrays)):
            self.flaws.append(self._flaws_of(start, count, rows))

    def _flaws_of(self, start: int, count: int, rows: NDArray[Any] | None) -> _Flaws:
        valid, counts = (self.arrays["quats"][start : start + count] != 0).any(axis=1), {}
        unrotated = start + np.flatnonzero(~valid)
        columns = {name: target[start : start + count] for name, target in self._targets.items()}
        if self._stored is not None and rows is not None:
            columns |= {name: rows[name] for name in map("f_rest_{}".format, range(3 * self._stored.coefficients))}
        for name, column in columns.items():
            nans, infinite = np.isnan(column), np.isinf(column)
            valid &= ~(nans | infinite)
            if nans.any() or infinite.any():
                counts[name] = np.array([nans.sum(), infinite.sum()])
        return _Flaws(start, valid, counts, unrotated)

    def valid_rows(self, path: Path, drop_invalid: bool, surplus: tuple[str, ...]) -> NDArray[np.bool_] | None:
        """Return the mask [count] bool of valid rows; None if all are valid.

        Args:
            drop_invalid: Whether rows may be invalid.
            surplus: Note on content after the rows. With it, invalid rows mean that the header does not fit them.

        Raises:
            SceneError: If invalid rows may not be dropped, or no valid rows remain.
        """
        if not self.flaws:
            return None
        retained = np.ones(len(self.arrays["means"]), dtype=np.bool_)
        totals: dict[str, NDArray[np.int64]] = {}
        unrotated = np.concatenate([flaw.unrotated for flaw in self.flaws])
        for flaw in self.flaws:
            retained[flaw.start : flaw.start + len(flaw.valid)] = flaw.valid
            for name, numbers in flaw.counts.items():
                totals[name] = totals.get(name, 0) + numbers
        rest = sorted(
            (name for name in totals if name not in _ORDER), key=lambda name: int(name.removeprefix("f_rest_"))
        )
        invalid = []
        for name in [*(name for name in _ORDER if name in totals), *rest]:
            counts = dict(zip(("NaN", "infinite"), totals[name], strict=True))
            invalid.append(f"{name} ({', '.join(f'{number} {what}' for what, number in counts.items() if number)})")
        bad = int((~retained).sum())
        flawed = [f"hold NaN or infinite values: {', '.join(invalid)}"] if invalid else []
        if len(unrotated):
            flawed += [
                f"have a quaternion of length 0, not a rotation ({len(unrotated)}, first: Gaussian {min(unrotated)})"
            ]
        summary = f"{path}: {bad} of {len(retained)} Gaussians {', or '.join(flawed)}"
        if surplus:
            raise SceneError(f"{summary}. Its rows are not as the header declares: {surplus[0]}.")
        if bad == len(retained):
            raise SceneError(f"{summary}. No valid Gaussians remain. Train or export the scene again.")
        if not drop_invalid:
            raise SceneError(f"{summary}. Use --drop-invalid to drop these Gaussians.")
        return retained


def apply_filter(scales: NDArray[np.float32], opacities: NDArray[np.float32], deviations: NDArray[Any]) -> None:
    """Convolve Gaussians with the 3D filters of Mip-Splatting, in place.

    A filter limits the detail of a Gaussian to what its training views could sample. Trainers keep its deviation beside
    the Gaussian (property `filter_3D`), which is drawn convolved, at an opacity that keeps its integral. Variances
    along the axes become s^2 + f^2, and the opacity is multiplied by the square root of the ratio of the determinants
    before and after. Both are computed from logarithms, so that nothing over- or underflows.

    Args:
        scales: [n, 3], log scales.
        opacities: [n], logits.
        deviations: [n], deviation f of each filter, in world units; 0 leaves the Gaussian unchanged.
    """
    before, logits = scales.astype(np.float64), opacities.astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # invalid values are reported later
        filters = 2 * np.log(np.abs(deviations.astype(np.float64)))
        after = np.logaddexp(2 * before, filters[:, None]) / 2
        ratio = (before - after).sum(axis=1)
        log_opacity = ratio - np.logaddexp(0, -logits)
        filtered = log_opacity - np.log(-np.expm1(log_opacity))
    scales[:] = after
    opacities[:] = np.where(ratio < 0, filtered, logits)

"""Registry entry of a scene format, and what several formats need: units, quantization, axes.

A file may state its render mode.

Programs confuse logarithms of scales and logits of opacities with the values themselves, which gives plausible numbers.
Formats that store deviations and opacities convert them here, and all scenes are checked after they were read.

Compressed formats share the bytes of opacities, rotations by their three smallest components, and an order. All
computations use float64, so that the format's own rounding is the only loss.

A PLY has the axes of its cameras: x right, y down, z forward. A `Frame` converts others.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from io import BufferedReader
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sgsst_core.constants import EPS2D, SH_DEGREES, spherical_harmonics
from sgsst_core.errors import SceneError, reading_scene
from sgsst_core.scene.rendering import CLASSIC, MAX_EPS2D, Rendering

#: SH coefficients per color channel above degree 0, by SH degree.
COEFFICIENTS = {degree: number for number, degree in SH_DEGREES.items()}
#: The same for files, whose coefficients of degree 4 are not drawn.
STORED_COEFFICIENTS = {**COEFFICIENTS, 4: 24}
#: Gaussians that are converted at a time.
BLOCK_ROWS = 1 << 16

#: float32 arrays of N Gaussians by the names of `Scene`'s tensors: means, scales and sh_dc [N, 3], quats [N, 4] (wxyz),
#: opacities [N] (logits), sh_rest [N, coefficients, 3].
Arrays = dict[str, NDArray[np.float32]]


@dataclass(frozen=True)
class RenderTag:
    """Render mode that a scene file states.

    Attributes:
        rendering: Stated render mode, else classic.
        reason: Part of the file that states it, such as "the file's flag"; empty if none does.
        warnings: Pairs of texts: how the scene is drawn, and why renders may differ from those of its trainer.
    """

    rendering: Rendering = CLASSIC
    reason: str = ""
    warnings: tuple[tuple[str, str], ...] = ()


#: Tag of files that state nothing.
UNTAGGED = RenderTag()


@dataclass(frozen=True)
class FileStart:
    """Beginning of a file.

    Attributes:
        head: First bytes, at most `HEAD_BYTES`.
    """

    path: Path
    head: bytes
    size: int


@dataclass(frozen=True)
class OpenScene:
    """Open scene file.

    It is not memory-mapped: if another program truncates a mapped file, the next access kills the process (SIGBUS).
    """

    path: Path
    stream: BufferedReader

    def read(self, offset: int, buffer: NDArray[np.uint8]) -> None:
        """Read bytes of the file, starting at `offset`, until a buffer is full.

        Raises:
            SceneError: If the file is too short.
            OSError: If it cannot be read.
        """
        self.stream.seek(offset)
        if self.stream.readinto(buffer.data) < len(buffer):
            raise changed(self.path)


def changed(path: Path) -> SceneError:
    """Return the error for a file that was changed after it was read."""
    return SceneError(
        f"{path}: was changed after it was read; the new colors may belong to other Gaussians. "
        "Put the original file back and run again."
    )


@dataclass(frozen=True)
class SceneHeader:
    """Checked header of a scene file. Formats subclass it to add fields for their readers.

    Attributes:
        coefficients: SH coefficients per color channel above degree 0.
        notes: Notes on contents that are not read, or not read as stored.
        axes: Axes that the scene has in an SPZ, see `spz`.
    """

    format: "SceneFormat"
    count: int
    coefficients: int
    notes: tuple[str, ...] = field(default=(), kw_only=True)
    axes: str = field(default="rub", kw_only=True)
    tag: RenderTag = field(default=UNTAGGED, kw_only=True)


@dataclass(frozen=True)
class SceneFormat:
    """Scene format.

    Everything that depends on the format of a scene derives from its entry: detection, reading, writing, file names,
    options, messages and the page.

    Attributes:
        name: File name suffix without its first dot. It is also the name in options, reports and the REST API.
        title: Name of the format in messages.
        bytes_per_gaussian: Typical size of a Gaussian of SH degree 3 in a file.
        matches: Check whether the content of a file has this format.
        read_header: Header check: reads the header without allocating memory for the data, and compares it with the
            size of the file. Raises a SceneError if the header is wrong or the file is truncated. It runs in the API
            process.
        read: Reader. It fills arrays that were allocated by the header, and may return a header with more notes. It
            need not check for non-finite values. None for PLY, which `scene_file` reads, because its other data is
            written back.
        write: Writer of a scene's arrays and its render mode, if the format can state one. It raises an OutputError
            without path if it cannot represent the arrays. None if the format is only read.
        ranges: Lowest and highest value by the name of the array. That of "scales" holds for the largest of each
            Gaussian.
        step: Distance between positions that can be stored, for positions [n, 3]: [n], or the same for all. None if
            it is far below the size of a Gaussian.
        has_axes: Whether the writer takes axes as a fourth argument.
    """

    name: str
    title: str
    bytes_per_gaussian: int
    matches: Callable[[FileStart], bool]
    read_header: Callable[[FileStart], SceneHeader]
    read: Callable[[OpenScene, SceneHeader, Arrays], SceneHeader | None] | None = None
    write: Callable[..., None] | None = None
    media_type: str = "application/octet-stream"
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    step: Callable[[NDArray[np.float32]], NDArray[np.float64]] | None = None
    has_axes: bool = False

    @property
    def suffix(self) -> str:
        """Return the file name suffix, with its dot."""
        return f".{self.name}"


def stated(mode: str, reason: str, eps2d: float | None = None) -> RenderTag:
    """Return the tag of a file that states a render mode, with a warning if the scene can only be approximated.

    Args:
        mode: Stated mode, one of `Rendering.mode`. Any other is read as classic, with a warning.
        reason: Part of the file that states it.
        eps2d: Stated blur; None for the default.
    """
    warnings: tuple[tuple[str, str], ...] = ()
    if mode not in ("classic", "antialiased", "2dgs"):
        warnings, mode = (("classic", f"{reason} is unknown"),), "classic"
    elif mode == "2dgs":
        flat = "projected Gaussians of 2D Gaussian Splatting are approximated; its trainer intersects them with rays"
        warnings = (("as Gaussians without thickness", f"{reason}; {flat}"),)
    return RenderTag(Rendering(mode, eps2d or EPS2D), reason, warnings)  # type: ignore[arg-type]


def extras_tag(extras: object, where: str) -> RenderTag:
    """Return the render mode that a JSON document states in the fields that `extras_of` writes.

    Args:
        extras: Value that should be a JSON object.
    """
    members = extras if isinstance(extras, dict) else {}
    model, eps2d = members.get("model", "default"), members.get("eps2d")
    eps2d = usable_eps2d(eps2d) if type(eps2d) in (int, float) else None
    if model == "default" and eps2d is None:
        return UNTAGGED
    return stated("classic" if model == "default" else str(model), f"the model {str(model)[:40]!r} in {where}", eps2d)


def extras_of(rendering: Rendering) -> dict[str, Any]:
    """Return the fields of a JSON document that state a render mode; empty for the default mode."""
    model = {} if rendering.mode == CLASSIC.mode else {"model": rendering.mode}
    return model if rendering.eps2d == EPS2D else {**model, "eps2d": rendering.eps2d}


def usable_eps2d(value: Any) -> float | None:
    """Return a stated blur as a float; None if it is not a number or out of range."""
    try:
        number = float(value)
    except (ValueError, OverflowError):
        return None
    return number if math.isfinite(number) and 0 < number <= MAX_EPS2D else None


#: Errors of a JSON document with missing or wrong values.
WRONG_JSON = (ValueError, TypeError, KeyError, IndexError, AttributeError, RecursionError, OverflowError)


def json_numbers(values: Any, count: int) -> NDArray[np.float64]:
    """Return `count` numbers of a parsed JSON list, or a single number, as float64. null becomes NaN.

    Raises:
        ValueError: If there are more or fewer, or any is a text, a truth value or a list.
        OverflowError: If an integer is too large.
    """
    numbers = values if isinstance(values, list) else [values]
    if len(numbers) != count or not all(type(value) in (int, float, type(None)) for value in numbers):
        raise ValueError(f"{len(numbers)} values in place of {count} numbers, or values that are not numbers")
    return np.array(numbers, np.float64)


def whole_number(name: str, value: Any, least: int = 0) -> int:
    """Return an integer of a parsed JSON document.

    Raises:
        ValueError: If it is less than `least`, or of another type, such as a truth value.
    """
    if type(value) is not int or value < least:
        raise ValueError(f"{name}: {value}")
    return value


def blocks(count: int) -> Iterator[slice]:
    """Yield the slices of `count` Gaussians that are converted at a time."""
    for start in range(0, count, BLOCK_ROWS):
        yield slice(start, min(start + BLOCK_ROWS, count))


def read_rows(file: OpenScene, kind: np.dtype, offset: int, count: int) -> NDArray[Any]:
    """Read `count` rows of a dtype from a byte offset on."""
    data = np.empty(count * kind.itemsize, np.uint8)
    file.read(offset, data)
    return data.view(kind)


def row_blocks(file: OpenScene, kind: np.dtype, offset: int, count: int) -> Iterator[tuple[slice, NDArray[Any]]]:
    """Yield `count` rows of a dtype from a byte offset on, block by block, with the slice of their Gaussians."""
    for block in blocks(count):
        yield block, read_rows(file, kind, offset + block.start * kind.itemsize, block.stop - block.start)


def read_bytes(path: Path, start: int, end: int) -> bytes:
    """Return the bytes of a part of a file, or those that are left.

    Raises:
        SceneError: If the file cannot be read.
    """
    with reading_scene(path), path.open("rb") as file:
        file.seek(start)
        return file.read(end - start)


def truncated(path: Path, declared: str) -> SceneError:
    """Return the error about a file that is shorter than a header declares."""
    return SceneError(f"{path}: {declared}: the file is truncated or its header is wrong. Copy or export it again.")


#: Fraction of values outside their range, above which they have other units.
_MAX_OUTSIDE = 0.2
#: Number of Gaussians below which values in an unusual range say nothing.
_MIN_GAUSSIANS = 16
#: SH coefficient of degree 0 above which colors are not those of 3DGS: eight times as bright as white.
_LARGEST_COLOR = 26.0


@np.errstate(divide="ignore", invalid="ignore", over="ignore")  # invalid values are reported later
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
    return np.log(deviations)


@np.errstate(divide="ignore", invalid="ignore")
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
    return np.log(opacities) - np.log1p(-opacities)


@np.errstate(invalid="ignore")
def check_units(path: Path, arrays: Arrays, *, logits_stored: bool) -> None:
    """Check that values are logits and SH coefficients. Values that are not numbers are ignored.

    Args:
        arrays: Arrays of the scene.
        logits_stored: Whether the format stores logits. Opacities of others may be in any part of 0..1.

    Raises:
        SceneError: If opacities or colors were stored as they are.
    """
    if len(arrays["means"]) < _MIN_GAUSSIANS:
        return
    (least, most), (darkest, brightest) = (
        (float(np.fmin.reduce(arrays[name], axis=None)), float(np.fmax.reduce(arrays[name], axis=None)))
        for name in ("opacities", "sh_dc")
    )
    if logits_stored and least >= 0 and 0 < most <= 1:
        raise SceneError(
            f"{path}: its logits of opacities go from {least:.3g} to {most:.3g}: they seem to be opacities "
            "(activated). Export the scene again with logarithms of scales and logits of opacities, as 3DGS trainers "
            "write them."
        )
    if darkest >= 0 and brightest > _LARGEST_COLOR:
        raise SceneError(
            f"{path}: its colors (f_dc) go from {darkest:.3g} to {brightest:.3g}: they seem to be colors of 0 to "
            "255, not SH coefficients. Export the scene again with (color / 255 - 0.5) / 0.2821."
        )


#: Opacities of exactly 0 and 1 have no finite logit, so they are read as 0.25/255 and 1 - 0.25/255. The difference is
#: below the rounding of these formats, and invisible in 8-bit images.
_MIN_OPACITY = 0.25 / 255
_OTHER_THREE = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])


_OPACITIES = np.clip(np.arange(256) / 255, _MIN_OPACITY, 1 - _MIN_OPACITY)
#: Logit of the opacity i / 255 for each byte i, [256] float32.
OPACITY_LOGITS: NDArray[np.float32] = np.log(_OPACITIES / (1 - _OPACITIES)).astype(np.float32)


def opacity_bytes(logits: NDArray[Any]) -> NDArray[Any]:
    """Convert logits [n] to opacities in 255ths, [n] uint8. Infinite logits become 0 and 255."""
    # tanh neither overflows nor loses small values
    return np.rint(127.5 * (1 + np.tanh(0.5 * logits.astype(np.float64)))).astype(np.uint8)


def to_steps(values: NDArray[Any], maximum: int) -> NDArray[np.uint32]:
    """Quantize values to uint32 steps 0..maximum, which cover the range 0..1. Values outside it are clamped."""
    steps: NDArray[np.uint32] = np.rint(np.clip(values, 0, 1) * maximum).astype(np.uint32)
    return steps


def join_bits(fractions: NDArray[np.float64], widths: Sequence[int]) -> NDArray[np.uint32]:
    """Quantize fractions [n, k] in 0..1 to k numbers of some bits, and join each row, the first in the highest bits."""
    joined: NDArray[np.uint32] = np.zeros(len(fractions), np.uint32)
    for column, width in zip(fractions.T, widths, strict=True):
        joined = joined << np.uint32(width) | to_steps(column, (1 << width) - 1)
    return joined


def with_largest(index: NDArray[Any], three: NDArray[np.float64]) -> NDArray[np.float64]:
    """Restore unit quaternions [n, 4] from three components [n, 3] and the index [n] of the omitted one.

    The omitted component is positive, and follows from the unit length.
    """
    rows = np.arange(len(index))
    quats = np.empty((len(index), 4))
    quats[rows[:, None], _OTHER_THREE[index]] = three
    quats[rows, index] = np.sqrt(np.maximum(0, 1 - (three**2).sum(axis=1)))
    return quats


def without_largest(quats: NDArray[Any]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the index [n] of the largest component of quaternions [n, 4], and the other three components [n, 3].

    Quaternions are normalized, and their sign is chosen so that the largest component is positive. A quaternion of
    length 0 is restored as (1, 0, 0, 0), which is the identity if the real part comes first.
    """
    values = quats.astype(np.float64)
    largest = np.abs(values).argmax(axis=1)
    rows = np.arange(len(values))
    length = np.linalg.norm(values, axis=1) * np.where(values[rows, largest] < 0, -1, 1)
    values = values / np.where(length == 0, 1, length)[:, None]
    return largest, values[rows[:, None], _OTHER_THREE[largest]]


def along_curve(means: NDArray[np.float32]) -> NDArray[np.int64]:
    """Return the indices that sort Gaussians along a Z-order curve with 21 bits per axis."""
    low, high = means.min(axis=0).astype(np.float64), means.max(axis=0).astype(np.float64)
    cells = np.where(high > low, high - low, 1)
    code = np.zeros(len(means), np.uint64)
    for axis in range(3):
        values = to_steps((means[:, axis] - low[axis]) / cells[axis], (1 << 21) - 1).astype(np.uint64)
        # insert two empty bits after each bit
        for shift, mask in (
            (32, 0x1F00000000FFFF),
            (16, 0x1F0000FF0000FF),
            (8, 0x100F00F00F00F00F),
            (4, 0x10C30C30C30C30C3),
            (2, 0x1249249249249249),
        ):
            values = (values | (values << np.uint64(shift))) & np.uint64(mask)
        code |= values << np.uint64(axis)
    return code.argsort(kind="stable")


#: Rotation by 180 degrees about z, [4, 4], which converts between a PLY and axes with y up and z forward, as of glTF.
Y_UP = np.diag([-1.0, -1.0, 1.0, 1.0])
#: Number of directions from which the matrices of spherical harmonics are computed; 15 determine degree 3.
_DIRECTIONS = 64
#: Decimals of a matrix of spherical harmonics: float64 leaves more, and a rotation by 180 degrees gets exact signs.
_DECIMALS = 12
#: Largest factor, whose third power does not overflow.
_LARGEST = 1e30
#: Maximum deviation of a matrix from a rotation, relative to its scale.
_TOLERANCE = 1e-4


@dataclass(frozen=True)
class Frame:
    """Similarity transformation of a scene: x becomes scale * rotation x + translation.

    Attributes:
        rotation: Rotation, [3, 3] float64.
        scale: Positive factor.
        translation: Translation, [3] float64.
    """

    rotation: NDArray[np.float64]
    scale: float
    translation: NDArray[np.float64]

    @staticmethod
    def of(matrix: NDArray[np.float64]) -> "Frame":
        """Split an affine transformation [4, 4].

        Raises:
            ValueError: If it mirrors or distorts.
        """
        linear = matrix[:3, :3]
        if not np.isfinite(matrix).all() or np.abs(linear).max() > _LARGEST:
            raise ValueError("the transformation is not finite")
        scale = float(np.cbrt(np.linalg.det(linear)))
        if scale <= 0 or np.abs(linear @ linear.T - scale**2 * np.eye(3)).max() > _TOLERANCE * scale**2:
            raise ValueError("the transformation mirrors or distorts the scene")
        return Frame(linear / scale, scale, matrix[:3, 3])

    def apply(self, arrays: Arrays) -> None:
        """Transform the arrays of a scene in place. Computes in float64; rotations by 180 degrees are exact."""
        from scipy.spatial.transform import Rotation  # not for the API process, which only reads headers

        x, y, z, w = Rotation.from_matrix(self.rotation).as_quat()
        turn = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])  # left multiplication, wxyz
        harmonics = harmonics_matrix(self.rotation, arrays["sh_rest"].shape[1])
        for part in blocks(len(arrays["means"])):
            block = {name: array[part] for name, array in arrays.items()}
            means = block["means"].astype(np.float64)
            block["means"][:] = self.scale * (means @ self.rotation.T) + self.translation
            if self.scale != 1:
                block["scales"] += np.float32(np.log(self.scale))
            block["quats"][:] = block["quats"].astype(np.float64) @ turn.T
            block["sh_rest"][:] = np.einsum("ij,njc->nic", harmonics, block["sh_rest"].astype(np.float64))


def harmonics_matrix(rotation: NDArray[np.float64], coefficients: int) -> NDArray[np.float64]:
    """Return the matrix of SH coefficients above degree 0, [coefficients, coefficients], of a rotation or reflection.

    A rotated function has the value at d that the original has at the inversely rotated d, for all directions d.
    """
    directions = np.random.default_rng(0).normal(size=(_DIRECTIONS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    values = (spherical_harmonics(*each.T)[:coefficients] for each in (directions, directions @ rotation))
    new, old = (np.reshape(each, (coefficients, _DIRECTIONS)).T for each in values)
    return np.round(np.linalg.lstsq(new, old, rcond=None)[0], _DECIMALS)

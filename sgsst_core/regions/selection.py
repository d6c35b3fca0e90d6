"""Selection of Gaussians by image masks, position, property, or a file of flags, as a mask [N] bool.

Gaussians vote on image masks with their blend weights. The vote of a Gaussian is the fraction of its blend weights in
the masked views that lies where masks are white. Most Gaussians are clearly inside or outside. Gaussians on which views
disagree, and those that no masked view shows, follow the majority of their neighbors. The border of the selection is
therefore smooth rather than scattered.

Positions are compared in float64, and boundaries are included. NaN is never selected.
"""

from __future__ import annotations

import operator
import tokenize
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.lib.format import open_memmap
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from sgsst_core.errors import MaskError
from sgsst_core.files.advice import POINTER, refuse_known
from sgsst_core.files.scene_file import SceneFile
from sgsst_core.rasterizer import Rasterizer
from sgsst_core.scene.camera import Camera

#: A Gaussian is inside if its vote is above the first value, and outside if it is below the second.
IN, OUT = 0.6, 0.4
#: Number of neighbors whose majority an undecided or invisible Gaussian follows.
NEIGHBORS = 8
#: Comparisons of a property with a number.
COMPARISONS: dict[str, Callable[[Tensor, float], Tensor]] = {
    ">=": operator.ge,
    "<=": operator.le,
    "!=": operator.ne,
    ">": operator.gt,
    "<": operator.lt,
    "=": operator.eq,
}


#: Suffix of masks of packed bits; every other file is read as .npy.
BITS_SUFFIX = ".bin"
#: Errors that NumPy raises for malformed headers, such as unclosed brackets, deep nesting and huge shapes.
_HEADER_ERRORS = (OSError, ValueError, TypeError, EOFError, OverflowError, MemoryError, tokenize.TokenError)


def count_votes(
    rasterizer: Rasterizer, cameras: Sequence[Camera], masks: Sequence[Callable[[], Tensor]], gaussians: int
) -> tuple[Tensor, Tensor]:
    """Return each Gaussian's blend weights summed over white mask pixels, and over all pixels: two [N] float64.

    Args:
        masks: Functions that load the mask [H, W] in 0..1 of each view.
        gaussians: N, number of Gaussians of the scene.
    """
    inside, total = (torch.zeros(gaussians, dtype=torch.float64) for _ in range(2))
    for camera, load in zip(cameras, masks, strict=True):
        mask = load().to(rasterizer.device, rasterizer.dtype)
        # The gradient of a rendered color is the contribution of each Gaussian to it: the transpose of blending.
        votes = rasterizer.color_gradient(torch.stack([mask, torch.ones_like(mask), mask], dim=2), camera).cpu()
        inside += votes[:, 0].double()
        total += votes[:, 1].double()
    return inside, total


def decide_by_votes(means: Tensor, inside: Tensor, total: Tensor) -> Tensor:
    """Return which Gaussians are inside, [N] bool.

    If no Gaussian is clearly inside or outside, those with a vote above 0.5 are inside. Gaussians that no masked view
    shows are then outside.

    Args:
        inside: [N], blend weights where masks are white, from `count_votes`.
        total: [N], all blend weights in the masked views.
    """
    share = inside / torch.where(total > 0, total, 1.0)
    shown = total > 0
    decided = shown & ((share > IN) | (share < OUT))
    result = shown & (share > 0.5)
    open_ = ~decided
    if not bool(decided.any()) or not bool(open_.any()):
        return result
    places = means.double().numpy()
    count = min(NEIGHBORS, int(decided.sum()))
    _, nearest = cKDTree(places[decided]).query(places[open_], k=count, workers=torch.get_num_threads())
    votes = result[decided][torch.as_tensor(nearest).reshape(-1, count)].double().mean(dim=1)
    result[open_] = torch.where(votes == 0.5, result[open_], votes > 0.5)
    return result


def in_box(means: Tensor, corners: Sequence[float]) -> Tensor:
    """Select positions between two opposite corners x0, y0, z0, x1, y1, z1, in any order."""
    first, second = torch.tensor([corners[:3], corners[3:]], dtype=torch.float64)
    positions = means.double()
    return ((positions >= torch.minimum(first, second)) & (positions <= torch.maximum(first, second))).all(dim=1)


def in_sphere(means: Tensor, sphere: Sequence[float]) -> Tensor:
    """Select positions within distance r of x, y, z."""
    *middle, radius = sphere
    distance: Tensor = (means.double() - torch.tensor(middle, dtype=torch.float64)).norm(dim=1)
    return distance <= radius


def in_half_space(means: Tensor, plane: Sequence[float]) -> Tensor:
    """Select positions with a x + b y + c z >= d."""
    *normal, distance = plane
    height: Tensor = means.double() @ torch.tensor(normal, dtype=torch.float64)
    return height >= distance


def where_property(values: Tensor, sign: str, number: float) -> Tensor:
    """Select values [N] by comparison with a number, which is converted to their dtype so that "=" can match."""
    return COMPARISONS[sign](values, torch.tensor(number).to(values).item()) & ~values.isnan()


def read_mask(path: Path, file: SceneFile) -> Tensor:
    """Read a mask with one flag per row of the scene's file, and return the flags of the scene's Gaussians, [N] bool.

    A file that ends in .bin holds one bit per row: bit `i % 8` (1 is the lowest) of byte `i // 8` is the flag of row
    `i`, and unused bits of the last byte are 0. Other files are .npy arrays of the values 0 and 1.

    Raises:
        MaskError: If the file cannot be read, has another length, or has values other than 0 and 1.
    """
    try:
        refuse_known(path, [POINTER], MaskError)
    except OSError as error:
        raise MaskError(f"{path}: cannot be read: {error.strerror}. Check the path.") from error
    rows = len(file.scene) if file.retained is None else len(file.retained)
    read = _read_bits if path.suffix.lower() == BITS_SUFFIX else _read_npy
    flags = read(path, rows, file.path)
    return torch.from_numpy(np.array(flags if file.retained is None else flags[file.retained]))


def _read_bits(path: Path, rows: int, scene: Path) -> NDArray[np.bool_]:
    expected = (rows + 7) // 8
    with path.open("rb") as file:
        content = file.read(expected + 1)
    size = len(content) if len(content) <= expected else path.stat().st_size
    if size != expected:
        raise MaskError(
            f"{path}: has {size:,} bytes, but {scene} has {rows:,} Gaussians. "
            f"One bit for each makes {expected:,} bytes."
        )
    bits = np.unpackbits(np.frombuffer(content, np.uint8), bitorder="little")
    if bits[rows:].any():
        raise MaskError(f"{path}: has bits after that of the last of {rows:,} Gaussians. They must be 0.")
    return bits[:rows].astype(bool)


def _read_npy(path: Path, rows: int, scene: Path) -> NDArray[np.bool_]:
    try:
        values = open_memmap(path, mode="r")  # reads neither pickles nor archives, as np.load does
    except _HEADER_ERRORS as error:
        raise MaskError(f"{path}: cannot be read as .npy: {error}. Write it with numpy.save.") from error
    if values.dtype.kind not in "biuf":
        raise MaskError(f"{path}: does not hold an array of flags or numbers. Write it with numpy.save.")
    if values.shape != (rows,):
        raise MaskError(
            f"{path}: has the shape {values.shape}, but {scene} has {rows:,} Gaussians. It must be ({rows},)."
        )
    flags: NDArray[np.bool_] = values == 1
    if not bool((flags | (values == 0)).all()):
        raise MaskError(f"{path}: has values other than 0 and 1. Give a flag for each Gaussian.")
    return flags

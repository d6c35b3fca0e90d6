"""Demo scene without a download: the stereo pair Motorcycle, lifted to Gaussians.

The pair and its disparity are from the Middlebury 2014 benchmark (Scharstein et al., "High-resolution stereo datasets
with subpixel-accurate ground truth", GCPR 2014). Every pixel of the left photo becomes a flat Gaussian that covers just
that pixel as seen from the left camera. Surfaces that only the right camera sees are added from the right photo. Behind
depth edges, a thin margin of background is extrapolated, so that views between and around the two cameras have no
cracks.

World: meters, the left camera's axes (x right, y down, z forward), the origin at the left camera.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage
from scipy.spatial.transform import Rotation

from sgsst_core.constants import COLOR_OFFSET, SH_C0
from sgsst_core.files.atomic import atomic_path, ensure_writable_folder
from sgsst_core.files.formats.sog import SOG
from sgsst_core.files.scene_file import write_scene
from sgsst_core.paintings import STARRY_NIGHT
from sgsst_core.scene.gaussians import Scene

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Folder of the photos and of the disparity in pixels of the left one, infinite where it is unknown.
PAIR = Path(__file__).with_name("motorcycle")
#: Calibration for the size of the photos (741x500), as documented by scikit-image's `stereo_motorcycle`: focal length
#: and principal point in pixels, and baseline in meters. Lengths in pixels are Middlebury's (focal 3979.911 px, doffs
#: 124.343 px at 2964x2000) divided by 4.
FOCAL = 994.978
CENTER_X, CENTER_Y = 311.193, 254.877
BASELINE = 0.193001
#: Difference of the two principal points' x: depth = FOCAL * BASELINE / (disparity + DISPARITY_OFFSET).
DISPARITY_OFFSET = 31.086

#: Standard deviation of a Gaussian in pixels of its photo. Larger values blur, smaller ones leave a visible lattice.
PIXEL_SIGMA = 0.5
#: Standard deviation of a Gaussian that replaces several pixels, relative to their joint side length. It is larger,
#: because the rasterizer's own blur of 0.3 px^2 widens a large Gaussian less.
MERGED_SIGMA = 0.62
#: Ratio of a disc's thickness to its smaller radius.
FLATNESS = 0.1
OPACITY = 0.97
#: Maximum slope (depth per unit of width) of a lifted surface. Steeper slopes are clamped, because most of them come
#: from edges between two objects and would produce needle-shaped Gaussians.
MAX_SLOPE = 3.0
#: Disparity step in pixels that counts as an edge between two objects.
EDGE_STEP = 3.0
#: Rows and columns of the window that is searched for the surface behind a pixel. On each side of an edge, half of the
#: window is extrapolated. It is wide because the cameras lie side by side, and low because the floor's disparity grows
#: downwards.
EDGE_WINDOW = (13, 49)
#: Width in pixels of the rim beside an edge that may be foreground although its disparity is unknown.
RIM = 3.0
#: Color difference (0..1) between the two photos above which a guessed disparity is dropped.
WRONG_COLOR = 0.2
#: Maximum color difference (0..1) of four pixels that are merged into one Gaussian. Their disparities must also lie on
#: a plane within FLAT_STEP. Merging saves a third of the Gaussians with no visible difference.
FLAT_COLOR = 0.08
FLAT_STEP = 0.3

#: Number of views on the camera path: an ellipse around both cameras, looking at the motorcycle.
VIEWS = 10
VIEW_WIDTH, VIEW_HEIGHT = 720, 480
#: Focal length of the views; a little longer than the photos', so that the border of the photos stays out of view.
VIEW_FOCAL = 1.14 * FOCAL
PATH_RADIUS = (0.12, 0.035, 0.05)  # meters along x, y, z
LOOK_AT = (0.13, 0.0, 2.7)


@dataclass(frozen=True)
class DemoScene:
    """Files of the demo.

    Attributes:
        ply: Scene, a 3DGS PLY of SH degree 0.
        cameras: Views of the scene, an INRIA cameras.json.
        style: Style image, JPEG.
    """

    ply: Path
    cameras: Path
    style: Path


class Samples(NamedTuple):
    """Pixels to lift: position, disparity and its gradient, color (0..1), and size in pixels; shape [n] or [n, 3]."""

    x: Array
    y: Array
    disparity: Array
    slope_x: Array
    slope_y: Array
    color: Array
    size: Array


def build_demo(folder: Path) -> DemoScene:
    """Write the demo's scene, cameras and style image into a folder, and create the folder.

    Raises:
        OutputError: If the folder cannot be written.
    """
    ensure_writable_folder(folder)
    demo = DemoScene(folder / "motorcycle.ply", folder / "cameras.json", folder / "starry_night.jpg")
    write_scene(demo.ply, lift_pair())
    _write_cameras(demo.cameras)
    with atomic_path(demo.style) as temporary:
        temporary.write_bytes(STARRY_NIGHT.read_bytes())
    return demo


def build_example(folder: Path) -> None:
    """Write the demo's scene, compressed, and its cameras into a folder, for the page (`api.http.static`)."""
    write_scene(folder / "motorcycle.sog", lift_pair(), SOG)
    _write_cameras(folder / "cameras.json")


def _write_cameras(path: Path) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(camera_path(), indent=1), encoding="utf-8")


def lift_pair() -> Scene:
    """Return the stereo pair as Gaussians of SH degree 0."""
    left, right = (np.asarray(Image.open(PAIR / name)) / 255.0 for name in ("left.png", "right.png"))
    with np.load(PAIR / "disparity.npz") as archive:
        measured = archive["arr_0"]
    known = np.isfinite(measured)
    disparity, behind_left = _fill(measured.astype(np.float64), known, left)

    # A guessed disparity is wrong if its pixel would be visible in the right photo, but the color there differs.
    moved, _ = _move_to_right(disparity)
    rows, columns, inside = _in_other_photo(disparity, -1)
    shows = inside & (disparity > moved[rows, columns] - EDGE_STEP)
    wrong = ~known & shows & (np.abs(left - right[rows, columns]).max(axis=2) > WRONG_COLOR)

    moved, seen = _move_to_right(np.where(wrong, np.inf, disparity))
    filled, behind_right = _fill(moved, seen, right)
    # One more pixel all around, so that the seam between the two photos has no cracks.
    only_right = ndimage.binary_dilation(~seen, np.ones((3, 3)))
    invented_left = behind_left.mask & _hidden(behind_left.disparity, filled, -1)
    invented_right = behind_right.mask & _hidden(behind_right.disparity, disparity, 1)
    parts = [
        _gaussians(_samples(disparity, left, ~wrong), 0.0),
        _gaussians(_samples(behind_left.disparity, behind_left.color, invented_left), 0.0),
        _gaussians(_samples(filled, right, only_right), BASELINE),
        _gaussians(_samples(behind_right.disparity, behind_right.color, invented_right), BASELINE),
    ]
    means, quats, scales, sh_dc = (np.concatenate(columns).astype(np.float32) for columns in zip(*parts, strict=True))
    return Scene(
        means=torch.from_numpy(means),
        quats=torch.from_numpy(quats),
        scales=torch.from_numpy(scales),
        opacities=torch.full((len(means),), float(np.log(OPACITY / (1 - OPACITY)))),
        sh_dc=torch.from_numpy(sh_dc),
        sh_rest=torch.zeros(len(means), 0, 3),
    )


class _Behind(NamedTuple):
    """Extrapolated surface behind depth edges: its mask, disparity and color."""

    mask: Mask
    disparity: Array
    color: Array


def _fill(disparity: Array, known: Mask, photo: Array) -> tuple[Array, _Behind]:
    """Return the disparity with unknown pixels filled in, and the surface behind the rims of the foreground.

    Unknown pixels lie mostly beside a foreground object that hides the background from the other camera. They get the
    disparity of the nearest background pixel. A pixel is foreground if its window contains a surface that is clearly
    farther from the camera.
    """
    lowest = ndimage.minimum_filter(np.where(known, disparity, np.inf), size=EDGE_WINDOW)
    source = known & (disparity <= lowest + EDGE_STEP)
    rows, columns = ndimage.distance_transform_edt(~source, return_distances=False, return_indices=True)
    nearest = disparity[rows, columns]
    distance, (near_rows, near_columns) = ndimage.distance_transform_edt(~known, return_indices=True)
    # Beside an edge, an unknown pixel may still be foreground; its color decides.
    unlike_known = np.abs(photo - photo[near_rows, near_columns]).sum(axis=2)
    unlike_source = np.abs(photo - photo[rows, columns]).sum(axis=2)
    front = (distance <= RIM) & (unlike_known < unlike_source)
    filled = np.where(known | front, disparity[near_rows, near_columns], nearest)
    mask = known & ~source & (nearest < disparity - EDGE_STEP)
    # Copies of the nearest pixel make streaks; blurring hides them.
    color = ndimage.gaussian_filter(photo[rows, columns], (3, 3, 0))
    return filled, _Behind(mask, nearest, color)


def _in_other_photo(disparity: Array, direction: int) -> tuple[NDArray[np.intp], NDArray[np.intp], Mask]:
    """Return the row and column of each pixel in the other photo, and a mask of the pixels inside that photo.

    `direction` is -1 from left to right and 1 from right to left. Columns outside are clamped to the border.
    """
    rows, columns = np.meshgrid(*map(np.arange, disparity.shape), indexing="ij")
    moved = np.rint(columns + direction * disparity)
    last = disparity.shape[1] - 1
    return rows, np.clip(moved, 0, last).astype(np.intp), (moved >= 0) & (moved <= last)


def _hidden(disparity: Array, other: Array, direction: int) -> Mask:
    """Return a mask of the pixels that the other photo does not show: occluded there, or outside its border."""
    rows, columns, inside = _in_other_photo(disparity, direction)
    return ~inside | (other[rows, columns] > disparity + EDGE_STEP)


def _move_to_right(disparity: Array) -> tuple[Array, Mask]:
    """Return the left photo's disparity as seen by the right camera, and a mask of the pixels that have a value.

    The disparity is 0 where no pixel of the left photo is visible.
    """
    rows, columns, inside = _in_other_photo(disparity, -1)
    moved = np.full(disparity.shape, -np.inf)
    np.maximum.at(moved, (rows[inside], columns[inside]), disparity[inside])  # the nearest surface wins
    # Slanted surfaces are stretched in the right photo: a single column between two hits is not a gap.
    hit = ndimage.binary_closing(moved > 0, np.ones((1, 3)))
    between = hit & ~(moved > 0)
    moved[between] = ndimage.maximum_filter(moved, size=(1, 3))[between]
    return np.where(hit, moved, 0.0), hit


def _samples(disparity: Array, photo: Array, chosen: Mask) -> Samples:
    """Return samples of the chosen pixels; four similar pixels become one sample."""
    slope_x, slope_y = (_slope(disparity, axis) for axis in (1, 0))
    rows, columns = np.meshgrid(*map(np.arange, disparity.shape), indexing="ij")
    fields = np.dstack([columns + 0.5, rows + 0.5, disparity, slope_x, slope_y, photo])
    height, width = (side // 2 * 2 for side in disparity.shape)
    blocks = fields[:height, :width].reshape(height // 2, 2, width // 2, 2, -1)
    mean = blocks.mean(axis=(1, 3), keepdims=True)
    off = blocks - mean
    plane = off[..., 0] * mean[..., 3] + off[..., 1] * mean[..., 4]
    alike = (np.abs(off[..., 2] - plane) < FLAT_STEP).all(axis=(1, 3))
    alike &= (np.ptp(blocks[..., 5:], axis=(1, 3)) < FLAT_COLOR).all(axis=-1)
    alike &= chosen[:height, :width].reshape(height // 2, 2, width // 2, 2).all(axis=(1, 3))
    single = chosen.copy()
    single[:height, :width] &= ~alike.repeat(2, axis=0).repeat(2, axis=1)
    merged = mean[:, 0, :, 0][alike]
    all_fields = np.concatenate([fields[single], merged])
    x, y, sample_disparity, sample_slope_x, sample_slope_y = all_fields[:, :5].T
    size = np.concatenate([np.ones(int(single.sum())), np.full(len(merged), 2.0)])
    return Samples(x, y, sample_disparity, sample_slope_x, sample_slope_y, all_fields[:, 5:], size)


def _slope(disparity: Array, axis: int) -> Array:
    """Return the gradient of the disparity: the smaller of the differences to both sides, 0 if their signs differ.

    A pixel beside an edge therefore gets the slope of its own surface. The differences span two pixels, to reduce
    noise.
    """
    ahead = (np.roll(disparity, -2, axis) - disparity) / 2
    backward = (disparity - np.roll(disparity, 2, axis)) / 2
    return np.where(ahead * backward > 0, np.sign(ahead) * np.minimum(np.abs(ahead), np.abs(backward)), 0.0)


def _gaussians(samples: Samples, camera_x: float) -> tuple[Array, Array, Array, Array]:
    """Return means, quats, log scales and sh_dc of flat discs on the samples' surfaces. Each projects to a circle.

    Depth is FOCAL * BASELINE / d with d = disparity + offset, so a surface whose disparity is linear is a plane. The
    derivatives of the 3D point with respect to the pixel span that plane; the disc's covariance is the sum of their
    outer products.
    """
    shifted = samples.disparity + DISPARITY_OFFSET
    depth = FOCAL * BASELINE / shifted
    center_x = CENTER_X + (DISPARITY_OFFSET if camera_x > 0 else 0.0)
    ray = np.stack([(samples.x - center_x) / FOCAL, (samples.y - CENTER_Y) / FOCAL, np.ones_like(depth)], axis=1)
    center = depth[:, None] * ray + [camera_x, 0.0, 0.0]

    tangents = np.zeros((len(depth), 3, 2))
    tangents[:, 0, 0] = tangents[:, 1, 1] = depth / FOCAL
    for axis, slope in enumerate((samples.slope_x, samples.slope_y)):
        steepest = MAX_SLOPE * shifted / FOCAL
        depth_slope = -depth * np.clip(slope, -steepest, steepest) / shifted
        tangents[:, :, axis] += depth_slope[:, None] * ray
    radii_squared, axes = np.linalg.eigh(tangents @ tangents.transpose(0, 2, 1))  # ascending: the normal first
    sigma = np.where(samples.size > 1, MERGED_SIGMA, PIXEL_SIGMA) * samples.size
    radii = np.sqrt(np.maximum(radii_squared, 0)) * sigma[:, None]
    radii[:, 0] = FLATNESS * radii[:, 1]
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]  # a rotation, not a reflection

    quats = Rotation.from_matrix(axes).as_quat()[:, [3, 0, 1, 2]]  # w first
    return center, quats, np.log(radii), (samples.color - COLOR_OFFSET) / SH_C0


def camera_path() -> list[dict[str, object]]:
    """Return the views in the INRIA format.

    Each has a position, a camera-to-world rotation (columns right, down, forward), and focal lengths.
    """
    views = []
    for i in range(VIEWS):
        angle = 2 * np.pi * i / VIEWS
        middle = np.array([BASELINE / 2, 0.0, 0.0])
        position = middle + np.array(PATH_RADIUS) * [np.cos(angle), np.sin(angle), np.sin(angle)]
        forward = np.array(LOOK_AT) - position
        forward /= np.linalg.norm(forward)
        right = np.cross([0.0, 1.0, 0.0], forward)
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
        view = {"id": i, "img_name": f"view_{i:02d}", "width": VIEW_WIDTH, "height": VIEW_HEIGHT}
        view |= {"position": position.tolist(), "rotation": rotation.tolist(), "fx": VIEW_FOCAL, "fy": VIEW_FOCAL}
        views.append(view)
    return views


if __name__ == "__main__":
    build_example(Path(sys.argv[1]))

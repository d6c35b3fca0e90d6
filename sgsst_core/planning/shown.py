"""How much of a scene cameras show, judged by the centers of its Gaussians without rendering."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

import torch
from torch import Tensor

from sgsst_core.errors import CameraError
from sgsst_core.scene.camera import Camera, spread

#: Gaussians and cameras that are looked at.
_GAUSSIANS, _CAMERAS = 20_000, 200
#: Least fraction of the Gaussians in a frame, and of all, that the near plane hides if it is reported. Captures in
#: meters have nearly none.
_MUCH_OF_FRAMES, _MUCH_OF_SCENE = 0.1, 0.01
#: Fraction of the Gaussians in the frames that may lie nearer than a suggested near plane, and its margin.
_NEAREST, _MARGIN = 0.01, 0.5


@dataclass(frozen=True)
class Shown:
    """Fractions of a scene's Gaussians whose centers are in the frames of cameras.

    Attributes:
        typical: Fraction in one frame, median over the cameras.
        together: Fraction in at least one frame.
        nearer: Fraction in at least one frame, but nearer than the near plane in all of these.
        near: Distance of a near plane that hides nearly none of them; None if `nearer` is not remarkable.
    """

    typical: float
    together: float
    nearer: float = 0.0
    near: float | None = None


def shown_by(means: Tensor, cameras: Sequence[Camera], near: float) -> Shown:
    """Return how much of a scene cameras show, from samples of both.

    Args:
        means: Centers of the Gaussians, [N, 3].
        cameras: At least one camera.
        near: Distance of the near plane in world units.
    """
    points = means[:: max(1, len(means) // _GAUSSIANS)].double()
    together, nearer = torch.zeros(2, len(points), dtype=torch.bool)
    fractions, depths = [], []
    for camera in spread(cameras, _CAMERAS):
        x, y, z = (points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]).unbind(1)
        across, down = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        inside = (z > 0) & (across >= 0) & (across < camera.width) & (down >= 0) & (down < camera.height)
        depths.append(z[inside])
        nearer |= inside & (z <= near)
        inside &= z > near
        together |= inside
        fractions.append(float(inside.double().mean()))
    nearer &= ~together
    hidden, in_frames = float(nearer.double().mean()), float((nearer | together).double().mean())
    remarkable = hidden >= max(_MUCH_OF_SCENE, _MUCH_OF_FRAMES * in_frames)
    suggested = _suggested(torch.cat(depths)) if remarkable else None
    return Shown(median(fractions), float(together.double().mean()), hidden, suggested)


def _suggested(depths: Tensor) -> float:
    """Return a near plane with one digit, given the depths of Gaussians in frames."""
    near = _MARGIN * float(depths.sort().values[int(_NEAREST * len(depths))])
    digit = 10.0 ** math.floor(math.log10(max(near, 1e-30)))
    return float(f"{math.floor(near / digit) * digit:.0e}") or near


def hidden_text(shown: Shown, gaussians: int, near: float) -> str:
    """Return how many of a scene's Gaussians the near plane hides."""
    count = round(shown.nearer * gaussians)
    return f"{count:,} of {gaussians:,} Gaussians are in their frames, but nearer than the near plane at {near:g}"


def nothing_seen(means: Tensor, cameras: Sequence[Camera], near: float) -> CameraError:
    """Return the error for cameras that see no Gaussian, which names the near plane if that is the cause.

    The arguments are those of `shown_by`.
    """
    shown = shown_by(means, cameras, near)
    none = f"None of the {len(cameras)} cameras sees a Gaussian"
    if shown.near is not None:
        return CameraError(
            f"{none}: {hidden_text(shown, len(means), near)}. Add --near {shown.near:g}, which suits the scene's units."
        )
    return CameraError(
        f"{none}. Check that cameras and scene belong together (same training run, same world), or let an orbit make "
        "the cameras."
    )

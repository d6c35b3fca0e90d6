"""Hard cases of compressed scene files and camera orbits: one Gaussian, extreme sizes, objects without extent."""

import math
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from benchmarks.stability.case import Case, CaseResult, Group, ordinary, repeated
from sgsst_core.constants import COLOR_OFFSET, SH_C0
from sgsst_core.errors import InvalidInputError
from sgsst_core.files.formats.glb import GLB
from sgsst_core.files.formats.ply import COMPRESSED_PLY
from sgsst_core.files.formats.scene_format import SceneFormat
from sgsst_core.files.formats.sog import SOG
from sgsst_core.files.formats.spz import SPZ
from sgsst_core.files.scene_file import read_scene, write_scene
from sgsst_core.orbit import OrbitRequest, make_orbit
from sgsst_core.scene.gaussians import TENSORS, Scene

_GROUP: Group = "files and orbits"
_AGAIN = "change when what was read is written and read again, in steps of the form"
_CAMERAS = "cameras that are not finite, or do not face the object"


def cases() -> list[Case]:
    """Return all cases of this group."""
    entries = [
        Case(f"{name}, as {format.name}", _GROUP, _AGAIN, partial(_compressed, make, format))
        for format in (COMPRESSED_PLY, SPZ, SOG, GLB)
        for name, make in _SCENES.items()
    ]
    entries += [
        Case(f"{name}, as splat", _GROUP, "values that are not what the file holds", partial(_splat, make))
        for name, make in _SCENES.items()
    ]
    return [
        *entries,
        *(
            Case(f"orbit: {name}", "files and orbits", _CAMERAS, partial(_orbit, make))
            for name, make in _OBJECTS.items()
        ),
    ]


def _one() -> Scene:
    return replace(repeated(1), sh_dc=torch.tensor([[0.5, -0.5, 1.0]]))


def _extreme_scales() -> Scene:
    """Return Gaussians with log scales from -9.9 to 5.9, the range of a byte in SPZ."""
    scene = ordinary(90, seed=3)
    return replace(scene, scales=torch.linspace(-9.9, 5.9, 270).reshape(90, 3))


def _far_and_near() -> Scene:
    """Return Gaussians with positions from 1e-4 to 1e4."""
    scene = ordinary(60, seed=4)
    return replace(scene, means=scene.means * torch.logspace(-4, 3, 60)[:, None])


def _saturated() -> Scene:
    scene = ordinary(30, seed=5, degree=1)
    rest = scene.sh_rest
    return replace(scene, sh_dc=scene.sh_dc * 1e3, sh_rest=rest * 1e3, opacities=scene.opacities * 40)


_SCENES: dict[str, Callable[[], Scene]] = {
    "one Gaussian": _one,
    "300 Gaussians at one place": lambda: repeated(300),
    "sizes from 5e-5 to 365": _extreme_scales,
    "positions from 1e-4 to 1e4": _far_and_near,
    "colors, opacities and harmonics out of range": _saturated,
}


def _compressed(make: Callable[[], Scene], format: SceneFormat, full: bool) -> CaseResult:
    """Check that a compressed file is finite and complete, and that writing it again keeps its quantized values."""
    scene = make()
    with tempfile.TemporaryDirectory() as folder:
        first, second = Path(folder) / "first", Path(folder) / "second"
        write_scene(first, scene, format)
        reread = read_scene(first).scene
        write_scene(second, reread, format)
        again = read_scene(second).scene
    if len(reread) != len(scene) or not all(map(_finite, (reread, again))):
        return CaseResult(math.inf, 0.0, "Gaussians are missing, or hold values that are not finite")
    steps = {"means": _position_step(reread, format), "scales": 16 / 2047 if format is COMPRESSED_PLY else 1 / 16}
    steps |= {"sh_dc": 0.03, "opacities": math.inf, "quats": 0.02, "sh_rest": 1 / 16}
    error = 0.0
    for name, step in steps.items():
        one, other = (_sorted(getattr(each, name), each) for each in (reread, again))
        if math.isfinite(step) and one.numel():
            error = max(error, float((one.abs() - other.abs()).abs().max()) / step)
    return CaseResult(error, 2.0, f"{len(reread)} Gaussians; positions to {steps['means']:.2g}")


def _sorted(values: torch.Tensor, scene: Scene) -> torch.Tensor:
    """Return rows ordered by position.

    Compressed PLY files may reorder Gaussians. The order of Gaussians at the same position does not matter.
    """
    order = np.lexsort(scene.means.double().numpy().round(3).T)
    return values.double()[torch.from_numpy(order)]


def _position_step(scene: Scene, format: SceneFormat) -> float:
    extent = float((scene.means.amax(0) - scene.means.amin(0)).max())
    if format is COMPRESSED_PLY:  # 10 bits within the bounds of 256 Gaussians
        return max(extent / 1023, 1e-6 * float(scene.means.abs().max()))
    farthest = float(scene.means.abs().max())
    return float(2.0 ** (math.ceil(math.log2(max(farthest, 1e-6))) - 22))


def _finite(scene: Scene) -> bool:
    return all(bool(getattr(scene, name).isfinite().all()) for name in TENSORS)


def _splat(make: Callable[[], Scene], full: bool) -> CaseResult:
    """Check a .splat file: positions and sizes are read exactly, all other values up to the rounding of a byte."""
    scene = make()
    sizes = scene.scales.exp().numpy().astype("<f4")
    colors = (COLOR_OFFSET + SH_C0 * scene.sh_dc.double()).clamp(0, 1)
    opacity = torch.sigmoid(scene.opacities.double())[:, None]
    quats = torch.nn.functional.normalize(scene.quats.double(), dim=1)
    rgba = (torch.cat([colors, opacity], 1) * 255).round().to(torch.uint8).numpy()
    rotated = (quats * 128 + 128).round().clamp(0, 255).to(torch.uint8).numpy()
    rows = [
        position.astype("<f4").tobytes() + size.tobytes() + color.tobytes() + quat.tobytes()
        for position, size, color, quat in zip(scene.means.numpy(), sizes, rgba, rotated, strict=True)
    ]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.splat"
        path.write_bytes(b"".join(rows))
        try:
            reread = read_scene(path).scene
        except InvalidInputError as error:
            return CaseResult(math.inf, 0.0, f"was refused: {error}")
    shown = COLOR_OFFSET + SH_C0 * reread.sh_dc.double()
    wrong = float((shown - colors).abs().max()) * 255
    wrong = max(wrong, float((torch.sigmoid(reread.opacities.double())[:, None] - opacity).abs().max()) * 255)
    same = torch.equal(reread.means, scene.means) and bool(
        torch.allclose(reread.scales.double(), torch.from_numpy(sizes).double().log(), rtol=1e-6, atol=1e-6)
    )
    return CaseResult(wrong if same and _finite(reread) else math.inf, 0.8, "colors and opacities, in 255ths")


def _cloud(x: float, y: float, z: float, count: int = 200) -> Scene:
    """Return small round Gaussians in a box with the given sides."""
    scene = repeated(count, mean=(0.0, 0.0, 0.0), scale=0.02)
    box = torch.rand(count, 3, generator=torch.Generator().manual_seed(9)) - 0.5
    return replace(scene, means=box * torch.tensor([x, y, z]))


_OBJECTS: dict[str, Callable[[], Scene]] = {
    "a flat object": lambda: _cloud(2.0, 0.0, 1.0),
    "an upright sheet": lambda: _cloud(2.0, 1.0, 0.0),
    "a line": lambda: _cloud(0.0, 2.0, 0.0),
    "everything at one place": lambda: _cloud(0.0, 0.0, 0.0),
    "one Gaussian": lambda: repeated(1),
    "one needle": lambda: replace(repeated(1), scales=torch.tensor([[1.0, -12.0, -12.0]])),
    "a millionth of a unit": lambda: replace(_cloud(1e-6, 1e-6, 2e-6), scales=torch.full((200, 3), -17.0)),
    "a million units": lambda: replace(_cloud(1e6, 2e6, 1e6), scales=torch.full((200, 3), 11.0)),
}


def _orbit(make: Callable[[], Scene], full: bool) -> CaseResult:
    """Check that all cameras are finite and face the object, or that a clear error is raised."""
    scene = make()
    try:
        orbit = make_orbit(scene, OrbitRequest(near=1e-9))
    except InvalidInputError as error:
        return CaseResult(0.0, 0.0, f"refused: {error}")
    middle, wrong = scene.means.double().mean(0), 0
    for camera in orbit.cameras:
        pose = camera.world_to_camera
        finite = bool(pose.isfinite().all()) and math.isfinite(camera.fx) and camera.fx > 0
        depth = float((pose[:3, :3] @ middle + pose[:3, 3])[2]) if finite else -1.0
        wrong += not (finite and depth > 0 and min(camera.width, camera.height) > 0)
    return CaseResult(float(wrong), 0.0, f"{len(orbit.cameras)} views, {orbit.radius:.3g} away")

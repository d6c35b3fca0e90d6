"""Whether the estimated up direction of real scenes is right, turned by every 90 degrees, in the formats of users.

python -m benchmarks.up_direction [SCENES]

SCENES is the folder of the scenes (CONTRIBUTING.md), by default ../shared/data/scenes. Each scene is turned to the 24
orientations of a cube, written as SOG, SPZ, .splat, PLY and compressed PLY in turn, and read again. An estimate is
right if it is within 30 degrees of the known direction, or asks: it is not sure.
"""

from __future__ import annotations

import argparse
import itertools
import tempfile
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from benchmarks.machine import write_result
from sgsst_core import load_scene
from sgsst_core.files.formats import by_name
from sgsst_core.files.scene_file import write_scene
from sgsst_core.orbit.subject import find_subject, find_up
from sgsst_core.scene.gaussians import Scene

#: Scenes with their up direction; that of the plush is the mean one of its cameras. The comb has none of its own: it is
#: shown with its teeth down.
SCENES: dict[str, tuple[float, float, float]] = {
    "biker/point_cloud.ply": (0, -1, 0),
    "broche/broche.splat": (0, -1, 0),
    "playbot_synthetic_sh2/point_cloud.ply": (0, -1, 0),
    "snowmiku_plush/point_cloud.ply": (-0.21, -0.97, -0.16),
    "statues/massa.sog": (0, -1, 0),
    "statues/narcissus.sog": (0, -1, 0),
}
FORMATS = ("sog", "spz", "splat", "ply", "compressed.ply")
#: Least cosine of the angle to the known direction.
_RIGHT = np.cos(np.radians(30))


def cube_rotations() -> list[Rotation]:
    """Return the 24 rotations of a cube onto itself."""
    angles = itertools.product(range(0, 360, 90), repeat=3)
    rotations = {
        tuple(np.rint(r.as_matrix()).ravel()): r for r in (Rotation.from_euler("xyz", a, degrees=True) for a in angles)
    }
    return list(rotations.values())


def rotated(scene: Scene, rotation: Rotation) -> Scene:
    """Return a scene rotated around the origin, without its view-dependent color."""
    own = scene.quats.double().numpy()
    quats = (rotation * Rotation.from_quat(own, scalar_first=True)).as_quat(scalar_first=True)
    means = torch.from_numpy(rotation.apply(scene.means.double().numpy())).float()
    rest = scene.means.new_zeros((len(scene), 0, 3))
    return replace(scene, means=means, quats=torch.from_numpy(quats).float(), sh_rest=rest)


def write(path: Path, scene: Scene) -> None:
    """Write a scene in the format of its name; the program itself does not write .splat."""
    if path.suffix != ".splat":
        write_scene(path, scene, by_name(path.name.removeprefix("scene.")))
        return
    rows = np.zeros(len(scene), [("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])
    rows["means"], rows["scales"] = scene.means.numpy(), scene.scales.exp().numpy()
    rows["rgba"][:, 3] = (255 * scene.opacities.sigmoid()).round().numpy()
    quats = scene.quats / scene.quats.norm(dim=1, keepdim=True)
    rows["quats"] = (128 * quats + 128).round().clamp(0, 255).numpy()
    path.write_bytes(rows.tobytes())


def main() -> None:
    """Print, for each scene, how many estimates are sure and right, unsure, and sure but wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="?", type=Path, default=Path("../shared/data/scenes"))
    arguments = parser.parse_args()
    figures = {}
    for name, up in SCENES.items():
        scene = load_scene(arguments.scenes / name).scene
        counts: Counter[str] = Counter()
        for index, rotation in enumerate(cube_rotations()):
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder, f"scene.{FORMATS[index % len(FORMATS)]}")
                write(path, rotated(scene, rotation))
                estimate = find_up(find_subject(load_scene(path).scene))
            expected = rotation.apply(up) / np.linalg.norm(up)
            right = float(estimate.direction.numpy() @ expected) >= _RIGHT
            counts["right" if estimate.sure and right else "wrong" if estimate.sure else "asks"] += 1
            counts["among the candidates"] += not estimate.sure and _is_candidate(estimate.candidates, expected)
        figures[name] = dict(counts)
        print(name, figures[name], flush=True)
    print(write_result("up_direction", figures))


def _is_candidate(candidates: list[str], expected: np.ndarray) -> bool:
    """Return whether the axis nearest to a direction is among some."""
    axis = int(np.abs(expected).argmax())
    return ("-" if expected[axis] < 0 else "") + "xyz"[axis] in candidates


if __name__ == "__main__":
    main()

"""Comparison of scenes Gaussian by Gaussian, and scripts that run other programs."""

import subprocess
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree

from sgsst_core.files.scene_file import read_scene
from sgsst_core.scene.gaussians import TENSORS, Scene

FOLDER = Path(__file__).parent
#: Largest differences of opacities after the sigmoid, and of other values, from what another program reads. Compressed
#: formats leave a byte's value open: some read its center, others its lower end.
OPACITIES, VALUES = 1.1e-3, {"compressed.ply": 0.02}


def run_script(modules: Path, name: str, *arguments: str | Path | int) -> None:
    """Run a script of this folder with the packages of npm, and after `write_ply.mjs`, whose functions it may call."""
    script = "".join((FOLDER / part).read_text() for part in ("write_ply.mjs", name))
    command = ["node", "--input-type=module", "-e", script, *map(str, arguments)]
    done = subprocess.run(command, cwd=modules, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def read_raw(path: Path) -> Scene:
    """Return a scene as its numbers stand in the file: other programs do not turn the axes of an SPZ."""
    return read_scene(path, spz_axes="rdf").scene


def matched(actual: Scene, expected: Scene) -> Scene:
    """Return the Gaussians of `found` in the order of `expected`, by position."""
    assert len(actual) == len(expected)
    _, rows = cKDTree(actual.means.numpy()).query(expected.means.numpy())
    assert len(np.unique(rows)) == len(expected)
    return actual.subset(torch.from_numpy(rows))


def assert_same(actual: Scene, expected: Scene, tolerance: float = 1e-4, opacities: float = OPACITIES) -> None:
    """Assert that every value of every Gaussian is the same, up to the sign of quaternions."""
    actual = matched(actual, expected)
    assert actual.sh_degree == expected.sh_degree
    for name in TENSORS:
        one, other = (getattr(each, name).double() for each in (actual, expected))
        if name == "opacities":
            one, other = one.sigmoid(), other.sigmoid()
        if name == "quats":
            one, other = (torch.nn.functional.normalize(each, dim=1) for each in (one, other))
            other = other * (one * other).sum(dim=1, keepdim=True).sign()
        error = float((one - other).abs().max()) if one.numel() else 0.0
        assert error <= (opacities if name == "opacities" else tolerance), (name, error)

"""Tests of blends against float64 references, and of the scenes that cannot be blended."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sgsst_core.errors import SceneError, SettingsError
from sgsst_core.files.formats import scene_format
from sgsst_core.files.library import save
from sgsst_core.files.scene_file import SceneFile, blend_scenes, normalized, read_scene, write_scene
from sgsst_core.scene.gaussians import Scene
from tests.sgsst_core.splat_scenes import cloud


def recolored(scene: Scene, seed: int, attenuation: float = 0.0) -> Scene:
    generator = torch.Generator().manual_seed(seed)
    return replace(scene.attenuated(attenuation), sh_dc=torch.randn(len(scene), 3, generator=generator))


def written(folder: Path, *scenes: Scene) -> list[SceneFile]:
    paths = [folder / f"scene_{index}.ply" for index in range(len(scenes))]
    for path, scene in zip(paths, scenes, strict=True):
        write_scene(path, scene)
    return [read_scene(path) for path in paths]


@pytest.mark.parametrize("weights", [(0.3, 0.7), (-0.5, 1.5), (2.0, 6.0), (1.0, 0.0), (0.2, 0.3, 0.5)])
def test_blend_is_the_weighted_mean(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, weights: tuple[float, ...]
) -> None:
    monkeypatch.setattr(scene_format, "BLOCK_ROWS", 17)
    scene = cloud(60, degree=2)
    files = written(tmp_path, *[recolored(scene, seed) for seed in range(len(weights))])
    blend = blend_scenes(files, weights)
    fractions = np.array(weights, np.float64) / sum(weights)
    colors = np.stack([file.scene.sh_dc.double().numpy() for file in files])
    expected = np.einsum("s,snc->nc", fractions, colors)
    spacing = np.spacing(np.abs(expected).astype(np.float32))
    assert (np.abs(blend.scene.sh_dc.numpy() - expected) <= spacing).all()
    assert torch.equal(blend.scene.sh_rest, files[0].scene.sh_rest)


def test_blend_of_one_scene_is_bit_identical(tmp_path: Path) -> None:
    scene = cloud(60, degree=3)
    files = written(tmp_path, scene, recolored(scene, 1, attenuation=0.4))
    for index, weights in enumerate([(1, 0), (0, 1)]):
        save(tmp_path / "blend.ply", blend_scenes(files, weights))
        assert (tmp_path / "blend.ply").read_bytes() == files[index].path.read_bytes()


@pytest.mark.parametrize("attenuation", [0.4, 1.0])
def test_attenuated_harmonics_are_blended(tmp_path: Path, attenuation: float) -> None:
    scene = cloud(60, degree=2)
    files = written(tmp_path, scene, recolored(scene, 1, attenuation))
    save(tmp_path / "blend.ply", blend_scenes(files, [-0.5, 1.5]))
    blend = read_scene(tmp_path / "blend.ply").scene
    expected = scene.sh_rest.double() * (1 - 1.5 * attenuation)
    assert torch.allclose(blend.sh_rest.double(), expected, rtol=1e-5, atol=1e-6)


def test_extreme_colors_stay_finite(tmp_path: Path) -> None:
    scene = cloud(4, degree=0)
    files = written(tmp_path, *[replace(scene, sh_dc=torch.full((4, 3), value)) for value in (-3e38, 3e38)])
    assert torch.isfinite(blend_scenes(files, [-2, 3]).scene.sh_dc).all()


def shifted(scene: Scene) -> Scene:
    means = scene.means.clone()
    means[-1, 2] += 1e-3
    return replace(scene, means=means)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda scene: scene.subset(torch.arange(59)), "has 59 Gaussians, but .* has 60"),
        (shifted, "other positions"),
        (lambda scene: replace(scene, scales=scene.scales + 1), "other scales"),
        (lambda scene: replace(scene, quats=scene.quats.flip(1)), "other rotations"),
        (lambda scene: replace(scene, opacities=scene.opacities - 1), "other opacities"),
    ],
)
def test_other_scenes_are_refused(tmp_path: Path, change: Callable[[Scene], Scene], message: str) -> None:
    scene = cloud(60, degree=0)
    with pytest.raises(SceneError, match=message):
        blend_scenes(written(tmp_path, scene, change(scene)), [1, 1])


@pytest.mark.parametrize(
    "weights", [(1, -1), (0, 0), (-1, 0), (float("nan"), 1), (float("inf"), 1), (1e308, 1), (30, -29)]
)
def test_unusable_weights_are_refused(weights: tuple[float, ...]) -> None:
    with pytest.raises(SettingsError, match="Give"):
        normalized(weights)

"""Tests of checkpoints of gsplat and nerfstudio, hostile ones included, and of gsplat's dictionaries."""

import os
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from sgsst_core import load_scene, save
from sgsst_core.errors import OutputError, SceneError
from sgsst_core.files.formats.scene_format import OPACITY_LOGITS
from sgsst_core.files.library import TrainerCheckpoint, scene_of_splats
from sgsst_core.files.scene_file import read_scene
from sgsst_core.scene.gaussians import TENSORS, Scene
from tests.sgsst_core.trainer_scenes import splats_of, write_gsplat, write_nerfstudio
from tests.small_scenes import wall


def same(first: Scene, second: Scene) -> bool:
    return all(torch.equal(getattr(first, name), getattr(second, name)) for name in TENSORS)


def assert_equal(first: Any, second: Any) -> None:
    """Compare everything in two checkpoints."""
    assert type(first) is type(second)
    if isinstance(first, dict):
        assert list(first) == list(second)
        for name in first:
            assert_equal(first[name], second[name])
    elif isinstance(first, torch.Tensor):
        assert torch.equal(first, second)
    else:
        assert first == second


def load_all(path: Path) -> Any:
    return torch.load(path, weights_only=False)


@pytest.mark.parametrize("write", [write_gsplat, write_nerfstudio])
def test_only_colors_of_a_checkpoint_change(tmp_path: Path, write: Any) -> None:
    path, scene = write(tmp_path / "given.ckpt", wall(sh_degree=3)), wall(sh_degree=3)
    loaded = load_scene(path)
    assert isinstance(loaded, TrainerCheckpoint)
    assert same(loaded.scene, scene)
    result = loaded.stylized(replace(scene, sh_dc=scene.sh_dc + 1), None, 0.0)
    save(tmp_path / "out.pt", result)
    before, after = load_all(path), load_all(tmp_path / "out.pt")
    name = "splats" if write is write_gsplat else "pipeline"
    colors = "sh0" if write is write_gsplat else "_model.gauss_params.features_dc"
    assert torch.equal(after[name][colors], before[name][colors] + 1)
    before[name][colors] = after[name][colors]
    assert_equal(after, before)
    assert same(load_scene(tmp_path / "out.pt").scene, result.scene)


def test_checkpoint_can_be_saved_as_a_scene_file(tmp_path: Path) -> None:
    loaded = load_scene(write_nerfstudio(tmp_path / "given.ckpt", wall(sh_degree=1)))
    save(tmp_path / "out.ply", loaded)
    assert same(read_scene(tmp_path / "out.ply").scene, wall(sh_degree=1))
    for path, form in (
        (tmp_path / "out.json", loaded),
        (tmp_path / "out.pt", loaded.scene),
        (tmp_path / "out", loaded),
    ):
        with pytest.raises(OutputError, match="no suffix that a scene can be written with"):
            save(path, form)
    os.utime(loaded.path, ns=(0, 0))
    with pytest.raises(SceneError, match="was changed after it was read"):
        save(tmp_path / "other.pt", loaded)
    assert sorted(each.name for each in tmp_path.iterdir()) == ["given.ckpt", "out.ply"]


def repacked(path: Path, target: Path, compression: int = zipfile.ZIP_STORED, cut: int | None = None) -> Path:
    """Write the entries of a checkpoint again, compressed or with truncated tensor data."""
    with zipfile.ZipFile(path) as given, zipfile.ZipFile(target, "w", compression) as written:
        for entry in given.infolist():
            data = given.read(entry)
            written.writestr(entry.filename, data[:cut] if "/data/" in entry.filename else data)
    return target


class Command:
    """Object whose pickle runs a command."""

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, ("touch executed",)


#: Functions that write a file, given its path, a good checkpoint and its splats; and problems of the file.
HOSTILE: dict[str, tuple[Callable[[Path, Path, dict[str, Any]], object], str]] = {
    "command": (
        lambda path, good, splats: torch.save({"splats": {**splats, "means": Command()}}, path),
        "more than tensors and plain values. Such a file can run any program",
    ),
    "expanded": (  # a few bytes that would become terabytes
        lambda path, good, splats: torch.save(
            {"splats": {**splats, "means": torch.zeros(1, 1).expand(1 << 40, 3)}}, path
        ),
        "`means` is larger than its data",
    ),
    "compressed": (lambda path, good, splats: repacked(good, path, zipfile.ZIP_DEFLATED), "compressed entries"),
    "short": (lambda path, good, splats: repacked(good, path, cut=8), "not a readable checkpoint"),
    "half": (
        lambda path, good, splats: path.write_bytes(good.read_bytes()[:5000]),
        "not a readable checkpoint .File is not a zip file",
    ),
    "other": (
        lambda path, good, splats: torch.save({"model": splats}, path),
        "neither a checkpoint of gsplat's trainer nor one of nerfstudio.*ns-export",
    ),
    "list": (
        lambda path, good, splats: torch.save([splats], path),
        r"neither a checkpoint.*original 3DGS code has point_cloud/iteration_\*/point_cloud\.ply beside it",
    ),
    "nerfacto": (
        lambda path, good, splats: torch.save({"pipeline": {"_model.field.weight": torch.ones(3)}}, path),
        "holds no Gaussians",
    ),
    "degree 0": (lambda path, good, splats: write_nerfstudio(path, wall()), "SH degree 0"),
    "nan": (
        lambda path, good, splats: torch.save({"splats": {**splats, "quats": splats["quats"] * torch.nan}}, path),
        "nan.pt: The scene: `quats` holds 2464 NaN",
    ),
    "text": (
        lambda path, good, splats: torch.save({"splats": {**splats, "opacities": "many"}}, path),
        "`opacities` is a str",
    ),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_unusable_checkpoints_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, case: str) -> None:
    monkeypatch.chdir(tmp_path)
    path, (write, problem) = tmp_path / f"{case}.pt", HOSTILE[case]
    write(path, write_gsplat(tmp_path / "good.pt", wall()), splats_of(wall()))
    with pytest.raises(SceneError, match=problem):
        load_scene(path)
    assert not Path("executed").exists()


def test_activated_values_are_detected() -> None:
    scene = wall(sh_degree=1)
    assert same(scene_of_splats(splats_of(scene)), scene)
    loaded = scene_of_splats(splats_of(scene, activated=True))
    torch.testing.assert_close(loaded.scales, scene.scales)
    torch.testing.assert_close(loaded.opacities, scene.opacities, rtol=1e-4, atol=0)
    opaque = {**splats_of(scene, activated=True), "opacities": torch.ones(len(scene))}
    flat = {**opaque, "scales": torch.tensor([0.1, 0.1, 0.0]).repeat(len(scene), 1)}
    assert float(scene_of_splats(flat).opacities.max()) == pytest.approx(float(OPACITY_LOGITS[-1]))
    assert bool(scene_of_splats(flat).scales.isfinite().all())
    del opaque["shN"]
    assert scene_of_splats(opaque).sh_degree == 0


def test_partly_activated_values_are_refused() -> None:
    scene = wall()
    for logits, scales in ((scene.opacities.sigmoid(), scene.scales), (scene.opacities, scene.scales.exp())):
        with pytest.raises(SceneError, match="logarithms and logits as gsplat's trainers keep them"):
            scene_of_splats({**splats_of(scene), "opacities": logits, "scales": scales})
    assert bool(
        scene_of_splats({**splats_of(scene), "opacities": scene.opacities * torch.inf}).opacities.isfinite().all()
    )


def test_dictionaries_without_colors_are_refused() -> None:
    splats = splats_of(wall())
    with pytest.raises(SceneError, match=r"lacks `quats`, `sh0`\. Give a dictionary with means, quats"):
        scene_of_splats({key: value for key, value in splats.items() if key not in ("quats", "sh0")})
    with pytest.raises(SceneError, match="`scales` is a list"):
        scene_of_splats({**splats, "scales": [1.0]})

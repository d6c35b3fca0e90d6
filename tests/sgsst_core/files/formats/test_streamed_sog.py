"""Tests of streamed SOG: the finest level, colors of the others, and false files."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from sgsst_core.errors import OutputError, SceneError
from sgsst_core.files.formats import read_scene_header
from sgsst_core.files.formats.streamed_sog import pack
from sgsst_core.files.library import load_scene, save
from sgsst_core.files.scene_file import read_scene, write_levels
from sgsst_core.scene.gaussians import TENSORS
from sgsst_core.scene.stored_harmonics import held
from tests.sgsst_core.files.formats.samples import refused
from tests.sgsst_core.files.formats.streamed import Files, archived, files_of, part_of, streamed, unpacked
from tests.sgsst_core.splat_scenes import cloud


def three_levels() -> Files:
    """Return a streamed SOG whose finest level has two parts and an environment, of different SH degrees."""
    sizes = ((300, 1), (200, 2), (90, 1), (20, 0), (50, 0))
    scenes = [cloud(count, degree=degree) for count, degree in sizes]
    scenes = [replace(scene, means=scene.means + 0.01 * number) for number, scene in enumerate(scenes)]
    return streamed([scenes[:2], [scenes[2]], [scenes[3]]], scenes[4])


@pytest.mark.parametrize("given", ["folder", "index", "archive", "folder in an archive"])
def test_finest_level_and_environment_are_read(tmp_path: Path, given: str) -> None:
    files = three_levels()
    folder = unpacked(tmp_path / "scene", files)
    above = "scene/" if given == "folder in an archive" else ""
    path = {"folder": folder, "index": folder / "lod-meta.json"}.get(given) or archived(tmp_path / "any", files, above)
    header, file = read_scene_header(path), read_scene(path)
    assert (header.format.title, header.count, file.scene.sh_degree) == ("streamed SOG", 550, 2)
    parts = [part_of(files, name, tmp_path / "parts") for name in ("0_0", "0_1", "env")]
    for name in TENSORS[:-1]:
        assert torch.equal(getattr(file.scene, name), torch.cat([getattr(part, name) for part in parts])), name
    rest = held(file.scene.sh_rest)
    assert torch.equal(rest[:300, :3], held(parts[0].sh_rest))
    assert not rest[:300, 3:].any()
    assert torch.equal(rest[300:500], held(parts[1].sh_rest))
    assert ["the finest of 3 levels" in note for note in file.notes] == [True]


@pytest.mark.parametrize("target", ["lod-meta.json", "recolored.zip"])
def test_colors_are_carried_to_all_levels(tmp_path: Path, target: str) -> None:
    files = three_levels()
    original = unpacked(tmp_path / "scene", files)
    scene = read_scene(original).scene
    change = torch.where(scene.means[:, :1] > scene.means[:, 0].median(), 0.5, 0.0) * torch.tensor([1.0, -1.0, 0.0])
    out = tmp_path / "out" / target
    out.parent.mkdir()
    write_levels(out, replace(scene, sh_dc=scene.sh_dc + change), original)
    written = files_of(out.parent if target == "lod-meta.json" else out)
    assert written.keys() == files.keys()
    changed = {name for name in files if written[name] != files[name]}
    assert {name.rpartition("/")[2] for name in changed} == {"meta.json", "sh0.webp"}
    for part in ("0_0", "0_1", "1_0", "2_0", "env"):
        before, after = (part_of(each, part, tmp_path / str(i)) for i, each in enumerate((files, written)))
        nearest = (before.means[:, None] - scene.means).square().sum(dim=2).argmin(dim=1)
        torch.testing.assert_close(after.sh_dc, before.sh_dc + change[nearest], atol=0.2, rtol=0)
        assert torch.equal(after.opacities, before.opacities)


def test_parts_without_new_colors_keep_all_bytes(tmp_path: Path) -> None:
    files = three_levels()
    original = archived(tmp_path / "scene.zip", files)
    scene = read_scene(original).scene
    write_levels(tmp_path / "same.zip", scene, original)
    assert files_of(tmp_path / "same.zip") == files
    colors = scene.sh_dc.clone()
    colors[:150] += 1
    write_levels(tmp_path / "other.zip", replace(scene, sh_dc=colors), original)
    written = files_of(tmp_path / "other.zip")
    assert written["0_0/sh0.webp"] != files["0_0/sh0.webp"]
    assert all(written[name] == files[name] for name in files if name.startswith(("0_1/", "env/")))
    pack(unpacked(tmp_path / "folder", files) / "lod-meta.json", tmp_path / "packed.zip")
    assert files_of(tmp_path / "packed.zip") == files


def test_other_gaussians_are_refused_and_nothing_is_written(tmp_path: Path) -> None:
    original = archived(tmp_path / "scene.zip", three_levels())
    scene, out = read_scene(original).scene, tmp_path / "out.zip"
    with pytest.raises(OutputError, match="are not those of the finest level"):
        write_levels(out, scene.subset(torch.arange(549)), original)
    with pytest.raises(OutputError, match="are not those of the finest level"):
        write_levels(out, scene.subset(torch.arange(550).flip(0)), original)
    save(tmp_path / "plain.sog", load_scene(original))
    with pytest.raises(SceneError, match="no streamed SOG"):
        write_levels(out, scene, tmp_path / "plain.sog")
    assert not out.exists()


@pytest.mark.parametrize("target", ["lod-meta.json", "out.zip"])
def test_nothing_is_written_if_a_coarse_level_is_damaged(tmp_path: Path, target: str) -> None:
    files = three_levels()
    files["2_0/means_u.webp"] = files["2_0/means_u.webp"][:40]
    original = unpacked(tmp_path / "scene", files)
    scene = read_scene(original).scene
    (tmp_path / "out").mkdir()
    with pytest.raises(SceneError, match="is not a readable WebP or PNG image"):
        write_levels(tmp_path / "out" / target, replace(scene, sh_dc=scene.sh_dc + 1), original)
    assert list((tmp_path / "out").iterdir()) == []


def deeper(index: dict[str, Any]) -> None:
    """Nest the tree more deeply than Python's parser goes."""
    index["tree"] = "DEEP"


HOSTILE: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "folder above": (
        lambda index: index["filenames"].__setitem__(0, "../0_0/meta.json"),
        "not the meta.json of a fold",
    ),
    "absolute": (lambda index: index["filenames"].__setitem__(0, "/etc/meta.json"), "not the meta.json of a folder"),
    "address": (
        lambda index: index["filenames"].__setitem__(1, "https://a.org/meta.json"),
        "not the meta.json of a folder",
    ),
    "other file": (lambda index: index["filenames"].__setitem__(1, "0_1/secret.txt"), "not the meta.json of a folder"),
    "number": (lambda index: index["filenames"].__setitem__(1, 5), "not that of a streamed SOG"),
    "missing part": (lambda index: index["filenames"].__setitem__(0, "7_7/meta.json"), "7_7/meta.json"),
    "missing environment": (lambda index: index.update(environment="sky/meta.json"), "sky/meta.json"),
    "environment elsewhere": (
        lambda index: index.update(environment="../sky/meta.json"),
        "not the meta.json of a folder",
    ),
    "no tree": (lambda index: index.pop("tree"), "not that of a streamed SOG"),
    "deep tree": (deeper, "not that of a streamed SOG"),
    "no leaves": (lambda index: index["tree"].update(children=[]), "refers to no Gaussians"),
    "version": (lambda index: index.update(version=2), "version: 2"),
    "counts": (lambda index: index.update(counts=[1, 90, 20]), "level 0 has 500 Gaussians in place of 1"),
    "many files": (lambda index: index.update(filenames=["0_0/meta.json"] * 2000), "2000 files"),
    "level": (lambda index: index.update(lodLevels=2), "level 2 of 2"),
    "two levels": (lambda index: leaf(index, 0)["lods"].update({"1": leaf(index, 0)["lods"]["0"]}), "several levels"),
    "negative": (lambda index: leaf(index, 0)["lods"]["0"].update(offset=-1), "level 0 of 3"),
    "truth": (lambda index: leaf(index, 0)["lods"]["0"].update(count=True), "level 0 of 3"),
    "overlap": (lambda index: leaf(index, 0)["lods"]["0"].update(offset=0), "0_0/meta.json has 300 Gaussians, but"),
    "huge": (lambda index: leaf(index, 0)["lods"]["0"].update(count=10**15), "0_0/meta.json has 300 Gaussians, but"),
}


def leaf(index: dict[str, Any], number: int) -> dict[str, Any]:
    return index["tree"]["children"][number]  # type: ignore[no-any-return]


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("what", HOSTILE)
def test_false_index_is_refused(tmp_path: Path, what: str, packed: bool) -> None:
    change, message = HOSTILE[what]
    files = three_levels()
    index = json.loads(files["lod-meta.json"])
    change(index)
    text = json.dumps(index).replace('"DEEP"', '{"children":[' * 10**5 + "]}" * 10**5)
    files["lod-meta.json"] = text.encode()
    path = archived(tmp_path / "scene.zip", files) if packed else unpacked(tmp_path / "scene", files)
    with pytest.raises(SceneError, match=message):
        read_scene(path)


def test_huge_contents_are_refused(tmp_path: Path) -> None:
    files = three_levels()
    meta = json.loads(files["0_0/meta.json"])
    for changed, message in (
        ({"lod-meta.json": b'{"lodLevels": 1,' + b" " * (1 << 23) + b"}"}, "more than 2097152 bytes"),
        ({"0_0/meta.json": b" " * (1 << 20)}, "0_0/meta.json has more than 65536 bytes"),
        ({"0_0/meta.json": json.dumps(meta | {"count": 10**9}).encode()}, "0_0/means_l.webp has .* pixels"),
        ({"1_0/meta.json": b"{}"}, "1_0/meta.json is not that of a SOG scene"),
    ):
        data = archived(tmp_path / "archive.zip", files | changed).read_bytes()
        refused(tmp_path, data, message, "scene.zip")


def test_damaged_archives_are_refused(tmp_path: Path) -> None:
    data = archived(tmp_path / "good.zip", three_levels()).read_bytes()
    (tmp_path / "scene.zip").write_bytes(data[: len(data) // 2])
    with pytest.raises(SceneError, match="truncated ZIP archive"):
        read_scene(tmp_path / "scene.zip")
    start = data.index(b"PK\x01\x02")
    (tmp_path / "scene.zip").write_bytes(data[:start] + b"XXXX" + data[start + 4 :])
    with pytest.raises(SceneError, match="damaged ZIP archive"):
        read_scene(tmp_path / "scene.zip")


def test_published_scene_is_read_and_recolored(shared_data: Path, tmp_path: Path) -> None:
    original = shared_data / "scenes" / "playbot_streamed_sog"
    scene = read_scene(original).scene
    assert (len(scene), scene.sh_degree) == (500_000, 2)
    write_levels(tmp_path / "gray.zip", replace(scene, sh_dc=torch.zeros_like(scene.sh_dc)), original)
    written = files_of(tmp_path / "gray.zip")
    assert len(written) == 1 + 7 * 8
    assert float(read_scene(tmp_path / "gray.zip").scene.sh_dc.abs().max()) < 1e-5
    coarse = part_of(written, "6_0", tmp_path / "parts")
    assert float(coarse.sh_dc.abs().mean()) < 0.5 * float(
        read_scene(original / "6_0/meta.json").scene.sh_dc.abs().mean()
    )

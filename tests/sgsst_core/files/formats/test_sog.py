"""Tests of SOG and streamed SOG, and of their codebooks."""

import io
import json
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.cluster.vq import kmeans2

from sgsst_core.errors import OutputError, SceneError
from sgsst_core.files.formats import read_scene_header
from sgsst_core.files.formats.sog import SOG, nearest_entries, pack, palette, value_codebook
from sgsst_core.files.library import load_scene, save
from sgsst_core.files.scene_file import read_scene, write_levels, write_scene
from sgsst_core.scene.gaussians import TENSORS
from tests.sgsst_core.files.formats.samples import (
    Files,
    archived,
    assert_close,
    check_documents,
    encoded,
    files_of,
    part_of,
    refused,
    streamed,
    unpacked,
)
from tests.sgsst_core.splat_scenes import cloud
from tests.small_scenes import wall


def zipped(files: Files, method: int = zipfile.ZIP_STORED) -> bytes:
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w", method) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return target.getvalue()


def webp(pixels: Any, mode: str = "RGBA") -> bytes:
    file = io.BytesIO()
    Image.fromarray(np.array(pixels, np.uint8)).convert(mode).save(file, "WEBP", lossless=True, exact=True)
    return file.getvalue()


def by_hand(version: int) -> Files:
    """Return the files of two Gaussians with an SH palette of degree 1."""
    palette = np.zeros((1, 192, 4), np.uint8)
    palette[0, 3:6, 0] = [1, 2, 3]  # red of the second vector
    images = {
        "low": webp([[[0, 255, 0, 255], [255, 255, 0, 255]]]),
        "high": webp([[[0, 255, 0, 255], [255, 255, 128, 255]]]),
        "quats": webp([[[128, 128, 255, 252], [0, 128, 128, 254]]]),
        "scales": webp([[[0, 1, 2, 255], [2, 1, 0, 255]]]),
        "sh0": webp([[[2, 1, 0, 0], [0, 1, 2, 255]]]),
        "palette": webp(palette),
        "huge": b"RIFF" + bytes(4) + b"WEBPVP8X" + bytes(8) + (9999).to_bytes(3, "little") * 2,
        "labels": webp([[[0, 0, 0, 255], [1, 0, 0, 255]]]),
    }
    codebook = list(range(-5, 251))
    steps = {"mins": [-5.0] * 3, "maxs": [250.0] * 3}
    meta: dict[str, Any] = {
        "means": {"mins": [-1, -2, 0], "maxs": [1, 3, 2], "files": ["low", "high"]},
        "scales": {"files": ["scales"]} | ({"codebook": codebook} if version == 2 else steps),
        "quats": {"files": ["quats"]},
        "sh0": {"files": ["sh0"]} | ({"codebook": codebook} if version == 2 else {}),
        "shN": {"files": ["palette", "labels"]}
        | ({"codebook": codebook} if version == 2 else {"mins": -5, "maxs": 250}),
    }
    if version == 2:
        meta |= {"version": 2, "count": 2}
        meta["shN"] |= {"bands": 1, "count": 64}
    else:
        meta["means"]["shape"] = [2, 3]
        meta["sh0"] |= {"mins": [-5.0] * 3 + [-4], "maxs": [250.0] * 3 + [6]}
    return {"meta.json": json.dumps(meta).encode()} | images


@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
@pytest.mark.parametrize("version", [1, 2])
def test_values_match_those_computed_by_hand(tmp_path: Path, version: int, method: int) -> None:
    path = tmp_path / "scene"
    path.write_bytes(zipped(by_hand(version), method))
    scene = read_scene(path).scene
    expected = [[1 - np.e, np.e**3 - 1, 0], [np.e - 1, np.e**3 - 1, np.exp(2 * 32768 / 65535) - 1]]
    torch.testing.assert_close(scene.means, torch.tensor(expected, dtype=torch.float32))
    assert scene.scales.tolist() == [[-5, -4, -3], [-3, -4, -5]]
    assert scene.sh_dc.tolist() == [[-3, -4, -5], [-5, -4, -3]]
    half = 0.5**0.5
    expected = [[half, 0, 0, half], [-half, 0, half, 0]]
    torch.testing.assert_close(scene.quats, torch.tensor(expected), atol=0.01, rtol=0)
    rest = scene.sh_rest
    assert (rest[0].tolist(), rest[1].tolist()) == ([[-5] * 3] * 3, [[-4, -5, -5], [-3, -5, -5], [-2, -5, -5]])
    if version == 2:
        assert scene.opacities.sigmoid().tolist() == pytest.approx([0.25 / 255, 1 - 0.25 / 255], rel=1e-4)
    else:
        assert scene.opacities.tolist() == [-4, 6]


def test_padding_may_have_any_colors(tmp_path: Path) -> None:
    """Writers may change the colors of transparent pixels, with which images are padded, or pad with white."""
    padding = [[9, 8, 7, 0], [255] * 4]
    files = by_hand(2)
    for name in ("low", "high", "quats", "scales", "sh0", "labels"):
        pixels = np.asarray(Image.open(io.BytesIO(files[name])).convert("RGBA"))
        files[name] = webp(np.concatenate([pixels, [padding]]))
    (tmp_path / "scene.sog").write_bytes(zipped(files))
    assert read_scene(tmp_path / "scene.sog").notes == ()


def test_older_form_of_the_render_mode_is_read(tmp_path: Path) -> None:
    (tmp_path / "scene.sog").write_bytes(changed(antialias=True))
    assert read_scene(tmp_path / "scene.sog").scene.rendering.antialiased


def test_missing_first_value_of_a_codebook_is_extrapolated(tmp_path: Path) -> None:
    """Older writers left it empty (null); it lies a mean step below the second value, as in PlayCanvas' reader."""
    path, files = tmp_path / "scene.sog", by_hand(2)
    path.write_bytes(zipped(files))
    complete = read_scene(path).scene
    meta = json.loads(files["meta.json"])
    for name in ("scales", "sh0", "shN"):
        meta[name]["codebook"][0] = None
    path.write_bytes(zipped(files | {"meta.json": json.dumps(meta).encode()}))
    scene = read_scene(path).scene
    step = 254 / 255
    values = torch.tensor([-4 - step, -4, -3])
    torch.testing.assert_close(scene.scales, torch.stack([values, values.flip(0)]))
    torch.testing.assert_close(scene.sh_dc[1], values)
    expected = torch.where(complete.sh_rest == -5, -4 - step, complete.sh_rest.double())
    torch.testing.assert_close(scene.sh_rest, expected.float())
    meta["scales"]["codebook"][1] = None
    refused(tmp_path, zipped(files | {"meta.json": json.dumps(meta).encode()}), "NaN")


def test_folder_is_read_by_its_meta_json(tmp_path: Path) -> None:
    encoded(tmp_path, SOG, degree=3)
    files = files_of(tmp_path / "good")
    folder = unpacked(tmp_path / "folder", files)
    assert_close(read_scene(folder / "meta.json").scene, read_scene(tmp_path / "good").scene, opacities=0, others=0)
    for name in files:
        if name.endswith(".webp"):  # the specification allows images of other formats
            Image.open(folder / name).save(folder / name, "PNG")
    assert_close(read_scene(folder / "meta.json").scene, read_scene(tmp_path / "good").scene, opacities=0, others=0)
    (folder / "quats.webp").unlink()
    refused(
        folder,
        (folder / "meta.json").read_bytes(),
        "quats.webp cannot be read: No such file.*whole folder",
        "meta.json",
    )


def test_new_colors_change_only_one_image(tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    write_scene(first, cloud(3000, degree=2), SOG)
    scene = read_scene(first).scene
    write_scene(second, replace(scene, sh_dc=torch.rand(3000, 3)), SOG)
    before, after = (files_of(path) for path in (first, second))
    # rotations with two components of nearly the same size can be stored in two ways
    assert {name for name in before if before[name] != after[name]} <= {"sh0.webp", "meta.json", "quats.webp"}
    assert (scene.quats - read_scene(second).scene.quats).abs().quantile(0.95) == 0
    metas = [json.loads(files["meta.json"]) for files in (before, after)]
    assert [key for key in metas[0] if key != "means" and metas[0][key] != metas[1][key]] == ["sh0"]


def test_transparent_gaussians_keep_their_colors(tmp_path: Path) -> None:
    scene = replace(wall(), opacities=torch.full((616,), -1e4))
    write_scene(tmp_path / "scene", scene, SOG)
    loaded = read_scene(tmp_path / "scene").scene
    order, other = (each.means[:, 0].double().argsort() for each in (scene, loaded))
    assert float(loaded.sh_dc.std()) > 0.01
    assert float((scene.sh_dc[order].mean(dim=0) - loaded.sh_dc[other].mean(dim=0)).abs().max()) < 0.01


def changed(**values: Any) -> bytes:
    files = by_hand(2)
    meta = json.loads(files["meta.json"])
    for name, value in values.items():
        entry, _, key = name.partition("__")
        if key:
            meta[entry][key] = value
        else:
            meta[entry] = value
    return zipped(files | {"meta.json": json.dumps(meta).encode()})


def many_channels() -> bytes:
    """Return a scene of version 1 whose bounds have 100,000 channels, for each of which 256 steps were computed."""
    files = by_hand(1)
    meta = json.loads(files["meta.json"])
    meta["scales"] |= {"mins": [0] * 100_000, "maxs": [1] * 100_000}
    return zipped(files | {"meta.json": json.dumps(meta).encode()}, zipfile.ZIP_DEFLATED)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (many_channels(), "100000 values in place of 3 numbers"),
        (zipped({"a.txt": b"text"}), "a ZIP archive without meta.json, so no SOG scene"),
        (zipped({f"{i:0200}": b"" for i in range(9000)}), "a ZIP archive of 9000 files"),
        (zipped(by_hand(2))[:-30], "truncated ZIP archive"),
        (b"PK\x03\x04" + bytes(100), "truncated ZIP archive"),
        (zipped({"meta.json": b"[" * 100_000}), "not that of a SOG scene"),
        (zipped({"meta.json": b" " * (1 << 21)}), "meta.json has more than 1048576 bytes"),
        (zipped({"meta.json": b'{"version": 2}'}), "not that of a SOG scene .KeyError"),
        (changed(version=3), "SOG of version 3.*splat-transform"),
        (changed(count=0), "count: 0"),
        (changed(count=10**9), "2 x 1 pixels.*do not fit 1000000000 Gaussians"),
        (changed(count=3), "2 x 1 pixels.*do not fit 3 Gaussians"),
        (changed(means__files=["../low", "high"]), "files of means"),
        (changed(means__files=["low"]), "files of means"),
        (changed(means__mins=[0, 1]), "2 values in place of 3 numbers"),
        (changed(means__maxs=[1, 3, 1e9]), "infinite"),
        (changed(scales__codebook=[0.0] * 257), "codebook of 257 values"),
        (changed(scales__codebook=[]), "codebook of 0 values"),
        (changed(scales__codebook=["1_0"]), "values that are not numbers"),
        (changed(means__files={"low": 0, "high": 1}), "files of means"),
        (changed(sh0__codebook=[0.0, None, 1.0]), "f_dc_1"),
        (changed(quats__files=["sh0"]), "sh0 has no valid rotations"),
        (changed(shN__files=["labels", "palette"]), "width of labels: 2"),
        (changed(shN__files=["palette", "low"]), "low refers to vector 65535 of 64"),
        (changed(shN__count=1), "labels refers to vector 1 of 1"),
        (changed(shN__count=0), "count of shN: 0"),
        (changed(motion={"degree": 1, "files": ["low", "high"]}), "property 'motion', so it is a dynamic scene"),
        (changed(trbf={"files": ["low"]}), "dynamic scene"),
        (changed(format="sogst", version=1), "dynamic scene"),
        (changed(quats__files=["nothing"]), "without nothing"),
        (zipped(by_hand(2) | {"low": by_hand(2)["low"] + bytes(1 << 28)}, zipfile.ZIP_DEFLATED), "low has more than"),
        (zipped(by_hand(2) | {"sh0": by_hand(2)["sh0"][:-8]}), "sh0 is not a readable WebP or PNG image"),
        (changed(count=10**8, means__files=["huge", "huge"]), "100000000 Gaussians, more than [0-9]+ bytes can hold"),
        (zipped(by_hand(2) | {"sh0": b"RIFF" + bytes(100)}), "sh0 is no lossless WebP or PNG image"),
        (zipped(by_hand(2) | {"scales": webp(np.zeros((5000, 5000, 3)), "RGB")}), "5000 x 5000 pixels"),
    ],
)
def test_false_file_is_refused(tmp_path: Path, data: bytes, message: str) -> None:
    refused(tmp_path, data, message)


@pytest.mark.parametrize("version", [1, 2])
def test_wrong_meta_json_values_are_refused(tmp_path: Path, version: int) -> None:
    files = by_hand(version)
    check_documents(
        tmp_path / "scene",
        json.loads(files["meta.json"]),
        lambda document: zipped(files | {"meta.json": json.dumps(document).encode()}),
    )


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
    rest = file.scene.sh_rest
    assert torch.equal(rest[:300, :3], parts[0].sh_rest)
    assert not rest[:300, 3:].any()
    assert torch.equal(rest[300:500], parts[1].sh_rest)
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


def test_folder_of_a_part_that_cannot_be_created_is_named(tmp_path: Path) -> None:
    original = archived(tmp_path / "scene.zip", three_levels())
    (tmp_path / "2_0").touch()
    with pytest.raises(OutputError, match="2_0: cannot be used as output folder: there is a file of that name"):
        write_levels(tmp_path / "lod-meta.json", read_scene(original).scene, original)


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
    "deep tree": (lambda index: index.update(tree="DEEP"), "not that of a streamed SOG"),  # deeper than Python's parser
    "no leaves": (lambda index: index["tree"].update(children=[]), "refers to no Gaussians"),
    "version": (lambda index: index.update(version=2), "version: 2"),
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


def error(rows: np.ndarray, approximations: np.ndarray) -> float:
    return float(((rows.astype(np.float64) - approximations) ** 2).mean())


def test_extreme_values_leave_the_others_their_entries() -> None:
    values = np.random.default_rng(0).normal(size=20_000).astype(np.float32)
    usual = value_codebook(values)
    usual_error = error(values, usual[nearest_entries(values, usual)])
    for extremes in ([1e3], [1e7], [-1e7], [1e3, 1e7, -1e5]):
        extreme = np.concatenate([values, np.array(extremes, np.float32)])
        codebook = value_codebook(extreme)
        nearest = codebook[nearest_entries(extreme, codebook)]
        assert error(values, nearest[: len(values)]) < 1.2 * usual_error
        np.testing.assert_allclose(nearest[len(values) :], extremes, rtol=1e-6)


def test_palette_is_nearly_as_good_as_k_means() -> None:
    generator = np.random.default_rng(3)
    rows = (generator.normal(size=(6000, 4)) * [3, 1, 0.5, 0.1]).astype(np.float32)
    vectors, labels = palette(rows, 1024)
    assert len(vectors) <= 1024
    reference, other = kmeans2(rows.astype(np.float64), 1024, iter=15, minit="points", seed=0)
    assert error(rows, vectors[labels]) < 1.3 * error(rows, reference[other])

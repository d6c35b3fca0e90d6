"""Tests of SOG: values computed by hand, both versions, results with new colors, and false files."""

from __future__ import annotations

import io
import json
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from sgsst_core.files.formats.sog import SOG
from sgsst_core.files.scene_file import read_scene, write_scene
from sgsst_core.scene.stored_harmonics import held
from tests.sgsst_core.files.formats.samples import assert_close, check_documents, encoded, refused
from tests.sgsst_core.splat_scenes import cloud
from tests.small_scenes import wall

Files = dict[str, bytes]


def unzipped(data: bytes) -> Files:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


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
    rest = held(scene.sh_rest)
    assert rest[0].tolist() == [[-5] * 3] * 3
    assert rest[1].tolist() == [[-4, -5, -5], [-3, -5, -5], [-2, -5, -5]]
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


def test_unknown_images_are_noted(tmp_path: Path) -> None:
    (tmp_path / "scene.sog").write_bytes(changed(normals={"files": ["low"]}, note="files"))
    assert read_scene(tmp_path / "scene.sog").notes == ("normals of meta.json are unknown and left out",)


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
    expected = torch.where(held(complete.sh_rest) == -5, -4 - step, held(complete.sh_rest).double())
    torch.testing.assert_close(held(scene.sh_rest), expected.float())
    meta["scales"]["codebook"][1] = None
    refused(tmp_path, zipped(files | {"meta.json": json.dumps(meta).encode()}), "NaN")


def test_folder_is_read_by_its_meta_json(tmp_path: Path) -> None:
    data = encoded(tmp_path, SOG, degree=3)
    folder = tmp_path / "folder"
    folder.mkdir()
    for name, content in unzipped(data).items():
        (folder / name).write_bytes(content)
    assert_close(read_scene(folder / "meta.json").scene, read_scene(tmp_path / "good").scene, opacities=0, others=0)
    for name in unzipped(data):
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
    before, after = (unzipped(path.read_bytes()) for path in (first, second))
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


def bomb() -> bytes:
    return zipped(by_hand(2) | {"low": by_hand(2)["low"] + bytes(1 << 28)}, zipfile.ZIP_DEFLATED)


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
        (zipped({f"{i}": b"" for i in range(300)}), "a ZIP archive of 300 files"),
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
        (changed(sh0__codebook=[0.0, None, 1.0]), "f_dc_1 .2 NaN"),
        (changed(quats__files=["sh0"]), "sh0 has no valid rotations"),
        (changed(shN__files=["labels", "palette"]), "width of labels: 2"),
        (changed(shN__files=["palette", "low"]), "low refers to vector 65535 of 64"),
        (changed(shN__count=1), "labels refers to vector 1 of 1"),
        (changed(shN__count=0), "count of shN: 0"),
        (changed(motion={"degree": 1, "files": ["low", "high"]}), "property 'motion', so it is a dynamic scene"),
        (changed(trbf={"files": ["low"]}), "dynamic scene"),
        (changed(format="sogst", version=1), "dynamic scene"),
        (changed(quats__files=["nothing"]), "without nothing"),
        (bomb(), "low has more than"),
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

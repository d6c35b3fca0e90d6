"""Sample files of compressed formats and streamed SOGs, and checks of their readers."""

import copy
import io
import json
import struct
import tracemalloc
import zipfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import gsply
import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement

from sgsst_core.constants import SH_C0
from sgsst_core.errors import SceneError
from sgsst_core.files.formats import read_scene_header
from sgsst_core.files.formats.scene_format import SceneFormat
from sgsst_core.files.formats.sog import SOG
from sgsst_core.files.scene_file import encode_scene, read_scene, write_scene
from sgsst_core.scene.gaussians import TENSORS, Scene
from tests.small_scenes import wall

#: Record of a .splat file.
SPLAT_ROW = struct.pack("<6f8B", 1, 2, 3, 1, 1, 1, 0, 255, 51, 128, 255, 128, 128, 128)


def scene_of(data: gsply.GSData | None) -> Scene:
    assert data is not None
    rest = np.zeros((len(data.means), 0, 3), np.float32) if data.shN is None else data.shN
    arrays = data.means, data.quats, data.scales, data.opacities.reshape(-1), data.sh0, rest
    return Scene(*(torch.from_numpy(np.ascontiguousarray(array)) for array in arrays))


def gsply_of(scene: Scene) -> gsply.GSData:
    arrays = {name: getattr(scene, name).numpy() for name in TENSORS}
    rest = arrays["sh_rest"]
    return gsply.GSData.from_arrays(
        means=arrays["means"],
        scales=arrays["scales"],
        quats=arrays["quats"] / np.linalg.norm(arrays["quats"], axis=1, keepdims=True),
        opacities=arrays["opacities"],
        sh0=arrays["sh_dc"],
        shN=rest if rest.shape[1] else None,
        format="ply",
    )


def assert_close(actual: Scene, expected: Scene, *, opacities: float = 1.1e-3, others: float = 3e-6) -> None:
    """Assert that scenes are equal up to rounding and the sign of quaternions, and that opacities are finite."""
    for name in TENSORS:
        first, second = getattr(actual, name).double(), getattr(expected, name).double()
        tolerance = others
        if name == "quats":
            first, second = (torch.nn.functional.normalize(each, dim=1) for each in (first, second))
            second = second * (first * second).sum(dim=1, keepdim=True).sign()
        if name == "opacities":
            assert bool(torch.isfinite(first).all())
            first, second, tolerance = first.sigmoid(), second.sigmoid(), opacities
        torch.testing.assert_close(first, second, rtol=tolerance, atol=tolerance)


def rewritten(
    source: Path, target: str, kinds: Callable[[str], str | None], *, form: str = "little", **added: Any
) -> Path:
    """Write the Gaussians of a PLY to another one of its folder: little, big, as text, or mixed up.

    Args:
        kinds: Function that returns the type of a property; None to leave it out.
        added: Values of further properties, which lie between the coefficients if properties are mixed up.
    """
    old = PlyData.read(source)["vertex"].data
    names = (*old.dtype.names, *added)
    names = (*names[20:], *names[:20]) if form == "mixed up" else names
    rows = np.empty(len(old), [(name, kind) for name in names if (kind := kinds(name))])
    for name in rows.dtype.names or ():
        rows[name] = added[name] if name in added else old[name]
    path, order = source.with_name(target), {"text": "=", "big": ">"}.get(form, "<")
    PlyData([PlyElement.describe(rows, "vertex")], text=form == "text", byte_order=order).write(str(path))
    return path


def encoded(tmp_path: Path, format: SceneFormat, degree: int = 1) -> bytes:
    """Return the bytes of a small scene in a format."""
    write_scene(tmp_path / "good", wall(sh_degree=degree), format)
    return (tmp_path / "good").read_bytes()


def refused(tmp_path: Path, data: bytes, message: str, name: str = "scene.ply") -> None:
    """Assert that a file is refused with a message, without allocating much memory."""
    path = tmp_path / name
    path.write_bytes(data)
    tracemalloc.start()
    try:
        with pytest.raises(SceneError, match=message) as caught:
            read_scene(path)
        assert tracemalloc.get_traced_memory()[1] < 64e6
    finally:
        tracemalloc.stop()
    assert str(path) in str(caught.value)


def check_damage(path: Path, good: bytes, wrap: Callable[[bytes], bytes] = bytes, trials: int = 80) -> None:
    """Assert that randomly damaged files give a `SceneError` or a scene of finite values.

    Args:
        path: File to write.
        good: Bytes of a scene, of which some are changed, mostly in the header.
        wrap: Conversion of the changed bytes to those of a file.
        trials: Number of damaged files.
    """
    generator = np.random.default_rng(3)
    for trial in range(trials):
        data = bytearray(good)
        for _ in range(generator.integers(1, 8)):
            index = int(generator.integers(0, min(len(data), 1500) if generator.random() < 0.7 else len(data)))
            data[index] = int(generator.integers(0, 256))
        if generator.random() < 0.3:
            del data[int(generator.integers(0, len(data))) :]
        path.write_bytes(wrap(bytes(data)))
        try:
            scene = read_scene(path).scene
        except SceneError:
            continue
        assert all(bool(torch.isfinite(getattr(scene, name)).all()) for name in TENSORS), trial


def ksplat(scene: Scene, level: int, bucket_size: int = 256) -> bytes:
    """Return a scene as .ksplat of one section, in whose buckets Gaussians follow each other; the last may be partial.

    Positions of level 1 and 2 are steps within the largest extent of a bucket.
    """
    count, coefficients = len(scene), scene.sh_rest.shape[1]
    means = scene.means.double().numpy()
    full, rest = divmod(count, bucket_size)
    buckets = [means[start : start + bucket_size] for start in range(0, count, bucket_size)]
    centers = np.array([(each.min(axis=0) + each.max(axis=0)) / 2 for each in buckets], "<f4")
    block = float(np.ceil(2 * max(np.abs(each - center).max() for each, center in zip(buckets, centers, strict=True))))
    kinds = {0: ("<f4", "<f4", "<f4"), 1: ("<u2", "<f2", "<f2"), 2: ("<u2", "<f2", "u1")}[level]
    names = ("position", "scale", "rotation", "color", "harmonics")
    types = (kinds[0], kinds[1], kinds[1], "u1", kinds[2])
    rows = np.zeros(count, [*zip(names, types, (3, 3, 4, 4, 3 * coefficients), strict=True)])
    steps = np.rint((means - centers[np.arange(count) // bucket_size]) * (32767 / (block / 2))) + 32767
    rows["position"] = steps if level else means
    rows["scale"] = scene.scales.double().exp().numpy()
    rows["rotation"] = scene.quats.numpy()
    rows["color"][:, :3] = ((0.5 + SH_C0 * scene.sh_dc.double()).clamp(0, 1) * 255).round().numpy()
    rows["color"][:, 3] = (scene.opacities.double().sigmoid() * 255).round().numpy()
    harmonics = scene.sh_rest.double().numpy()
    bands = [harmonics[:, first:last].transpose(0, 2, 1).reshape(count, -1) for first, last in ((0, 3), (3, 8))]
    values = np.concatenate(bands, axis=1)
    rows["harmonics"] = np.rint((values.clip(-1.5, 1.5) + 1.5) / 3 * 255) if level == 2 else values
    degree = {0: 0, 3: 1, 8: 2}[coefficients]
    head = struct.pack("<4BIIIIHxx5f", 0, 1, 0, 0, 1, 1, count, count, level, 0, 0, 0, 0, 0).ljust(4096, b"\0")
    stored = (bucket_size, len(buckets), block, 12, 32767, 0, full, bool(rest)) if level else (0, 0, 0.0, 0, 0, 0, 0, 0)
    section = struct.pack("<IIIIfHxxIIIIH", count, count, *stored, degree).ljust(1024, b"\0")
    lengths = struct.pack("<I", rest) if rest else b""
    return head + section + (lengths + centers.tobytes() if level else b"") + rows.tobytes()


#: Values of all kinds of JSON, some of which NumPy would convert to numbers.
_WRONG: list[Any] = [
    *(None, True, -1, 0, 1e999, 2**70, "x", "1_0", "x" * 100_000, [], {}, {"a": 1, "b": 2}),
    *([[]], [{}], [None] * 2, ["a"] * 2, [[1]], [1] * 3, ["1_0"] * 3),
]


def check_documents(path: Path, document: Any, make: Callable[[Any], bytes]) -> None:
    """Assert that a header with a wrong value anywhere in its JSON gives a short `SceneError`, or is usable.

    The API process reads these headers, and returns their errors to clients.

    Args:
        path: File to write.
        document: JSON of a scene.
        make: Conversion of changed JSON to the bytes of a file.
    """
    lengths = []
    for keys in _keys(document):
        for wrong in _WRONG:
            changed = copy.deepcopy(document) if keys else wrong
            inner = changed
            for key in keys[:-1]:
                inner = inner[key]
            if keys:
                inner[keys[-1]] = wrong
            path.write_bytes(make(changed))
            try:
                read_scene_header(path)
            except SceneError as error:
                lengths.append(len(str(error)))
    assert len(lengths) > len(document)
    assert max(lengths) < len(str(path)) + 1000


def _keys(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the keys that lead to each value within a JSON value; of lists, the first values."""
    yield path
    children = value if isinstance(value, dict) else range(min(len(value), 4)) if isinstance(value, list) else ()
    for key in children:
        yield from _keys(value[key], (*path, key))


Files = dict[str, bytes]


def sog_files(scene: Scene) -> Files:
    """Return the files of an unpacked SOG."""
    target = io.BytesIO()
    encode_scene(target, scene, SOG, Path("scene.sog"))
    with zipfile.ZipFile(target) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def streamed(levels: Sequence[Sequence[Scene]], environment: Scene | None = None) -> Files:
    """Return the files of a streamed SOG, given the scenes of each level; each has two leaves for every scene."""
    files: Files = {}
    leaves: list[dict[str, Any]] = []
    for level, scenes in enumerate(levels):
        for number, scene in enumerate(scenes):
            files |= {f"{level}_{number}/{name}": data for name, data in sog_files(scene).items()}
            half = len(scene) // 2
            for offset, count in ((half, len(scene) - half), (0, half)):
                lods = {str(level): {"file": len(names_of(files)) - 1, "offset": offset, "count": count}}
                leaves.append({"bound": {"min": [0, 0, 0], "max": [1, 1, 1]}, "lods": lods})
    index: dict[str, Any] = {"lodLevels": len(levels), "filenames": names_of(files), "environment": None}
    if environment is not None:
        files |= {f"env/{name}": data for name, data in sog_files(environment).items()}
        index["environment"] = "env/meta.json"
    index["tree"] = {"bound": leaves[0]["bound"], "children": leaves}
    return files | {"lod-meta.json": json.dumps(index).encode()}


def names_of(files: Files) -> list[str]:
    """Return the paths of the parts."""
    return [name for name in files if name.endswith("/meta.json")]


def unpacked(folder: Path, files: Files) -> Path:
    """Write files to a folder, and return it."""
    for name, data in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    return folder


def archived(path: Path, files: Files, above: str = "") -> Path:
    """Write files to a ZIP archive, and return its path."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            archive.writestr(above + name, data)
    return path


def files_of(path: Path) -> Files:
    """Return the files of an archive or a folder."""
    if path.is_dir():
        return {each.relative_to(path).as_posix(): each.read_bytes() for each in path.rglob("*") if each.is_file()}
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def part_of(files: Files, folder: str, at: Path) -> Scene:
    """Return the scene of one part, written to a folder."""
    return read_scene(unpacked(at, files) / folder / "meta.json").scene

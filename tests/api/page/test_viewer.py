"""Tests of the page's 3D view: comparison with `sgsst render`, wipe, depth order, GPU context lost, headset."""

import base64
import contextlib
import gzip
import io
import json
import shutil
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image
from plyfile import PlyData

from sgsst_core.files.camera_files import read_cameras
from sgsst_core.files.formats import by_name
from sgsst_core.files.scene_file import read_scene, write_scene
from sgsst_core.orbit import orbit
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scene.camera import Camera, resized
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.rendering import Rendering
from sgsst_core.scene.spherical_harmonics import scene_colors
from tests.api.page.browser import PATIENCE, Watched, decoded, psnr, rendered, serve_files, view_script
from tests.api.page.test_exported import export, painted
from tests.real_scenes import scene_path
from tests.sgsst_core.files.formats.samples import archived, ksplat, streamed
from tests.sgsst_core.files.test_camera_files import CAPTURES
from tests.sgsst_core.files.test_scene_file import with_filter, without_thickness
from tests.sgsst_core.objects import joined
from tests.small_scenes import cameras, wall, write_files

pytestmark = pytest.mark.slow

#: Minimum PSNR in decibels in every camera.
FAITHFUL = 45.0
#: Draws frames for half a second, in which a key that is held moves the camera.
HALF_A_SECOND = """async () => {
    const begin = performance.now();
    while (performance.now() - begin < 500) await new Promise(requestAnimationFrame);
}"""
Visit = Callable[..., Watched]
#: Returns what the page reads of camera files, given as pairs of name and base64.
READ_CAMERAS = """async ([base, files]) => {
  const { readCameras } = await import(`${base}/cameras.js`);
  const blob = (text) => new Blob([Uint8Array.from(atob(text), (character) => character.charCodeAt(0))]);
  return await readCameras(files.map(([name, text]) => ({ name, blob: blob(text) })));
}"""


def base_of(watched: Watched) -> str:
    """Return the base URL of the page's modules."""
    source: str = watched.page.locator("script[type=module]").evaluate("script => script.src")
    return source.rsplit("/", 1)[0]


def shown(watched: Watched, folder: Path, name: str, size: tuple[int, int], steps: str | None = None) -> Any:
    serve_files(watched.page, folder)
    script = view_script(steps) if steps else view_script()
    return watched.page.evaluate(script, [base_of(watched), "/given/scene.ply", "/given/cameras.json", name, *size])


def real_scene(shared_data: Path, name: str) -> tuple[Scene, list[Camera]]:
    scene = read_scene(scene_path(shared_data, name)).scene
    file = shared_data / "scenes" / name / "cameras.json"
    if file.exists():
        return scene, [resized(camera, 240) for camera in read_cameras(file)[::33]]
    return scene, orbit(scene, 3, width=240, height=180)


@pytest.mark.parametrize("capture", ["colmap4_panorama", "metashape_spherical"])
def test_faces_of_panoramas_are_those_of_the_service(visit: Visit, files: dict[str, Path], capture: str) -> None:
    """A mixed COLMAP model and a transforms.json are shown, and read as by the service."""
    paths = sorted((CAPTURES / capture).rglob("*.*"))
    expected = read_cameras(CAPTURES / capture)
    watched = visit()
    watched.page.get_by_label("Scene", exact=True).set_input_files(files["scene"])
    watched.page.get_by_label("Cameras", exact=True).set_input_files(paths)
    watched.page.get_by_text(f"{len(expected)} cameras shown in the scene").wait_for()
    sent = [[path.name, base64.b64encode(path.read_bytes()).decode()] for path in paths]
    read = watched.page.evaluate(READ_CAMERAS, [base_of(watched), sent])
    assert [each["name"] for each in read] == [camera.name for camera in expected]
    for each, camera in zip(read, expected, strict=True):
        assert all(each[key] == getattr(camera, key) for key in ("fx", "fy", "width", "height"))
        assert np.allclose(each["position"], camera.center.numpy(), atol=1e-12)
        assert np.allclose(each["axes"], camera.world_to_camera[:3, :3].numpy(), atol=1e-12)


@pytest.mark.parametrize(("name", "degree"), [("broche", 0), ("playbot_synthetic_sh2", 2), ("snowmiku_plush", 3)])
def test_view_is_that_of_the_renderer(visit: Visit, shared_data: Path, tmp_path: Path, name: str, degree: int) -> None:
    scene, views = real_scene(shared_data, name)
    assert scene.sh_degree == degree
    write_files(tmp_path, scene, views)
    watched = visit("/#/jobs")
    for camera in views:
        pixels = decoded(shown(watched, tmp_path, camera.name, (camera.width, camera.height)))
        assert psnr(pixels, rendered(tmp_path / "scene.ply", camera)) >= FAITHFUL, camera.name


@pytest.mark.parametrize(
    ("form", "name"),
    [
        ("compressed.ply", "playbot_synthetic_sh2"),
        ("spz", "snowmiku_plush"),
        ("v3.spz", "snowmiku_plush"),
        ("glb", "snowmiku_plush"),
        ("splat", "broche"),
        ("sog", "snowmiku_plush"),
        ("ksplat1", "broche"),
        ("ksplat2", "playbot_synthetic_sh2"),
    ],
)
def test_packed_scenes_are_shown(visit: Visit, shared_data: Path, tmp_path: Path, form: str, name: str) -> None:
    scene, views = real_scene(shared_data, name)
    ply, _, _ = write_files(tmp_path, scene, views)
    ply.unlink()  # the browser and `sgsst render` read only the compressed scene, whose name is no hint
    if form == "splat":
        ply.write_bytes(scene_path(shared_data, name).read_bytes())
    elif form.startswith("ksplat"):
        ply.write_bytes(ksplat(scene, int(form[-1])))
    else:
        write_scene(tmp_path / f"scene.{form}", scene, by_name(form))
        (tmp_path / f"scene.{form}").rename(ply)
    watched = visit("/#/jobs")
    for camera in views[:2]:
        pixels = decoded(shown(watched, tmp_path, camera.name, (camera.width, camera.height)))
        assert psnr(pixels, rendered(ply, camera)) >= FAITHFUL, camera.name


@pytest.mark.parametrize(
    ("form", "eps2d"),
    [("ply", 0.3), ("ply", 0.1), ("compressed.ply", 0.1), ("spz", 0.3), ("v3.spz", 0.3), ("glb", 0.1), ("sog", 0.1)],
)
def test_antialiased_scenes_are_shown_as_such(visit: Visit, tmp_path: Path, form: str, eps2d: float) -> None:
    scene = replace(dust(), rendering=Rendering("antialiased", eps2d))
    ply, _, _ = write_files(tmp_path, scene, cameras(2, 120, 90))
    write_scene(ply, scene, by_name(form))
    assert_shown_like(visit("/#/jobs"), tmp_path, ply, differs=True)


def test_filtered_flat_text_and_big_endian_scenes_are_shown(visit: Visit, tmp_path: Path) -> None:
    ply, _, _ = write_files(tmp_path, dust(), cameras(2, 120, 90))
    watched = visit("/#/jobs")
    with_filter(ply, dust(), torch.linspace(0, 0.02, len(dust())))
    assert_shown_like(watched, tmp_path, ply, differs=True)
    without_thickness(ply, dust())
    assert_shown_like(watched, tmp_path, ply, differs=False)
    write_scene(ply, dust())
    for form in ({"text": True}, {"byte_order": ">"}):
        PlyData(PlyData.read(ply, mmap=False).elements, **form).write(ply)
        assert_shown_like(watched, tmp_path, ply, differs=False)


def test_glb_of_several_sets_and_spz_without_gzip_are_shown(visit: Visit, tmp_path: Path) -> None:
    ply, _, _ = write_files(tmp_path, dust(), cameras(2, 120, 90))
    watched = visit("/#/jobs")
    write_scene(ply, replace(dust(), rendering=Rendering("antialiased")), by_name("v3.spz"))
    ply.write_bytes(gzip.decompress(ply.read_bytes()))
    assert_shown_like(watched, tmp_path, ply, differs=True)
    write_scene(ply, replace(dust(), rendering=Rendering("antialiased")), by_name("glb"))
    ply.write_bytes(with_two_sets(ply.read_bytes()))
    assert len(read_scene(ply).scene) == 616
    assert_shown_like(watched, tmp_path, ply, differs=True)


def test_finest_level_of_a_streamed_sog_is_shown(visit: Visit, tmp_path: Path) -> None:
    ply, _, _ = write_files(tmp_path, dust(), cameras(2, 120, 90))
    near, far = (dust().subset(torch.arange(start, 616, 2)) for start in (0, 1))
    far = replace(far, sh_rest=torch.zeros((len(far), 0, 3)))
    archived(ply, streamed([[near], [near.subset(torch.arange(20))]], far), "scene/")
    assert len(read_scene(ply).scene) == 616
    assert_shown_like(visit("/#/jobs"), tmp_path, ply, differs=False)


def test_quantized_moved_and_rotated_glb_is_shown(visit: Visit, tmp_path: Path) -> None:
    scene = replace(dust(), sh_rest=torch.randn(616, 15, 3, generator=torch.Generator().manual_seed(3)))
    ply, _, _ = write_files(tmp_path, scene, cameras(2, 120, 90))
    watched = visit("/#/jobs")
    tipped = {"rotation": [0.1**0.5, 0, 0, 0.9**0.5], "translation": [0, 1.8, 0.6]}  # by 37 degrees, in place
    matrix = {"matrix": [0, 1, 0, 0, -0.8, 0, 0.6, 0, 0.6, 0, 0.8, 0, -1.8, 0, 0.6, 1]}
    poses: list[tuple[dict[str, Any], dict[str, Any]]]
    poses = [({}, {}), (tipped, {"rotation": [0, 0, 0.6, 0.8]}), (matrix, {})]
    for inner, outer in poses:
        write_scene(ply, scene, by_name("glb"))
        ply.write_bytes(quantized(ply.read_bytes(), inner, outer))
        assert len(read_scene(ply).scene) == 616
        assert_shown_like(watched, tmp_path, ply, differs=False)


def quantized(data: bytes, inner: dict[str, Any], outer: dict[str, Any]) -> bytes:
    """Return a GLB with normalized positions of 16 bits, in a node below others; two of them move and scale them."""
    size = struct.unpack_from("<I", data, 12)[0]
    document, binary = json.loads(data[20 : 20 + size]), bytearray(data[20 + size + 8 :])
    (primitive,) = document["meshes"][0]["primitives"]
    entry = document["accessors"][primitive["attributes"]["POSITION"]]
    view = document["bufferViews"][entry["bufferView"]]
    start, stride = view.get("byteOffset", 0) + entry.get("byteOffset", 0), view.get("byteStride", 12)
    rows = [struct.unpack_from("<3f", binary, start + i * stride) for i in range(entry["count"])]
    for i, row in enumerate(rows):
        struct.pack_into("<3h", binary, start + i * stride, *(round(32767 * (value - 0.5) / 8) for value in row))
    entry |= {"componentType": 5122, "normalized": True}
    for name in ("min", "max"):
        entry.pop(name, None)
    view["byteStride"] = stride
    scales = document["accessors"][primitive["attributes"]["KHR_gaussian_splatting:SCALE"]]
    place = document["bufferViews"][scales["bufferView"]]
    start, stride = place.get("byteOffset", 0) + scales.get("byteOffset", 0), place.get("byteStride", 12)
    for i in range(entry["count"]):
        values = struct.unpack_from("<3f", binary, start + i * stride)
        struct.pack_into("<3f", binary, start + i * stride, *(value / 8 for value in values))
    mesh = {"mesh": 0, "scale": [4, 4, 4], "translation": [0, 0, 0.25]}
    document["nodes"] = [
        {"children": [1], "scale": [2, 2, 2], "translation": [0.5, 0.5, 0]},
        mesh,
        {"children": [0]} | inner,
        {"children": [2]} | outer,
    ]
    document["scenes"] = [{"nodes": [3]}]
    return as_glb(document, bytes(binary))


def as_glb(document: dict[str, Any], binary: bytes) -> bytes:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIIII", b"glTF", 2, 28 + len(text) + len(binary), len(text), 0x4E4F534A)
    return head + text + struct.pack("<II", len(binary), 0x004E4942) + binary


def with_two_sets(data: bytes) -> bytes:
    """Return a GLB of one set of Gaussians as one of two sets: the first 300, and the others."""
    size = struct.unpack_from("<I", data, 12)[0]
    document, binary = json.loads(data[20 : 20 + size]), data[20 + size :]
    accessors = document["accessors"]
    widths = {"SCALAR": 4, "VEC3": 12, "VEC4": 16}
    second = [
        entry | {"count": 316, "byteOffset": 300 * (4 if entry["componentType"] == 5121 else widths[entry["type"]])}
        for entry in accessors
    ]
    (primitive,) = document["meshes"][0]["primitives"]
    other = primitive | {"attributes": {name: len(second) + at for name, at in primitive["attributes"].items()}}
    document["accessors"] = [entry | {"count": 300} for entry in accessors] + second
    document["meshes"] = [{"primitives": [primitive]}, {"primitives": [other]}]
    document["nodes"] = [{"mesh": 0}, {"mesh": 1}]
    document["scenes"] = [{"nodes": [0, 1]}]
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(binary), len(text), 0x4E4F534A)
    return head + text + binary


def test_flag_that_spark_sets_is_ignored(visit: Visit, tmp_path: Path) -> None:
    ply, _, _ = write_files(tmp_path, dust(), cameras(2, 120, 90))
    scene = dust()
    scene = replace(scene, means=scene.means / 256, rendering=Rendering("antialiased"))
    write_scene(ply, scene, by_name("v3.spz"))  # with 20 fractional bits; Spark writes 12
    data = bytearray(gzip.decompress(ply.read_bytes()))
    data[13] = 12
    ply.write_bytes(gzip.compress(bytes(data)))
    assert_shown_like(visit("/#/jobs"), tmp_path, ply, differs=False)


def dust() -> Scene:
    """Return a scene of many Gaussians smaller than a pixel."""
    return replace(wall(sh_degree=1), scales=torch.tensor([0.02, 0.012, 0.01]).log().repeat(616, 1))


def assert_shown_like(watched: Watched, folder: Path, scene: Path, *, differs: bool) -> None:
    """Assert that the page shows a scene like `sgsst render`, and whether a classic render differs clearly."""
    camera = cameras(2, 120, 90)[0]
    pixels = decoded(shown(watched, folder, camera.name, (camera.width, camera.height)))
    assert psnr(pixels, rendered(scene, camera)) >= FAITHFUL
    classic = read_scene(scene).rendered("classic", None).scene
    image = make_rasterizer("cpu", classic).render(scene_colors(classic, camera), camera)
    expected = np.rint(image.clamp(0, 1).double().numpy() * 255)
    assert (psnr(pixels, expected) < 35) == differs


@pytest.mark.parametrize("stated", [False, True])
@pytest.mark.parametrize("version", [1, 2])
def test_old_spz_is_shown(visit: Visit, tmp_path: Path, version: int, stated: bool) -> None:
    scene = wall()
    ply, _, _ = write_files(tmp_path, scene)
    ply.write_bytes(old_spz(scene, version, stated))
    watched, camera = visit("/#/jobs"), cameras()[0]
    pixels = decoded(shown(watched, tmp_path, camera.name, (camera.width, camera.height)))
    assert psnr(pixels, rendered(ply, camera)) >= FAITHFUL


def old_spz(scene: Scene, version: int, rub: bool) -> bytes:
    """Encode a scene as SPZ of version 1 or 2, without spherical harmonics; `rub` is the default, and not stated."""
    flip = np.array([1, -1, -1] if rub else [1, 1, 1])
    means = scene.means.double().numpy() * flip
    fixed = np.rint(means * 2**12).astype("<i4")
    position = (
        means.astype("<f2").tobytes() if version == 1 else fixed.view(np.uint8).reshape(-1, 3, 4)[..., :3].tobytes()
    )
    quats = (scene.quats / scene.quats.norm(dim=1, keepdim=True)).double().numpy()
    vectors = quats[:, 1:] * np.where(quats[:, :1] < 0, -1, 1) * flip
    parts = [
        scene.opacities.sigmoid().numpy() * 255,
        (scene.sh_dc.numpy() * 0.15 + 0.5) * 255,
        (scene.scales.numpy() + 10) * 16,
        (vectors + 1) * 127.5,
    ]
    packed = [np.clip(np.rint(part), 0, 255).astype(np.uint8).tobytes() for part in parts]
    head = struct.pack("<4sIIBBBB", b"NGSP", version, len(scene), 0, 12, 2 * (not rub), 0)
    extension = b"" if rub else struct.pack("<III", 0xADBE0003, 4, 6)
    return gzip.compress(b"".join([head, position, *packed, extension]))


def test_less_memory_shows_fewer_harmonics_and_says_so(visit: Visit, tmp_path: Path) -> None:
    write_files(tmp_path, wall(sh_degree=3))
    watched = visit("/#/jobs")
    steps = """async (viewer, source, picture, base) => {
      const { SplatScene } = await import(`${base}/viewer/splat_scene.js`);
      const tight = new SplatScene(viewer.gl, new URL("/given/scene.ply", location.href).href, () => {}, 616 * 80);
      await tight.ready;
      const found = [source.degree, tight.header.degree, tight.degree];
      tight.end();
      return found;
    }"""
    assert shown(watched, tmp_path, "view_1", (64, 48), steps) == [3, 3, 1]


def test_frames_that_take_long_are_followed_by_rest(visit: Visit, tmp_path: Path) -> None:
    write_files(tmp_path, wall(sh_degree=1))
    steps = """async (viewer, source, picture) => {
      await picture();
      return [1e9, 0].map((took) => (viewer.milliseconds.push(took), viewer.crowded()));
    }"""
    assert shown(visit("/#/jobs"), tmp_path, "view_1", (64, 48), steps) == [True, False]


def test_wipe_is_exact_to_the_pixel(visit: Visit, tmp_path: Path) -> None:
    write_files(tmp_path, wall(sh_degree=1), cameras(1, 200, 150))
    halves = struct.pack("<1848e", *np.linspace(-2, 2, 1848))
    (tmp_path / "colors.f16").write_bytes(halves)
    steps = """async (viewer, source, picture) => {
      await source.addColors("other", (await fetch("/given/colors.f16")).body);
      viewer.show({ scene: source, colors: "own" }, { scene: source, colors: "other" });
      const found = [];
      for (const cut of [0, 0.333, 1]) { viewer.wipe(cut); found.push(await picture()); }
      return found;
    }"""
    after, half, before = map(decoded, shown(visit("/#/jobs"), tmp_path, "view_0", (200, 150), steps))
    edge = round(0.333 * 200)
    assert np.array_equal(half[:, :edge], before[:, :edge])
    assert np.array_equal(half[:, edge:], after[:, edge:])
    assert np.abs(before - after).mean() > 20


def test_order_is_right_from_every_side(visit: Visit, tmp_path: Path) -> None:
    """The order is compared with a sort of float64 depths: Gaussians may only be swapped within float32 precision."""
    write_files(tmp_path, wall())
    steps = """async (viewer, source, picture, base) => {
      const { depthOrder } = await import(`${base}/viewer/depth_order.js`);
      const count = 20000, centers = new Float32Array(count * 3), reach = new Float32Array(count).fill(0.01);
      let seed = 7;
      for (let i = 0; i < centers.length; i++) {
        seed = (Math.imul(seed, 1103515245) + 12345) >>> 0;
        centers[i] = (seed / 2 ** 32 - 0.5) * (i % 97 ? 4 : 400);
      }
      const worst = [];
      for (let turn = 0; turn < 12; turn++) {
        const c = Math.cos(turn), s = Math.sin(turn);
        const axes = [[c, 0, -s], [0, 1, 0], [s, 0, c]], eye = [-5 * s, 0, -5 * c];
        const order = depthOrder(centers, reach, count, { axes, eye, tan: [1e6, 1e6], near: 0.2 });
        const depth = (i) => axes[2].reduce((sum, part, k) => sum + part * (centers[3 * i + k] - eye[k]), 0);
        let expected = 0, back = 0;
        for (let i = 0; i < count; i++) expected += depth(i) >= 0.2;
        for (let k = 1; k < order.length; k++) {
          back = Math.max(back, (depth(order[k]) - depth(order[k - 1])) / depth(order[k]));
        }
        worst.push([expected - order.length, new Set(order).size - order.length, back]);
      }
      return worst;
    }"""
    for left_out, twice, back in shown(visit("/#/jobs"), tmp_path, "view_1", (64, 48), steps):
        assert abs(left_out) <= 1  # one may lie on the near plane within rounding
        assert twice == 0
        assert back < 1e-5


def test_flight_between_viewpoints_leads_around_the_scene(visit: Visit, tmp_path: Path) -> None:
    """The viewpoints lie opposite of each other, and then a quarter of a turn apart, with another zoom."""
    write_files(tmp_path, wall())
    steps = """async (viewer, source, picture, base) => {
      const { Motion } = await import(`${base}/viewer/controls.js`), { camera } = viewer, { center } = source.middle;
      const motion = new Motion(viewer), from = (turn, fx) => {
        const s = Math.sin(turn), c = Math.cos(turn);
        const position = [center[0] - 3 * s, center[1], center[2] - 3 * c], axes = [[c, 0, -s], [0, 1, 0], [s, 0, c]];
        return { name: "", position, axes, fx, fy: fx, width: 3, height: 2 };
      };
      const away = () => Math.hypot(...camera.eye.map((value, i) => value - center[i])), distances = [];
      const viewpoints = [from(0, 2), from(Math.PI, 2), from(Math.PI / 2, 4)], reached = [];
      camera.stand(viewpoints[0], source.middle);
      motion.flyTo(viewpoints.slice(1), 1500);
      for (let i = 1; i <= 60; i++) {
        motion.advance(50);
        distances.push(away());
        if (i % 30 === 0) reached.push([camera.eye, camera.axes, camera.focal[0]]);
      }
      const wanted = viewpoints.slice(1).map(({ position, axes, fx }) => [position, axes, fx / 2]);
      return [distances, reached, wanted, motion.flight];
    }"""
    distances, reached, wanted, flight = shown(visit("/#/jobs"), tmp_path, "view_1", (64, 48), steps)
    assert np.allclose(distances, 3, atol=1e-9)
    assert reached == wanted
    assert flight is None


def test_lost_graphics_device_comes_back(visit: Visit, tmp_path: Path) -> None:
    write_files(tmp_path, wall(sh_degree=1))
    steps = """async (viewer, source, picture) => {
      const before = await picture(), device = viewer.gl.getExtension("WEBGL_lose_context");
      viewer.onReload = () => {
        const again = viewer.open(source.source);
        viewer.show({ scene: again, colors: "own" });
      };
      device.loseContext();
      while (!viewer.lost) await new Promise((go) => setTimeout(go, 20));
      device.restoreContext();
      const there = () => !viewer.lost && viewer.sides && viewer.sides.left.scene.whole;
      while (!there()) await new Promise((go) => setTimeout(go, 20));
      return [before, await picture()];
    }"""
    watched = visit("/#/jobs", allowed=["WebGL"])
    before, after = map(decoded, shown(watched, tmp_path, "view_1", (128, 96), steps))
    assert np.array_equal(before, after)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"no scene at all", "Not a scene file"),
        (b"ply" + bytes(70_000), "Not a PLY file."),
        (b"NGSP" + bytes(60), "This SPZ version"),
        (b"NGSP\4\0\0\0" + b"\1\0\0\0" + bytes(60), "Couldn't read the scene."),
        (gzip.compress(b"no scene, but text that somebody has packed"), "Not a scene file"),
        (b"ply\nformat binary 1.0\nelement vertex 1\nproperty float x\nend_header\n1234", "Not a PLY file."),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n", "no 3D Gaussians"),
        (
            b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nend_header\n1234",
            "no 3D Gaussians",
        ),
    ],
)
def test_files_that_cannot_be_shown(visit: Visit, tmp_path: Path, content: bytes, said: str) -> None:
    watched = visit()
    file = tmp_path / "scene.ply"
    file.write_bytes(content)
    watched.page.get_by_label("Scene", exact=True).set_input_files(file)
    watched.page.locator(".frame .note").filter(has_text=said).wait_for()


@pytest.mark.parametrize(("form", "front"), [("sog", "red"), ("ply", "blue")])
def test_scene_is_first_seen_from_its_front(visit: Visit, tmp_path: Path, form: str, front: str) -> None:
    halves = [replace(wall(), means=wall().means * torch.tensor([1, 1, 0]) + torch.tensor([0, 0, z])) for z in (-1, 1)]
    colors = [wall().sh_dc.new_tensor(color).expand(616, 3) for color in ([-1.7, -1.7, 1.7], [1.7, -1.7, -1.7])]
    scene = joined(*(replace(half, sh_dc=color) for half, color in zip(halves, colors, strict=True)))
    ply, _, _ = write_files(tmp_path)
    write_scene(ply, scene, by_name(form))
    steps = "(viewer, source, picture) => { viewer.frame([0, -1, 0]); viewer.draw(); return picture(); }"
    image = decoded(shown(visit("/#/jobs"), tmp_path, "view_0", (64, 48), steps))
    middle = image[image.shape[0] // 2, image.shape[1] // 2]
    assert ("red", "green", "blue")[int(middle.argmax())] == front


def test_camera_follows_keys_and_double_clicks(visit: Visit, tmp_path: Path) -> None:
    """A scene without cameras is orbited, keys move while they are held, and a double click turns to what is there."""
    scene = dust()
    side = torch.where(torch.arange(len(scene)) % 2 == 0, -1.0, 1.0)
    means = scene.means * 0.15
    means[:, 0] += side
    red = torch.tensor([1.7, -1.7, -1.7])
    colors = torch.where(side[:, None] > 0, red, red.flip(0))
    ply, _, _ = write_files(tmp_path, replace(scene, means=means, sh_dc=colors), cameras(2, 120, 90))
    watched = visit("/#/", reduced_motion="reduce")
    page = watched.page
    page.get_by_label("Scene", exact=True).set_input_files(ply)
    page.get_by_text("No cameras were given, so the views orbit the object.").wait_for()
    assert page.get_by_label("Orbit the object").is_checked()
    page.get_by_role("button", name="Show cameras").click()  # hides them
    view = page.locator("canvas.view")
    view.scroll_into_view_if_needed()
    across, image = place_of_red(watched)
    assert abs(across - 0.5) > 0.1
    box = view.bounding_box()
    page.mouse.dblclick(box["x"] + across * box["width"], box["y"] + box["height"] / 2)
    middle, turned = place_of_red(watched)
    assert abs(middle - 0.5) < 0.05
    view.focus()
    page.keyboard.down("d")
    page.evaluate(HALF_A_SECOND)
    page.keyboard.up("d")
    moved, _ = place_of_red(watched)
    assert moved < middle - 0.02, "the camera has moved to the right"
    view.focus()
    page.keyboard.press("Home")
    assert np.abs(watched.pixels() - image).mean() < 1
    assert np.abs(turned - image).mean() > 1


def place_of_red(watched: Watched) -> tuple[float, Any]:
    """Return where the view is red, as a fraction of its width, and the view's image."""
    image = watched.pixels()
    weights = (image[..., 0] - image[..., 2]).clip(0).sum(axis=0)
    assert weights.sum() > 0
    return float((weights * np.arange(len(weights))).sum() / weights.sum() / len(weights)), image


IWER = "iwer@2.5.0"
#: Emulated headset, with a function that changes its state and waits for some frames.
DEVICE = """
window.device = new IWER.XRDevice(IWER.metaQuest3, { stereoEnabled: true });
device.ipd = 0.08;
device.installRuntime({ forceInstall: true });
window.after = async (change, frames) => {
  change(device.controllers.left, device.controllers.right);
  for (let i = 0; i < frames; i++) await new Promise((go) => device.activeSession.requestAnimationFrame(go));
};
"""


@pytest.fixture(scope="module")
def emulator() -> Path:
    """Return the script of the emulator."""
    folder = Path(sys.prefix) / "iwer"
    script = folder / "node_modules" / "iwer" / "build" / "iwer.js"
    if not script.exists():
        npm = shutil.which("npm")
        if npm is None:
            pytest.skip("npm is missing: apt-get install npm")
        command = [npm, "install", "--silent", "--no-save", "--prefix", str(folder), IWER]
        with contextlib.suppress(subprocess.TimeoutExpired):
            subprocess.run(command, check=False, timeout=120)
        if not script.exists():
            pytest.skip(f"npm could not install {IWER}")
    return script


class Worn:
    """Exported page in a headset, whose stylized scene is red and whose original is blue."""

    def __init__(self, watched: Watched) -> None:
        self.page = watched.page

    def after(self, change: str, frames: int = 8) -> NDArray[np.float64]:
        """Change the controllers `left` and `right` by JavaScript; return the display some frames later, [h, w, 3]."""
        self.page.evaluate(f"after((left, right) => {{ {change} }}, {frames})")
        with Image.open(io.BytesIO(self.page.screenshot(timeout=PATIENCE))) as image:
            return np.asarray(image.convert("RGB"), dtype=np.float64)


@pytest.fixture
def worn(tmp_path: Path, browser: Any, emulator: Path) -> Iterator[Worn]:
    assert export(tmp_path, painted(0.9, 0.1, 0.1), painted(0.1, 0.1, 0.9)) == 0
    watched = Watched(browser, (tmp_path / "page.html").as_uri())
    watched.page.add_init_script(path=emulator)
    watched.page.add_init_script(DEVICE)
    watched.page.goto(watched.url)
    watched.settled()
    watched.page.get_by_role("button", name="VR").click()
    yield Worn(watched)
    watched.check()
    watched.context.close()


def area(image: NDArray[np.float64], channel: int) -> NDArray[np.bool_]:
    """Return where red (0) or blue (2) Gaussians are."""
    mask: NDArray[np.bool_] = (image[..., channel] > 100) & (image[..., 2 - channel] < 80)
    return mask


def middle(mask: NDArray[np.bool_]) -> float:
    """Return the mean column of a mask."""
    return float(np.nonzero(mask)[1].mean())


def test_each_eye_sees_the_scene_from_its_place(worn: Worn) -> None:
    red = area(worn.after(""), 0)
    left, right = np.array_split(red, 2, axis=1)
    assert left.mean() > 0.01
    assert middle(left) > middle(right) + 1
    worn.page.evaluate("device.activeSession.end()")
    worn.page.locator("canvas[data-state=settled]").wait_for()
    assert worn.page.get_by_role("button", name="VR").get_attribute("aria-pressed") == "false"


def test_button_shows_the_original_and_stick_blends(worn: Worn) -> None:
    assert area(worn.after("right.updateButtonValue('a-button', 1)"), 2).mean() > 0.01
    assert area(worn.after("right.updateButtonValue('a-button', 0)"), 0).mean() > 0.01
    assert area(worn.after("right.updateAxes('thumbstick', 0, 1)", 120), 2).mean() > 0.01


def test_two_hands_change_the_size_of_the_scene(worn: Worn) -> None:
    apart = "left.position.set(-0.2, 1.2, -0.4); right.position.set(0.2, 1.2, -0.4)"
    before = area(worn.after(apart), 0).mean()
    worn.after("for (const hand of [left, right]) hand.updateButtonValue('squeeze', 1)")
    shrunk = area(worn.after("left.position.set(-0.1, 1.2, -0.4); right.position.set(0.1, 1.2, -0.4)"), 0).mean()
    assert shrunk < 0.75 * before  # it shrinks toward the hands, and so comes nearer
    worn.after("for (const hand of [left, right]) hand.updateButtonValue('squeeze', 0)")
    assert area(worn.after(apart), 0).mean() == pytest.approx(shrunk, rel=0.1)


def test_trigger_teleports_to_the_floor(worn: Worn) -> None:
    before = area(worn.after("right.position.set(0, 1.2, 0); right.quaternion.set(-0.5, 0, 0, 0.866)"), 0).mean()
    worn.after("right.updateButtonValue('trigger', 1)")
    assert area(worn.after("right.updateButtonValue('trigger', 0)"), 0).mean() > 1.3 * before

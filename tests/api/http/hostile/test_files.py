"""Tests of hostile files: the API responds with a problem document, and keeps no files or memory afterwards."""

import asyncio
import gzip
import io
import json
import re
import struct
import sys
import zipfile
import zlib
from pathlib import Path
from types import FrameType
from typing import Any

import httpx2
import pytest
from backports import zstd
from PIL import Image, ImageCms, PngImagePlugin

from api.http.app import create_app
from service.settings import ServiceSettings
from service.store import Store
from sgsst_core.files.formats import FORMATS
from sgsst_core.files.formats.ply import PLY
from sgsst_core.files.formats.sog import STREAMED_SOG
from tests.api.http.sending import (
    MB,
    NAMES,
    Files,
    Make,
    begin,
    count_jobs,
    form,
    image_bytes,
    refused,
    send,
)
from tests.api.service import Service
from tests.icc_profiles import with_float_steps
from tests.pngs import chunk, png


def header(scene: bytes, old: str, new: str | bytes) -> bytes:
    """Return the scene file with one replacement in its header."""
    end = scene.index(b"end_header") + len(b"end_header")
    assert old.encode() in scene[:end]
    return scene[:end].replace(old.encode(), new.encode() if isinstance(new, str) else new, 1) + scene[end:]


VERTEX = "element vertex 616"


LIST = "element face 200\nproperty list uchar int vertex_indices\n"


def with_faces(scene: bytes, declared: str, data: bytes) -> bytes:
    return header(scene, "end_header", declared + "end_header") + data


def before_vertices(scene: bytes, declared: str, data: bytes) -> bytes:
    """Insert another PLY element before the Gaussians."""
    changed = header(scene, VERTEX, declared + VERTEX)
    start = changed.index(b"end_header\n") + len(b"end_header\n")
    return changed[:start] + data + changed[start:]


SCENES: list[tuple[str, Make]] = [
    ("count of a million digits", lambda f: header(f["scene"], VERTEX, "element vertex " + "9" * 1_000_000)),
    ("count 2^64", lambda f: header(f["scene"], VERTEX, f"element vertex {2**64}")),
    ("count 10^18 - 1", lambda f: header(f["scene"], VERTEX, "element vertex 999999999999999999")),
    ("no Gaussians", lambda f: header(f["scene"], VERTEX, "element vertex 0")),
    ("rows of no bytes", lambda f: header(f["scene"], "end_header", "element nothing 999999999999\nend_header")),
    ("positions as lists", lambda f: header(f["scene"], "property float y", "property list uchar float y")),
    ("binary data said to be text", lambda f: header(f["scene"], "binary_little_endian", "ascii")),
    ("a line without end", lambda f: b"ply\n" + b"x" * 3 * MB),
    (
        "50,000 elements",
        lambda f: (
            b"ply\nformat ascii 1.0\n" + b"".join(b"element e%d 0\n" % i for i in range(50_000)) + b"end_header\n"
        ),
    ),
    (
        "40,000 properties",
        lambda f: (
            b"ply\nformat ascii 1.0\nelement vertex 1\n"
            + b"".join(b"property char p%d\n" % i for i in range(40_000))
            + b"end_header\n"
            + b"1 " * 40_000
        ),
    ),
    (
        "list longer than the file",
        lambda f: before_vertices(
            f["scene"], "element face 1\nproperty list uint int v\n", struct.pack("<I", 2**32 - 1)
        ),
    ),
    ("lists that end early", lambda f: with_faces(f["scene"], LIST, b"\x01\0\0\0\0" * 150)),
    ("one byte short", lambda f: f["scene"][:-1]),
    ("gzip", lambda f: gzip.compress(f["scene"])),
    ("zip", lambda f: zipped("scene.ply", f["scene"])),
    ("text with one endless number", lambda f: text_scene(f["scene"], "1" * MB)),
    ("compressed, more Gaussians than bytes", lambda f: header(f["compressed.ply"], VERTEX, "element vertex 700")),
    ("SPZ of 4 billion Gaussians", lambda f: spz(2**32 - 1, b"")),
    ("SPZ of 5,001 Gaussians", lambda f: spz(5001, bytes(5001 * 20))),
    ("SPZ, fewer than it says", lambda f: spz(4000, bytes(3999 * 20))),
    ("SPZ, a gigabyte behind it", lambda f: spz_bomb()),
    ("SPZ 4, streams beyond the file", lambda f: spz_4(2**63)),
    ("SPZ 4 of a billion Gaussians in 100 bytes", lambda f: spz_4(20, 10**9) + bytes(100)),
    ("SPZ 4, a gigabyte in a stream", lambda f: spz_4_bomb()),
    ("splat, one byte more", lambda f: f["splat"] + b"x"),
    ("SOG, files of another folder", lambda f: f["sog"].replace(b"quats.webp", b"../../a.sh")),
    ("SOG, a gigabyte in an image", lambda f: zipped("meta.json", bytes(1 << 30))),
    ("GLB of 4 billion Gaussians", lambda f: f["glb"].replace(b'"count": 616', b'"count": 4294967295')),
    (
        "GLB with data in another file",
        lambda f: f["glb"].replace(b'"byteLength"', b'"uri": "/etc/passwd", "byteLength"'),
    ),
    ("GLB with deep JSON", lambda f: glb(b"[" * 500_000)),
    ("ksplat of 4 billion Gaussians", lambda f: ksplat_with(f["ksplat"], 16, 2**32 - 1)),
    ("ksplat of 4 billion buckets", lambda f: ksplat_with(f["ksplat"], 4096 + 12, 2**32 - 1)),
    ("a checkpoint", lambda f: zipped("archive/data.pkl", b"cos\nsystem\n(S'true'\ntR.")),
]


def spz(count: int, data: bytes, *, version: int = 3, degree: int = 0) -> bytes:
    return gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", version, count, degree, 12, 0, 0) + data)


def spz_bomb() -> bytes:
    """Return an SPZ of one Gaussian, followed by a gigabyte of zeros."""
    deflate = zlib.compressobj(1, wbits=31)
    data = deflate.compress(struct.pack("<4sIIBBBB", b"NGSP", 3, 1, 0, 12, 0, 0) + bytes(20))
    for _ in range(64):
        data += deflate.compress(bytes(16 * MB))
    return data + deflate.flush()


def spz_4(size: int, count: int = 1) -> bytes:
    """Return the header of an SPZ 4 file and the table of its streams, which take `size` bytes each."""
    head = b"NGSP" + struct.pack("<IIBBBBI", 4, count, 0, 12, 0, 5, 32) + bytes(12)
    return head + b"".join(struct.pack("<QQ", size, count * each) for each in (9, 1, 3, 3, 4))


def spz_4_bomb() -> bytes:
    """Return an SPZ 4 file of one Gaussian, whose positions are a gigabyte of zeros."""
    stream = zstd.compress(bytes(1 << 30))
    return spz_4(len(stream)) + 5 * stream


def ksplat_with(scene: bytes, place: int, *values: int) -> bytes:
    """Return a .ksplat file with other numbers from a byte offset on."""
    new = struct.pack(f"<{len(values)}I", *values)
    return scene[:place] + new + scene[place + len(new) :]


def glb(document: bytes) -> bytes:
    return struct.pack("<4sIII4s", b"glTF", 2, 20 + len(document), len(document), b"JSON") + document


def zipped(name: str, data: bytes) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr(name, data)
    return file.getvalue()


def text_scene(scene: bytes, first: str) -> bytes:
    """Return an ASCII PLY with the header of `scene`, whose first row starts with the word `first`."""
    head = header(scene, "binary_little_endian", "ascii")
    head = head[: head.index(b"end_header\n") + 11]
    values = head.count(b"property")
    return head + f"{first} {'0 ' * (values - 1)}\n".encode() + f"{'0 ' * values}\n".encode() * 615


@pytest.mark.parametrize("make", [case[1] for case in SCENES], ids=[case[0] for case in SCENES])
def test_false_scene_headers_are_rejected(
    client: httpx2.Client, store: Store, files: Files, packed: Files, make: Make
) -> None:
    before = count_jobs(store)
    answer = client.post("/v1/jobs", files=form(files, scene=make({**files, **packed})))
    problem = refused(answer, 422, "invalid-scene", "too-many-gaussians", "inspection-limit")
    if problem["code"] != "inspection-limit":
        assert problem["input"] == "scene"
    assert count_jobs(store) == before


def test_api_process_leaves_reading_to_the_confined_one(tmp_path: Path, files: Files, packed: Files) -> None:
    """Headers alone may take seconds and gigabytes; a scene without a style is refused before any other process."""
    reading: list[object] = []

    def hook(event: str, arguments: tuple[object, ...]) -> None:
        if event == "open" and str(arguments[0]).startswith(str(tmp_path)):
            frame: FrameType | None = sys._getframe()
            while frame := frame and frame.f_back:
                module = frame.f_globals.get("__name__", "")
                if module.startswith("sgsst_core.files") and module != "sgsst_core.files.atomic":
                    reading.append(arguments[0])

    async def submit(scene: bytes) -> int:
        app = create_app(ServiceSettings(data=tmp_path, min_free_bytes=0))
        async with app.router.lifespan_context(app):
            transport = httpx2.ASGITransport(app)
            async with httpx2.AsyncClient(transport=transport, base_url="http://127.0.0.1") as client:
                return (await client.post("/v1/jobs", files={"scene": scene})).status_code

    sys.addaudithook(hook)
    assert [asyncio.run(submit(scene)) for scene in (files["scene"], packed[STREAMED_SOG.name])] == [422, 422]
    assert not reading


@pytest.mark.parametrize("what", [format.name for format in FORMATS if format is not PLY])
def test_compressed_scenes_are_detected_from_their_content(
    client: httpx2.Client, files: Files, packed: Files, what: str
) -> None:
    """The format is detected regardless of the file name, for files in the request and for tus uploads."""
    answer = client.post("/v1/jobs", files=form(files, scene=("my scan.ply", packed[what])))
    assert answer.status_code == 202, answer.text
    where = begin(client, len(packed[what]))
    assert send(client, where, 0, packed[what]).status_code == 204
    parts = [("scene", (None, where.rpartition("/")[2])), *form(files, scene=None)]
    answer = client.post("/v1/jobs", files=parts)
    assert answer.status_code == 202, answer.text
    inputs = client.get(answer.headers["location"]).json()["inputs"]
    assert [entry["size"] for entry in inputs if entry["role"] == "scene"] == [len(packed[what])]


def zeros(size: int) -> bytes:
    """Return `size` zero bytes compressed with deflate, without allocating all of them."""
    packer = zlib.compressobj(9)
    parts = [packer.compress(bytes(MB)) for _ in range(size // MB)]
    return b"".join(parts) + packer.compress(bytes(size % MB)) + packer.flush()


def jpeg(width: int, height: int) -> bytes:
    """Return a small JPEG whose header declares this larger size."""
    file = io.BytesIO()
    Image.new("RGB", (16, 16)).save(file, "JPEG")
    data = file.getvalue()
    at = data.index(b"\xff\xc0") + 5
    return data[:at] + struct.pack(">HH", height, width) + data[at + 4 :]


def jpeg_of_scans(count: int) -> bytes:
    """Return a progressive JPEG of 20 megapixels whose last scan is repeated `count` times."""
    file = io.BytesIO()
    Image.new("L", (5000, 4000), 128).save(file, "JPEG", progressive=True)
    data = file.getvalue()
    return data[:-2] + data[data.rindex(b"\xff\xda") : -2] * count + data[-2:]


def text_bomb() -> bytes:
    """Return a small PNG with compressed XMP data that expand to 200 MB."""
    xmp = chunk(b"iTXt", b"XML:com.adobe.xmp\0\1\0\0\0" + zeros(200 * MB))
    return png(16, 16, xmp, chunk(b"IDAT", zeros(49 * 16)))


def tagged() -> bytes:
    """Return a PNG whose EXIF data contain an offset beyond their end."""
    file = io.BytesIO()
    info = PngImagePlugin.PngInfo()
    info.add(b"eXIf", b"MM\0*\0\0\0\x08\xff\xff" + b"\x01\x12\0\x03\xff\xff\xff\xff\xff\xff\xff\xf0" * 4)
    Image.new("RGB", (64, 48)).save(file, "PNG", pnginfo=info)
    return file.getvalue()[:-30]


IMAGES: list[tuple[str, Make]] = [
    ("PNG bomb", lambda f: png(6000, 6000, chunk(b"IDAT", zeros(18_001 * 6000)))),
    ("PNG of more pixels than Pillow takes", lambda f: png(100_000, 100_000, chunk(b"IDAT", zeros(MB)))),
    ("PNG with much text", lambda f: text_bomb()),
    ("PNG of no width", lambda f: png(0, 100, chunk(b"IDAT", zeros(100)))),
    ("PNG without pixels", lambda f: png(64, 48)),
    ("PNG with a wrong check sum", lambda f: f["style"][:40] + b"\0\0\0\0" + f["style"][44:]),
    ("PNG with broken EXIF", lambda f: tagged()),
    ("JPEG bomb", lambda f: jpeg(65_500, 65_500)),
    ("JPEG of no height", lambda f: jpeg(100, 0)),
    ("JPEG truncated", lambda f: image_bytes("JPEG", 500, 500)[:-900]),
    (
        "GIF bomb",
        lambda f: image_bytes("GIF", 8, 8)[:6] + struct.pack("<HH", 65_535, 65_535) + image_bytes("GIF", 8, 8)[10:],
    ),
    (
        "TIFF bomb",
        lambda f: image_bytes("TIFF", 8, 8).replace(
            struct.pack("<HHII", 256, 4, 1, 8), struct.pack("<HHII", 256, 4, 1, 2**31)
        )[:200],
    ),
    ("JPEG of 400 scans", lambda f: jpeg_of_scans(400)),
    ("PPM of endless comments", lambda f: b"P3 10 10 255\n" + b"#\n" * 2 * MB + b"1 " * 300),
    ("JPEG 2000", lambda f: image_bytes("JPEG2000", 64, 64)),
    ("WebP cut off", lambda f: image_bytes("WEBP", 64, 64)[:20]),
    (
        "PostScript",
        lambda f: b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 100 100\n%%EndComments\n(/etc/passwd) run\nshowpage\n",
    ),
    ("PDF", lambda f: b"%PDF-1.4\n1 0 obj<</Type/Catalog>>endobj\ntrailer<</Root 1 0 R>>"),
    ("gzip bomb", lambda f: gzip.compress(bytes(50 * MB))),
    ("gzip", lambda f: gzip.compress(f["style"])),
    ("HTML", lambda f: b"<!doctype html><script>alert(1)</script>"),
]


@pytest.mark.parametrize("make", [case[1] for case in IMAGES], ids=[case[0] for case in IMAGES])
def test_false_image_headers_are_rejected(client: httpx2.Client, store: Store, files: Files, make: Make) -> None:
    before = count_jobs(store)
    answer = client.post("/v1/jobs", files=form(files, style=make(files)))
    problem = refused(answer, 422, "invalid-image", "image-too-large", "inspection-limit")
    assert problem.get("input", "style") == "style"
    assert count_jobs(store) == before


def test_long_color_profile_is_fast(client: httpx2.Client, files: Files) -> None:
    file = io.BytesIO()
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    Image.open(io.BytesIO(files["style"])).save(file, "PNG", icc_profile=with_float_steps(srgb, 50_000))
    answer = client.post("/v1/jobs", files=form(files, style=file.getvalue()))
    assert answer.status_code == 202, answer.text


def changed_cameras(files: Files, **values: Any) -> bytes:
    entries = json.loads(files["cameras"])
    entries[1] |= values
    return json.dumps(entries).encode()


def transforms(**values: Any) -> bytes:
    frame = {"file_path": "a.png", "transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}
    return json.dumps({"fl_x": 64, "w": 64, "h": 48, "frames": [{**frame, **values}]}).encode()


CAMERAS: list[tuple[str, str, Make]] = [
    ("10^9 pixels wide", "cameras.json", lambda f: changed_cameras(f, width=10**9, height=10**9)),
    ("10^400 pixels wide", "cameras.json", lambda f: changed_cameras(f, width=10**400)),
    (
        "a number of 10,000 digits",
        "cameras.json",
        lambda f: f["cameras"].replace(b'"width": 64', b'"width": ' + b"6" * 10_000),
    ),
    ("infinite focal length", "cameras.json", lambda f: changed_cameras(f, fx=float("inf"))),
    ("rotation of objects", "cameras.json", lambda f: changed_cameras(f, rotation={"a": 1})),
    ("more than a thousand", "cameras.json", lambda f: json.dumps(json.loads(f["cameras"]) * 400).encode()),
    ("deep JSON", "cameras.json", lambda f: b'{"frames":' + b"[" * 500_000),
    ("half a surrogate", "cameras.json", lambda f: b'[{"img_name": "\\ud800"}]'),
    ("no UTF-8", "cameras.json", lambda f: b"\xff\xfe\xfd"),
    ("gzip", "cameras.json", lambda f: gzip.compress(f["cameras"])),
    ("COLMAP of 2^60 cameras", "cameras.bin", lambda f: struct.pack("<Q", 2**60) + bytes(100)),
    ("a name of another kind", "cameras.json.exe", lambda f: f["cameras"]),
]


@pytest.mark.parametrize(("name", "make"), [case[1:] for case in CAMERAS], ids=[case[0] for case in CAMERAS])
def test_false_camera_files_are_rejected(
    client: httpx2.Client, store: Store, files: Files, name: str, make: Make
) -> None:
    before = count_jobs(store)
    answer = client.post("/v1/jobs", files=form(files, cameras=(name, make(files))))
    problem = refused(answer, 422, "invalid-cameras", "too-many-views", "too-many-pixels", "inspection-limit")
    assert problem.get("input", "cameras") == "cameras"
    assert count_jobs(store) == before


MODEL: list[tuple[str, bytes]] = [
    ("cameras.bin", struct.pack("<QIiQQ4d", 1, 1, 1, 64, 48, 64, 64, 32, 24)),
    ("images.bin", struct.pack("<QI7dI", 1, 1, 1, 0, 0, 0, 0, 0, 4, 1) + b"a.png\0" + struct.pack("<Q", 0)),
]


@pytest.mark.parametrize("name", ["points3D.bin", "rigs.bin", "frames.bin"])
def test_false_colmap_models_are_rejected(client: httpx2.Client, files: Files, name: str) -> None:
    """Eight bytes declare 2^60 entries; nothing reads these files."""
    model = [*MODEL, (name, struct.pack("<Q", 2**60))]
    answer = client.post("/v1/jobs", files=[*form(files, cameras=None), *(("cameras", file) for file in model)])
    assert answer.status_code == 202 or answer.json()["detail"].startswith("None of the 1 cameras sees"), answer.text


@pytest.mark.parametrize(
    "photos", [[], [("photos", ("other.png", image_bytes("PNG", 64, 48)))]], ids=["none", "others"]
)
def test_camera_files_cannot_read_server_files(
    client: httpx2.Client, files: Files, tmp_path: Path, photos: list[tuple[str, tuple[str, bytes]]]
) -> None:
    """If a transforms.json lacks image sizes, the reader opens the image at any path that the file contains."""
    there = tmp_path / "secret.png"
    there.write_bytes(files["style"])
    answers = set()
    for path in (there, tmp_path / "nothing.png", Path("/etc/passwd"), Path("../../../../../../etc/passwd")):
        content = json.loads(transforms(file_path=str(path)))
        del content["w"], content["h"]
        body = [*form(files, cameras=("transforms.json", json.dumps(content).encode())), *photos]
        answer = client.post("/v1/jobs", files=body)
        problem = answer.json() if photos else refused(answer, 422, "invalid-cameras")  # names come with their paths
        assert (answer.status_code, problem["code"]) == (422, "invalid-cameras")
        answers.add(problem["detail"].replace(str(path), "PATH").replace(str(path).lstrip("/"), "PATH"))
    assert len(answers) == 1, f"answers tell what is on the machine: {answers}"


@pytest.mark.parametrize(
    "role", ["scene", *(pytest.param(role, marks=pytest.mark.slow) for role in ("style", "photos"))]
)
def test_file_names_cannot_escape_folder(client: httpx2.Client, service: Service, files: Files, role: str) -> None:
    def outside_blobs() -> set[Path]:
        places = {*service.stored(), *service.data.parent.iterdir()}
        return {path for path in places if "blobs" not in path.parts}

    before = outside_blobs()
    photos = [("photos", (f"view_{i}.png", image_bytes("PNG", 64, 48))) for i in range(3)] if role == "photos" else []
    for name in NAMES:
        encoded = name.encode().replace(b'"', b"%22").replace(b"\r", b"%0D").replace(b"\n", b"%0A")
        content = files.get(role, image_bytes("PNG", 64, 48))
        body = [*((r, c) for r, c in form(files) if r != role), *photos]
        request = client.build_request("POST", "/v1/jobs", files=[*body, (role, ("NAME", content))])
        data = request.read().replace(b'filename="NAME"', b'filename="' + encoded + b'"')
        answer = client.post("/v1/jobs", content=data, headers={"content-type": request.headers["content-type"]})
        if answer.status_code != 202:  # for example a name that no field can have; refusing it is valid too
            codes = ("malformed-body", "invalid-request", "unknown-upload", "invalid-image")
            refused(answer, 400 if answer.status_code == 400 else 422, *codes)
            continue
        for entry in answer.json()["inputs"]:
            shown = entry["name"]
            assert shown
            assert not shown.startswith(("/", "."))
            assert all(part not in ("", ".", "..") and not part.startswith(".") for part in shown.split("/"))
            assert "/" not in shown or entry["role"] == "photos"
            assert not re.search(r"[\x00-\x1f\x7f\\]", shown)
            assert all(len(part.encode()) <= 255 for part in shown.split("/"))
    assert {path.name for path in outside_blobs() - before} <= {"sgsst.db-wal", "sgsst.db-shm"}

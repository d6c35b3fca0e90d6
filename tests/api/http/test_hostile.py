"""Tests of hostile requests: the API responds with a problem document, and keeps no files or memory afterwards."""

from __future__ import annotations

import base64
import contextlib
import gzip
import io
import json
import re
import select
import socket
import struct
import time
import zipfile
import zlib
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlsplit

import httpx2
import psutil
import pytest
from annotated_types import Ge
from backports import zstd
from PIL import Image, ImageCms, PngImagePlugin

from api.cli.options import kind_of
from api.http.connection import MAX_HEAD_BYTES, MAX_HEADERS
from api.http.context import SESSION_COOKIE
from service.files.artifacts import Artifacts
from service.parameters import JobParameters
from service.problems import SHARE_ID, UPLOAD_ID
from service.settings import ServiceSettings
from service.store import Store, open_store
from service.store.jobs import NewJob
from service.store.tables import UploadRow
from sgsst_core.files.formats import EXTRA_FORMATS, FORMATS
from sgsst_core.files.formats.ply import PLY
from sgsst_core.files.scene_file import write_scene
from sgsst_core.options import declared
from tests.api.service import Service, check_documented, wait_for
from tests.icc_profiles import with_float_steps
from tests.sgsst_core.files.formats.samples import ksplat
from tests.small_scenes import wall, write_files

MB = 1_000_000
#: Maximum growth in bytes of the API process during one test, at its peak.
GROWTH = 48 * MB
#: Seconds after which the service under test gives up on a stalled body or head.
STILL = 2.0
#: Size in bytes of the largest result of the finished job.
LARGE = 16 * MB
TUS = {"Tus-Resumable": "1.0.0"}
OFFSET_STREAM = "application/offset+octet-stream"

Files = dict[str, bytes]
Make = Callable[[Files], bytes]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Files:
    ply, cameras, style = write_files(tmp_path_factory.mktemp("inputs"), wall())
    return {"scene": ply.read_bytes(), "cameras": cameras.read_bytes(), "style": style.read_bytes()}


@pytest.fixture(scope="module")
def packed(tmp_path_factory: pytest.TempPathFactory) -> Files:
    """Return the test scene as files in compressed formats."""
    folder, scene = tmp_path_factory.mktemp("packed"), wall()
    files: Files = {}
    for format in EXTRA_FORMATS:
        write_scene(folder / format.name, scene, format)
        files[format.name] = (folder / format.name).read_bytes()
    files["ksplat"] = ksplat(scene, level=1)
    color = bytes([200, 100, 50, 255, 255, 128, 128, 128])
    rows = [struct.pack("<6f", *mean, 0.16, 0.16, 0.01) + color for mean in scene.means.tolist()]
    return {**files, "splat": b"".join(rows)}


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory, files: Files) -> Iterator[Service]:
    limits = {
        "SGSST_MAX_REQUEST_BYTES": str(100 * MB),
        "SGSST_MAX_UPLOAD_BYTES": str(80 * MB),
        "SGSST_MAX_GAUSSIANS": "5000",
        "SGSST_MAX_IMAGE_PIXELS": str(20 * MB),
        "SGSST_MAX_PIXELS": str(100 * MB),
        "SGSST_MAX_VIEWS": "100",
        "SGSST_MAX_PHOTOS": "50",
        "SGSST_RECEIVE_SECONDS": str(STILL),
        "SGSST_INSPECTION_SECONDS": "10",
        "SGSST_INSPECTION_BYTES": str(2000 * MB),
        "SGSST_MAX_JOBS_PER_KEY": "10000",
    }
    with Service(tmp_path_factory.mktemp("hostile") / "data", alone=True, **limits) as running:
        with running.client() as client:  # One-time allocations do not count as growth.
            assert client.post("/v1/jobs", files=form(files)).status_code == 202
            client.get("/openapi.json")
        yield running


@pytest.fixture
def client(service: Service) -> Iterator[httpx2.Client]:
    with service.client() as opened:
        yield opened


@pytest.fixture(scope="module")
def store(service: Service) -> Iterator[Store]:
    opened = open_store(ServiceSettings(data=service.data))
    yield opened
    opened.close()


@pytest.fixture(autouse=True)
def unharmed(service: Service) -> Iterator[None]:
    """Check after each test that the API has not crashed, failed or grown, and has left no partial file."""
    before = api_of(service)
    logged = service.log.stat().st_size
    Path(f"/proc/{before.pid}/clear_refs").write_text("5")  # reset the peak memory
    start = memory_of(before, "VmRSS")
    yield
    assert api_of(service).pid == before.pid
    peak = memory_of(before, "VmHWM")
    assert peak - start < GROWTH, f"grew by {(peak - start) / MB:.0f} MB"
    folders = [service.data / name for name in ("incoming", "inspections")]
    wait_for(lambda: not any(any(folder.iterdir()) for folder in folders), "half files to be removed")
    with service.log.open(errors="replace") as log:
        log.seek(logged)
        said = log.read()
    assert "Traceback" not in said, said[-3000:]


def api_of(service: Service) -> psutil.Process:
    process = service.process("api.http.server")
    assert process is not None
    return process


def memory_of(process: psutil.Process, field: str) -> int:
    status = Path(f"/proc/{process.pid}/status").read_text()
    match = re.search(rf"{field}:\s+(\d+) kB", status)
    assert match
    return 1024 * int(match[1])


def form(files: Files, **changed: bytes | tuple[str, bytes] | None) -> list[tuple[str, Any]]:
    """Return multipart fields. `changed` has new contents, or pairs (file name, content); None omits a field."""
    names = {"scene": "scene.ply", "cameras": "cameras.json", "style": "style.png"}
    parts: list[tuple[str, Any]] = []
    for role in {**files, **changed}:
        content = changed.get(role, files.get(role))
        if content is not None:
            parts.append((role, content if isinstance(content, tuple) else (names.get(role, role), content)))
    return parts


def refused(answer: httpx2.Response, status: int, *codes: str) -> dict[str, Any]:
    """Check that a response is a problem document with this status and one of the codes, and return the document."""
    assert answer.status_code == status, f"{answer.status_code} {answer.text[:500]}"
    assert answer.headers["content-type"] == "application/problem+json"
    check_documented(answer)
    problem: dict[str, Any] = answer.json()
    assert problem["status"] == status
    assert problem["code"] in codes, problem
    assert problem["title"]
    assert problem["detail"]
    assert len(answer.content) < 20_000, "it repeats what was sent"
    assert not re.search(r"/tmp|/work|Errno|Traceback|\.part\b", problem["detail"]), problem["detail"]
    return problem


def count_jobs(store: Store) -> int:
    return len(store.jobs.page(None, limit=100_000))


# --- files that lie ------------------------------------------------------------------------------------------------


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
    ("negative count", lambda f: header(f["scene"], VERTEX, "element vertex -616")),
    ("hexadecimal count", lambda f: header(f["scene"], VERTEX, "element vertex 0x268")),
    ("count with underscores", lambda f: header(f["scene"], VERTEX, "element vertex 6_1_6")),
    ("count in other digits", lambda f: header(f["scene"], VERTEX, "element vertex ٦١٦")),
    ("count of 4,000 digits", lambda f: header(f["scene"], VERTEX, "element vertex " + "9" * 4000)),
    ("count of a million digits", lambda f: header(f["scene"], VERTEX, "element vertex " + "9" * 1_000_000)),
    ("count 2^64", lambda f: header(f["scene"], VERTEX, f"element vertex {2**64}")),
    ("count 10^18 - 1", lambda f: header(f["scene"], VERTEX, "element vertex 999999999999999999")),
    ("count missing", lambda f: header(f["scene"], VERTEX, "element vertex")),
    ("no Gaussians", lambda f: header(f["scene"], VERTEX, "element vertex 0")),
    ("vertex twice", lambda f: header(f["scene"], VERTEX, VERTEX + "\n" + VERTEX)),
    ("no vertex", lambda f: header(f["scene"], VERTEX, "element points 616")),
    ("rows of no bytes", lambda f: header(f["scene"], "end_header", "element nothing 999999999999\nend_header")),
    ("a property twice", lambda f: header(f["scene"], "property float y", "property float x")),
    ("an unknown type", lambda f: header(f["scene"], "property float y", "property float128 y")),
    ("a longer type", lambda f: header(f["scene"], "property float y", "property double y")),
    ("positions as lists", lambda f: header(f["scene"], "property float y", "property list uchar float y")),
    ("list of float length", lambda f: header(f["scene"], "property float y", "property list float float y")),
    ("no opacity", lambda f: header(f["scene"], "property float opacity", "property float opacitx")),
    ("no rotation", lambda f: header(f["scene"], "property float rot_3", "property float rot_4")),
    ("an unknown byte order", lambda f: header(f["scene"], "binary_little_endian", "binary_middle_endian")),
    ("the other byte order", lambda f: header(f["scene"], "binary_little_endian", "binary_big_endian")),
    ("binary data said to be text", lambda f: header(f["scene"], "binary_little_endian", "ascii")),
    ("format 2.0", lambda f: header(f["scene"], "endian 1.0", "endian 2.0")),
    ("no format", lambda f: header(f["scene"], "format", "comment format")),
    ("zero bytes in the header", lambda f: header(f["scene"], VERTEX, b"element ver\x00tex 616")),
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
    (
        "list of negative length",
        lambda f: before_vertices(f["scene"], "element face 1\nproperty list char int v\n", b"\xff"),
    ),
    ("lists that end early", lambda f: with_faces(f["scene"], LIST, b"\x01\0\0\0\0" * 150)),
    ("a quaternion of length 0", lambda f: f["scene"][:-16] + bytes(16)),
    ("text with 1_0", lambda f: text_scene(f["scene"], "1_0")),
    ("infinite scale", lambda f: f["scene"][:-20] + struct.pack("<f", float("inf")) + f["scene"][-16:]),
    ("header only", lambda f: f["scene"][: f["scene"].index(b"end_header\n") + 11]),
    ("half a header", lambda f: f["scene"][:200]),
    ("one byte short", lambda f: f["scene"][:-1]),
    ("gzip", lambda f: gzip.compress(f["scene"])),
    ("zip", lambda f: zipped("scene.ply", f["scene"])),
    ("text with words for numbers", lambda f: text_scene(f["scene"], "lots")),
    ("text with too few numbers", lambda f: text_scene(f["scene"], "")),
    ("text with one endless number", lambda f: text_scene(f["scene"], "1" * MB)),
    ("compressed, more Gaussians than bytes", lambda f: header(f["compressed.ply"], VERTEX, "element vertex 700")),
    ("compressed, too few chunks", lambda f: header(f["compressed.ply"], "element chunk 3", "element chunk 2")),
    ("compressed, one byte short", lambda f: f["compressed.ply"][:-1]),
    ("compressed, no bounds", lambda f: header(f["compressed.ply"], "property float max_z", "property int max_z")),
    ("compressed, infinite bounds", lambda f: with_bound(f["compressed.ply"], float("inf"))),
    ("SPZ, half of it", lambda f: f["v3.spz"][: len(f["v3.spz"]) // 2]),
    ("SPZ, wrong checksum", lambda f: f["v3.spz"][:-8] + bytes(8)),
    ("SPZ of 4 billion Gaussians", lambda f: spz(2**32 - 1, b"")),
    ("SPZ of 5,001 Gaussians", lambda f: spz(5001, bytes(5001 * 20))),
    ("SPZ, fewer than it says", lambda f: spz(4000, bytes(3999 * 20))),
    ("SPZ, a gigabyte behind it", lambda f: spz_bomb()),
    ("SPZ of version 9", lambda f: spz(1, bytes(20), version=9)),
    ("SPZ of degree 200", lambda f: spz(1, bytes(20), degree=200)),
    ("SPZ 4, streams beyond the file", lambda f: spz_4(2**63)),
    ("SPZ 4 of a billion Gaussians in 100 bytes", lambda f: spz_4(20, 10**9) + bytes(100)),
    ("SPZ 4, half of it", lambda f: f["spz"][: len(f["spz"]) // 2]),
    ("SPZ 4, a gigabyte in a stream", lambda f: spz_4_bomb()),
    ("splat, one byte more", lambda f: f["splat"] + b"x"),
    ("splat with infinite places", lambda f: f["splat"] + struct.pack("<6f8B", *[float("inf")] * 3, 1, 1, 1, *[9] * 8)),
    ("splat with sizes of 0", lambda f: f["splat"][:-32] + f["splat"][-32:-20] + bytes(12) + f["splat"][-8:]),
    ("SOG, half of it", lambda f: f["sog"][: len(f["sog"]) // 2]),
    ("SOG, files of another folder", lambda f: f["sog"].replace(b"quats.webp", b"../../a.sh")),
    ("SOG, a gigabyte in an image", lambda f: zipped("meta.json", bytes(1 << 30))),
    ("GLB, half of it", lambda f: f["glb"][: len(f["glb"]) // 2]),
    ("GLB of 4 billion Gaussians", lambda f: f["glb"].replace(b'"count": 616', b'"count": 4294967295')),
    (
        "GLB with data in another file",
        lambda f: f["glb"].replace(b'"byteLength"', b'"uri": "/etc/passwd", "byteLength"'),
    ),
    ("GLB with deep JSON", lambda f: glb(b"[" * 500_000)),
    ("GLB of a mesh", lambda f: glb(b'{"meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}]}')),
    ("ksplat, half of it", lambda f: f["ksplat"][: len(f["ksplat"]) // 2]),
    ("ksplat of 4 billion Gaussians", lambda f: ksplat_with(f["ksplat"], 16, 2**32 - 1)),
    ("ksplat, a section of 4 billion Gaussians", lambda f: ksplat_with(f["ksplat"], 4096, 2**32 - 1, 2**32 - 1)),
    ("ksplat of 4 billion buckets", lambda f: ksplat_with(f["ksplat"], 4096 + 12, 2**32 - 1)),
    ("ksplat, fewer Gaussians in buckets", lambda f: ksplat_with(f["ksplat"], 5120, 1)),
    ("a checkpoint", lambda f: zipped("archive/data.pkl", b"cos\nsystem\n(S'true'\ntR.")),
    ("SOG, files by name", lambda f: sog(files={"means_l.webp": 0, "means_u.webp": 0})),
    ("SOG, text for numbers", lambda f: sog(mins=["1_0", 0, 0])),
    ("SOG, 100,000 channels", lambda f: sog_of_channels(100_000)),
    ("SOG without images", lambda f: zipped("meta.json", b'{"version": 2, "means": {"files": ["means_l.webp"]}}')),
]


def with_bound(scene: bytes, value: float) -> bytes:
    """Return a compressed PLY whose first bound is replaced by `value`."""
    start = scene.index(b"end_header\n") + 11
    return scene[:start] + struct.pack("<f", value) + scene[start + 4 :]


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


def sog(**means: Any) -> bytes:
    """Return a SOG archive without images, with these values in the entry `means`."""
    entry = {"mins": [0, 0, 0], "maxs": [1, 1, 1], "files": ["means_l.webp", "means_u.webp"], **means}
    steps = {name: {"codebook": [0.0], "files": [f"{name}.webp"]} for name in ("scales", "quats", "sh0")}
    return zipped("meta.json", json.dumps({"version": 2, "count": 16, "means": entry, **steps}).encode())


def sog_of_channels(count: int) -> bytes:
    """Return a SOG archive of version 1 whose scales have bounds for that many channels."""
    means = {"shape": [16, 3], "mins": [0, 0, 0], "maxs": [1, 1, 1], "files": ["means_l.webp", "means_u.webp"]}
    bounds = {"mins": [0] * count, "maxs": [1] * count}
    steps = {name: {**bounds, "files": [f"{name}.webp"]} for name in ("scales", "quats", "sh0")}
    return zipped("meta.json", json.dumps({"means": means, **steps}).encode())


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


@pytest.mark.parametrize("what", [format.name for format in FORMATS if format is not PLY])
def test_compressed_scenes_are_detected_from_their_content(
    client: httpx2.Client, store: Store, files: Files, packed: Files, what: str
) -> None:
    """The format is detected regardless of the file name, for files in the request and for tus uploads."""
    answer = client.post("/v1/jobs", files=form(files, scene=("my scan.ply", packed[what])))
    assert answer.status_code == 202, answer.text
    headers = {**TUS, "Upload-Length": str(len(packed[what]))}
    where = client.post("/v1/uploads", headers=headers).headers["location"]
    headers = {**TUS, "Upload-Offset": "0", "Content-Type": OFFSET_STREAM}
    assert client.patch(where, headers=headers, content=packed[what]).status_code == 204
    parts = [("scene", (None, where.rpartition("/")[2])), *form(files, scene=None)]
    answer = client.post("/v1/jobs", files=parts)
    assert answer.status_code == 202, answer.text
    inputs = client.get(answer.headers["location"]).json()["inputs"]
    assert [entry["size"] for entry in inputs if entry["role"] == "scene"] == [len(packed[what])]


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(width: int, height: int, *chunks: bytes) -> bytes:
    """Return an RGB PNG whose header declares this size, with these chunks."""
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + b"".join(chunks) + chunk(b"IEND", b"")


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


def image_bytes(format_: str, width: int, height: int) -> bytes:
    file = io.BytesIO()
    Image.new("L", (width, height)).save(file, format_)
    return file.getvalue()


def text_bomb() -> bytes:
    """Return a small PNG with a compressed comment that expands to 200 MB."""
    return png(16, 16, chunk(b"zTXt", b"Comment\0\0" + zeros(200 * MB)), chunk(b"IDAT", zeros(49 * 16)))


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
    ("no width", "cameras.json", lambda f: changed_cameras(f, width=0)),
    ("negative width", "cameras.json", lambda f: changed_cameras(f, width=-64)),
    ("half a pixel", "cameras.json", lambda f: changed_cameras(f, width=64.5)),
    ("a width of words", "cameras.json", lambda f: changed_cameras(f, width="wide")),
    ("10^9 pixels wide", "cameras.json", lambda f: changed_cameras(f, width=10**9, height=10**9)),
    ("10^400 pixels wide", "cameras.json", lambda f: changed_cameras(f, width=10**400)),
    (
        "a number of 10,000 digits",
        "cameras.json",
        lambda f: f["cameras"].replace(b'"width": 64', b'"width": ' + b"6" * 10_000),
    ),
    ("infinite focal length", "cameras.json", lambda f: changed_cameras(f, fx=float("inf"))),
    ("no rotation", "cameras.json", lambda f: changed_cameras(f, rotation=[[0, 0, 0]] * 3)),
    ("ragged rotation", "cameras.json", lambda f: changed_cameras(f, rotation=[[1, 0, 0], [0], []])),
    ("rotation of objects", "cameras.json", lambda f: changed_cameras(f, rotation={"a": 1})),
    ("infinite position", "cameras.json", lambda f: changed_cameras(f, position=[1e999, 0, 0])),
    ("no name", "cameras.json", lambda f: changed_cameras(f, img_name="")),
    ("more than a thousand", "cameras.json", lambda f: json.dumps(json.loads(f["cameras"]) * 400).encode()),
    ("deep JSON", "cameras.json", lambda f: b'{"frames":' + b"[" * 500_000),
    ("half a surrogate", "cameras.json", lambda f: b'[{"img_name": "\\ud800"}]'),
    ("no UTF-8", "cameras.json", lambda f: b"\xff\xfe\xfd"),
    ("gzip", "cameras.json", lambda f: gzip.compress(f["cameras"])),
    ("fish eye", "transforms.json", lambda f: transforms(is_fisheye=True)),
    (
        "an angle of 7",
        "transforms.json",
        lambda f: json.dumps(
            {"camera_angle_x": 7, "w": 9, "h": 9, "frames": [{"file_path": "a", "transform_matrix": []}]}
        ).encode(),
    ),
    ("COLMAP of 2^60 cameras", "cameras.bin", lambda f: struct.pack("<Q", 2**60) + bytes(100)),
    ("COLMAP cut off", "cameras.bin", lambda f: struct.pack("<QIiQQ", 1, 1, 1, 64, 48)),
    ("COLMAP without images", "cameras.bin", lambda f: struct.pack("<QIiQQ4d", 1, 1, 1, 64, 48, 64, 64, 32, 24)),
    ("COLMAP of 1_0", "cameras.txt", lambda f: b"1 PINHOLE 6_4 48 64 64 32 24\n"),
    ("rotation of text", "cameras.json", lambda f: changed_cameras(f, rotation=[["1_0", "0", "0"]] * 3)),
    ("COLMAP of words", "cameras.txt", lambda f: b"1 PINHOLE wide high 1 1 1 1\n"),
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


# --- names ---------------------------------------------------------------------------------------------------------

NAMES = [
    "../../../../etc/cron.d/x",
    "/etc/passwd",
    "..\\..\\..\\windows\\system32\\x",
    "C:\\x.ply",
    "\\\\server\\share\\x.ply",
    "a\x00b.ply",
    "a\nb\r\nX-Injected: 1.ply",
    "....//....//x.ply",
    "%2e%2e%2f%2e%2e%2fx.ply",
    "..%c0%af..%c0%afx.ply",
    ".",
    "..",
    "...",
    "/",
    "",
    " ",
    ".bashrc",
    "-rf",
    "~root/.ssh/id",
    "$(id).ply",
    "CON",
    "aux.ply",
    "x.ply:stream",
    "a" * 5000 + ".ply",
    "a/" * 3000 + "x.ply",
    "界" * 200 + ".ply",
    "é" * 255,
    "\u202egpj.ply",
    "\ufeffx.ply",
    "👩‍👩‍👧‍👦" * 50,
]


@pytest.mark.parametrize("role", ["scene", "style", pytest.param("photos", marks=pytest.mark.slow)])
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


# --- multipart bodies ----------------------------------------------------------------------------------------------

BOUNDARY = "b0undary"


def post(client: httpx2.Client, body: bytes | Iterator[bytes], kind: str = "", **headers: str) -> httpx2.Response:
    kind = kind or f"multipart/form-data; boundary={BOUNDARY}"
    return client.post("/v1/jobs", content=body, headers={"content-type": kind, **headers})


def part(head: str, body: bytes = b"x") -> bytes:
    return f"--{BOUNDARY}\r\n{head}\r\n\r\n".encode("latin-1") + body + b"\r\n"


END = f"--{BOUNDARY}--\r\n".encode()
FILE = 'Content-Disposition: form-data; name="{}"; filename="x"'

BODIES: list[tuple[str, bytes, int]] = [
    ("nothing", b"", 400),
    ("another boundary", b"--other\r\n\r\nx\r\n--other--\r\n", 400),
    ("the end alone", END, 422),
    ("no end", part(FILE.format("scene")), 400),
    ("no head", f"--{BOUNDARY}\r\n\r\nx\r\n".encode() + END, 422),
    ("no name", part('Content-Disposition: form-data; filename="x"') + END, 422),
    ("no disposition", part("Content-Type: text/plain") + END, 422),
    ("a head without colon", part("what is this") + END, 400),
    ("zero bytes in the head", part('Content-Disposition: form-data; name="sc\0ene"') + END, 422),
    ("another charset", part("Content-Disposition: form-data; name=\"scene\"; filename*=none''%ff%fe") + END, 422),
    (
        "endless continuations",
        part('Content-Disposition: form-data; name="scene"; ' + "; ".join(f'filename*{i}="x"' for i in range(5000)))
        + END,
        400,
    ),
    ("a boundary within", part(FILE.format("scene"), part(FILE.format("style"))) + END, 422),
    ("rubbish", bytes(range(256)) * 100, 400),
    ("bare line ends", part(FILE.format("scene")).replace(b"\r\n", b"\n") + END, 400),
    ("a head of a megabyte", part("Content-Disposition: form-data; name=" + "x" * MB) + END, 400),
    ("a head of 2,000 lines", part("\r\n".join(f"X-{i}: y" for i in range(2000))) + END, 400),
    ("an unknown field", part(FILE.format("scene/../../x")) + END, 422),
    ("a field of a megabyte", part('Content-Disposition: form-data; name="parameters"', b" " * MB) + END, 422),
    ("a field twice", 2 * part('Content-Disposition: form-data; name="parameters"', b"{}") + END, 422),
    ("no text", part('Content-Disposition: form-data; name="parameters"', b"\xff\xfe") + END, 422),
]


@pytest.mark.parametrize(("body", "status"), [case[1:] for case in BODIES], ids=[case[0] for case in BODIES])
def test_malformed_bodies_are_rejected(client: httpx2.Client, store: Store, body: bytes, status: int) -> None:
    before = count_jobs(store)
    codes = ("malformed-body",) if status == 400 else ("invalid-request", "unknown-upload", "invalid-scene")
    refused(post(client, body), status, *codes)
    assert count_jobs(store) == before


@pytest.mark.parametrize(
    ("kind", "status"),
    [
        ("application/x-www-form-urlencoded", 415),
        ("application/octet-stream", 415),
        ("multipart/mixed; boundary=x", 415),
        ("application/json-patch+json", 415),
        ("nonsense", 415),
        ("multipart/form-data", 400),
        ("multipart/form-data; boundary=", 400),
        ("multipart/form-data; boundary=" + "x" * 3000, 400),
        ("multipart/form-data; boundary=\xff\xfe", 400),
        ("multipart/form-data; boundary*=none''%ff", 400),
    ],
)
def test_malformed_content_types_are_rejected(client: httpx2.Client, kind: str, status: int) -> None:
    answer = client.post("/v1/jobs", content=b"x=y", headers=[(b"content-type", kind.encode("latin-1"))])
    refused(answer, status, "unsupported-media-type" if status == 415 else "malformed-body")


def test_encoded_body_is_rejected(client: httpx2.Client, files: Files) -> None:
    """Nothing decompresses bodies, so a body cannot be a decompression bomb."""
    request = client.build_request("POST", "/v1/jobs", files=form(files))
    answer = post(
        client, gzip.compress(request.read()), request.headers["content-type"], **{"content-encoding": "gzip"}
    )
    refused(answer, 415, "unsupported-media-type")
    answer = post(client, gzip.compress(b"{}"), "application/json", **{"content-encoding": "gzip"})
    refused(answer, 415, "unsupported-media-type")


def test_too_many_parts_are_rejected(client: httpx2.Client, files: Files) -> None:
    small = part(FILE.format("photos"), b"x")
    refused(post(client, small * 1000 + END), 422, "too-many-files")
    named = part('Content-Disposition: form-data; name="photos"', b"upl_00000000000")
    refused(post(client, named * 20_000 + END), 422, "too-many-files")
    empty = part('Content-Disposition: form-data; name="photos"', b"")
    refused(post(client, empty * 20_000 + END), 422, "too-many-files")
    for role in ("photos", "mask"):
        job = {"scene": UPLOAD_ID, "style": UPLOAD_ID, role: [UPLOAD_ID] * 1000}
        refused(client.post("/v1/jobs", json=job), 422, "too-many-files")


def test_endless_part_header_is_rejected(client: httpx2.Client) -> None:
    def body() -> Iterator[bytes]:
        yield f"--{BOUNDARY}\r\nContent-Disposition: ".encode()
        for _ in range(90):
            yield b"x" * MB

    refused(post(client, body()), 400, "malformed-body")


def test_too_long_bodies_are_rejected(client: httpx2.Client, files: Files) -> None:
    def chunked(size: int) -> Iterator[bytes]:
        yield part(FILE.format("style"))[:-3]
        for _ in range(size):
            yield bytes(MB)
        yield b"\r\n" + END

    refused(post(client, chunked(85)), 413, "too-large")  # a file
    refused(post(client, chunked(120)), 413, "too-large")  # a request of undeclared length
    refused(post(client, b'{"scene": "' + b"x" * 2 * MB + b'"}', "application/json"), 413, "too-large")


# --- JSON ----------------------------------------------------------------------------------------------------------

NUMBERS = ["NaN", "Infinity", "-Infinity", "1e999", "-1e999", "1" + "0" * 400, "-1", "1.5e-400", "9" * 5000]
OPTIONS = declared(JobParameters)
FIELDS = [name for name, option in OPTIONS.items() if kind_of(option) in (int, float)]
#: Fields that accept one of these numbers.
MAY_BE_0 = {name for name in FIELDS if Ge(0) in OPTIONS[name].limits}
MAY_BE_NEGATIVE = {"elevation", "style_rotation"}  # angles


def submit_text(client: httpx2.Client, parameters: str) -> httpx2.Response:
    """Submit a job with these parameters and files that do not exist, because parameters are validated first."""
    body = f'{{"scene": "upl_00000000000", "style": "upl_00000000000", "parameters": {parameters}}}'
    return post(client, body.encode(), "application/json")


@pytest.mark.parametrize("field", FIELDS)
def test_malformed_numbers_are_rejected(client: httpx2.Client, field: str) -> None:
    refused(submit_text(client, "{}"), 422, "unknown-upload")
    for number in NUMBERS:
        if field in MAY_BE_0 | MAY_BE_NEGATIVE and number == "1.5e-400":
            continue  # rounds to 0
        if field in MAY_BE_NEGATIVE and number == "-1":
            continue
        refused(submit_text(client, f'{{"{field}": {number}}}'), 422, "invalid-request", "invalid-settings")


TEXTS = [
    '{"background": [NaN, 0, 0]}',
    '{"background": [1e999, 0, 0]}',
    '{"background": [2, 0, 0]}',
    '{"background": [0, 0, 0, 0]}',
    '{"background": "no color"}',
    '{"name": "\\ud800"}',
    '{"name": "a\\u0000b"}',
    '{"name": {"$ne": null}}',
    '{"name": ["a"]}',
    '{"\\ud800": 1}',
    '{"' + "x" * 50_000 + '": 1}',
    '{"__proto__": {}}',
    '{"__class__": "x"}',
    "{" + ",".join(f'"a{i}": 1' for i in range(3000)) + "}",
    '{"drop_invalid": "maybe"}',
    '{"preset": "../../preview"}',
    '{"backbone": "/etc/passwd"}',
    '{"up": null}',
    "null",
    "1",
    '"x"',
    "[]",
    '{"a":' * 10_000,
    "[" * 60_000 + "]" * 5_000,
    "{'seed': 1}",
    '{"seed": 1} {"seed": 2}',
]


@pytest.mark.parametrize("text", TEXTS, ids=[text[:25] for text in TEXTS])
def test_malformed_parameters_are_rejected(client: httpx2.Client, files: Files, text: str) -> None:
    refused(submit_text(client, text), 422, "invalid-request", "invalid-settings")
    answer = post(client, part('Content-Disposition: form-data; name="parameters"', text.encode()) + END)
    refused(answer, 422, "invalid-request", "invalid-settings")


JSON_BODIES = [
    b"",
    b"{",
    b"null",
    b"[]",
    b"{}",
    b'{"scene": 1, "style": 2}',
    b"\xff",
    b"[" * 900_000,
    b'{"scene": "\\ud800", "style": "x"}',
    b'{"scene": "upl_00000000000", "style": "upl_00000000000", "webhook": "\\ud800"}',
    b'{"scene": "../../x", "style": "/etc/passwd"}',
    b'{"scene": "upl_00000000000\\u0000", "style": "x"}',
    b'{"scene": "x", "style": "x", "photos": [' + b'"x",' * 20_000 + b'"x"]}',
    b'{"scene": "x", "style": "x", "cameras": [' + b'"x",' * 9 + b'"x"]}',
    b'{"scene": "x", "style": "x", "parameters": [1]}',
    b'{"scene": "x", "style": "x", "webhook": "file:///etc/passwd"}',
    b'{"scene": "job_00000000000", "style": "key_00000000000"}',
]


@pytest.mark.parametrize("body", JSON_BODIES, ids=[body[:30].decode("latin-1") for body in JSON_BODIES])
def test_json_with_unknown_uploads_is_rejected(client: httpx2.Client, body: bytes) -> None:
    answer = post(client, body, "application/json")
    refused(answer, 400 if body == b"\xff" else 422, "malformed-body", "invalid-request", "unknown-upload")


def test_webhooks_are_rejected_while_switched_off(client: httpx2.Client, files: Files) -> None:
    for url in ("http://169.254.169.254/latest", "file:///etc/passwd", "http://[::1", "x" * 60_000):
        refused(client.post("/v1/jobs", files=form(files), data={"webhook": url}), 422, "webhooks-off")


# --- tus -----------------------------------------------------------------------------------------------------------


def begin(client: httpx2.Client, size: int) -> str:
    answer = client.post("/v1/uploads", headers={**TUS, "Upload-Length": str(size)})
    assert answer.status_code == 201, answer.text
    return str(answer.headers["location"])


def send(client: httpx2.Client, where: str, offset: object, data: Any, **headers: Any) -> httpx2.Response:
    fixed = {**TUS, "Upload-Offset": str(offset), "Content-Type": OFFSET_STREAM}
    return client.patch(where, content=data, headers={**fixed, **headers})


#: Texts that Python's `int` accepts.
NO_DIGITS: list[Any] = ["1_0", "+10", "10.0", "1 0", "\u0661\u0660".encode(), "\uff11\uff10".encode()]


def test_numbers_must_be_digits(client: httpx2.Client, service: Service, done: str) -> None:
    """Queries and headers accept digits only; malformed body lengths are refused below the app."""
    for number in ("1_0", "+10", " 10", "10 ", "\u0661\u0660", "10.0"):
        refused(client.get("/v1/jobs", params={"limit": number}), 422, "invalid-request")
    for number in NO_DIGITS:
        answer = client.get(f"/v1/jobs/{done}/events", headers={"Last-Event-ID": number})
        refused(answer, 422, "invalid-request")
    for length in ("1_0", "+10", "1 0", "10.0", "0x10", "\xb2"):
        head, body = exchange(service, f"POST /v1/jobs HTTP/1.1\nContent-Length: {length}")
        assert head.startswith(b"HTTP/1.1 400 ")
        assert json.loads(body)["code"] == "malformed-request"


def test_uploads_require_protocol_version(client: httpx2.Client) -> None:
    """tus 1.0 requires the version in all requests except OPTIONS. `GET` is not part of tus."""
    where = begin(client, 5)
    data = {"Upload-Length": "5", "Upload-Offset": "0", "Content-Type": OFFSET_STREAM}
    for version in ({}, {"Tus-Resumable": ""}, {"Tus-Resumable": "0.2.2"}):
        for method, path in (("POST", "/v1/uploads"), ("PATCH", where), ("DELETE", where)):
            answer = client.request(method, path, headers={**data, **version}, content=b"12345")
            refused(answer, 412, "unsupported-tus-version")
            assert answer.headers["tus-version"] == "1.0.0"
        assert client.head(where, headers=version).status_code == 412
    assert client.options("/v1/uploads").status_code == 204
    assert client.get(where).json()["offset"] == 0
    assert client.delete(where, headers=TUS).status_code == 204


def test_malformed_upload_creation_is_rejected(client: httpx2.Client) -> None:
    for length in ("-1", "x", "1.5", "1e3", "0x10", "", str(2**60), "9" * 5000, "NaN", *NO_DIGITS):
        refused(client.post("/v1/uploads", headers={**TUS, "Upload-Length": length}), 422, "invalid-request")
    refused(client.post("/v1/uploads", headers={**TUS, "Upload-Length": "0"}), 400, "malformed-body")
    refused(client.post("/v1/uploads", headers={**TUS, "Upload-Length": str(81 * MB)}), 413, "too-large")
    refused(
        client.post("/v1/uploads", headers={"Tus-Resumable": "9", "Upload-Length": "5"}), 412, "unsupported-tus-version"
    )
    for metadata in (
        b"filename !!!",
        b"filename \xff\xfe",
        b"filename /////w==",
        b"filename YQ",
        b"name =" + b"=" * 100,
    ):
        headers = {b"Tus-Resumable": b"1.0.0", b"Upload-Length": b"5", b"Upload-Metadata": metadata}
        refused(client.post("/v1/uploads", headers=headers), 400, "malformed-body")
    refused(
        client.post("/v1/uploads", headers={**TUS, "Upload-Length": "5", "Upload-Metadata": "x" * 5000}),
        422,
        "invalid-request",
    )


def test_lists_of_many_photos_take_little_memory(client: httpx2.Client, service: Service, store: Store) -> None:
    """Six lists at once of jobs with 2,000 photos each, and lists that are not read; pages have every name once."""
    sha256 = store.jobs.inputs(store.jobs.page(None, limit=1)[0].row.id)[0]["sha256"]
    entry = {"name": "scene.ply", "sha256": sha256, "size": 1}
    photos = [{**entry, "role": "photos", "name": f"images/left/IMG_2026_{number:06d}.jpg"} for number in range(2000)]
    inputs = [*photos, {**entry, "role": "scene"}]
    ids = [store.jobs.create(NewJob("local", "", 0, {}, inputs), limit=10**6)[0].id for _ in range(60)]
    with ThreadPoolExecutor(6) as threads:
        answers = list(threads.map(lambda _: client.get("/v1/jobs?limit=200"), range(6)))
    for answer in answers:
        jobs = answer.json()["jobs"][:60]
        assert [job["id"] for job in jobs] == ids[::-1]
        assert jobs[0]["input_counts"] == {"photos": 2000, "scene": 1}
        assert [each["role"] for each in jobs[0]["inputs"]] == ["scene"]
        assert len(answer.content) < MB
    address = urlsplit(service.url)
    with contextlib.ExitStack() as stack:
        for path in ("/v1/jobs?limit=200", f"/v1/jobs/{ids[0]}/inputs") * 20:
            unread = stack.enter_context(socket.create_connection((address.hostname, address.port or 80)))
            unread.sendall(f"GET {path} HTTP/1.1\r\nHost: {address.netloc}\r\n\r\n".encode())
        assert client.get("/v1/jobs?limit=1").json()["next_cursor"] == ids[-1]
    names, cursor = [], "0"
    while cursor is not None:
        page = client.get(f"/v1/jobs/{ids[0]}/inputs?limit=700&cursor={cursor}").json()
        names += [each["name"] for each in page["inputs"]]
        cursor = page["next_cursor"]
    assert names == [each["name"] for each in inputs]
    assert page["inputs"][-2]["url"] == f"/v1/jobs/{ids[0]}/inputs/photos:1999"
    large = {"scene": UPLOAD_ID, "style": UPLOAD_ID, "parameters": {"name": "x", "background": [0.0] * 40_000}}
    assert client.post("/v1/jobs", json=large).status_code == 422
    for job_id in ids:
        store.jobs.cancel(job_id, None)
        store.jobs.delete(job_id, None)


def test_upload_names_cannot_escape_folder(client: httpx2.Client, service: Service) -> None:
    for name in NAMES:
        metadata = f"filename {base64.b64encode(name.encode()[:2900]).decode()}".strip()
        answer = client.post("/v1/uploads", headers={**TUS, "Upload-Length": "5", "Upload-Metadata": metadata})
        if answer.status_code == 400:  # cut within a character
            continue
        assert answer.status_code == 201, answer.text
        shown = answer.json()["filename"]
        assert not shown.startswith(("/", "."))
        assert ".." not in shown.split("/")
        assert client.delete(answer.headers["location"], headers=TUS).status_code == 204
    assert not list((service.data / "uploads").iterdir())


def test_malformed_upload_parts_are_rejected(client: httpx2.Client, service: Service) -> None:
    where = begin(client, 1000)
    file = service.data / "uploads" / (where.rsplit("/", 1)[1] + ".part")
    assert send(client, where, 0, bytes(100)).status_code == 204
    for offset in (0, 99, 101, 1000, 2**59):
        assert refused(send(client, where, offset, bytes(10)), 409, "conflict")["offset"] == 100
    for value in ("-1", "x", "1.5", str(2**60), "9" * 5000, "", *NO_DIGITS):
        refused(send(client, where, value, bytes(10)), 422, "invalid-request")
    wrong = base64.b64encode(bytes(32)).decode()
    refused(send(client, where, 100, bytes(10), **{"Upload-Checksum": f"sha256 {wrong}"}), 460, "checksum-mismatch")
    refused(send(client, where, 100, bytes(10), **{"Upload-Checksum": "sha256"}), 460, "checksum-mismatch")
    for checksum in (b"sha256 \xff\xfe", b"sha256 !", b"sha512 x", b"__class__ x", b"x" * 5000):
        refused(send(client, where, 100, bytes(10), **{"Upload-Checksum": checksum}), 400, "malformed-body")
    refused(
        send(client, where, 100, bytes(10), **{"Content-Type": "application/octet-stream"}),
        415,
        "unsupported-media-type",
    )
    refused(send(client, where, 100, bytes(10), **{"Tus-Resumable": "0.2.2"}), 412, "unsupported-tus-version")
    refused(send(client, where, 100, bytes(10), **{"Content-Encoding": "gzip"}), 415, "unsupported-media-type")
    assert client.head(where, headers=TUS).headers["upload-offset"] == "100"

    sized = {"Upload-Checksum": f"sha256 {wrong}"}
    refused(send(client, where, 100, bytes(901), **sized), 413, "too-large")
    refused(send(client, where, 100, iter([bytes(MB)] * 70), **sized), 413, "too-large")
    assert client.head(where, headers=TUS).headers["upload-offset"] == "100"
    assert file.stat().st_size <= 1000, "more is on the disk than was announced"
    refused(send(client, where, 100, bytes(901)), 413, "too-large")
    offset = int(client.head(where, headers=TUS).headers["upload-offset"])
    assert send(client, where, offset, bytes(1000 - offset)).status_code == 204
    refused(send(client, where, 5, b"x"), 409, "conflict")
    refused(send(client, where, 1000, b"x"), 413, "too-large")
    assert client.get(where).json()["complete"]
    assert not file.exists()
    assert client.delete(where, headers=TUS).status_code == 204


def test_ended_uploads_reject_parts(client: httpx2.Client, store: Store, files: Files) -> None:
    where = begin(client, 1000)
    upload_id = where.rsplit("/", 1)[1]
    with store.database.writing() as session:
        session.get_one(UploadRow, upload_id).expires_at = time.time() - 1
    refused(send(client, where, 0, bytes(10)), 404, "not-found")
    refused(client.get(where), 404, "not-found")
    assert client.head(where, headers=TUS).status_code == 404
    refused(client.delete(where, headers=TUS), 404, "not-found")
    refused(
        post(client, json.dumps({"scene": upload_id, "style": upload_id}).encode(), "application/json"),
        422,
        "unknown-upload",
    )
    deleted = begin(client, 1000)
    assert client.delete(deleted, headers=TUS).status_code == 204
    refused(send(client, deleted, 0, bytes(10)), 404, "not-found")
    for name in ("upl_' OR 1=1", "..", "upl_" + "0" * 5000, "%00", "job_00000000000"):
        assert client.get(f"/v1/uploads/{name}").status_code in (404, 405)


def test_second_writer_of_upload_is_locked_out(client: httpx2.Client, service: Service) -> None:
    where = begin(client, 1000)
    head = f"PATCH {where} HTTP/1.1\nTus-Resumable: 1.0.0\nUpload-Offset: 0\n"
    head += f"Content-Type: {OFFSET_STREAM}\nContent-Length: 1000"
    with connect(service) as first:
        first.sendall(lines(head + "\nExpect: 100-continue"))
        assert b" 100 " in first.recv(100)  # this request has the turn
        first.sendall(bytes(10))
        refused(send(client, where, 0, bytes(10)), 423, "upload-locked")
    wait_for(lambda: client.head(where, headers=TUS).headers["upload-offset"] == "10", "what has come to be saved")
    assert send(client, where, 10, bytes(990)).status_code == 204


# --- other people's things -----------------------------------------------------------------------------------------


def test_other_keys_ids_are_not_found(client: httpx2.Client, service: Service, store: Store, files: Files) -> None:
    _, mine = store.keys.create("hostile-mine")
    _, other = store.keys.create("hostile-other")
    with service.client(mine) as me, service.client(other) as you:
        job_id = me.post("/v1/jobs", files=form(files)).json()["id"]
        where = begin(me, 5)
        nothing = refused(you.get("/v1/jobs/job_0000000000000000000000000000000"), 404, "not-found")
        for method, path, body in (
            ("GET", "", None), ("POST", "/finish", None), ("POST", "/cancel", None), ("POST", "/retry", None),
            ("DELETE", "", None), ("PATCH", "", {"name": "x"}), ("GET", "/events", None), ("GET", "/progress", None),
            ("GET", "/inputs", None), ("GET", "/inputs/scene", None), ("GET", "/artifacts", None),
            ("GET", "/artifacts/stylized.ply", None), ("GET", "/artifacts/stylized.ply?format=spz", None),
            ("GET", "/artifacts/live/colors.f16", None), ("POST", "/blends", {"weight": 0.5}), ("POST", "/video", {}),
            ("GET", "/shares", None), ("POST", "/shares", {}), ("DELETE", f"/shares/{SHARE_ID}", None),
        ):  # fmt: skip
            problem = refused(you.request(method, f"/v1/jobs/{job_id}{path}", json=body), 404, "not-found")
            assert problem["detail"].replace(job_id, "") == nothing["detail"].replace("job_" + "0" * 31, "")
        reference = {"scene": f"/v1/jobs/{job_id}/inputs/scene", "style": f"/v1/jobs/{job_id}/inputs/style"}
        refused(you.post("/v1/jobs", json=reference), 422, "unknown-input")
        for method in ("GET", "DELETE"):
            refused(you.request(method, where, headers=TUS), 404, "not-found")
        assert you.head(where, headers=TUS).status_code == 404
        refused(send(you, where, 0, b"12345"), 404, "not-found")
        assert you.get("/v1/jobs", params={"cursor": job_id}).json()["jobs"] == []
        assert me.get(f"/v1/jobs/{job_id}").json()["status"] == "queued"
        assert me.get(where).json()["offset"] == 0


@pytest.mark.parametrize(
    "header",
    [
        b"Bearer",
        b"Bearer x y",
        b"Basic eDp5",
        b"bearer \xff\xfe",
        b"Bearer " + b"x" * 50_000,
        b"",
        b"Bearer ' OR 1=1 --",
    ],
)
def test_malformed_keys_are_rejected(client: httpx2.Client, header: bytes) -> None:
    answer = client.get("/v1/jobs", headers=[(b"authorization", header)])
    refused(answer, 401, "unauthorized")
    assert answer.headers["www-authenticate"] == "Bearer"


# --- results -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def done(service: Service, store: Store, files: Files, tmp_path_factory: pytest.TempPathFactory) -> str:
    """Create a finished job with results, whose name attempts header injection."""
    with service.client() as client:
        name = 'x"; Set-Cookie: a=b <script>/../../é'
        data = {"parameters": json.dumps({"name": name})}
        job_id = str(client.post("/v1/jobs", files=form(files), data=data).json()["id"])
        for queued in client.get("/v1/jobs", params={"status": "queued", "limit": 200}).json()["jobs"]:
            if queued["id"] != job_id:
                client.post(f"/v1/jobs/{queued['id']}/cancel")
    lease = store.leases.take("test")
    while lease is not None and lease.job_id != job_id:
        store.leases.stop(lease)
        lease = store.leases.take("test")
    assert lease is not None
    folder = tmp_path_factory.mktemp("results")
    (folder / "stylized.ply").write_bytes(files["scene"])
    (folder / "log.txt").write_bytes(b"")
    (folder / "colors.f16").write_bytes(bytes(LARGE))
    (folder / "report.html").write_text("<script>alert(1)</script>")
    artifacts = Artifacts(ServiceSettings(data=service.data).artifacts_url)
    published = [artifacts.put(job_id, lease.epoch, path.name, path) for path in sorted(folder.iterdir())]
    published.append(artifacts.put(job_id, lease.epoch, ".checkpoint", folder / "log.txt"))
    store.leases.start(lease)
    store.leases.publish(lease, published)
    store.leases.succeed(lease, published[:-1], {})
    return job_id


RANGES: list[tuple[str, int]] = [
    ("bytes=0-0", 206),
    ("bytes=-1", 206),
    ("bytes=-999999999999", 206),
    ("bytes=0-999999999999999", 206),
    ("bytes=-0", 416),
    ("bytes=99999999-", 416),
    ("bytes=99999999-999999999", 416),
    ("bytes=999999999999999999-", 416),
    ("bytes=0-0,1-1", 200),
    ("bytes=" + ",".join(f"{i}-" for i in range(1000)), 200),
    ("bytes=5-2", 200),
    ("bytes=-", 200),
    ("bytes=", 200),
    ("bytes=a-b", 200),
    ("bytes=0x0-0x5", 200),
    ("bytes=--5", 200),
    ("bytes=1-2-3", 200),
    ("bytes=" + "9" * 5000 + "-", 200),
    ("pages=1-2", 200),
    ("bytes 0-5", 200),
    ("", 200),
    ("bytes=\xb2-\xb3", 200),
]


@pytest.mark.parametrize(("text", "status"), RANGES, ids=[text[:25] or "empty" for text, _ in RANGES])
def test_ranges_follow_rfc_9110(client: httpx2.Client, files: Files, done: str, text: str, status: int) -> None:
    where = f"/v1/jobs/{done}/artifacts/stylized.ply"
    answer = client.get(where, headers=[(b"range", text.encode("latin-1"))])
    if status == 416:
        refused(answer, 416, "range-not-satisfiable")
        assert answer.headers["content-range"] == f"bytes */{len(files['scene'])}"
        return
    assert answer.status_code == status
    assert answer.content in files["scene"]
    assert len(answer.content) == int(answer.headers["content-length"])
    assert (answer.content == files["scene"]) or status == 206
    refused(
        client.get(f"/v1/jobs/{done}/artifacts/log.txt", headers={"Range": "bytes=0-0"}), 416, "range-not-satisfiable"
    )


def test_results_have_safe_headers(client: httpx2.Client, done: str) -> None:
    answer = client.get(f"/v1/jobs/{done}/artifacts/report.html")
    assert re.fullmatch(r'inline; filename="[A-Za-z0-9._-]+"', answer.headers["content-disposition"])
    assert "set-cookie" not in answer.headers
    assert answer.headers["x-content-type-options"] == "nosniff"
    policy = answer.headers["content-security-policy"]
    assert "sandbox" in policy
    assert "allow-same-origin" not in policy


PATHS = [
    "../../../sgsst.db",
    "..%2f..%2f..%2fsgsst.db",
    "%2e%2e/%2e%2e/sgsst.db",
    "..%5c..%5csgsst.db",
    "/etc/passwd",
    "%2fetc%2fpasswd",
    ".checkpoint",
    "%2echeckpoint",
    "./.checkpoint",
    "x/../.checkpoint",
    "previews/../stylized.ply",
    "stylized.ply/",
    "stylized.ply%00",
    "%00",
    "stylized.ply%0d%0aSet-Cookie:%20a=b",
    "%ff%fe",
    "%ed%a0%80",
    "x" * 5000,
    "%",
    "%%",
    "",
    "STYLIZED.PLY",
    "stylized.ply;x",
]


def test_result_paths_cannot_escape_job(service: Service, done: str) -> None:
    for path in PATHS:
        head, _ = exchange(
            service, f"GET /v1/jobs/{done}/artifacts/{path} HTTP/1.1\nHost: 127.0.0.1\nConnection: close"
        )
        assert head.split()[1] in (b"404", b"307", b"400"), (path, head)
        assert b"set-cookie" not in head.lower()


# --- connections ---------------------------------------------------------------------------------------------------


def connect(service: Service) -> socket.socket:
    parts = urlsplit(service.url)
    return socket.create_connection((str(parts.hostname), parts.port or 0), timeout=60)


def lines(head: str) -> bytes:
    if "Host:" not in head:
        first, _, rest = head.partition("\n")
        head = f"{first}\nHost: 127.0.0.1\n{rest}"
    return head.rstrip("\n").replace("\n", "\r\n").encode("latin-1") + b"\r\n\r\n"


def exchange(service: Service, head: str, body: bytes = b"") -> tuple[bytes, bytes]:
    """Send exactly these bytes, read until the connection is closed, and return head and body of the response."""
    with connect(service) as connection:
        connection.sendall(lines(head) + body)
        answer = b""
        while more := connection.recv(65536):
            answer += more
    headers, _, rest = answer.partition(b"\r\n\r\n")
    return headers, rest


def answer_on(connection: socket.socket) -> tuple[bytes, bytes]:
    """Return head and body of the next response, which must have a Content-Length. The connection stays open."""
    connection.settimeout(60)
    answer = connection.recv(65536)
    while not (match := re.search(rb"content-length: ([0-9]+)\r\n.*?\r\n\r\n", answer, re.DOTALL | re.IGNORECASE)) or (
        len(answer) < match.end() + int(match[1])
    ):
        more = connection.recv(65536)
        assert more, answer
        answer += more
    return answer[: match.end()], answer[match.end() :]


def closed(connection: socket.socket) -> bytes:
    """Return all bytes until the service closes the connection; fail if it does not."""
    connection.settimeout(60)
    answer = b""
    try:
        while more := connection.recv(65536):
            answer += more
    except ConnectionResetError:
        pass
    return answer


def test_slow_clients_are_disconnected_without_blocking_others(
    service: Service, client: httpx2.Client, files: Files
) -> None:
    """Connections that send nothing, half a head or half a body all end, and others are served meanwhile."""
    body = f"POST /v1/jobs HTTP/1.1\nContent-Type: multipart/form-data; boundary={BOUNDARY}\nContent-Length: 100000"
    starts = [b"", b"GET /v1/jobs HTTP/1.1\r\nHost: 127.0", lines(body), lines(body) + part(FILE.format("scene"))[:60]]
    slow = [connect(service) for _ in range(200)]
    for number, connection in enumerate(slow):
        connection.sendall(starts[number % len(starts)])
    assert client.get("/v1/jobs").status_code == 200
    assert client.post("/v1/jobs", files=form(files)).status_code == 202
    for number, connection in enumerate(slow):
        answer = closed(connection)
        connection.close()
        if number % len(starts) >= 2:
            assert b" 408 " in answer.splitlines()[0]
            assert b'"code":"too-slow"' in answer


def test_dripping_clients_are_disconnected(service: Service) -> None:
    """A client that sends single bytes at intervals does not stall, but is far below the minimum rate."""
    head = lines(
        f"POST /v1/jobs HTTP/1.1\nContent-Type: multipart/form-data; boundary={BOUNDARY}\nContent-Length: 100000"
    )
    rest = {0: b"GET /v1/jobs HTTP/1.1\r\nX: ", 1: head + part(FILE.format("scene"))[:70]}
    for start in rest.values():
        with connect(service) as connection:
            connection.sendall(start)
            connection.settimeout(0.3)
            deadline = time.monotonic() + 60
            ended = False
            while not ended:
                assert time.monotonic() < deadline, "it is still listened to"
                try:
                    connection.sendall(b"x")
                    ended = bool(connection.recv(1000)) or True
                except TimeoutError:
                    continue
                except OSError:
                    ended = True


def test_endless_head_is_disconnected(service: Service) -> None:
    for start, more in ((b"GET /", b"x"), (b"GET / HTTP/1.1\r\nX: ", b"x"), (b"GET / HTTP/1.1\r\n", b"X: y\r\n")):
        with connect(service) as connection:
            sent = 0
            try:
                connection.sendall(start)
                while sent < 60 * MB:
                    connection.sendall(more * (MB // len(more)))
                    sent += MB
            except OSError:
                pass
            assert sent < 60 * MB, "it was all taken in"


HEADS: list[tuple[str, bytes]] = [
    ("no HTTP", b"hello\r\n\r\n"),
    ("zero bytes", b"\0" * 1000),
    ("TLS", b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(500)),
    ("HTTP/2", b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"),
    ("two lengths", b"POST /v1/jobs HTTP/1.1\r\nHost: a\r\nContent-Length: 5\r\nContent-Length: 6\r\n\r\nxxxxx"),
    (
        "length and chunks",
        b"POST /v1/jobs HTTP/1.1\r\nHost: a\r\nContent-Length: 5\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n",
    ),
    ("negative length", b"POST /v1/jobs HTTP/1.1\r\nHost: a\r\nContent-Length: -5\r\n\r\n"),
    ("length 2^70", b"POST /v1/jobs HTTP/1.1\r\nHost: a\r\nContent-Length: 1180591620717411303424\r\n\r\n"),
    ("chunk of 2^70", b"POST /v1/jobs HTTP/1.1\r\nHost: a\r\nTransfer-Encoding: chunked\r\n\r\nffffffffffffffffff\r\n"),
    (
        "no chunk size",
        b"POST /v1/jobs HTTP/1.1\r\nHost: a\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n",
    ),
    ("folded header", b"GET / HTTP/1.1\r\nHost: a\r\n folded\r\n\r\n"),
    ("zero byte in a header", b"GET / HTTP/1.1\r\nHost: a\r\nX: a\0b\r\n\r\n"),
    ("line end in a header", b"GET / HTTP/1.1\r\nHost: a\r\nX: a\rb\r\n\r\n"),
    ("no path", b"GET HTTP/1.1\r\n\r\n"),
    ("CONNECT", b"CONNECT example.com:80 HTTP/1.1\r\nHost: a\r\n\r\n"),
    ("another site's path", b"GET http://example.com HTTP/1.1\r\nHost: a\r\n\r\n"),
    ("TRACE", b"TRACE / HTTP/1.1\r\nHost: a\r\nConnection: close\r\n\r\n"),
]


@pytest.mark.parametrize("data", [case[1] for case in HEADS], ids=[case[0] for case in HEADS])
def test_malformed_heads_are_rejected(service: Service, client: httpx2.Client, data: bytes) -> None:
    """Malformed heads are refused below the app. The connection is closed, so no remainder is read as a request."""
    with connect(service) as connection:
        connection.sendall(data)
        connection.shutdown(socket.SHUT_WR)
        answer = closed(connection)
    if answer:  # half a request ends with its connection
        head, _, body = answer.partition(b"\r\n\r\n")
        problem = json.loads(body)
        assert b"content-type: application/problem+json" in head.lower()
        assert int(head.split()[1]) == problem["status"]
        assert (problem["status"], problem["code"]) in (
            (400, "malformed-request"),
            (403, "foreign-site"),
            (405, "method-not-allowed"),
        )
    assert client.get("/livez").status_code == 200


def test_malformed_chunk_is_rejected(service: Service) -> None:
    """A malformed chunk gets one response, and subsequent bytes are not interpreted as a request."""
    start = f"POST /v1/jobs HTTP/1.1\nContent-Type: multipart/form-data; boundary={BOUNDARY}"
    with connect(service) as connection:
        connection.sendall(lines(start + "\nTransfer-Encoding: chunked\nExpect: 100-continue"))
        assert b" 100 " in connection.recv(100)  # the app is reading
        connection.sendall(b"5\r\n--b0u\r\nnonsense\r\n" + lines("GET /livez HTTP/1.1"))
        answer = closed(connection)
    assert answer.count(b"HTTP/1.1") == 1
    assert answer.startswith(b"HTTP/1.1 400 Bad Request\r\n")
    assert json.loads(answer.partition(b"\r\n\r\n")[2])["code"] == "malformed-request"


def test_too_large_head_is_rejected(service: Service) -> None:
    # Not a byte more than the service reads: a reset would discard its answer.
    for headers in (b"X: " + b"y" * MAX_HEAD_BYTES, b"X: y\r\n" * (MAX_HEADERS + 1)):
        with connect(service) as connection:
            connection.sendall(lines("GET /v1/jobs HTTP/1.1")[:-2] + headers)
            answer = closed(connection)
        assert answer.startswith(b"HTTP/1.1 431 Request Header Fields Too Large\r\n")
        assert json.loads(answer.partition(b"\r\n\r\n")[2])["code"] == "head-too-large"


def send_on(connection: socket.socket, more: bytes, most: int = 60 * MB) -> int:
    """Send the same bytes repeatedly until the service closes or `most` bytes are sent; return the number of bytes."""
    sent = 0
    with contextlib.suppress(OSError):
        while sent < most:
            connection.sendall(more)
            sent += len(more)
    return sent


TRAILERS = {
    "many": (b"0\r\n", b"X: y\r\n" * 100_000),
    "one": (b"0\r\nX: ", b"y" * 600_000),
    "of a chunk": (b"1;x=", b"y" * 600_000),
}


@pytest.mark.parametrize(("start", "more"), TRAILERS.values(), ids=TRAILERS)
@pytest.mark.parametrize("path", ["/livez", "/v1/session"])
def test_endless_trailers_are_rejected(service: Service, path: str, start: bytes, more: bytes) -> None:
    head = lines(f"POST {path} HTTP/1.1\nContent-Type: application/json\nTransfer-Encoding: chunked")
    with connect(service) as connection:
        connection.sendall(head + start)
        assert send_on(connection, more) < 60 * MB, "it was all taken in"


def test_trailers_are_not_headers(service: Service, client: httpx2.Client) -> None:
    """Trailers do not become headers, not even of the next request on the connection."""
    where = begin(client, 5)
    head = f"PATCH {where} HTTP/1.1\nTus-Resumable: 1.0.0\nUpload-Offset: 0\nContent-Type: {OFFSET_STREAM}"
    with connect(service) as connection:
        body = b"5\r\n12345\r\n0\r\nUpload-Checksum: sha256 AAAA\r\nHost: evil.example\r\n\r\n"
        connection.sendall(lines(head + "\nTransfer-Encoding: chunked") + body)
        assert connection.recv(65536).startswith(b"HTTP/1.1 204 ")
        connection.sendall(lines("GET /v1/jobs HTTP/1.1\nConnection: close"))
        assert closed(connection).startswith(b"HTTP/1.1 200 ")
    assert client.get(where).json()["complete"]


def test_pipelined_requests_are_bounded(service: Service) -> None:
    with connect(service) as connection:
        assert send_on(connection, lines("GET /livez HTTP/1.1") * 10_000) < 60 * MB, "it was all taken in"
    with connect(service) as connection:
        connection.sendall(lines("GET /livez HTTP/1.1") * 2 + lines("GET /livez HTTP/1.1\nConnection: close"))
        assert closed(connection).count(b"HTTP/1.1 200 OK") == 3


def test_unread_body_must_end(service: Service) -> None:
    """The response is sent before the body arrives. Single bytes at intervals do not keep the connection open."""
    for rest in (b"", b"x"):
        with connect(service) as connection:
            connection.sendall(lines("POST /livez HTTP/1.1\nContent-Length: 1000000"))
            connection.settimeout(0.3)
            deadline, answered = time.monotonic() + 60, b""
            while True:
                assert time.monotonic() < deadline, "it is still listened to"
                try:
                    connection.sendall(rest)
                    piece = connection.recv(65536)
                    answered += piece
                    if not piece:
                        break
                except TimeoutError:
                    continue
                except OSError:
                    break
            assert answered.startswith(b"HTTP/1.1 405 ")
            assert answered.count(b"HTTP/1.1") == 1, "it is answered twice"


def test_unread_responses_take_little_memory_and_end(service: Service, done: str) -> None:
    """Clients that request a large file and read nothing are disconnected; `unharmed` limits the memory."""
    with contextlib.ExitStack() as stack:
        unread = [stack.enter_context(connect(service)) for _ in range(60)]
        for connection in unread:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            connection.sendall(lines(f"GET /v1/jobs/{done}/artifacts/colors.f16 HTTP/1.1"))
        process = api_of(service)
        for connection in unread:
            with contextlib.suppress(ConnectionResetError):  # the first ones may be closed already
                connection.recv(1)
        wait_for(lambda: len(process.net_connections("tcp")) < 10, "unread connections to be closed")
        assert len(closed(unread[0])) < LARGE


def test_quoted_cookies_take_linear_time(service: Service) -> None:
    """Python's parser of quoted cookies takes quadratic time: about half a minute for 110 kB."""
    with connect(service) as connection:
        for name in ("other", SESSION_COOKIE):
            connection.sendall(b'GET /v1/session HTTP/1.1\r\nHost: 127.0.0.1\r\nCookie: %s="' % name.encode())
            connection.sendall(b'\\"' * 55_000 + b'"\r\n\r\n')
            assert select.select([connection], [], [], 15)[0]
            assert answer_on(connection)[0].startswith(b"HTTP/1.1 200 ")


def test_session_cookie_is_found_among_others(service: Service, client: httpx2.Client) -> None:
    cookies = 'theme=dark; sgsst_session=unknown; quoted="a\\073b"'
    answer = client.delete("/v1/session", headers={"Cookie": cookies, "Origin": "https://example.com"})
    assert (answer.status_code, answer.json()["code"]) == (403, "cross-origin"), "it counts as a session"
    assert client.delete("/v1/session", headers={"Cookie": "theme=dark"}).status_code == 204


def test_late_end_of_body_preserves_connection(service: Service) -> None:
    with connect(service) as connection:
        connection.sendall(lines("POST /livez HTTP/1.1\nContent-Length: 5"))
        head, _ = answer_on(connection)
        assert head.startswith(b"HTTP/1.1 405 ")
        connection.sendall(b"12345" + lines("GET /livez HTTP/1.1\nConnection: close"))
        assert closed(connection).startswith(b"HTTP/1.1 200 OK")


def test_too_long_json_is_rejected_immediately(service: Service) -> None:
    """A JSON body with too large a declared length is not read at all; an undeclared one is read up to the limit."""
    kind = "Content-Type: application/json"
    for path, size in (("/v1/session", 256_000), ("/v1/session", 4097), ("/v1/jobs", 2 * MB)):
        with connect(service) as connection:
            connection.sendall(lines(f"POST {path} HTTP/1.1\n{kind}\nContent-Length: {size}"))
            answer = connection.recv(65536)
        assert answer.startswith(b"HTTP/1.1 413 ")
    with connect(service) as connection:
        connection.sendall(lines(f"POST /v1/session HTTP/1.1\n{kind}\nTransfer-Encoding: chunked"))
        connection.sendall(b"2000\r\n" + b"x" * 0x2000)  # 8 kB of an unfinished chunk
        assert connection.recv(65536).startswith(b"HTTP/1.1 413 ")


def is_busy(connection: socket.socket) -> bool:
    """Return whether the response on a connection starts with status 503; it is not taken from the connection."""
    connection.setblocking(False)
    try:
        return connection.recv(12, socket.MSG_PEEK) == b"HTTP/1.1 503"
    except OSError:
        return False


def test_concurrent_bodies_share_memory_budget(service: Service, client: httpx2.Client) -> None:
    """Large bodies are refused while too many are arriving; small ones are accepted."""
    large = json.dumps({"scene": "x" * (MB - 1000), "style": "x"}).encode()
    head = lines(f"POST /v1/jobs HTTP/1.1\nContent-Type: application/json\nContent-Length: {len(large)}")
    with contextlib.ExitStack() as stack:
        held = [stack.enter_context(connect(service)) for _ in range(80)]
        for connection in held:
            connection.setblocking(False)
            with contextlib.suppress(OSError):
                connection.send(head)
        left = dict.fromkeys(held, large[:-1])  # no body is complete
        while left:
            _, ready, _ = select.select([], list(left), [], 1.0)
            if not ready:
                break
            for connection in ready:
                try:
                    left[connection] = left[connection][connection.send(left[connection]) :]
                except OSError:
                    left[connection] = b""
                if not left[connection]:
                    del left[connection]
        head, answer = answer_on(wait_for(lambda: next(filter(is_busy, held), None), "a large body to be refused"))
        refused(post(client, b'{"scene": "x", "style": "x"}', "application/json"), 422, "unknown-upload")
    assert head.startswith(b"HTTP/1.1 503 ")
    assert b"retry-after: 5" in head.lower()
    assert json.loads(answer)["code"] == "busy"
    wait_for(lambda: post(client, large, "application/json").status_code == 422, "room for a large body")


def test_connections_beyond_system_limit_are_rejected(tmp_path: Path) -> None:
    """Connections beyond the limit are answered with 503 or closed, and existing ones keep working."""
    running = Service(tmp_path / "data", alone=True)
    running._command = ["sh", "-c", 'ulimit -n 200 && exec "$@"', "sh", *running._command]
    limits = httpx2.Limits(keepalive_expiry=None)
    with running, httpx2.Client(base_url=running.url, timeout=60, limits=limits) as client:
        assert client.get("/livez").status_code == 200
        with contextlib.ExitStack() as stack:
            held = [stack.enter_context(connect(running)) for _ in range(400)]
            wait_for(lambda: len(select.select(held, [], [], 0)[0]) >= 250, "the others to be answered", running.said)
            assert client.get("/v1/jobs").status_code == 200
            answers = []
            for connection in select.select(held, [], [], 0)[0]:
                with contextlib.suppress(ConnectionResetError):
                    answers.append(connection.recv(65536))
            assert any(answer.startswith(b"HTTP/1.1 503 ") for answer in answers)
            assert all(answer.startswith(b"HTTP/1.1 503 ") or not answer for answer in answers)
        wait_for(running.ready, "room for a connection", running.said)
        assert "Traceback" not in running.log.read_text()


def test_open_files_beyond_system_limit_are_reported(tmp_path: Path) -> None:
    """Concurrent uploads for which no file descriptor is left get 503 with Retry-After."""
    running = Service(tmp_path / "data", alone=True)
    running._command = ["sh", "-c", 'ulimit -n 200 && exec "$@"', "sh", *running._command]
    head = f"POST /v1/jobs HTTP/1.1\nContent-Type: multipart/form-data; boundary={BOUNDARY}\nContent-Length: 1000000"
    body = part(FILE.format("style"), bytes(200_000))
    with running, contextlib.ExitStack() as stack:
        held = [stack.enter_context(connect(running)) for _ in range(140)]
        wait_for(running.ready, "a later connection, so that all of these are accepted")
        for connection in held:
            connection.sendall(lines(head) + body[:-2])
        answered = wait_for(lambda: select.select(held, [], [], 0)[0], "an upload to be refused", running.said)
        answer, rest = answer_on(answered[0])
        assert answer.startswith(b"HTTP/1.1 503 ")
        assert b"retry-after" in answer.lower()
        assert json.loads(rest)["code"] == "too-many-connections"
        stack.close()
        wait_for(running.ready, "room for a connection", running.said)


@pytest.mark.parametrize("second", ["127.0.0.1", "evil.example"])
def test_two_host_headers_are_rejected(service: Service, second: str) -> None:
    for hosts in (f"Host: 127.0.0.1\nHost: {second}", f"Host: {second}\nhost: 127.0.0.1"):
        head, body = exchange(service, f"GET /v1/jobs HTTP/1.1\n{hosts}\nConnection: close")
        assert head.startswith(b"HTTP/1.1 400 ")
        assert json.loads(body)["code"] == "malformed-request"


#: Names that a page's author can point at this machine, and texts that are not a host.
FOREIGN = [
    "127.evil.example",
    "127.0.0.1.evil.example",
    "127.0.0.1.nip.io",
    "localhost.evil.example",
    "evil.example",
    "127",
    "127.1",
    "127.0.0.1.",
    "localhost.",
    "127.0.0.1@evil.example",
    "evil.example@127.0.0.1",
    "127.0.0.1:80@evil.example",
    "127.0.0.1/evil.example",
    "[::1].evil.example",
    "[::1]evil",
    "[::2]",
    "::1",
    "[evil.example]",
    "128.0.0.1",
    "0.0.0.0",
    "127.0.0.256",
    "127.0.0.01",
    "0x7f.0.0.1",
]
OWN = [
    "127.0.0.1",
    "127.0.0.1:9",
    "127.8.9.10",
    "localhost",
    "LocalHost:80",
    "[::1]",
    "[::1]:8000",
    "[0:0:0:0:0:0:0:1]",
]


def test_foreign_host_headers_are_rejected(client: httpx2.Client) -> None:
    for host in [*FOREIGN, ""]:
        refused(client.get("/v1/jobs", headers={"Host": host}), 403, "foreign-site")
    for host in OWN:
        assert client.get("/v1/jobs", headers={"Host": host}).status_code == 200, host


def test_service_on_address_like_name_requires_keys() -> None:
    for host in ("127.evil.example", "127.0.0.1.evil.example", "0.0.0.0", "::", "localhost.evil.example"):
        assert ServiceSettings(host=host).keys_required
    for host in ("127.0.0.1", "127.8.9.10", "::1", "localhost"):
        assert not ServiceSettings(host=host).keys_required


def test_paths_cannot_inject_log_lines(service: Service, client: httpx2.Client) -> None:
    before = service.log.stat().st_size
    for text in ("\n12:00:00 error   forged", "\r\nforged", "\u2028forged", "\x1b[2Jforged", "a status=200 forged"):
        assert client.get(f"/v1/{quote(text, safe='')}").status_code == 404

    def logged() -> list[str]:
        return [line for line in service.log.read_bytes()[before:].decode().split("\n") if "forged" in line]

    lines = wait_for(lambda: logged() if len(logged()) == 5 else None, "the requests in the log")
    for line in lines:
        assert line.isprintable()
        pattern = r'\S+ info {4}request  method=GET path="/v1/[^"]*forged" status=404 seconds=\S+ request_id=\S+'
        assert re.fullmatch(pattern, line)


def test_hostile_requests_leave_no_files(service: Service, client: httpx2.Client, store: Store) -> None:
    """This test runs last: the service is still ready, and a database row refers to each stored file."""
    assert client.get("/readyz").status_code == 200
    metrics = client.get("/metrics").text
    assert not re.findall(r'sgsst_requests_total\{[^}]*status="(?!503)5\d\d"\} [1-9]', metrics)
    known = store.inputs.locations()
    files = {f"{path.parent.name}/{path.name}" for path in (service.data / "blobs").glob("*/*")}
    assert files == known

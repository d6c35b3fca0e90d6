"""Tests of spherical harmonics: the basis, the clamp and its gradient, and coefficients that are read on demand."""

import math
import os
import pickle
import subprocess
import sys
import textwrap
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor

from sgsst_core.constants import SH_C0
from sgsst_core.errors import SceneError
from sgsst_core.files import scene_file, stylized_ply
from sgsst_core.files.formats import scene_format
from sgsst_core.files.scene_file import read_scene, write_scene
from sgsst_core.files.stylized_ply import write_stylized
from sgsst_core.scene import spherical_harmonics, stored_harmonics
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import (
    basis,
    harmonics_energy,
    kernel_rest_colors,
    reference_rest_colors,
    rest_colors,
    view_colors,
    view_colors_gradient,
)
from sgsst_core.scene.stored_harmonics import StoredHarmonics, held
from tests.sgsst_core.files.formats.samples import rewritten
from tests.sgsst_core.splat_scenes import camera, cloud, displaced, rotated_pose


def sphere(polar: int = 64, around: int = 128) -> tuple[Tensor, Tensor]:
    """Return directions and weights of a quadrature on the sphere that is exact for products of basis functions."""
    step = 2 * math.pi / around
    x, w = (torch.from_numpy(part) for part in np.polynomial.legendre.leggauss(polar))
    angle = torch.arange(around, dtype=torch.float64) * step
    ring = (1 - x * x).sqrt()
    directions = torch.stack(
        [
            (ring[:, None] * angle.cos()).flatten(),
            (ring[:, None] * angle.sin()).flatten(),
            x[:, None].expand(-1, around).flatten(),
        ],
        dim=-1,
    )
    return directions, (w[:, None] * step).expand(-1, around).flatten()


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("chunk", [7, 1 << 17])
def test_harmonics_energy_is_that_over_all_directions(degree: int, chunk: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(spherical_harmonics, "_CHUNK", chunk)
    scene = cloud(20, degree=degree)
    weights = torch.rand(20, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    weights[:3] = 0
    directions, quadrature = sphere()
    colors = SH_C0 * scene.sh_dc.double() - (weights @ (SH_C0 * scene.sh_dc.double())) / weights.sum()
    rest = basis(directions, degree) @ held(scene.sh_rest).double().permute(1, 0, 2).reshape(-1, 60)
    squares = (quadrature @ rest.square() / (4 * math.pi)).reshape(20, 3).sum(dim=1)
    energy, variance = weights @ squares, weights @ colors.square().sum(dim=1)
    assert harmonics_energy(scene, weights) == pytest.approx(float(energy / (energy + variance)), rel=1e-9)


def test_harmonics_energy_has_no_division_by_zero() -> None:
    scene, weights = cloud(5, degree=1), torch.ones(5, dtype=torch.float64)
    same = replace(scene, sh_dc=torch.full_like(scene.sh_dc, 0.5))
    assert harmonics_energy(same, weights) == 1
    assert harmonics_energy(replace(same, sh_rest=torch.zeros_like(held(same.sh_rest))), weights) == 0
    huge = replace(scene, sh_rest=torch.full_like(held(scene.sh_rest), 1e30))
    assert harmonics_energy(huge, weights) == 1


def test_basis_has_signs_and_order_of_3dgs_files() -> None:
    # Computed by hand at (x, y, z) = (2, 3, 6) / 7 with the tabulated constants of the real harmonics.
    x, y, z = 2 / 7, 3 / 7, 6 / 7
    expected = [
        -0.48860251190292 * y,
        0.48860251190292 * z,
        -0.48860251190292 * x,
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2 * z * z - x * x - y * y),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (x * x - y * y),
        -0.5900435899266435 * y * (3 * x * x - y * y),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
        0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
        -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
        1.445305721320277 * z * (x * x - y * y),
        -0.5900435899266435 * x * (x * x - 3 * y * y),
    ]
    actual = basis(torch.tensor([x, y, z], dtype=torch.float64), 3)
    assert torch.allclose(actual, torch.tensor(expected, dtype=torch.float64), atol=1e-14)


def at_the_center() -> tuple[Scene, Camera]:
    """Return Gaussians at the camera's center, and at distances whose squares underflow or overflow."""
    scene = cloud(5, degree=3)
    means = torch.tensor([[0.0, 0, 0], [1e-38, 0, 0], [1e38, 1e38, 0], [0, 1e-45, -1e-45], [0, 0, -2.0]])
    return replace(scene, means=means), camera()


def huge_coefficients() -> tuple[Scene, Camera]:
    """Return Gaussians with huge SH coefficients, some of which cancel each other."""
    scene = cloud(300, degree=3)
    sizes = torch.logspace(0, 36, 300)[:, None, None]
    return replace(scene, sh_rest=held(scene.sh_rest) * sizes), camera(pose=rotated_pose())


KERNEL_CASES: dict[str, Callable[[], tuple[Scene, Camera]]] = {
    "ordinary": lambda: (cloud(300, degree=3), camera(pose=rotated_pose())),
    "camera far from the origin": lambda: displaced(
        cloud(300, degree=3), camera(pose=rotated_pose()), torch.tensor([1e6, -2e6, 1.5e6])
    ),
    "a Gaussian at the center": at_the_center,
    "huge coefficients": huge_coefficients,
    "no Gaussian": lambda: (cloud(0, degree=3), camera()),
}


@pytest.mark.parametrize("degree", [1, 2, 3])
@pytest.mark.parametrize("name", KERNEL_CASES)
def test_kernel_agrees_with_float64_reference(name: str, degree: int) -> None:
    """Files have this degree, or higher bands that are not used."""
    pytest.importorskip("triton")
    scene, view = KERNEL_CASES[name]()
    whole = held(scene.sh_rest)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    count = (degree + 1) ** 2 - 1
    exact = reference_rest_colors(whole.double(), scene.means, view, degree)
    sizes = whole[:, :count].abs().double().sum(1)
    for sh_rest in (whole, whole[:, :count]):
        actual = kernel_rest_colors(sh_rest.to(device), scene.means.to(device), view, degree)
        assert actual.dtype == torch.float32
        assert bool(((actual.cpu().double() - exact).abs() <= 1e-6 * sizes).all())


@pytest.mark.parametrize("degree", [1, 2, 3])
@pytest.mark.parametrize("name", KERNEL_CASES)
def test_cpu_sums_are_float64_rounded_once(name: str, degree: int) -> None:
    scene, view = KERNEL_CASES[name]()
    whole = held(scene.sh_rest)
    count = (degree + 1) ** 2 - 1
    exact = reference_rest_colors(whole.double(), scene.means, view, degree)
    sizes = whole[:, :count].abs().double().sum(1)
    actual = rest_colors(whole[:, :count], scene.means, view)
    assert actual.dtype == torch.float32
    assert bool(((actual.double() - exact).abs() <= 2**-24 * exact.abs() + 1e-14 * sizes).all())


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA GPU that PyTorch can use")
def test_gpu_colors_come_from_the_kernel() -> None:
    scene, view = cloud(300, degree=3), camera(pose=rotated_pose())
    sh_rest, means = held(scene.sh_rest).cuda(), scene.means.cuda()
    colors_on_gpu = rest_colors(sh_rest, means, view)
    assert torch.equal(colors_on_gpu, kernel_rest_colors(sh_rest, means, view, 3))
    assert torch.allclose(colors_on_gpu.cpu(), rest_colors(scene.sh_rest, scene.means, view), atol=1e-5)


def test_colors_are_clamped_and_gradient_is_zero_below_the_clamp() -> None:
    generator = torch.Generator().manual_seed(0)
    sh_dc = 3 * torch.randn(40, 3, generator=generator, dtype=torch.float64)
    rest = torch.randn(40, 3, generator=generator, dtype=torch.float64)
    sh_dc.requires_grad_()
    colors = view_colors(sh_dc, rest)
    assert float(colors.detach().min()) == 0
    assert float(colors.detach().max()) > 1
    assert torch.autograd.gradcheck(lambda dc: view_colors(dc, rest), (sh_dc,))
    gradient = torch.randn(40, 3, generator=generator, dtype=torch.float64)
    (expected,) = torch.autograd.grad(colors, sh_dc, gradient)
    assert torch.allclose(view_colors_gradient(gradient, colors.detach()), expected, atol=1e-15)


def test_clamp_aware_gradient_only_raises_clamped_colors() -> None:
    """At a color clamped to 0, a gradient passes if it would raise the color, not if it would lower it."""
    colors = torch.tensor([[0.0, 0.0, 0.5], [0.0, 0.2, 0.0]])
    gradient = torch.tensor([[-1.0, 1.0, 2.0], [0.0, -3.0, -4.0]])
    result = view_colors_gradient(gradient, colors, clamp_aware_gradient=True)
    torch.testing.assert_close(result, SH_C0 * torch.tensor([[-1.0, 0.0, 2.0], [0.0, -3.0, -4.0]]))


def test_wrong_number_of_coefficients_is_refused() -> None:
    scene, view = cloud(5, degree=1), camera()
    with pytest.raises(ValueError, match="coefficients per Gaussian, not 4"):
        rest_colors(torch.zeros(5, 4, 3), scene.means, view)
    with pytest.raises(ValueError, match="degree 4"):
        basis(torch.zeros(1, 3), 4)


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reduce the block size, so that small scenes have many blocks, including incomplete ones."""
    monkeypatch.setattr(stored_harmonics, "BLOCK_BYTES", 2000)
    monkeypatch.setattr(scene_file, "READ_BYTES", 3000)
    for module in (scene_format, stylized_ply):
        monkeypatch.setattr(module, "BLOCK_ROWS", 17)


def both(path: Path, *, drop: bool = False) -> tuple[Scene, Scene]:
    """Read a scene file twice: with SH coefficients left in the file, and with SH coefficients in memory."""
    stored = read_scene(path, drop_invalid=drop, held_bytes=0).scene
    plain = read_scene(path, drop_invalid=drop).scene
    assert isinstance(stored.sh_rest, StoredHarmonics)
    assert isinstance(plain.sh_rest, Tensor)
    return stored, plain


def written(folder: Path, count: int = 100, degree: int = 3) -> Path:
    write_scene(folder / "scene.ply", cloud(count, degree=degree))
    return folder / "scene.ply"


def extend(path: Path, comment: bytes, extra: tuple[str, ...], position: int, elements: bytes) -> None:
    """Write another file of the same scene, with a comment, extra properties or additional leading elements."""
    raw = path.read_bytes()
    head, _, body = raw.partition(b"end_header\n")
    old = np.frombuffer(body, [(line.split()[-1].decode(), "<f4") for line in head.splitlines() if b"property" in line])
    columns = [(name, "<f4") for name in old.dtype.names or ()]
    columns[position:position] = [(f"extra_{i}", kind) for i, kind in enumerate(extra)]
    rows = np.zeros(len(old), columns)
    for name in old.dtype.names or ():
        rows[name] = old[name]
    kinds = {"<f4": "float", "<f8": "double", "u1": "uchar", "<u2": "ushort"}
    lines = [f"property {kinds[kind]} {name}".encode() for name, kind in columns]
    front = [b"element front 3", b"property uchar v"] if elements else []
    top = [b"ply", b"format binary_little_endian 1.0", b"comment " + comment, *front]
    top += [f"element vertex {len(rows)}".encode(), *lines, b"end_header", b""]
    path.write_bytes(b"\n".join(top) + elements + rows.tobytes() + b"behind")


@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    count=st.integers(1, 60),
    degree=st.integers(1, 3),
    comment=st.binary(max_size=7).map(lambda text: text.replace(b"\n", b" ").replace(b"\r", b" ")),
    extra=st.sampled_from([(), ("<f4",), ("<f8",), ("u1", "u1", "<u2")]),
    position=st.integers(0, 9),
    elements=st.sampled_from([b"", b"\x01\x02\x03"]),
    mask=st.integers(0, 2**60 - 1),
)
def test_stored_harmonics_of_any_layout_equal_those_in_memory(
    tmp_path_factory: pytest.TempPathFactory,
    count: int,
    degree: int,
    comment: bytes,
    extra: tuple[str, ...],
    position: int,
    elements: bytes,
    mask: int,
) -> None:
    path = written(tmp_path_factory.mktemp("stored"), count, degree)
    extend(path, comment, extra, position, elements)
    stored, plain = both(path)
    view = camera(pose=rotated_pose())
    for name in ("means", "quats", "scales", "opacities", "sh_dc"):
        assert torch.equal(getattr(stored, name), getattr(plain, name))
    assert torch.equal(held(stored.sh_rest), held(plain.sh_rest))
    assert torch.equal(*(rest_colors(scene.sh_rest, scene.means, view) for scene in (stored, plain)))
    rows = torch.tensor([bool(mask >> i & 1) for i in range(count)])
    some = [scene.subset(rows) for scene in (stored, plain)]
    assert isinstance(some[0].sh_rest, StoredHarmonics)
    assert torch.equal(held(some[0].sh_rest), held(some[1].sh_rest))
    assert torch.equal(*(rest_colors(scene.sh_rest, scene.means, view) for scene in some))
    every_second = torch.arange(0, int(rows.sum()), 2)
    assert torch.equal(*(held(scene.subset(every_second).sh_rest) for scene in some))
    jumbled = torch.arange(count).flip(0).repeat(2)
    assert torch.equal(*(held(scene.subset(jumbled).sh_rest) for scene in (stored, plain)))


@pytest.mark.parametrize(
    ("form", "kinds"),
    [("big", {}), ("text", {}), ("little", {"f_rest_4": "f8"}), ("mixed up", {}), ("little", {"odd": "u1"})],
)
def test_unsupported_layouts_are_read_into_memory(tmp_path: Path, form: str, kinds: dict[str, str]) -> None:
    path = written(tmp_path, 5)
    expected, odd = held(read_scene(path).scene.sh_rest), {"odd": 7} if "odd" in kinds else {}
    other = rewritten(path, "other.ply", lambda name: kinds.get(name, "f4"), form=form, **odd)
    scene = read_scene(other, held_bytes=0).scene
    assert isinstance(scene.sh_rest, Tensor)
    assert torch.equal(scene.sh_rest, expected)


@pytest.mark.parametrize(("last", "degree"), [(None, 0), (0, 1), (2, 1), (3, 2), (7, 2), (8, 3)])
def test_zero_bands_are_removed_without_a_copy(tmp_path: Path, last: int | None, degree: int) -> None:
    scene = cloud(100, degree=3)
    values = torch.zeros(100, 15, 3)
    if last is not None:
        values[61, last, 2] = -1e-30
    write_scene(tmp_path / "scene.ply", replace(scene, sh_rest=values))
    for loaded in both(tmp_path / "scene.ply"):
        less = loaded.without_zero_bands()
        assert (loaded.used_degree(), less.sh_degree) == (degree, degree)
        assert type(less.sh_rest) is type(loaded.sh_rest)
        assert torch.equal(held(less.sh_rest), values[:, : (degree + 1) ** 2 - 1])
        without = torch.ones(100, dtype=torch.bool)
        without[61] = False
        assert loaded.used_degree(without) == 0


def test_invalid_gaussians_are_dropped_and_counted(tmp_path: Path) -> None:
    scene = cloud(100, degree=2)
    values = held(scene.sh_rest).clone()
    values[3, 1, 2], values[70, 0, 0] = torch.nan, torch.inf  # f_rest_17 and f_rest_0
    scene.opacities[70] = torch.nan
    write_scene(tmp_path / "scene.ply", replace(scene, sh_rest=values))
    messages = []
    for held_bytes in (0, 1 << 28):
        with pytest.raises(SceneError) as caught:
            read_scene(tmp_path / "scene.ply", held_bytes=held_bytes)
        messages.append(str(caught.value))
    assert messages[0] == messages[1]
    assert "2 of 100" in messages[0]
    assert "opacity (1 NaN), f_rest_0 (1 infinite), f_rest_17 (1 NaN)" in messages[0]
    stored, plain = both(tmp_path / "scene.ply", drop=True)
    assert len(stored) == 98
    assert torch.equal(held(stored.sh_rest), held(plain.sh_rest))
    source = read_scene(tmp_path / "scene.ply", drop_invalid=True, held_bytes=0)
    write_stylized(source, tmp_path / "out.ply", stored.sh_dc + 1)
    again = read_scene(tmp_path / "out.ply").scene
    assert torch.equal(held(again.sh_rest), held(plain.sh_rest))
    assert torch.equal(again.sh_dc, stored.sh_dc + 1)


def overwrite(path: Path, data: bytes) -> None:
    path.write_bytes(data[:-4] + bytes(4))
    os.utime(path, ns=(0, 0))  # file systems may update times late


@pytest.mark.parametrize(
    "change",
    [
        lambda path, data: os.truncate(path, len(data) // 2),
        lambda path, data: path.write_bytes(b""),
        overwrite,
        lambda path, data: path.write_bytes(data + b"\0"),
    ],
    ids=["shortened", "emptied", "overwritten", "longer"],
)
def test_changed_file_raises_an_error_instead_of_a_signal(
    tmp_path: Path, change: Callable[[Path, bytes], object]
) -> None:
    path = written(tmp_path)
    scene = both(path)[0]
    change(path, path.read_bytes())
    with pytest.raises(SceneError, match="was changed after it was read"):
        rest_colors(scene.sh_rest, scene.means, camera())


def test_replaced_or_deleted_file_stays_readable(tmp_path: Path) -> None:
    path = written(tmp_path)
    stored, plain = both(path)
    (tmp_path / "other.ply").write_bytes(b"ply")
    (tmp_path / "other.ply").replace(path)
    path.unlink()
    assert torch.equal(held(stored.sh_rest), held(plain.sh_rest))


def test_other_process_opens_the_same_file_or_raises(tmp_path: Path) -> None:
    path = written(tmp_path)
    stored, plain = both(path)
    assert isinstance(stored.sh_rest, StoredHarmonics)
    some = stored.sh_rest[torch.arange(0, 100, 3)]
    packed = pickle.dumps(some)
    assert torch.equal(held(pickle.loads(packed)), held(plain.sh_rest)[::3])
    path.write_bytes(b"ply")
    with pytest.raises(SceneError, match="was changed after it was read"):
        pickle.loads(packed)


_PEAK = textwrap.dedent("""
    import sys
    from pathlib import Path
    import torch
    from sgsst_core.files.scene_file import read_scene
    from sgsst_core.files.stylized_ply import write_stylized
    from sgsst_core.scene.spherical_harmonics import rest_colors
    from tests.sgsst_core.splat_scenes import camera

    def anonymous(what):
        lines = Path("/proc/self/status").read_text().splitlines()
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(what))

    folder, path = Path(sys.argv[1]), Path(sys.argv[1]) / "large.ply"
    small = read_scene(folder / "scene.ply", held_bytes=0).scene  # everything is imported and compiled
    rest_colors(small.sh_rest, small.means, camera())
    before = anonymous("RssAnon")
    file = read_scene(path, held_bytes=0)
    seen = torch.arange(len(file.scene)) % 10 > 0
    shown = file.scene.subset(seen).without_zero_bands()
    colors = rest_colors(shown.sh_rest, shown.means, camera())
    Path("/proc/self/clear_refs").write_text("5")  # the peak counts from here
    write_stylized(file, folder / "out.ply", file.scene.sh_dc + 1)
    print((anonymous("RssAnon") - before) // len(file.scene), (anonymous("VmHWM") - anonymous("VmRSS")))
""")


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="memory is looked for in Linux's /proc")
def test_neither_harmonics_nor_result_are_in_memory(tmp_path: Path) -> None:
    """A Gaussian takes 56 bytes, in the subset again, plus 12 for its color and 4 for its row; SH would take 180."""
    write_scene(tmp_path / "scene.ply", cloud(10, degree=3))
    count, one = 300_000, cloud(3000, degree=3)
    write_scene(tmp_path / "large.ply", one.subset(torch.arange(3000).repeat(count // 3000)))
    run = [sys.executable, "-c", _PEAK, str(tmp_path)]
    output = subprocess.run(
        run, capture_output=True, text=True, check=True, cwd=Path(scene_file.__file__).parents[2]
    ).stdout
    held_bytes, writing = map(int, output.split())
    assert held_bytes < 236  # a scene in memory without its subset
    assert writing < 40 << 20  # one block of rows plus the comparison of its colors; the file has 74 MB

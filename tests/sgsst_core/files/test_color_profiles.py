"""Tests that colors are converted to sRGB by an image's ICC profile, and that unusable profiles are ignored."""

from __future__ import annotations

import shutil
import struct
import subprocess
import warnings
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image, ImageCms

from sgsst_core.files.color_profiles import MAX_PROFILE_BYTES, ColorProfile
from sgsst_core.files.images import ImageWarning, load_image
from sgsst_core.files.photos import check_photos, find_masks, load_photo
from sgsst_core.scene.camera import Camera
from tests.icc_profiles import (
    ADOBE_RGB,
    D65,
    DISPLAY_P3,
    PROPHOTO,
    SRGB,
    cmyk_profile,
    gray_profile,
    rgb_profile,
    with_float_steps,
)

BUILT_IN_SRGB = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()


def colors(channels: int = 3) -> np.ndarray:
    """Return an image [24, 36, channels] uint8 of random colors."""
    return np.random.default_rng(0).integers(0, 256, (24, 36, channels), dtype="u1")


def save(path: Path, pixels: np.ndarray | Image.Image, profile: bytes, mode: str | None = None, **options: Any) -> Path:
    image = pixels if isinstance(pixels, Image.Image) else Image.fromarray(pixels, mode)
    image.save(path, icc_profile=profile, **options)
    return path


def srgb_of(linear_xyz: np.ndarray) -> np.ndarray:
    """Return sRGB values in 0..1 of XYZ values relative to D65 (IEC 61966-2-1)."""
    matrix = [
        [3.2404542, -1.5371385, -0.4985314],
        [-0.9692660, 1.8760108, 0.0415560],
        [0.0556434, -0.2040259, 1.0572252],
    ]
    linear = np.clip(linear_xyz @ np.array(matrix).T, 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def test_adobe_rgb_becomes_srgb(tmp_path: Path) -> None:
    stored = colors()
    image = load_image(save(tmp_path / "a.png", stored, rgb_profile(*ADOBE_RGB)))
    # From the specification of Adobe RGB (1998), section 4.3.5.3.
    matrix = [[0.57667, 0.18556, 0.18823], [0.29734, 0.62736, 0.07529], [0.02703, 0.07069, 0.99134]]
    expected = srgb_of((stored / 255.0) ** 2.19921875 @ np.array(matrix).T)
    assert np.abs(image.numpy() - expected).max() < 1.5 / 255
    assert np.abs(image.numpy() - stored / 255.0).max() > 0.1


@pytest.mark.parametrize(
    "profile", [b"", rgb_profile(*SRGB), BUILT_IN_SRGB, gray_profile(0.0)], ids=["no", "own", "built-in", "gray"]
)
def test_images_without_a_profile_or_in_srgb_are_bit_identical(tmp_path: Path, profile: bytes) -> None:
    stored = colors()[:, :, 0] if profile == gray_profile(0.0) else colors()
    image = load_image(save(tmp_path / "a.png", stored, profile))
    expected = torch.from_numpy(stored.reshape(24, 36, -1)).float() / 255
    assert torch.equal(image, expected.expand(24, 36, 3))


def chunked(path: Path, chunks: dict[bytes, bytes], profile: bytes = b"") -> Path:
    """Write the image of `colors` as a PNG with color chunks."""
    data = save(path, colors(), profile).read_bytes()
    body = b"".join(
        struct.pack(">I", len(value)) + kind + value + struct.pack(">I", zlib.crc32(kind + value))
        for kind, value in chunks.items()
    )
    path.write_bytes(data[:33] + body + data[33:])  # after the header
    return path


def chrm(red: tuple, green: tuple, blue: tuple, white: tuple, _gamma: float) -> bytes:
    return struct.pack(">8I", *(round(1e5 * value) for point in (white, red, green, blue) for value in point))


P3, ADOBE, SRGB_CHUNK = {b"cICP": bytes((12, 13, 0, 1))}, {b"cHRM": chrm(*ADOBE_RGB)}, {b"sRGB": b"\0"}
LINEAR, ROUNDED = {b"gAMA": struct.pack(">I", 100_000)}, {b"gAMA": struct.pack(">I", 45455)}


@pytest.mark.parametrize(
    ("chunks", "profile", "same_as"),
    [
        (ADOBE | ROUNDED, b"", rgb_profile(*ADOBE_RGB)),
        (ADOBE, b"", rgb_profile(*ADOBE_RGB[:4], 0.0)),
        (LINEAR, b"", rgb_profile(*SRGB[:4], 1.0)),
        ({b"cICP": bytes((9, 8, 0, 1))}, b"", rgb_profile((0.708, 0.292), (0.17, 0.797), (0.131, 0.046), D65, 1.0)),
        (P3 | SRGB_CHUNK | LINEAR, b"", rgb_profile(*DISPLAY_P3)),
        (P3, rgb_profile(*PROPHOTO), rgb_profile(*DISPLAY_P3)),
        (SRGB_CHUNK | LINEAR, rgb_profile(*PROPHOTO), rgb_profile(*PROPHOTO)),
        (SRGB_CHUNK | LINEAR | ADOBE, b"", b""),
        (ROUNDED, b"", b""),  # how many programs state sRGB
        (ROUNDED | {b"cHRM": chrm(*SRGB)}, b"", b""),
    ],
)
def test_color_chunks_of_a_png_count_by_their_precedence(
    tmp_path: Path, chunks: dict[bytes, bytes], profile: bytes, same_as: bytes
) -> None:
    image = load_image(chunked(tmp_path / "a.png", chunks, profile))
    expected = load_image(save(tmp_path / "b.png", colors(), same_as))
    assert float((image - expected).abs().max()) <= (2.1 / 255 if same_as else 0)


@pytest.mark.parametrize(
    "chunks",
    [
        {b"cICP": bytes((9, 16, 0, 1))},
        {b"cICP": b"\1"},
        {b"gAMA": bytes(4)},
        {b"gAMA": b"\0\0\0\1"},
        {b"gAMA": b"\1"},
        {b"cHRM": bytes(32)},
        {b"cHRM": struct.pack(">8I", *[33333] * 8)},
        {b"cHRM": struct.pack(">8I", *range(2**32 - 8, 2**32))},
    ],
)
def test_color_chunks_that_cannot_be_converted_give_a_warning(tmp_path: Path, chunks: dict[bytes, bytes]) -> None:
    with pytest.warns(ImageWarning, match="taken for sRGB, because their (cICP|gAMA or cHRM) chunk"):
        image = load_image(chunked(tmp_path / "a.png", chunks))
    assert torch.equal(image, torch.from_numpy(colors()).float() / 255)


def test_gray_of_8_and_16_bits_is_converted_equally(tmp_path: Path) -> None:
    profile = gray_profile(1.8)
    steps = np.arange(256, dtype="u1")[None]
    narrow = load_image(save(tmp_path / "a.png", steps, profile))
    linear = (steps / 255.0) ** (round(1.8 * 256) / 256)
    expected = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    assert np.abs(narrow.numpy()[:, :, 1] - expected).max() <= 1 / 255
    wide = (np.arange(65536, dtype="u2")).reshape(256, 256)
    image = load_image(save(tmp_path / "b.png", wide, profile))
    assert torch.allclose(image.reshape(-1, 3)[::257], narrow[0], atol=1e-6)
    assert len(image[:, :, 0].unique()) > 30_000


def test_rgb_profile_applies_to_gray_pixels(tmp_path: Path) -> None:
    steps = np.arange(256, dtype="u1")[None]
    gray = load_image(save(tmp_path / "a.png", steps, rgb_profile(*PROPHOTO)))
    same = load_image(save(tmp_path / "b.png", np.repeat(steps[:, :, None], 3, axis=2), rgb_profile(*PROPHOTO)))
    assert torch.equal(gray, same)


def test_transparent_and_palette_images_are_converted_before_compositing(tmp_path: Path) -> None:
    profile = rgb_profile(*DISPLAY_P3)
    opaque = load_image(save(tmp_path / "a.png", colors(), profile))
    rgba = np.dstack([colors(), np.full((24, 36), 255, "u1")])
    rgba[:12, :, 3] = 0
    image = load_image(save(tmp_path / "b.png", rgba, profile), background=(0.0, 1.0, 0.0))
    assert torch.equal(image[12:], opaque[12:])
    assert torch.equal(image[:12], torch.tensor([0.0, 1.0, 0.0]).expand(12, 36, 3))
    palette = Image.fromarray(colors()).quantize(16)
    pixels = load_image(save(tmp_path / "c.png", palette, profile))
    assert torch.equal(pixels, load_image(save(tmp_path / "d.png", palette.convert("RGB"), profile)))


def camera(name: str) -> Camera:
    return Camera(name, 36, 24, 40.0, 40.0, 18.0, 12.0, torch.eye(4, dtype=torch.float64))


def test_heic_images_are_read_with_their_profile(tmp_path: Path) -> None:
    heif = pytest.importorskip("pillow_heif", reason="the extra `heif` is not installed")
    heif.register_heif_opener()
    pixels = np.full((24, 36, 3), (200, 60, 30), np.uint8)
    path = save(tmp_path / "a.heic", pixels, rgb_profile(*DISPLAY_P3), format="HEIF", quality=100)
    expected = load_image(save(tmp_path / "a.png", pixels, rgb_profile(*DISPLAY_P3)))
    torch.testing.assert_close(load_image(path), expected, rtol=0, atol=2.5 / 255)


def test_photos_are_converted_and_masks_are_not(tmp_path: Path) -> None:
    path = save(tmp_path / "a.png", colors(), rgb_profile(*ADOBE_RGB))
    view = camera("a")
    photo, mask = check_photos(tmp_path, [view])[0], find_masks(tmp_path, [view])[0]
    assert photo is not None
    assert mask is not None
    assert torch.equal(load_photo(photo, view), load_image(path))
    assert torch.equal(load_photo(mask, view, color_managed=False), torch.from_numpy(colors()).float() / 255)


BROKEN: dict[str, tuple[bytes, str]] = {
    "noise": (b"no profile", "is broken"),
    "truncated": (rgb_profile(*ADOBE_RGB)[:200], "is broken|lacks"),
    "no curves": (rgb_profile(*ADOBE_RGB).replace(b"TRC", b"XXX"), "lacks what a conversion to sRGB needs"),
    "for other images": (cmyk_profile(), "is for CMYK colors"),
    "too large": (rgb_profile(*ADOBE_RGB) + bytes(MAX_PROFILE_BYTES), "has more than 4 MiB"),
}


@pytest.mark.parametrize("length", [3 << 19, MAX_PROFILE_BYTES - 10_000])
def test_long_profiles_of_a_png_are_used(tmp_path: Path, length: int) -> None:
    """Pillow itself refuses more than 1 MiB."""
    profile = rgb_profile(*ADOBE_RGB)
    expected = load_image(save(tmp_path / "a.tif", colors(), profile))
    long = profile + np.random.default_rng(2).bytes(length)
    assert torch.equal(load_image(save(tmp_path / "a.png", colors(), long)), expected)


@pytest.mark.parametrize("suffix", ["tif", "png"])
@pytest.mark.parametrize("name", BROKEN)
def test_unusable_profiles_are_ignored_with_a_warning(tmp_path: Path, name: str, suffix: str) -> None:
    profile, reason = BROKEN[name]
    path = save(tmp_path / f"a.{suffix}", colors(), profile)
    with pytest.warns(ImageWarning, match=rf"a\.{suffix}: its color profile is ignored, because it {reason}"):
        image = load_image(path)
    assert torch.equal(image, torch.from_numpy(colors()).float() / 255)
    messages: list[str] = []
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_image(path, warn=messages.append)
    assert len(messages) == 1


def test_floating_point_conversions_are_not_used() -> None:
    """The number of their steps is unlimited, so that a small profile could take hours."""
    image = Image.fromarray(colors())
    plain = ColorProfile(BUILT_IN_SRGB, "RGB")
    for steps in (1, 2, 20_000):
        profile = ColorProfile(with_float_steps(BUILT_IN_SRGB, steps), "RGB")
        assert not profile.changes
        assert profile.to_srgb(image).tobytes() == plain.to_srgb(image).tobytes()


def test_profiles_with_random_damage_are_used_or_refused() -> None:
    random = np.random.default_rng(0)
    image = Image.fromarray(colors())
    outcomes: set[object] = set()
    for original, mode in (
        (rgb_profile(*DISPLAY_P3), "RGB"),
        (rgb_profile(*ADOBE_RGB), "RGB"),
        (cmyk_profile(5), "CMYK"),
    ):
        for _ in range(150):
            data = bytearray(original)
            for position in random.integers(0, min(len(data), 700), 4):
                data[position] = random.integers(256)
            try:
                converted = ColorProfile(bytes(data), mode).to_srgb(image)
                outcomes.add((converted.mode, converted.size))
            except ValueError:
                outcomes.add("refused")
    assert outcomes == {("RGB", (36, 24)), "refused"}


def wide_png(path: Path, pixels: np.ndarray, profile: bytes) -> Path:
    """Write an RGB image of 16 bits, which Pillow cannot write."""
    height, width = pixels.shape[:2]
    rows = np.concatenate([np.zeros((height, 1), "u1"), pixels.astype(">u2").view("u1").reshape(height, -1)], axis=1)
    chunks = [
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 16, 2, 0, 0, 0)),
        (b"iCCP", b"test\0\0" + zlib.compress(profile)),
        (b"IDAT", zlib.compress(rows.tobytes())),
        (b"IEND", b""),
    ]
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + b"".join(
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
            for kind, data in chunks
        )
    )
    return path


#: Ten files as painters, phones, cameras, scanners and printers write them.
FILES: dict[str, Callable[[Path], Path]] = {
    "adobe.png": lambda path: save(path, colors(), rgb_profile(*ADOBE_RGB)),
    "adobe.jpg": lambda path: save(path, colors(), rgb_profile(*ADOBE_RGB), quality=95, subsampling=0),
    "p3.png": lambda path: save(path, colors(), rgb_profile(*DISPLAY_P3)),
    "p3.webp": lambda path: save(path, colors(), rgb_profile(*DISPLAY_P3), lossless=True),
    "prophoto.tif": lambda path: save(path, colors(), rgb_profile(*PROPHOTO)),
    "wide.png": lambda path: wide_png(path, colors().astype("u2") * 257, rgb_profile(*ADOBE_RGB)),
    "gray.png": lambda path: save(path, colors()[:, :, 0], gray_profile(2.2)),
    "gray16.png": lambda path: save(path, colors()[:, :, 0].astype("u2") * 257, gray_profile(1.8)),
    "inks.tif": lambda path: save(path, colors(4), cmyk_profile(), "CMYK"),
    "inks.jpg": lambda path: save(path, colors(4), cmyk_profile(), "CMYK", quality=95, subsampling=0),
    "clear.png": lambda path: save(path, colors(4), rgb_profile(*DISPLAY_P3)),
    "palette.png": lambda path: save(path, Image.fromarray(colors()).quantize(16), rgb_profile(*ADOBE_RGB)),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", FILES)
def test_colors_match_imagemagick(tmp_path: Path, name: str) -> None:
    program = shutil.which("convert-im6.q16") or shutil.which("magick")
    if program is None:
        pytest.skip("ImageMagick is not installed: apt-get install imagemagick")
    path = FILES[name](tmp_path / name)
    (tmp_path / "srgb.icc").write_bytes(BUILT_IN_SRGB)
    command = [program, str(path), "-profile", str(tmp_path / "srgb.icc"), "-background", "white", "-flatten"]
    command += ["-type", "TrueColor", "-depth", "16", "-endian", "LSB", "RGB:-"]
    output = subprocess.run(command, check=True, capture_output=True, timeout=60).stdout
    expected = np.frombuffer(output, "<u2").reshape(24, 36, 3) / 65535
    assert np.abs(load_image(path).numpy() - expected).max() <= 1 / 255

"""Tests of images and their color profiles, and of photos: found by name, and read as their cameras see them."""

import io
import os
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

from sgsst_core.errors import ImageError, OutputError
from sgsst_core.files.images import (
    FORMATS,
    MAX_JPEG_SCANS,
    MAX_PIXELS,
    MAX_PNG_TEXTS,
    MAX_PROFILE_BYTES,
    ColorProfile,
    ImageWarning,
    Photo,
    check_photos,
    find_masks,
    image_size,
    load_image,
    load_photo,
    save_jpg,
    save_png,
    stored_size,
)
from sgsst_core.scene.camera import Camera, resized
from sgsst_core.scene.colors import downscale
from tests.icc_profiles import (
    ADOBE_RGB,
    DISPLAY_P3,
    PROPHOTO,
    SRGB,
    cmyk_profile,
    gray_profile,
    rgb_profile,
    with_float_steps,
)
from tests.pngs import chunk, png
from tests.small_scenes import LFS_POINTER


def gradient(height: int = 6, width: int = 9) -> np.ndarray:
    """Return an image [height, width, 3] uint8 with all pixels different."""
    values = np.arange(height * width)
    return np.stack([values * 3 % 256, values * 5 % 256, 255 - values], axis=1).reshape(height, width, 3).astype("u1")


def save(path: Path, image: Image.Image, **options: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    image.save(path, **options)
    return path


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation_is_applied(tmp_path: Path, orientation: int) -> None:
    exif = Image.Exif()
    exif[0x0112] = orientation
    stored = gradient()
    path = save(tmp_path / "a.png", Image.fromarray(stored), exif=exif)
    # Visual edges of the stored first row and column, from TIFF 6.0, tag Orientation.
    shown = {
        1: stored,
        2: stored[:, ::-1],
        3: stored[::-1, ::-1],
        4: stored[::-1],
        5: stored.transpose(1, 0, 2),
        6: np.rot90(stored, -1),
        7: stored[::-1, ::-1].transpose(1, 0, 2),
        8: np.rot90(stored),
    }[orientation]
    image = load_image(path)
    assert torch.equal(image, torch.from_numpy(shown.copy()).float() / 255)
    assert image_size(path) == (image.shape[1], image.shape[0])
    scan = save(tmp_path / "a.tif", Image.fromarray(stored), exif=exif)
    assert torch.equal(load_image(scan), image)
    assert image_size(scan) == image_size(path)


def with_chunks(path: Path, *chunks: tuple[bytes, bytes], behind: bool = False) -> Path:
    """Insert chunks of a PNG after its header, or behind its pixels."""
    data = path.read_bytes()
    added = b"".join(chunk(*each) for each in chunks)
    at = len(data) - 12 if behind else 33
    path.write_bytes(data[:at] + added + data[at:])
    return path


def exif_chunk(orientation: int) -> tuple[bytes, bytes]:
    exif = Image.Exif()
    exif[0x0112] = orientation
    return b"eXIf", exif.tobytes().removeprefix(b"Exif\0\0")


@pytest.mark.parametrize("kind", ["eXIf", "iTXt", "compressed"])
def test_orientation_of_a_png_is_read_from_its_header(tmp_path: Path, kind: str) -> None:
    """The XMP data are longer than 1 MiB, the limit of Pillow for compressed ones."""
    xmp = b'<x tiff:Orientation="6"/>' + b" " * (3 << 19)
    orientation = {
        "eXIf": exif_chunk(6),
        "iTXt": (b"iTXt", b"XML:com.adobe.xmp\0\0\0\0\0" + xmp),
        "compressed": (b"iTXt", b"XML:com.adobe.xmp\0\1\0\0\0" + zlib.compress(xmp)),
    }[kind]
    path = with_chunks(save(tmp_path / "a.png", Image.fromarray(gradient())), orientation)
    with_chunks(path, exif_chunk(3), behind=True)  # what follows the pixels is not used
    assert stored_size(path) == ((9, 6), 6)
    assert image_size(path) == (6, 9)
    assert torch.equal(load_image(path), torch.from_numpy(np.rot90(gradient(), -1).copy()).float() / 255)
    assert torch.equal(load_image(path, oriented=False), torch.from_numpy(gradient()).float() / 255)


def test_long_texts_are_skipped_and_text_bombs_refused(tmp_path: Path) -> None:
    noise = np.random.default_rng(1).integers(1, 255, 3 << 20, np.uint8).tobytes()
    texts = [
        (b"tEXt", b"Comment\0" + noise),
        (b"zTXt", b"Comment\0\0" + zlib.compress(noise)),
        (b"iTXt", b"Comment\0\1\0\0\0" + zlib.compress(noise)),
        (b"zTXt", b"broken\0\0" + noise[:9]),
        (b"zTXt", b""),
    ]
    path = with_chunks(save(tmp_path / "a.png", Image.fromarray(gradient())), *texts)
    assert torch.equal(load_image(path), torch.from_numpy(gradient()).float() / 255)
    many = save(tmp_path / "b.png", Image.fromarray(gradient()))
    with_chunks(with_chunks(many, *texts[3:4] * MAX_PNG_TEXTS), texts[3], behind=True)
    with_chunks(path, (b"zTXt", b"XML:com.adobe.xmp\0\0" + zlib.compress(bytes(17 << 20))))
    for read in (load_image, image_size):
        with pytest.raises(ImageError, match=r"b\.png: is a PNG of more than 64 compressed texts"):
            read(many)
        with pytest.raises(ImageError, match=r"a\.png: is truncated or corrupt \(Decompressed data too large"):
            read(path)


@pytest.mark.parametrize("stop", range(8, 140, 7))
def test_truncated_pngs_with_metadata_are_refused(tmp_path: Path, stop: int) -> None:
    path = with_chunks(save(tmp_path / "a.png", Image.fromarray(gradient(40, 40))), exif_chunk(3))
    path.write_bytes(path.read_bytes()[:stop])
    with pytest.raises(ImageError):
        load_image(path)


def test_pointers_of_git_lfs_are_named(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_text(LFS_POINTER)
    for read in (load_image, image_size):
        with pytest.raises(ImageError, match=r"a\.png: is a pointer of Git LFS, not the file itself\. Run `git lfs"):
            read(path)


def test_transparency_is_composited_on_white(tmp_path: Path) -> None:
    rgba = np.dstack([gradient(), np.arange(54).reshape(6, 9).astype("u1") * 4])
    image = load_image(save(tmp_path / "a.png", Image.fromarray(rgba)))
    alpha = rgba[:, :, 3:] / 255.0
    expected = rgba[:, :, :3] / 255.0 * alpha + 1 - alpha
    assert np.abs(image.numpy() - expected).max() <= 1 / 255
    gray = load_image(save(tmp_path / "b.png", Image.fromarray(rgba).convert("LA")))
    assert torch.equal(gray[0, 0], torch.ones(3))


def test_palettes_with_and_without_transparency_are_read(tmp_path: Path) -> None:
    palette = Image.fromarray(gradient()).quantize(8)
    expected = torch.from_numpy(np.asarray(palette.convert("RGB")).copy()).float() / 255
    assert torch.equal(load_image(save(tmp_path / "a.png", palette)), expected)
    index = int(np.asarray(palette)[2, 3])
    image = load_image(save(tmp_path / "b.png", palette, transparency=index))
    clear = torch.from_numpy(np.asarray(palette) == index)
    assert torch.equal(image[clear], torch.ones_like(image[clear]))
    assert torch.equal(image[~clear], expected[~clear])


def test_gray_of_8_16_and_32_bits_is_read(tmp_path: Path) -> None:
    wide = (np.arange(54).reshape(6, 9) * 1200).astype("u2")
    expected = torch.from_numpy(wide.astype("f4") / 65535)[:, :, None].expand(6, 9, 3)
    assert torch.equal(load_image(save(tmp_path / "a.png", Image.fromarray(wide))), expected)
    assert torch.equal(load_image(save(tmp_path / "a.tif", Image.fromarray(wide))), expected)
    assert torch.equal(load_image(save(tmp_path / "b.tif", Image.fromarray(wide.astype("i4")))), expected)
    floats = Image.fromarray((wide / 65535).astype("f4"))
    assert torch.allclose(load_image(save(tmp_path / "c.tif", floats)), expected, atol=1e-6)
    narrow = (wide >> 8).astype("u1")
    image = load_image(save(tmp_path / "d.png", Image.fromarray(narrow)))
    assert torch.equal(image[:, :, 1], torch.from_numpy(narrow).float() / 255)
    one = load_image(save(tmp_path / "e.png", Image.fromarray(narrow > 100)))
    assert torch.equal(one[:, :, 2], torch.from_numpy(narrow > 100).float())


def test_overshoot_of_float_pixels_is_clipped(tmp_path: Path) -> None:
    for values, expected in (([0.5, 1.0001], [0.5, 1]), ([0.5, 2.0], [0.5, 1]), ([51.0, 2.5], [1, 2.5 / 51])):
        image = load_image(save(tmp_path / "a.tif", Image.fromarray(np.array([values], dtype="f4"))))
        assert image[0, :, 0].tolist() == pytest.approx(expected)


def test_transparent_16_bit_gray_is_composited(tmp_path: Path) -> None:
    values = np.array([[1000, 2000]], dtype="u2")
    image = load_image(save(tmp_path / "a.png", Image.fromarray(values), transparency=1000))
    assert (image[0, 0].tolist(), image[0, 1].tolist()) == ([1, 1, 1], pytest.approx([2000 / 65535] * 3))


def test_non_finite_float_pixels_are_refused(tmp_path: Path) -> None:
    path = save(tmp_path / "a.tif", Image.fromarray(np.array([[0.5, np.nan]], dtype="f4")))
    with pytest.raises(ImageError, match="NaN or infinite pixels"):
        load_image(path)


def test_cmyk_becomes_rgb(tmp_path: Path) -> None:
    cmyk = Image.new("CMYK", (8, 8), (255, 0, 0, 0))
    image = load_image(save(tmp_path / "a.tif", cmyk))
    assert image[3, 3].tolist() == pytest.approx([0, 1, 1], abs=0.02)


def test_first_frame_of_an_animation_is_read(tmp_path: Path) -> None:
    frames = [Image.new("RGB", (5, 4), color) for color in ("red", "blue")]
    for name in ("a.gif", "a.png", "a.webp"):
        path = save(tmp_path / name, frames[0], save_all=True, append_images=frames[1:], duration=100)
        assert load_image(path)[0, 0].tolist() == pytest.approx([1, 0, 0], abs=0.02)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("size", [(20_000, 9_000), (100_000, 100_000), (MAX_PIXELS + 1, 1)])
def test_decompression_bombs_are_refused_from_their_header(tmp_path: Path, size: tuple[int, int]) -> None:
    path = tmp_path / "bomb.png"
    path.write_bytes(png(*size, chunk(b"IDAT", zlib.compress(b""))))
    for read in (load_image, image_size):
        with pytest.raises(ImageError, match=r"bomb\.png: has more than 178 megapixels"):
            read(path)


@pytest.mark.filterwarnings("error")
def test_large_images_are_accepted(tmp_path: Path) -> None:
    path = tmp_path / "large.png"
    path.write_bytes(png(16_000, 10_000, chunk(b"IDAT", zlib.compress(b""))))
    assert image_size(path) == (16_000, 10_000)


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.gif", "a.webp", "a.tif", "a.bmp"])
def test_truncated_images_are_refused(tmp_path: Path, name: str) -> None:
    path = save(tmp_path / name, Image.fromarray(np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype="u1")))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(ImageError, match=rf"{name}: is (truncated|not an image)"):
        load_image(path)


def with_scans(path: Path, count: int) -> Path:
    """Write a progressive JPEG whose last scan is repeated."""
    file = io.BytesIO()
    Image.new("L", (64, 64), 128).save(file, "JPEG", progressive=True)
    data = file.getvalue()
    path.write_bytes(data[:-2] + data[data.rindex(b"\xff\xda") : -2] * (count - data.count(b"\xff\xda")) + data[-2:])
    return path


def test_progressive_jpegs_of_many_scans_are_refused(tmp_path: Path) -> None:
    assert load_image(with_scans(tmp_path / "some.jpg", MAX_JPEG_SCANS)).shape == (64, 64, 3)
    with pytest.raises(ImageError, match=r"many\.jpg: is a progressive JPEG of more than 100 scans"):
        load_image(with_scans(tmp_path / "many.jpg", MAX_JPEG_SCANS + 1))


def test_scans_of_thumbnails_and_trailing_data_are_ignored(tmp_path: Path) -> None:
    path = with_scans(tmp_path / "a.jpg", 50)
    scan = b"\xff\xda\x00\x02"
    thumbnail = b"\xff\xe5" + (2 + 2000 * len(scan)).to_bytes(2, "big") + scan * 2000
    path.write_bytes(path.read_bytes()[:2] + thumbnail + path.read_bytes()[2:] + scan * 2000)
    assert load_image(path).shape == (64, 64, 3)


@pytest.mark.parametrize("format_", ["PPM", "TGA", "JPEG2000", "PCX", "EPS", "ICO"])
def test_formats_with_unbounded_decoding_time_are_refused(tmp_path: Path, format_: str) -> None:
    path = tmp_path / "style.png"
    Image.new("RGB", (32, 32)).save(path, format_)
    with pytest.raises(ImageError, match=r"style\.png: is not an image that can be read\. Give a PNG or JPEG"):
        load_image(path)


@pytest.mark.parametrize("format_", FORMATS)
def test_formats_are_read(tmp_path: Path, format_: str) -> None:
    path = tmp_path / "style"
    Image.new("RGB", (32, 32), "red").save(path, format_)
    assert load_image(path)[16, 16, 0] > 0.9


def test_files_that_are_not_images_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "notes.jpg"
    for data in (b"", b"hello", b"ply\nformat ascii 1.0\n"):
        path.write_bytes(data)
        with pytest.raises(ImageError, match=r"notes\.jpg: is not an image"):
            load_image(path)
    for other, message in ((tmp_path / "a", "No such file"), (tmp_path, "Is a"), (path / "a", "Not a directory")):
        with pytest.raises(ImageError, match=message):
            load_image(other)


def test_png_is_clamped_rounded_and_exact(tmp_path: Path) -> None:
    image = torch.from_numpy(gradient()).float() / 255
    save_png(tmp_path / "a.png", image)
    assert torch.equal(load_image(tmp_path / "a.png"), image)
    save_png(tmp_path / "b.png", torch.tensor([[[-1.0, 0.5, 7.0]]]))
    assert (load_image(tmp_path / "b.png") * 255).tolist() == [[[0, 128, 255]]]
    assert sorted(os.listdir(tmp_path)) == ["a.png", "b.png"]


def test_invalid_images_are_not_written(tmp_path: Path) -> None:
    for wrong in (torch.zeros(3, 4), torch.zeros(4, 4, 1), torch.full((2, 2, 3), torch.nan)):
        with pytest.raises(ValueError, match=r"\[H, W, 3\] without NaN"):
            save_png(tmp_path / "a.png", wrong)
    with pytest.raises(OutputError):
        save_jpg(tmp_path / "missing" / "a.jpg", torch.zeros(2, 2, 3))
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("mode", ["RGB", "L", "P", "RGBA", "I;16", "CMYK"])
def test_large_images_are_reduced_before_they_are_floats(tmp_path: Path, mode: str) -> None:
    """Squares of pixels are averaged; an image that is small enough is read as it is."""
    values = (np.add.outer(np.arange(60), 2 * np.arange(80)) + 10).astype(np.uint8)
    gray = Image.fromarray(values)
    image = Image.fromarray(values.astype(np.uint16) * 257) if mode == "I;16" else gray.convert("RGB").convert(mode)
    path = tmp_path / ("a.tif" if mode == "CMYK" else "a.png")
    image.save(path)
    whole = load_image(path, color_managed=False)
    assert torch.equal(load_image(path, color_managed=False, max_pixels=80 * 60), whole)
    small = load_image(path, color_managed=False, max_pixels=80 * 60 - 1)
    assert small.shape == (30, 40, 3)
    assert (small - downscale(whole, 1)).abs().max() <= (4 if mode == "P" else 1.01) / 255


def test_large_jpegs_are_decoded_at_a_lower_resolution(tmp_path: Path) -> None:
    Image.linear_gradient("L").convert("RGB").save(tmp_path / "a.jpg", quality=95)
    small = load_image(tmp_path / "a.jpg", max_pixels=64 * 64)
    assert small.shape == (64, 64, 3)
    assert (small - downscale(load_image(tmp_path / "a.jpg"), 2)).abs().max() < 0.02


BUILT_IN_SRGB = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()


def colors(channels: int = 3) -> np.ndarray:
    """Return an image [24, 36, channels] uint8 of random colors."""
    return np.random.default_rng(0).integers(0, 256, (24, 36, channels), dtype="u1")


def saved_with_profile(
    path: Path, pixels: np.ndarray | Image.Image, profile: bytes, mode: str | None = None, **options: Any
) -> Path:
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
    image = load_image(saved_with_profile(tmp_path / "a.png", stored, rgb_profile(*ADOBE_RGB)))
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
    image = load_image(saved_with_profile(tmp_path / "a.png", stored, profile))
    expected = torch.from_numpy(stored.reshape(24, 36, -1)).float() / 255
    assert torch.equal(image, expected.expand(24, 36, 3))


@pytest.mark.parametrize(
    ("chunks", "warned"),
    [
        ({b"gAMA": struct.pack(">I", 45455)}, False),  # how many programs state sRGB
        ({b"gAMA": struct.pack(">I", 100_000)}, True),
        ({b"gAMA": struct.pack(">I", 100_000), b"sRGB": b"\0"}, False),
        ({b"cHRM": struct.pack(">8I", 31270, 32900, 64000, 33000, 30000, 60000, 15000, 6000)}, False),
        ({b"cHRM": struct.pack(">8I", 31270, 32900, 64000, 33000, 21000, 71000, 15000, 6000)}, True),
        ({b"cHRM": bytes(32)}, True),
    ],
)
def test_color_chunks_of_a_png_give_a_warning_unless_they_state_srgb(
    tmp_path: Path, chunks: dict[bytes, bytes], warned: bool
) -> None:
    notes: list[str] = []
    path = with_chunks(saved_with_profile(tmp_path / "a.png", colors(), b""), *chunks.items())
    image = load_image(path, warn=notes.append)
    assert torch.equal(image, torch.from_numpy(colors()).float() / 255)
    assert ["state another space" in note for note in notes] == [True] * warned


def test_gray_of_8_and_16_bits_is_converted_equally(tmp_path: Path) -> None:
    profile = gray_profile(1.8)
    steps = np.arange(256, dtype="u1")[None]
    narrow = load_image(saved_with_profile(tmp_path / "a.png", steps, profile))
    linear = (steps / 255.0) ** (round(1.8 * 256) / 256)
    expected = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    assert np.abs(narrow.numpy()[:, :, 1] - expected).max() <= 1 / 255
    wide = (np.arange(65536, dtype="u2")).reshape(256, 256)
    image = load_image(saved_with_profile(tmp_path / "b.png", wide, profile))
    assert torch.equal(image.reshape(-1, 3)[::257], narrow[0])


def test_transparent_and_palette_images_are_converted_before_compositing(tmp_path: Path) -> None:
    profile = rgb_profile(*DISPLAY_P3)
    opaque = load_image(saved_with_profile(tmp_path / "a.png", colors(), profile))
    rgba = np.dstack([colors(), np.full((24, 36), 255, "u1")])
    rgba[:12, :, 3] = 0
    image = load_image(saved_with_profile(tmp_path / "b.png", rgba, profile), background=(0.0, 1.0, 0.0))
    assert torch.equal(image[12:], opaque[12:])
    assert torch.equal(image[:12], torch.tensor([0.0, 1.0, 0.0]).expand(12, 36, 3))
    palette = Image.fromarray(colors()).quantize(16)
    pixels = load_image(saved_with_profile(tmp_path / "c.png", palette, profile))
    assert torch.equal(pixels, load_image(saved_with_profile(tmp_path / "d.png", palette.convert("RGB"), profile)))


def test_heic_images_are_read_with_their_profile(tmp_path: Path) -> None:
    heif = pytest.importorskip("pillow_heif", reason="the extra `heif` is not installed")
    heif.register_heif_opener()
    pixels = np.full((24, 36, 3), (200, 60, 30), np.uint8)
    path = saved_with_profile(tmp_path / "a.heic", pixels, rgb_profile(*DISPLAY_P3), format="HEIF", quality=100)
    expected = load_image(saved_with_profile(tmp_path / "a.png", pixels, rgb_profile(*DISPLAY_P3)))
    torch.testing.assert_close(load_image(path), expected, rtol=0, atol=2.5 / 255)


def test_photos_are_converted_and_masks_are_not(tmp_path: Path) -> None:
    path = saved_with_profile(tmp_path / "a.png", colors(), rgb_profile(*ADOBE_RGB))
    view = camera("a", 36, 24)
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
    expected = load_image(saved_with_profile(tmp_path / "a.tif", colors(), profile))
    long = profile + np.random.default_rng(2).bytes(length)
    assert torch.equal(load_image(saved_with_profile(tmp_path / "a.png", colors(), long)), expected)


@pytest.mark.parametrize("suffix", ["tif", "png"])
@pytest.mark.parametrize("name", BROKEN)
def test_unusable_profiles_are_ignored_with_a_warning(tmp_path: Path, name: str, suffix: str) -> None:
    profile, reason = BROKEN[name]
    path = saved_with_profile(tmp_path / f"a.{suffix}", colors(), profile)
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
    profiled = chunk(b"iCCP", b"test\0\0" + zlib.compress(profile))
    path.write_bytes(png(width, height, profiled, chunk(b"IDAT", zlib.compress(rows.tobytes())), bits=16))
    return path


#: Ten files as painters, phones, cameras, scanners and printers write them.
FILES: dict[str, Callable[[Path], Path]] = {
    "adobe.png": lambda path: saved_with_profile(path, colors(), rgb_profile(*ADOBE_RGB)),
    "adobe.jpg": lambda path: saved_with_profile(path, colors(), rgb_profile(*ADOBE_RGB), quality=95, subsampling=0),
    "p3.png": lambda path: saved_with_profile(path, colors(), rgb_profile(*DISPLAY_P3)),
    "p3.webp": lambda path: saved_with_profile(path, colors(), rgb_profile(*DISPLAY_P3), lossless=True),
    "prophoto.tif": lambda path: saved_with_profile(path, colors(), rgb_profile(*PROPHOTO)),
    "wide.png": lambda path: wide_png(path, colors().astype("u2") * 257, rgb_profile(*ADOBE_RGB)),
    "gray.png": lambda path: saved_with_profile(path, colors()[:, :, 0], gray_profile(2.2)),
    "gray16.png": lambda path: saved_with_profile(path, colors()[:, :, 0].astype("u2") * 257, gray_profile(1.8)),
    "inks.tif": lambda path: saved_with_profile(path, colors(4), cmyk_profile(), "CMYK"),
    "inks.jpg": lambda path: saved_with_profile(path, colors(4), cmyk_profile(), "CMYK", quality=95, subsampling=0),
    "clear.png": lambda path: saved_with_profile(path, colors(4), rgb_profile(*DISPLAY_P3)),
    "palette.png": lambda path: saved_with_profile(
        path, Image.fromarray(colors()).quantize(16), rgb_profile(*ADOBE_RGB)
    ),
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


def camera(name: str, width: int = 90, height: int = 60) -> Camera:
    return Camera(name, width, height, 100.0, 100.0, width / 2, height / 2, torch.eye(4, dtype=torch.float64))


def paths(matches: list[Photo | None]) -> list[Path]:
    assert all(matches)
    return [photo.path for photo in matches if photo]


@pytest.mark.parametrize(
    ("file", "name"),
    [
        ("0001.jpg", "0001.jpg"),
        ("0001.jpg", "0001"),
        ("0001.JPG", "0001"),
        ("0001.png", "0001.jpg"),
        ("0001.jpg", "images/0001.jpg"),
        ("0001.jpg", "../images/0001"),
        ("0001.jpg", "images\\0001.jpg"),
        ("sub/0001.jpg", "0001.jpg"),
        ("frame.0001.jpg", "frame.0001"),
        ("frame.0001.jpg", "frame.0001.jpg"),
        ("IMG_1.JPG", "img_1.jpg"),
        ("Cam0/a.jpg", "cam0/A"),
        ("u\u0308.jpg", "\u00fc.jpg"),
        ("\u00fc.jpg", "u\u0308.jpg"),
    ],
)
def test_photos_are_matched_by_name(tmp_path: Path, file: str, name: str) -> None:
    save(tmp_path / "other.jpg", Image.new("RGB", (90, 60)))
    path = save(tmp_path / file, Image.new("RGB", (180, 120)))
    assert paths(check_photos(tmp_path, [camera(name)])) == [path]


def test_rig_photos_are_matched_by_folder_and_extension(tmp_path: Path) -> None:
    for name in ("cam0/a.png", "cam1/a.png", "cam1/a.jpg", "b.png", "old/b.png"):
        save(tmp_path / name, Image.new("RGB", (90, 60)))
    names = ["cam1/a.png", "images/cam0/a", "cam1/a.jpg", "b.png"]
    matched = paths(check_photos(tmp_path, [camera(name) for name in names]))
    assert [str(path.relative_to(tmp_path)) for path in matched] == ["cam1/a.png", "cam0/a.png", "cam1/a.jpg", "b.png"]
    several = r"more than one photo for 2 of 3 views: a, cam1/a \(such as cam0/a.png and cam1/a.jpg\)"
    with pytest.raises(ImageError, match=several):
        check_photos(tmp_path, [camera("a"), camera("b"), camera("cam1/a")])


@pytest.mark.parametrize(
    ("file", "name"),
    [
        ("a.jpg.png", "a.jpg"),
        ("a.jpg.png", "a"),
        ("a.jpg.mask.png", "images/a.jpg"),
        ("a.mask.png", "a.jpg"),
        ("cam1/a.jpg.png", "images/cam1/a.jpg"),
        ("a.v2.png", "a.v2.jpg"),
    ],
)
def test_masks_are_found_by_the_conventions_of_colmap_and_realityscan(tmp_path: Path, file: str, name: str) -> None:
    save(tmp_path / "cam0" / "other.jpg.png", Image.new("RGB", (90, 60)))
    path = save(tmp_path / file, Image.new("RGB", (90, 60)))
    assert paths(find_masks(tmp_path, [camera(name)])) == [path]
    if path.stem != "a.v2":
        with pytest.raises(ImageError, match="no photo"):
            check_photos(tmp_path, [camera(name)])


def test_masks_named_as_their_cameras_come_first(tmp_path: Path) -> None:
    for name in ("a.png", "a.jpg.png", "b.jpg.png", "b.png.png"):
        save(tmp_path / name, Image.new("RGB", (90, 60)))
    masks = find_masks(tmp_path, [camera(name) for name in ("a.jpg", "b.jpg", "b.png")])
    assert [path.name for path in paths(masks)] == ["a.png", "b.jpg.png", "b.png.png"]


def test_case_of_a_name_counts_if_files_differ_by_it(tmp_path: Path) -> None:
    for name in ("IMG.png", "Img.png", "b.png"):
        save(tmp_path / name, Image.new("RGB", (90, 60)))
    matches = check_photos(tmp_path, [camera("IMG"), camera("img"), camera("B")])
    assert [photo and photo.path.name for photo in matches] == ["IMG.png", None, "b.png"]


def test_missing_photos_are_named(tmp_path: Path) -> None:
    save(tmp_path / "v03.png", Image.new("RGB", (90, 60)))
    cameras = [camera(f"v{i:02d}") for i in range(15)]
    with pytest.raises(ImageError, match=r"no photo for 14 of 15 views: v00, v01, v02, v04, .*v10, \.\.\."):
        check_photos(tmp_path, cameras)
    matches = check_photos(tmp_path, [cameras[0], cameras[3]])
    assert [photo and photo.path.name for photo in matches] == [None, "v03.png"]
    with pytest.raises(ImageError, match="not a folder"):
        check_photos(tmp_path / "v03.png", cameras)


def test_photos_with_another_aspect_ratio_are_refused(tmp_path: Path) -> None:
    path = save(tmp_path / "a.png", Image.new("RGB", (93, 60)))
    for check in (
        lambda: check_photos(tmp_path, [camera("a")]),
        lambda: load_photo(Photo(path), camera("a")),
    ):
        with pytest.raises(ImageError, match="is 93 x 60, but its camera 'a' 90 x 60, another aspect"):
            check()
    # The rounded sides of a small camera do not count as another aspect ratio.
    save(tmp_path / "b.png", Image.new("RGB", (990, 742)))
    check_photos(tmp_path, [resized(camera("b", 990, 742), 22)])


def oriented(folder: Path, orientation: int, size: tuple[int, int]) -> Path:
    """Save a photo whose left half is black and whose right half is white, with an EXIF orientation."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    image = Image.new("RGB", size)
    image.paste("white", (size[0] // 2, 0, *size))
    return save(folder / "a.png", image, exif=exif)


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_exif_orientation_is_ignored_if_the_stored_photo_fits(tmp_path: Path, orientation: int) -> None:
    path = oriented(tmp_path, orientation, (90, 60))
    (photo,) = check_photos(tmp_path, [camera("a")])
    assert photo == Photo(path, ambiguous=orientation == 3)
    assert photo
    assert float(load_photo(photo, camera("a"))[:, 60:].min()) == 1
    rotated = load_photo(Photo(path, oriented=True), camera("a")) if orientation == 3 else None
    assert rotated is None or float(rotated[:, :30].min()) == 1


@pytest.mark.parametrize(("orientation", "white"), [(6, slice(40, 60)), (8, slice(0, 20))])
def test_exif_orientation_is_applied_if_only_the_rotated_photo_fits(
    tmp_path: Path, orientation: int, white: slice
) -> None:
    path = oriented(tmp_path, orientation, (60, 90))
    (photo,) = check_photos(tmp_path, [camera("a")])
    assert photo == Photo(path, oriented=True)
    assert photo
    pixels = load_photo(photo, camera("a"))
    assert pixels.shape == (60, 90, 3)
    assert float(pixels[white].min()) == 1  # the stored right side: 6 turns it down, and 8 up


def test_broken_photos_are_detected_early(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(b"no photo")
    with pytest.raises(ImageError, match=r"a\.jpg: is not an image"):
        check_photos(tmp_path, [camera("a")])


def test_photos_are_resized_to_the_camera_without_aliasing(tmp_path: Path) -> None:
    stripes = np.zeros((120, 180, 3), dtype="u1")
    stripes[:, ::2] = 255
    photo = Photo(save(tmp_path / "a.png", Image.fromarray(stripes)))
    small = load_photo(photo, camera("a", 45, 30))
    assert small.shape == (30, 45, 3)
    assert float((small - 0.5).abs()[:, 2:-2].max()) < 0.02  # point sampling would give 0 or 1
    same = load_photo(photo, camera("a", 180, 120))
    assert torch.equal(same, torch.from_numpy(stripes).float() / 255)
    large = load_photo(photo, camera("a", 360, 240))
    assert large.shape == (240, 360, 3)
    assert float(large.min()) >= 0
    assert float(large.max()) <= 1

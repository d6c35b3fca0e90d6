"""Tests that all common kinds of images are converted to float32 RGB, and that broken files give a clear error."""

from __future__ import annotations

import io
import os
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from sgsst_core.errors import ImageError, OutputError
from sgsst_core.files.images import (
    FORMATS,
    MAX_JPEG_SCANS,
    MAX_PIXELS,
    image_size,
    load_image,
    save_jpg,
    save_png,
    stored_size,
)
from sgsst_core.scene.pyramid import downscale
from tests.small_scenes import LFS_POINTER


def gradient(height: int = 6, width: int = 9) -> np.ndarray:
    """Return an image [height, width, 3] uint8 with all pixels different."""
    values = np.arange(height * width)
    return np.stack([values * 3 % 256, values * 5 % 256, 255 - values], axis=1).reshape(height, width, 3).astype("u1")


def save(path: Path, image: Image.Image, **options: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    image.save(path, **options)
    return path


def test_rgb_is_read_exactly(tmp_path: Path) -> None:
    image = load_image(save(tmp_path / "a.png", Image.fromarray(gradient())))
    assert image.dtype == torch.float32
    assert torch.equal(image, torch.from_numpy(gradient()).float() / 255)


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


def with_chunks(path: Path, *chunks: tuple[bytes, bytes], behind: bool = False) -> Path:
    """Insert chunks of a PNG after its header, or behind its pixels."""
    data = path.read_bytes()
    added = b"".join(
        struct.pack(">I4s", len(content), kind) + content + struct.pack(">I", zlib.crc32(kind + content))
        for kind, content in chunks
    )
    at = len(data) - 12 if behind else 33
    path.write_bytes(data[:at] + added + data[at:])
    return path


def exif_chunk(orientation: int) -> tuple[bytes, bytes]:
    exif = Image.Exif()
    exif[0x0112] = orientation
    return b"eXIf", exif.tobytes().removeprefix(b"Exif\0\0")


@pytest.mark.parametrize("behind", [False, True])
@pytest.mark.parametrize("kind", ["eXIf", "iTXt", "compressed"])
def test_orientation_behind_the_pixels_is_applied_as_before_them(tmp_path: Path, behind: bool, kind: str) -> None:
    """The XMP data are longer than 1 MiB, the limit of Pillow for compressed ones."""
    xmp = b'<x tiff:Orientation="6"/>' + b" " * (3 << 19)
    chunk = {
        "eXIf": exif_chunk(6),
        "iTXt": (b"iTXt", b"XML:com.adobe.xmp\0\0\0\0\0" + xmp),
        "compressed": (b"iTXt", b"XML:com.adobe.xmp\0\1\0\0\0" + zlib.compress(xmp)),
    }[kind]
    path = with_chunks(save(tmp_path / "a.png", Image.fromarray(gradient())), chunk, behind=behind)
    assert stored_size(path) == ((9, 6), 6)
    assert image_size(path) == (6, 9)
    assert torch.equal(load_image(path), torch.from_numpy(np.rot90(gradient(), -1).copy()).float() / 255)
    assert torch.equal(load_image(path, oriented=False), torch.from_numpy(gradient()).float() / 255)


@pytest.mark.parametrize("behind", [False, True])
def test_long_texts_are_skipped_and_text_bombs_refused(tmp_path: Path, behind: bool) -> None:
    noise = np.random.default_rng(1).integers(1, 255, 3 << 20, np.uint8).tobytes()
    texts = [
        (b"tEXt", b"Comment\0" + noise),
        (b"zTXt", b"Comment\0\0" + zlib.compress(noise)),
        (b"iTXt", b"Comment\0\1\0\0\0" + zlib.compress(noise)),
        (b"zTXt", b"broken\0\0" + noise[:9]),
        (b"zTXt", b""),
    ]
    path = with_chunks(save(tmp_path / "a.png", Image.fromarray(gradient())), *texts, behind=behind)
    assert torch.equal(load_image(path), torch.from_numpy(gradient()).float() / 255)
    bombs = [(b"zTXt", b"a\0\0" + zlib.compress(bytes(9 << 20)))] * 2
    with_chunks(path, *bombs, behind=behind)
    for read in (load_image, image_size):
        with pytest.raises(ImageError, match=r"a\.png: holds more than 16 MiB of compressed text\. Save it without"):
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
    for scale in (1.0, 255.0):
        floats = Image.fromarray((wide / 65535 * scale).astype("f4"))
        assert torch.allclose(load_image(save(tmp_path / "c.tif", floats)), expected, atol=1e-6)
    narrow = (wide >> 8).astype("u1")
    image = load_image(save(tmp_path / "d.png", Image.fromarray(narrow)))
    assert torch.equal(image[:, :, 1], torch.from_numpy(narrow).float() / 255)
    one = load_image(save(tmp_path / "e.png", Image.fromarray(narrow > 100)))
    assert torch.equal(one[:, :, 2], torch.from_numpy(narrow > 100).float())


def test_overshoot_of_float_pixels_is_clipped(tmp_path: Path) -> None:
    for values, expected in (([0.5, 1.0001], [0.5, 1]), ([0.5, 2.0], [0.5, 1]), ([51.0, 2.5], [0.2, 2.5 / 255])):
        image = load_image(save(tmp_path / "a.tif", Image.fromarray(np.array([values], dtype="f4"))))
        assert image[0, :, 0].tolist() == pytest.approx(expected)


def test_transparent_16_bit_gray_is_composited(tmp_path: Path) -> None:
    values = np.array([[1000, 2000]], dtype="u2")
    image = load_image(save(tmp_path / "a.png", Image.fromarray(values), transparency=1000))
    assert image[0, 0].tolist() == [1, 1, 1]
    assert image[0, 1].tolist() == pytest.approx([2000 / 65535] * 3)


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


def png_header(width: int, height: int) -> bytes:
    """Return a PNG whose header declares this size, without pixel data."""
    size = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunks = [(b"IHDR", size), (b"IDAT", zlib.compress(b"")), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in chunks
    )


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("size", [(20_000, 9_000), (100_000, 100_000), (MAX_PIXELS + 1, 1)])
def test_decompression_bombs_are_refused_from_their_header(tmp_path: Path, size: tuple[int, int]) -> None:
    path = tmp_path / "bomb.png"
    path.write_bytes(png_header(*size))
    for read in (load_image, image_size):
        with pytest.raises(ImageError, match=r"bomb\.png: has more than 178 megapixels"):
            read(path)


@pytest.mark.filterwarnings("error")
def test_large_images_are_accepted(tmp_path: Path) -> None:
    path = tmp_path / "large.png"
    path.write_bytes(png_header(16_000, 10_000))
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
    with pytest.raises(ImageError, match="No such file"):
        load_image(tmp_path / "none.jpg")
    with pytest.raises(ImageError, match="Is a directory"):
        load_image(tmp_path)
    with pytest.raises(ImageError, match="Not a directory"):
        load_image(path / "below.jpg")


def test_png_is_clamped_rounded_and_exact(tmp_path: Path) -> None:
    image = torch.from_numpy(gradient()).float() / 255
    save_png(tmp_path / "a.png", image)
    assert torch.equal(load_image(tmp_path / "a.png"), image)
    save_png(tmp_path / "b.png", torch.tensor([[[-1.0, 0.5, 7.0]]]))
    assert (load_image(tmp_path / "b.png") * 255).tolist() == [[[0, 128, 255]]]
    assert sorted(os.listdir(tmp_path)) == ["a.png", "b.png"]


def test_jpg_is_close(tmp_path: Path) -> None:
    rows, columns = torch.meshgrid(torch.linspace(0, 1, 64), torch.linspace(0, 1, 48), indexing="ij")
    image = torch.stack([rows, columns, 1 - rows], dim=2)
    save_jpg(tmp_path / "a.jpg", image)
    with Image.open(tmp_path / "a.jpg") as file:
        assert file.format == "JPEG"
    assert float((load_image(tmp_path / "a.jpg") - image).abs().max()) < 0.03


def test_invalid_images_are_not_written(tmp_path: Path) -> None:
    for wrong in (torch.zeros(3, 4), torch.zeros(4, 4, 1), torch.full((2, 2, 3), torch.nan)):
        with pytest.raises(ValueError, match=r"\[H, W, 3\] without NaN"):
            save_png(tmp_path / "a.png", wrong)
    with pytest.raises(OutputError):
        save_jpg(tmp_path / "missing" / "a.jpg", torch.zeros(2, 2, 3))
    assert os.listdir(tmp_path) == []


def test_real_paintings_are_read(shared_data: Path) -> None:
    assert load_image(shared_data / "styles" / "starry_night.jpg").shape == (1520, 1920, 3)


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

"""Conversion of images to sRGB by their ICC profiles, and profiles of the color chunks of PNGs."""

from __future__ import annotations

import functools
import io
import struct
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageCms

#: Maximum size of a profile in bytes. Those of printing processes have up to 3 MB.
MAX_PROFILE_BYTES = 4 << 20
#: Modes of images by the color spaces of profiles.
_MODES = {"RGB": "RGB", "GRAY": "L", "CMYK": "CMYK"}
#: Maximum change of 8-bit values by a profile that counts as sRGB. Published sRGB profiles differ in the last digits.
_ROUNDING = 1
#: Spacing of the 8-bit colors for which a profile is compared with sRGB.
_PROBE_STEP = 15
_D50 = np.array([0.9642, 1.0, 0.8249])
#: Cone responses of the Bradford adaptation (ICC.1:2010, annex E).
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
_D65 = (0.3127, 0.3290)
_REC_709 = (_D65, (0.64, 0.33), (0.30, 0.60), (0.15, 0.06))
#: Chromaticities of white, red, green and blue, by the numbers of ITU-T H.273, table 2, in cICP.
_PRIMARIES = {
    1: _REC_709,
    5: (_D65, (0.64, 0.33), (0.29, 0.60), (0.15, 0.06)),
    6: (_D65, (0.63, 0.34), (0.31, 0.595), (0.155, 0.07)),
    9: (_D65, (0.708, 0.292), (0.17, 0.797), (0.131, 0.046)),
    11: ((0.314, 0.351), (0.68, 0.32), (0.265, 0.69), (0.15, 0.06)),
    12: (_D65, (0.68, 0.32), (0.265, 0.69), (0.15, 0.06)),
}
_SRGB_CURVE = (2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)
_REC_709_CURVE = (1 / 0.45, 1 / 1.099, 0.099 / 1.099, 1 / 4.5, 0.081)
#: Parameters of `_matrix_profile` by the numbers of ITU-T H.273, table 3.
_CURVES: dict[int, tuple[float, ...]] = {4: (2.2,), 5: (2.8,), 8: (1.0,), 13: _SRGB_CURVE}
_CURVES |= dict.fromkeys((1, 6, 14, 15), _REC_709_CURVE)
#: Exponent that stands for sRGB with its primaries, as the specification of PNG recommends, and rounding.
_SRGB_GAMMA, _GAMMA_ROUNDING, _PRIMARY_ROUNDING = 2.2, 0.02, 0.001
#: Exponents of curves that are believed.
_GAMMAS = (0.1, 10.0)


class ColorProfile:
    """ICC profile of an image.

    Args:
        mode: Mode of the image that it belongs to: "L", "RGB" or "CMYK".

    Attributes:
        changes: Whether the profile differs from sRGB, so that colors change.

    Raises:
        ValueError: If the profile is broken, too large, or not for such images. The message is the reason.
    """

    def __init__(self, data: bytes, mode: str) -> None:
        if len(data) > MAX_PROFILE_BYTES:
            raise ValueError(f"it has more than {MAX_PROFILE_BYTES >> 20} MiB")
        try:
            profile = ImageCms.ImageCmsProfile(io.BytesIO(_without_float_conversions(data)))
        except (ImageCms.PyCMSError, OSError) as error:
            raise ValueError("it is broken") from error
        space = profile.profile.xcolor_space.strip()
        self._mode = _MODES.get(space, "")
        if self._mode != mode and (self._mode, mode) != ("RGB", "L"):
            raise ValueError(f"it is for {space or 'unknown'} colors")
        # By default, LittleCMS combines a conversion into one table in advance, which may be wrong by 10/255. Only that
        # of a matrix is exact to 8 bits.
        precise = self._mode == "RGB" and profile.profile.is_matrix_shaper
        flags = ImageCms.Flags.NONE if precise else ImageCms.Flags.NOOPTIMIZE
        try:
            self._transform = ImageCms.buildTransform(
                profile, _srgb(), self._mode, "RGB", ImageCms.Intent.PERCEPTUAL, flags
            )
        except ImageCms.PyCMSError as error:
            raise ValueError("it lacks what a conversion to sRGB needs") from error
        self.changes = self._mode == "CMYK" or self._differs_from_srgb()

    def to_srgb(self, image: Image.Image) -> Image.Image:
        """Convert an image to sRGB, in mode RGB. Transparency is dropped."""
        converted = ImageCms.applyTransform(image.convert(self._mode), self._transform)
        assert converted is not None  # it is None only for conversions in place
        return converted

    def gray_to_srgb(self, gray: NDArray[np.float32]) -> NDArray[np.float32]:
        """Convert gray values [H, W] in 0..1 to sRGB, [H, W, 3].

        They are interpolated between the converted values of 8 bits, so that finer gradations remain.
        """
        steps = np.arange(256, dtype=np.uint8)
        converted = np.asarray(self.to_srgb(Image.fromarray(steps[None])), np.float32)[0] / 255
        channels = [np.interp(gray, steps / 255, channel) for channel in converted.T]
        return np.stack(channels, axis=2).astype(np.float32)

    def _differs_from_srgb(self) -> bool:
        """Return whether the profile changes a grid of colors, by more than rounding."""
        axis = np.arange(0, 256, _PROBE_STEP, dtype=np.uint8)
        if self._mode == "L":
            probe = Image.fromarray(axis[None])
        else:
            probe = Image.fromarray(np.stack(np.meshgrid(axis, axis, axis), axis=3).reshape(len(axis), -1, 3))
        change = np.asarray(self.to_srgb(probe), np.int16) - np.asarray(probe.convert("RGB"), np.int16)
        return int(np.abs(change).max()) > _ROUNDING


def png_profile(chunks: Mapping[bytes, bytes]) -> bytes:
    """Return the ICC profile that the color chunks of a PNG state; empty for sRGB.

    Args:
        chunks: Contents of cICP, sRGB, gAMA and cHRM, in this order of precedence.

    Raises:
        ValueError: If they cannot be converted. The message is the reason.
    """
    if cicp := chunks.get(b"cICP"):
        primaries, transfer, *rest = cicp.ljust(4, b"\0")[:4]
        if primaries not in _PRIMARIES or transfer not in _CURVES or rest != [0, 1]:
            raise ValueError(f"their cICP chunk states {' '.join(map(str, cicp[:4]))}, such as HDR, which is not read")
        return _matrix_profile(_PRIMARIES[primaries], _CURVES[transfer])
    if b"sRGB" in chunks or not chunks:
        return b""
    points: Sequence[tuple[float, float]] = _REC_709
    curve: Sequence[float] = _SRGB_CURVE
    try:
        if b"cHRM" in chunks:
            values = [value / 1e5 for value in struct.unpack(">8I", chunks[b"cHRM"])]
            points = list(zip(values[::2], values[1::2], strict=True))
        if b"gAMA" in chunks:
            gamma = 1e5 / struct.unpack(">I", chunks[b"gAMA"])[0]
            is_srgb = abs(gamma - _SRGB_GAMMA) < _GAMMA_ROUNDING and np.allclose(points, _REC_709, 0, _PRIMARY_ROUNDING)
            curve = _SRGB_CURVE if is_srgb else (gamma,)
        return _matrix_profile(points, curve)
    except (ArithmeticError, struct.error, np.linalg.LinAlgError) as error:
        raise ValueError("their gAMA or cHRM chunk is broken") from error


def _matrix_profile(points: Sequence[tuple[float, float]], curve: Sequence[float]) -> bytes:
    """Return the profile of an RGB space (ICC.1:2010).

    Args:
        points: Chromaticities xy of white, red, green and blue.
        curve: Exponent; or exponent, a, b, c and d of (a x + b)^exponent from d on and c x below.

    Raises:
        ArithmeticError: If the values are those of no space.
    """
    white, *columns = (np.array([x / y, 1, (1 - x - y) / y]) for x, y in points)
    matrix = np.stack(columns, axis=1)
    matrix *= np.linalg.solve(matrix, white)
    adapted = np.linalg.solve(_BRADFORD, np.diag(_BRADFORD @ _D50 / (_BRADFORD @ white)) @ _BRADFORD @ matrix)
    if not (np.abs(adapted) < 4).all() or np.max(points) > 2 or not _GAMMAS[0] < curve[0] < _GAMMAS[1]:
        raise ArithmeticError

    def numbers(values: Sequence[float] | NDArray[np.float64]) -> bytes:
        return bytes(np.rint(65536 * np.asarray(values)).astype(">i4").data)

    tags = {"wtpt": b"XYZ " + bytes(4) + numbers(_D50)}
    for name, column in zip("rgb", adapted.T, strict=True):
        tags[f"{name}XYZ"] = b"XYZ " + bytes(4) + numbers(column)
        tags[f"{name}TRC"] = struct.pack(">4s4xH2x", b"para", 3 if len(curve) > 1 else 0) + numbers(curve)
    table, body = struct.pack(">I", len(tags)), b""
    for name, tag in tags.items():
        table += struct.pack(">4sII", name.encode(), 132 + 12 * len(tags) + len(body), len(tag))
        body += tag
    size = 128 + len(table) + len(body)
    head = struct.pack(">I4xI4s4s4s12x4s", size, 2 << 24, b"mntr", b"RGB ", b"XYZ ", b"acsp").ljust(68, b"\0")
    return (head + numbers(_D50)).ljust(128, b"\0") + table + body


def _without_float_conversions(data: bytes) -> bytes:
    """Rename the tags of a profile's optional floating-point conversions, D2B0 to D2B3, so that they are not used.

    They may have any number of steps: a profile of 1 MB would take hours. Every profile has another conversion, by
    tables or a matrix, with a fixed number of steps (ICC.1:2010, section 8).
    """
    profile = bytearray(data)
    tags = int.from_bytes(profile[128:132], "big")
    for position in range(132, min(132 + 12 * tags, len(profile)), 12):
        if profile[position : position + 3] == b"D2B":
            profile[position] = ord("x")
    return bytes(profile)


@functools.cache
def _srgb() -> ImageCms.ImageCmsProfile:
    """Return an sRGB profile of ICC version 2.

    With version 4, the perceptual intent would map the darkest ink of a printing process to black. ImageMagick and most
    viewers do not.
    """
    data = bytearray(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    data[8] = 2
    return ImageCms.ImageCmsProfile(io.BytesIO(bytes(data)))

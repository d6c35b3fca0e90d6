"""Conversion of images to sRGB by their ICC profiles."""

from __future__ import annotations

import functools
import io

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

"""Writing of videos: MP4 with H.264, WebM with VP9 and optional alpha channel, and sequences of PNG images."""

import re
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from sgsst_core.errors import OutputError
from sgsst_core.files.atomic import atomic_path, disk_errors, ensure_writable_folder, remove_leftovers

#: Frame of a video: [height, width, 3 or 4] uint8, sRGB, with straight alpha.
VideoFrame = NDArray[np.uint8]
#: Encoder and its options by suffix. The qualities are hardly distinguishable from the renders.
_ENCODERS: dict[str, tuple[str, dict[str, str]]] = {
    ".mp4": ("libx264", {"crf": "18", "preset": "veryfast"}),
    ".webm": (
        "libvpx-vp9",
        {"crf": "22", "b": "0", "deadline": "good", "cpu-used": "4", "row-mt": "1", "auto-alt-ref": "0"},
    ),
}
#: Options of the container: an MP4 starts with its index, so that it plays before it has been received as a whole.
_CONTAINER = {".mp4": {"movflags": "+faststart"}, ".webm": {}}
#: Codes of ITU-T H.273: primaries and matrix of BT.709, transfer function of sRGB, limited range.
_PRIMARIES, _TRANSFER, _MATRIX, _LIMITED = 1, 13, 1, 1
#: Maximum length of a side, for which decoders in browsers exist.
MAX_SIDE = 8192
#: Name of a PNG in a folder that is given without a pattern.
_FRAME_NAME = "frame_%04d.png"
_PATTERN = re.compile(r"[^%]*%(0\d)?d[^%]*")


def is_encoded(out: Path) -> bool:
    """Return whether a path names one video file, whose frames have even sides, rather than PNG images."""
    return out.suffix.lower() in _ENCODERS


def frames_folder(out: Path) -> Path:
    """Return the folder in which a video or its images are written: the path itself if it names a folder.

    A path names a folder if it is one, or if what follows its last dot has no letter, as in `v1.2`.
    """
    return out if _names_folder(out) else out.parent


def _names_folder(out: Path) -> bool:
    is_suffix = any(character.isalpha() for character in out.suffix)
    return not is_encoded(out) and (out.is_dir() or not is_suffix)


def check_video_path(out: Path, *, alpha: bool = False) -> None:
    """Check that a path names a video or a sequence of images that can be written.

    Raises:
        OutputError: If it does not, or if its format has no alpha channel but `alpha` is set.
        ModuleNotFoundError: If a video is to be written, and the extra `video` is not installed.
    """
    suffix = out.suffix.lower()
    if is_encoded(out):
        import av  # noqa: F401

        if out.is_dir():
            raise OutputError(f"{out}: is a folder. Name the video file to write, such as {out / 'video.mp4'}.")
        if alpha and suffix == ".mp4":
            raise OutputError(f"{out}: MP4 has no alpha channel. Name a .webm file or a folder for PNG images.")
    elif not _names_folder(out) and (suffix != ".png" or not _PATTERN.fullmatch(out.name)):
        raise OutputError(
            f"{out}: is no video. Name a .mp4 or .webm file, a pattern such as frame_%04d.png, or an existing folder."
        )


@contextmanager
def video_writer(
    out: Path, width: int, height: int, fps: int, *, alpha: bool = False
) -> Iterator[Callable[[VideoFrame], None]]:
    """Yield a function that appends a frame to a video or image sequence, which appears at the end of the block.

    If the block raises, nothing of it remains. Frames are encoded as they come; none is retained.

    Args:
        out: Path for `check_video_path`. In a folder, or with a pattern, images are numbered from 0.
        width: Width of all frames in pixels; even for a video file.
        height: Height of all frames in pixels; even for a video file.
        alpha: Whether frames have an alpha channel.

    Raises:
        OutputError: If the video cannot be written; see `check_video_path`.
    """
    check_video_path(out, alpha=alpha)
    if is_encoded(out):
        if max(width, height) > MAX_SIDE or width % 2 or height % 2:
            raise OutputError(
                f"{out}: a video of {width}x{height} pixels cannot be encoded. Sides must be even, and at most "
                f"{MAX_SIDE}."
            )
        remove_leftovers(out)
        with atomic_path(out) as temporary, encoder(temporary, width, height, fps, alpha=alpha) as write:
            yield write
    else:
        with _image_sequence(frames_folder(out), _FRAME_NAME if _names_folder(out) else out.name) as write:
            yield write


@contextmanager
def encoder(
    path: Path, width: int, height: int, fps: int, *, alpha: bool = False
) -> Iterator[Callable[[VideoFrame], None]]:
    """Yield a function that appends a frame to a video file, like `video_writer`, but written in place."""
    import av

    codec, options = _ENCODERS[path.suffix.lower()]
    try:
        with av.open(str(path), "w", options=_CONTAINER[path.suffix.lower()]) as container:
            stream: Any = container.add_stream(codec, rate=fps, options=options)
            stream.width, stream.height, stream.pix_fmt = width, height, "yuva420p" if alpha else "yuv420p"
            context = stream.codec_context
            context.color_primaries, context.color_trc = _PRIMARIES, _TRANSFER
            context.colorspace, context.color_range = _MATRIX, _LIMITED
            context.thread_count = torch.get_num_threads()

            def write(image: VideoFrame) -> None:
                frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgba" if alpha else "rgb24")
                container.mux(
                    stream.encode(
                        frame.reformat(
                            format=stream.pix_fmt,
                            dst_colorspace=av.video.reformatter.Colorspace.ITU709,
                            src_color_range=av.video.reformatter.ColorRange.JPEG,
                            dst_color_range=av.video.reformatter.ColorRange.MPEG,
                        )
                    )
                )

            yield write
            container.mux(stream.encode(None))
    except av.FFmpegError as error:
        raise OSError(error.errno, error.strerror) from error


@contextmanager
def _image_sequence(folder: Path, name: str) -> Iterator[Callable[[VideoFrame], None]]:
    """Yield a function that writes images to a temporary folder; they are moved to `folder` when the block ends."""
    new = not folder.exists()
    ensure_writable_folder(folder)
    temporary = Path(tempfile.mkdtemp(prefix=".sgsst-", dir=folder))
    count = 0

    def write(image: VideoFrame) -> None:
        nonlocal count
        Image.fromarray(image).save(temporary / (name % count), compress_level=4)
        count += 1

    try:
        with disk_errors(folder):
            yield write
        for index in range(count):
            (temporary / (name % index)).replace(folder / (name % index))
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
        if new and not any(folder.iterdir()):
            folder.rmdir()

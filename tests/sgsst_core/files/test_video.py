"""Tests of video files: decoded frames are the written ones, and nothing half-written remains."""

import subprocess
import sys
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sgsst_core.errors import OutputError
from sgsst_core.files.video import check_video_path, video_writer

av = pytest.importorskip("av", reason="the extra `video` is not installed")

WIDTH, HEIGHT, COUNT = 96, 64, 12


def frame(index, alpha=False):
    """Return a smooth frame whose colors change with its number; its upper part is transparent."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    rgb = np.stack([x * 2, y * 3, np.full_like(x, 20 * index)], axis=2).astype(np.uint8)
    opacity = np.where(y < 20, 0, np.where(y < 40, 128, 255)).astype(np.uint8)
    return np.concatenate([rgb, opacity[:, :, None]], axis=2) if alpha else rgb


def write(out, *, alpha=False, count=COUNT):
    """Write a video of some frames."""
    with video_writer(out, WIDTH, HEIGHT, 25, alpha=alpha) as append:
        for index in range(count):
            append(frame(index, alpha))


def decoded(out, codec=None):
    """Return the frames of a video, and its stream."""
    with av.open(str(out)) as container:
        stream = container.streams.video[0]
        if codec is None:
            return list(container.decode(stream)), stream
        decoder = av.CodecContext.create(codec, "r")
        return [frame for packet in container.demux(stream) for frame in decoder.decode(packet)], stream


def psnr(image, expected):
    """Return the PSNR in dB of two images of 8 bits."""
    return 10 * np.log10(255**2 / np.mean((image.astype(float) - expected) ** 2))


@pytest.mark.parametrize(("name", "codec"), [("video.mp4", "h264"), ("video.webm", "vp9"), ("VIDEO.MP4", "h264")])
def test_decoded_frames_are_the_written_ones(tmp_path, name, codec):
    out = tmp_path / name
    write(out)
    frames, stream = decoded(out)
    assert (stream.codec_context.name, stream.codec_context.pix_fmt) == (codec, "yuv420p")
    assert stream.average_rate == Fraction(25)
    assert [float(each.time) for each in frames] == pytest.approx([index / 25 for index in range(COUNT)], abs=1e-3)
    for index, each in enumerate(frames):
        rgb = each.reformat(format="rgb24", src_colorspace="ITU709", dst_color_range="JPEG").to_ndarray()
        assert psnr(rgb, frame(index)) > 35
    context = stream.codec_context
    assert (context.color_primaries, context.color_trc, context.colorspace, context.color_range) == (1, 13, 1, 1)
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_index_of_an_mp4_precedes_its_frames(tmp_path):
    write(tmp_path / "video.mp4")
    data = (tmp_path / "video.mp4").read_bytes()
    assert 0 < data.index(b"moov") < data.index(b"mdat")


def test_webm_has_an_alpha_channel(tmp_path):
    write(tmp_path / "video.webm", alpha=True)
    frames, stream = decoded(tmp_path / "video.webm", "libvpx-vp9")
    assert stream.metadata["alpha_mode"] == "1"
    pixels = frames[5].to_ndarray(format="rgba").astype(int)
    assert np.abs(pixels[:, :, 3] - frame(5, alpha=True)[:, :, 3])[[10, 30, 50]].max() <= 3


@pytest.mark.parametrize("alpha", [False, True])
def test_png_images_are_exact(tmp_path, alpha):
    write(tmp_path / "images", alpha=alpha)
    write(tmp_path / "named" / "shot%02d.png", alpha=alpha)
    for index in range(COUNT):
        for path in (tmp_path / "images" / f"frame_{index:04d}.png", tmp_path / "named" / f"shot{index:02d}.png"):
            assert np.array_equal(np.asarray(Image.open(path)), frame(index, alpha))
    assert len(list((tmp_path / "images").iterdir())) == COUNT


@pytest.mark.parametrize("name", ["video.mp4", "video.webm", "images", "shot%03d.png"])
def test_interrupted_video_leaves_nothing_and_replaces_nothing(tmp_path, name):
    existing = tmp_path / "video.mp4"
    existing.write_bytes(b"an earlier video")

    def interrupted():
        with video_writer(tmp_path / name, WIDTH, HEIGHT, 25) as append:
            append(frame(0))
            append(frame(1))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert [path.name for path in tmp_path.iterdir()] == ["video.mp4"]
    assert existing.read_bytes() == b"an earlier video"


def test_full_disk_is_reported(tmp_path):
    """A limit on the size of files stands in for a full disk, in a process of its own."""
    program = f"""
import resource, numpy as np
from pathlib import Path
from sgsst_core.errors import OutputError
from sgsst_core.files.video import video_writer
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
noise = np.random.default_rng(0).integers(0, 256, ({HEIGHT}, {WIDTH}, 3), dtype=np.uint8)
try:
    with video_writer(Path({str(tmp_path / "video.mp4")!r}), {WIDTH}, {HEIGHT}, 25) as write:
        for shift in range(200):
            write(np.roll(noise, shift * 7919))
except OutputError as error:
    print(error)
"""
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert "cannot be written" in ended.stdout, ended.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "alpha", "message"),
    [
        ("video.mp4", True, "no alpha channel"),
        ("video.avi", False, "is no video"),
        ("image.png", False, "is no video"),
        ("100%_%d.png", False, "is no video"),
        (".", False, None),
    ],
)
def test_paths_that_cannot_be_written_are_refused(tmp_path, name, alpha, message):
    if message is None:
        check_video_path(tmp_path / name, alpha=alpha)
        return
    with pytest.raises(OutputError, match=message):
        check_video_path(tmp_path / name, alpha=alpha)


@pytest.mark.parametrize(
    ("name", "exists"),
    [("v1.2", True), ("v1.2", False), ("take.two", True), ("2026.01.31", False), ("still.png", True)],
)
def test_folder_with_a_dot_in_its_name_gets_images(tmp_path, name, exists):
    if exists:
        (tmp_path / name).mkdir()
    with video_writer(tmp_path / name, 16, 16, 2) as write:
        write(np.zeros((16, 16, 3), np.uint8))
    assert [path.name for path in (tmp_path / name).iterdir()] == ["frame_0000.png"]


def test_folder_named_like_a_video_is_refused(tmp_path):
    (tmp_path / "video.mp4").mkdir()
    with pytest.raises(OutputError, match="is a folder"):
        check_video_path(tmp_path / "video.mp4")


@pytest.mark.parametrize(("width", "height"), [(95, 64), (96, 63), (8194, 64)])
def test_sizes_that_encoders_refuse_are_refused(tmp_path, width, height):
    with pytest.raises(OutputError, match="even"), video_writer(Path(tmp_path / "v.mp4"), width, height, 25):
        pass

"""Errors for camera files in known but unsupported formats, which say how to convert them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path, PurePosixPath
from typing import Any

from sgsst_core.errors import CameraError

_HEAD_BYTES = 4096

_METASHAPE = (
    "cameras of Metashape. Export them as Colmap (File > Export > Export Cameras, version 2.2 or later), or use "
    "`ns-process-data metashape --xml cameras.xml --data IMAGES --output-dir OUT` and give OUT/transforms.json"
)
_REALITY_CAPTURE = (
    "cameras of RealityCapture. Export the registration in COLMAP's format, or use "
    "`ns-process-data realitycapture --csv cameras.csv --data IMAGES --output-dir OUT` and give OUT/transforms.json"
)
_BUNDLER = (
    "a Bundler file. Export COLMAP's format from the program that wrote it, or compute cameras from the photos with "
    "`colmap automatic_reconstructor --workspace_path OUT --image_path IMAGES` and give OUT/sparse/0"
)
_POLYCAM = (
    "raw data of Polycam. Convert it with `ns-process-data polycam --data EXPORT.zip --output-dir OUT` and give "
    "OUT/transforms.json"
)
_RECORD3D = (
    "data of Record3D. Convert it with `ns-process-data record3d --data FOLDER --output-dir OUT` and give "
    "OUT/transforms.json"
)
_OPENSFM = "a reconstruction of OpenSfM. Run `bin/opensfm export_colmap DATASET` and give the model that it writes"
_OPENMVG = "a scene of OpenMVG. Convert it with `openMVG_main_openMVG2Colmap -i sfm_data.json -o OUT` and give OUT"
_NERFSTUDIO_EXPORT = (
    "an export of `ns-export cameras`, which has no focal lengths. Give the transforms.json of the data set, with the "
    "dataparser_transforms.json of the training run beside it"
)
_DATABASE = (
    "a database of COLMAP, which has no poses. Give the sparse model that `colmap mapper` writes, such as sparse/0"
)

#: Advice by the start of a file, in lower case and without a byte order mark or blanks.
_BY_HEAD: tuple[tuple[Callable[[bytes], bool], str], ...] = (
    (lambda head: head.startswith((b"<?xml", b"<document")) and b"<chunk" in head, _METASHAPE),
    (lambda head: head.startswith(b"#name,x,y,"), _REALITY_CAPTURE),
    (lambda head: head.startswith(b"# bundle file"), _BUNDLER),
    (lambda head: head.startswith(b"sqlite format 3\0"), _DATABASE),
)
#: Advice by the suffix of a file, where only its name is known.
_BY_SUFFIX = {".xml": _METASHAPE, ".csv": _REALITY_CAPTURE, ".out": _BUNDLER, ".r3d": _RECORD3D, ".db": _DATABASE}


def advice_for_name(name: str) -> str:
    """Return advice for the suffix of a known format, with a leading space; empty for other suffixes."""
    advice = _BY_SUFFIX.get(PurePosixPath(name).suffix.lower())
    return "" if advice is None else f" It may be {advice}."


def refuse_file(path: Path) -> None:
    """Raise an error if the start of a file shows that it is in a known format that cannot be read.

    Raises:
        CameraError: If so; the message says how to convert the data.
        OSError: If the file cannot be read.
    """
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES).removeprefix(b"\xef\xbb\xbf").lstrip().lower()
    for matches, advice in _BY_HEAD:
        if matches(head):
            raise _refusal(path, advice)
    if path.suffix.lower() == ".r3d":
        raise _refusal(path, _RECORD3D)


def refuse_json(path: Path, content: Any) -> None:
    """Raise an error if the content of a JSON file is in a known format that cannot be read.

    Raises:
        CameraError: If so; the message says how to convert the data.
    """
    first = content[0] if isinstance(content, list) and content else content
    if not isinstance(first, dict):
        return
    for names, advice in (
        ({"t_00", "t_23", "fx"}, _POLYCAM),
        ({"poses", "K"}, _RECORD3D),
        ({"cameras", "shots"}, _OPENSFM),
        ({"sfm_data_version"}, _OPENMVG),
        ({"file_path", "transform"}, _NERFSTUDIO_EXPORT),
    ):
        if names <= first.keys():
            raise _refusal(path, advice)


def refuse_folder(folder: Path) -> None:
    """Raise an error if a folder holds data in a known format that cannot be read.

    Raises:
        CameraError: If so; the message says how to convert the data.
    """
    for pattern, advice in (
        ("keyframes/*cameras", _POLYCAM),
        ("EXR_RGBD/metadata.json", _RECORD3D),
        ("reconstruction.json", _OPENSFM),
        ("opensfm/reconstruction.json", _OPENSFM),
        ("sfm_data.json", _OPENMVG),
        ("bundle.out", _BUNDLER),
    ):
        match = next(folder.glob(pattern), None)
        if match is not None:
            raise _refusal(match, advice)


def _refusal(path: Path, advice: str) -> CameraError:
    return CameraError(f"{path}: is {advice}.")

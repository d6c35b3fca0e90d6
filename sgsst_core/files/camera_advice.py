"""Errors for camera files in known but unsupported formats, which say how to convert them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from sgsst_core.errors import CameraError
from sgsst_core.files.lfs_pointers import POINTER, is_pointer

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
_AS_COLMAP = "Export the cameras as a COLMAP model, or give those that the scene was trained with"
_METASHAPE_PROJECT = (
    "a project of Metashape. Export its cameras as Colmap (File > Export > Export Cameras, version 2.2 or later)"
)
_REALITY_CAPTURE_PROJECT = (
    "data of RealityCapture that only it reads. Export the registration in COLMAP's format from the project"
)
_BLOCKS_EXCHANGE = f"a BlocksExchange file. {_AS_COLMAP}"
_LLFF = "poses of LLFF, computed by COLMAP. Give the COLMAP model, such as sparse/0"
_NEUS = f"the cameras of a data set for NeuS. {_AS_COLMAP}"
_MESHROOM = f"a file of Meshroom. {_AS_COLMAP} (Meshroom's node ExportColmap)"
_PIX4D = f"camera parameters of Pix4D. {_AS_COLMAP}"
_VISUALSFM = f"a model of VisualSFM. {_AS_COLMAP}"
_ANIMATION = f"an animation file. {_AS_COLMAP}"
_VIEWER_PATH = "a camera path of nerfstudio's viewer. Give the transforms.json of the data set"
_VIEWER_POSES = (
    "poses or settings of SuperSplat, which have no sizes of images. Give the cameras that the scene was trained with, "
    "or use --orbit"
)
_ARCHIVE = "an archive. Unpack it, and give the folder with the cameras"

#: Advice by the start of a file, in lower case and without a byte order mark or blanks.
_BY_HEAD: tuple[tuple[Callable[[bytes], bool], str], ...] = (
    (is_pointer, POINTER),
    (lambda head: head.startswith((b"<?xml", b"<document")) and b"<chunk" in head, _METASHAPE),
    (lambda head: head.startswith(b"#name,x,y,"), _REALITY_CAPTURE),
    (lambda head: b"<blocksexchange" in head, _BLOCKS_EXCHANGE),
    (lambda head: head.startswith(b"<realitycaptureproject"), _REALITY_CAPTURE_PROJECT),
    (lambda head: head.startswith(b"# bundle file"), _BUNDLER),
    (lambda head: head.startswith(b"imagename x y z omega phi kappa"), _PIX4D),
    (lambda head: head.startswith(b"nvm_v3"), _VISUALSFM),
    (lambda head: head.startswith((b"ogawa", b"kaydara fbx binary")), _ANIMATION),
    (lambda head: head.startswith(b"sqlite format 3\0"), _DATABASE),
)
#: Advice by the end of a file's name.
_BY_SUFFIX = {
    ".r3d": _RECORD3D,
    ".psx": _METASHAPE_PROJECT,
    ".rcproj": _REALITY_CAPTURE_PROJECT,
    ".xmp": _REALITY_CAPTURE_PROJECT,
    "poses_bounds.npy": _LLFF,
    "cameras_sphere.npz": _NEUS,
    ".sfm": _MESHROOM,
    "_calibrated_external_camera_parameters.txt": _PIX4D,
    ".nvm": _VISUALSFM,
    ".abc": _ANIMATION,
    ".fbx": _ANIMATION,
    ".zip": _ARCHIVE,
}
#: Likely advice by the end of a file's name, where only the name is known.
_LIKELY_BY_SUFFIX = {".xml": _METASHAPE, ".csv": _REALITY_CAPTURE, ".out": _BUNDLER, ".db": _DATABASE, **_BY_SUFFIX}


def advice_for_name(name: str) -> str:
    """Return advice for the name of a file in a known format, with a leading space; empty for other names."""
    advice = _at_end(name, _LIKELY_BY_SUFFIX)
    return "" if advice is None else f" It may be {advice}."


def _at_end(name: str, table: Mapping[str, str]) -> str | None:
    """Return the advice of the first end of a name in a table; None if there is none."""
    return next((advice for end, advice in table.items() if name.lower().endswith(end)), None)


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
    known = _at_end(path.name, _BY_SUFFIX)
    if known is not None:
        raise _refusal(path, known)


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
        ({"views", "intrinsics", "poses"}, _MESHROOM),
        ({"camera_path"}, _VIEWER_PATH),
        ({"position", "target"}, _VIEWER_POSES),
        ({"tonemapping", "cameras"}, _VIEWER_POSES),
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

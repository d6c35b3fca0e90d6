"""Files of known kinds that are no readable scenes or cameras: what each is, and what to do. Imports no PyTorch."""

import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

from sgsst_core.errors import CameraError, InvalidInputError, SceneError

#: Bytes of a file in which its kind is looked for.
_HEAD_BYTES = 4096
#: Signatures in the first bytes of a PyTorch checkpoint: the first file of its ZIP archive, and pickle.
_CHECKPOINT, _PICKLE = b"/data.pkl", (b"\x80\x02", b"\x80\x04", b"\x80\x05")
#: Scenes in the folders of a run, in order of preference: of the original code, of gsplat, any, and an unpacked SOG.
_SCENES_IN_RUNS = ("point_cloud/iteration_*/point_cloud.ply", "ply/*.ply", "*.ply", "meta.json")
#: Checkpoints of gsplat and nerfstudio in the folders of a run.
_CHECKPOINTS_IN_RUNS = ("ckpts/*_rank0.pt", "nerfstudio_models/*.ckpt")
_AS_COLMAP = "Export the cameras as a COLMAP model, or give those that the scene was trained with."
_TRANSFORMS = "--output-dir OUT` and give OUT/transforms.json."


def converted(name: str) -> str:
    """Return the sentence that says how to convert a file with an example name to a PLY."""
    return f"Convert it first: `splat-transform {name} scene.ply` (https://github.com/playcanvas/splat-transform)."


def is_checkpoint(head: bytes) -> bool:
    """Return whether the first bytes of a file are those of a PyTorch checkpoint."""
    return (head.startswith(b"PK") and _CHECKPOINT in head[:200]) or head.startswith(_PICKLE)


def _is_html(head: bytes) -> bool:
    return head[:20].lower().startswith((b"<!doctype html", b"<html"))


def _begins(*starts: bytes, holding: bytes = b"") -> Callable[[bytes], bool]:
    """Return a check of the first bytes of a file, for words in lower case."""
    return lambda head: head.lower().startswith(starts) and holding in head.lower()


class Kind(NamedTuple):
    """Kind of files that cannot be read.

    Attributes:
        text: Description of them, and advice.
        head: Check of the first bytes of a file, without a byte order mark and leading blanks.
        suffixes: Ends of the names of such files only, in lower case.
        usual: Ends of the names of such files, which others have too.
        keys: Names in a JSON object, or in the first object of a list; one set for each variant.
        within: Patterns of files in a folder with such data.
    """

    text: str
    head: Callable[[bytes], bool] = lambda head: False
    suffixes: tuple[str, ...] = ()
    usual: tuple[str, ...] = ()
    keys: tuple[frozenset[str], ...] = ()
    within: tuple[str, ...] = ()


POINTER = Kind(
    "a pointer of Git LFS, not the file itself. Run `git lfs pull`.",
    lambda head: head.startswith(b"version https://git-lfs"),
)

#: Kinds of files that are no readable scenes. The first match counts.
SCENES = (
    Kind("empty. Copy or export it again.", lambda head: not head),
    Kind(
        "a checkpoint, not a scene. Make a PLY of it: `sgsst convert CHECKPOINT scene.ply` (gsplat, nerfstudio) or "
        "`ns-export gaussian-splat` (nerfstudio); the original 3DGS code has point_cloud/iteration_*/point_cloud.ply "
        "beside it.",
        is_checkpoint,
    ),
    POINTER,
    Kind(
        "a viewer of SuperSplat, with the scene in it or beside it. Export the scene as PLY or SOG instead.",
        lambda head: _is_html(head) and b"SuperSplat" in head,
    ),
    Kind("an HTML page, such as an error message. Download the scene again.", _is_html),
    Kind(
        "a tileset of 3D Tiles, whose data are in other files. Give the scene that it was made of.",
        _begins(b"{", holding=b'"geometricerror"'),
    ),
    Kind(f"a scene of XGRIDS. {converted('scene.lcc')}", _begins(b"{", holding=b'"totalsplats"'), (".lcc", ".lcc2")),
    Kind(
        "OpenUSD, which is written but not read. Give the scene that it was made of, or export it as PLY.",
        lambda head: head.startswith((b"PXR-USDC", b"#usda")) or (head.startswith(b"PK") and b".usd" in head[:200]),
    ),
    Kind(
        "an archive of NumPy arrays, such as those of gsplat, not a scene. Write a PLY of it with "
        "`gsplat.export_splats`, or give the checkpoint of the run (ckpts/*.pt).",
        lambda head: head.startswith(b"PK") and b".npy" in head[:200],
        (".npz",),
    ),
    Kind(
        "a dynamic scene, whose Gaussians move or exist at certain moments only. Export one moment as a static scene.",
        suffixes=(".sog4d", ".sog4d.zip", ".splat4d"),
    ),
    Kind(
        "a table of splat-transform, which cannot be read. Write a PLY instead: `splat-transform SOURCE scene.ply`.",
        _begins(b"x,y,z,", holding=b"f_dc_0"),
    ),
    Kind("a scene for streaming of Spark. Give the scene that it was made of.", _begins(b"rad0"), (".rad",)),
    Kind("an SPX scene. Convert it to PLY with gsbox (https://github.com/gotoeasy/gsbox).", _begins(b"spx"), (".spx",)),
    Kind(
        "a glTF document whose data are in other files. Save it as one GLB; Gaussians need KHR_gaussian_splatting.",
        _begins(b"{", holding=b'"asset"'),
        (".gltf",),
    ),
    Kind("an OBJ mesh without Gaussians. Train Gaussians on renders of it first.", suffixes=(".obj",)),
)

#: Kinds of files that are no readable cameras.
CAMERAS = (
    POINTER,
    Kind(
        "cameras of Metashape. Export them as Colmap (File > Export > Export Cameras, version 2.2 or later), or use "
        f"`ns-process-data metashape --xml cameras.xml --data IMAGES {_TRANSFORMS}",
        _begins(b"<?xml", b"<document", holding=b"<chunk"),
        usual=(".xml",),
    ),
    Kind(
        "cameras of RealityCapture. Export the registration in COLMAP's format, or use "
        f"`ns-process-data realitycapture --csv cameras.csv --data IMAGES {_TRANSFORMS}",
        _begins(b"#name,x,y,"),
        usual=(".csv",),
    ),
    Kind(f"a BlocksExchange file. {_AS_COLMAP}", lambda head: b"<blocksexchange" in head.lower()),
    Kind(
        "data of RealityCapture that only it reads. Export the registration in COLMAP's format from the project.",
        _begins(b"<realitycaptureproject"),
        (".rcproj", ".xmp"),
    ),
    Kind(
        "a Bundler file. Export COLMAP's format from the program that wrote it, or compute cameras from the photos "
        "with `colmap automatic_reconstructor --workspace_path OUT --image_path IMAGES` and give OUT/sparse/0.",
        _begins(b"# bundle file"),
        usual=(".out",),
        within=("bundle.out",),
    ),
    Kind(
        f"camera parameters of Pix4D. {_AS_COLMAP}",
        _begins(b"imagename x y z omega phi kappa"),
        ("_calibrated_external_camera_parameters.txt",),
    ),
    Kind(f"a model of VisualSFM. {_AS_COLMAP}", _begins(b"nvm_v3"), (".nvm",)),
    Kind(f"an animation file. {_AS_COLMAP}", _begins(b"ogawa", b"kaydara fbx binary"), (".abc", ".fbx")),
    Kind(
        "a database of COLMAP, which has no poses. Give the sparse model that `colmap mapper` writes: sparse/0.",
        _begins(b"sqlite format 3\0"),
        usual=(".db",),
    ),
    Kind(
        "a project of Metashape. Export its cameras as Colmap (File > Export > Export Cameras, version 2.2 or later).",
        suffixes=(".psx",),
    ),
    Kind("poses of LLFF, computed by COLMAP. Give the COLMAP model, such as sparse/0.", suffixes=("poses_bounds.npy",)),
    Kind(f"the cameras of a data set for NeuS. {_AS_COLMAP}", suffixes=("cameras_sphere.npz",)),
    Kind("an archive. Unpack it, and give the folder with the cameras.", suffixes=(".zip",)),
    Kind(
        f"raw data of Polycam. Convert it with `ns-process-data polycam --data EXPORT.zip {_TRANSFORMS}",
        keys=(frozenset({"t_00", "t_23", "fx"}),),
        within=("keyframes/*cameras",),
    ),
    Kind(
        f"data of Record3D. Convert it with `ns-process-data record3d --data FOLDER {_TRANSFORMS}",
        suffixes=(".r3d",),
        keys=(frozenset({"poses", "K"}),),
        within=("EXR_RGBD/metadata.json",),
    ),
    Kind(
        "a reconstruction of OpenSfM. Run `bin/opensfm export_colmap DATASET` and give the model that it writes.",
        keys=(frozenset({"cameras", "shots"}),),
        within=("reconstruction.json", "opensfm/reconstruction.json"),
    ),
    Kind(
        "a scene of OpenMVG. Convert it with `openMVG_main_openMVG2Colmap -i sfm_data.json -o OUT` and give OUT.",
        keys=(frozenset({"sfm_data_version"}),),
        within=("sfm_data.json",),
    ),
    Kind(
        "an export of `ns-export cameras`, which has no focal lengths. Give the transforms.json of the data set, with "
        "the dataparser_transforms.json of the training run beside it.",
        keys=(frozenset({"file_path", "transform"}),),
    ),
    Kind(
        f"a file of Meshroom. {_AS_COLMAP[:-1]} (Meshroom's node ExportColmap).",
        suffixes=(".sfm",),
        keys=(frozenset({"views", "intrinsics", "poses"}),),
    ),
    Kind(
        "a camera path of nerfstudio's viewer. Give the transforms.json of the data set.",
        keys=(frozenset({"camera_path"}),),
    ),
    Kind(
        "poses or settings of SuperSplat, which have no sizes of images. Give the cameras that the scene was trained "
        "with, or use --orbit.",
        keys=(frozenset({"position", "target"}), frozenset({"tonemapping", "cameras"})),
    ),
)

#: Properties that change what the usual ones mean: why the usual ones alone are not the scene, and what to do.
_CHANGED_MEANING: tuple[tuple[re.Pattern[str], str], ...] = (
    (
        re.compile(
            r"t|times?|(t|time)_(center|mean|scale|sigma|start|end)|(start|end)_time|trbf(_\w+)?|motion(_\w+)?|omega_\w+|sogst|sog4d"
            r"|f_t_\d+|(scale|scales|scaling|rot|rotation|opacity|xyz|mean|mu|center|sigma|cov)_t"
            r"|(rot|rotation)_r(_\w+)?|v[xyz]|vel(ocity|ocities)?(_\w+)?|durations?|life(span|time)"
        ),
        "a dynamic scene, whose Gaussians move or exist at certain moments only. Export one moment as a static scene",
    ),
    (
        re.compile(r"binding(_\d+)?|f_offset_\d+|f_anchor_feat_\d+"),
        "a scene whose Gaussians are relative to a mesh or to anchors. Export them in world coordinates",
    ),
    (
        re.compile(r"beta(_\d+)?|sb_params_\d+|shape(_\d+)?|scale_[3-9]|rot_[4-9]"),
        "a scene of another kernel than 3D Gaussians. Export it as one of 3D Gaussians",
    ),
)


def known_kind(path: Path, head: bytes, kinds: Iterable[Kind]) -> Kind | None:
    """Return the kind of a file by its first bytes or its name; None if it is of no known one."""
    name = path.name.lower()
    return next((kind for kind in kinds if kind.head(head) or name.endswith(kind.suffixes)), None)


def refuse_known(path: Path, kinds: Iterable[Kind], error: type[InvalidInputError]) -> None:
    """Raise an error that says what to do if the start or the name of a file is that of a known kind.

    Raises:
        InvalidInputError: If so, of the given type.
        OSError: If the file cannot be read.
    """
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES).removeprefix(b"\xef\xbb\xbf").lstrip()
    if kind := known_kind(path, head, kinds):
        raise error(f"{path}: is {kind.text}")


def refuse_changed_meaning(path: Path, names: Iterable[str]) -> None:
    """Raise a SceneError if a file has properties that change what the usual ones of a 3DGS scene mean.

    Args:
        names: Names of its properties, or of the attributes of a glTF primitive, which may have a prefix.
    """
    for name in names:
        plain = name.rpartition(":")[2].lstrip("_").lower()
        for pattern, text in _CHANGED_MEANING:
            if pattern.fullmatch(plain):
                raise SceneError(f"{path}: has the property {name!r}, so it is {text}.")


def refuse_scene_folder(folder: Path) -> NoReturn:
    """Raise a SceneError about a folder given as a scene: it names the scene in the folder, or how to export one."""
    for pattern in (*_SCENES_IN_RUNS, *_CHECKPOINTS_IN_RUNS):
        path = max(folder.glob(pattern), key=_numbers, default=None)
        if path is not None:
            if pattern in _CHECKPOINTS_IN_RUNS:
                raise SceneError(f"{folder}: is a folder. Make a scene of it: `sgsst convert {path} scene.ply`.")
            raise SceneError(f"{folder}: is a folder. Give the scene in it: {path}")
    raise SceneError(f"{folder}: is a folder. Give the file of a scene.")


def _numbers(path: Path) -> list[int]:
    """Return the numbers in a path, to find the scene of the last iteration."""
    return [int(number) for number in re.findall("[0-9]{1,18}", str(path))]


def advice_for_name(name: str) -> str:
    """Return advice for the name of a camera file of a known kind, with a leading space; empty for other names."""
    ends = ((end, kind.text) for kind in CAMERAS for end in kind.usual + kind.suffixes)
    return next((f" It may be {text}" for end, text in ends if name.lower().endswith(end)), "")


def refuse_camera_json(path: Path, content: Any) -> None:
    """Raise a CameraError that says what to do if the content of a JSON file is that of a known kind."""
    first = content[0] if isinstance(content, list) and content else content
    for kind in CAMERAS if isinstance(first, dict) else ():
        if any(names <= first.keys() for names in kind.keys):
            raise CameraError(f"{path}: is {kind.text}")


def refuse_camera_folder(folder: Path) -> None:
    """Raise a CameraError that says what to do if a folder holds data of a known kind."""
    for kind in CAMERAS:
        for match in (path for pattern in kind.within for path in folder.glob(pattern)):
            raise CameraError(f"{match}: is {kind.text}")

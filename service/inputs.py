"""Inputs of a job: its parameters as JSON, and its files, staged as `sgsst stylize` expects them.

The staging folder has links to the blobs under the users' names. PyTorch is not imported.
"""

import re
import unicodedata
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

from service import problems
from sgsst_core.errors import SettingsError
from sgsst_core.files.advice import advice_for_name
from sgsst_core.files.formats import format_of_name
from sgsst_core.settings import Option, checked
from worker import options
from worker.job import JobSpec, SceneRequest, scene_bytes

#: Maximum number of characters of a job's name.
MAX_JOB_NAME = 200
JobName = Annotated[str, Field(max_length=MAX_JOB_NAME, pattern=options.NO_CONTROLS)]


class JobParameters(options.StylizeOptions):
    """Parameters of a job; omitted ones take the preset's values, as for `sgsst stylize`."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [{"preset": "preview", "resolution": 480}, {"orbit": 24, "steps_sos": 100}],
            "x-groups": {title: [*names] for title, names in options.GROUPS.items()},
        }
    )

    name: Annotated[JobName, Option(default="the names of scene and style")] = Field(
        "", description="Display name; need not be unique."
    )
    retention_days: Annotated[float | None, Option(unit="days", metavar="N", default="the service's")] = Field(
        None,
        gt=0,
        allow_inf_nan=False,
        description="Days after the job's end until its results are deleted; at most the service's. Its record is "
        "deleted after as many more.",
    )
    style_weights: Annotated[
        list[Annotated[float, Field(gt=0, allow_inf_nan=False)]] | None, Option(instead="--style FILE:WEIGHT")
    ] = Field(
        None,
        min_length=1,
        max_length=options.MOST_STYLE_IMAGES,
        description="Weight of each style image that belongs to no region, in upload order: images are mixed in "
        "proportion. Default: equal weights.",
    )
    regions: Annotated[list[options.RegionOptions] | None, Option(instead="--region NAME:SPEC")] = Field(
        None,
        max_length=options.MOST_REGIONS + 1,
        description="Regions of the scene, each with its own style or frozen. Where regions overlap, the later one "
        "wins.",
    )
    painted: Annotated[list[options.PaintedOptions] | None, Option(instead="--view NAME=FILE")] = Field(
        None,
        max_length=options.MOST_PAINTED,
        description="Views of the painted files, in upload order. Without views, the files state them.",
    )

    @property
    def region_requests(self) -> tuple[options.RegionRequest, ...]:
        """Return the requested regions.

        Raises:
            SettingsError: If the regions are inconsistent.
        """
        return options.region_requests(self.regions or (), exists=lambda path: False)

    @property
    def renders_views(self) -> bool:
        """Whether checking the files renders views: to select a region by their masks, or to find a painted one."""
        masks = [region.selection and region.selection.kind == "masks" for region in self.region_requests]
        return self.painted is not None or any(masks)

    def check_painted(self, count: int) -> None:
        """Check that the parameters are those of a job with `count` painted files.

        Raises:
            SettingsError: If one does not apply, or there are more views than files.
        """
        if (views := len(self.painted or ())) > count:
            raise SettingsError(
                f"painted has {views} views, but there are {count} painted files. Send a file for each."
            )
        given = {name for name in self.model_fields_set if getattr(self, name) is not None}
        if count and (unused := sorted(given - _WITH_PAINTED)):
            raise SettingsError(f"{unused[0]} does not apply to a job with painted files. Omit it.")


#: Parameters that apply to jobs with painted files.
_WITH_PAINTED = {"name", "painted", "background", "pad_sh", *options.ViewOptions.model_fields}


def stored_parameters(values: Mapping[str, Any]) -> JobParameters:
    """Return the parameters of a stored job.

    Raises:
        SettingsError: If this version does not support them.
    """
    try:
        return checked(JobParameters, values)
    except SettingsError as error:
        raise SettingsError(
            f"{error} The job was stored by an earlier version that accepted this. Submit a new job without it."
        ) from error


#: Name of the stylized scene; the names of a job's other files are derived from it.
RESULT = "stylized.ply"
#: Name of the checkpoint that an unfinished job resumes from; the leading dot hides it from users.
CHECKPOINT = ".checkpoint"
#: Name of the plan of a dry run in an attempt's folder.
PLAN = "plan.safetensors"
ROLES = ("scene", "style", "cameras", "photos", "mask", "painted")
#: Roles whose files keep their folders: cameras and regions refer to them by relative paths.
_FOLDER_ROLES = ("photos", "mask")
#: Maximum number of style images: those that belong to no region, plus one for each region.
MOST_STYLES = options.MOST_STYLE_IMAGES + options.MOST_REGIONS
#: Maximum number of camera files: a COLMAP model has up to five (cameras, images, points3D, rigs, frames), and a
#: transforms.json may come with a dataparser_transforms.json.
MAX_CAMERA_FILES = 8
_CAMERA_SUFFIXES = {".json", ".bin", ".txt"}
#: Maximum bytes of a path component, as of file systems, and number of components.
_MAX_NAME, _MAX_DEPTH = 255, 8
#: Characters that no name keeps: control characters, separators of lines, marks that reorder text, and surrogates
#: (bytes that are not UTF-8).
_UNFIT = re.compile("[\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
_FALLBACKS = {"scene": "scene.ply", "style": "style", "cameras": "cameras.json", "mask": "mask.bin"}


class Staged(BaseModel):
    """Paths of a job's files relative to the staging folder, so that reports do not reveal its location."""

    model_config = ConfigDict(frozen=True)

    scene: Path
    styles: tuple[Path, ...]
    cameras: Path | None
    photos: Path | None
    painted: tuple[Path, ...] = ()


def staged_name(role: str, name: str, number: int = 0) -> str:
    """Return the name under which an input is staged: its own, with composed accents, inside its folder.

    Cameras and regions refer to photos and masks by their names, so these keep all characters and their folders. Other
    files keep only the last path component, and less of it if a file system may not hold it.

    Args:
        name: Name that the user gave it, with slashes or backslashes between folders.
        number: Number of the input, for one without a name.

    Raises:
        INVALID_INPUT: If a photo or mask cannot keep its name.
    """
    parts = PurePosixPath(unicodedata.normalize("NFC", name).replace("\\", "/")).parts
    given = [part for part in parts if part not in ("/", "..", ".")]
    safe = [*filter(None, map(_safe, given))]
    if role not in _FOLDER_ROLES:
        safe = safe[-1:]
    elif safe != given or len(given) > _MAX_DEPTH:
        raise problems.INVALID_REQUEST(
            f"The name {ascii(name)[:200]} of {role!r} has more than {_MAX_DEPTH} parts, or a part that starts with a "
            f"dot, has more than {_MAX_NAME} bytes, is not UTF-8 or holds control characters. Rename the file.",
            input=role,
        )
    return "/".join(safe) or _FALLBACKS.get(role, f"photo_{number}")


def _safe(part: str) -> str:
    """Return a path component itself if a file system can hold it and shows it, else plain characters from its end."""
    if not part.startswith(".") and not _UNFIT.search(part) and len(part.encode()) <= _MAX_NAME:
        return part
    plain = re.sub(r"[^\w .+@,=()-]+", "_", part).encode()[-_MAX_NAME // 2 :].decode(errors="ignore").strip()
    return f"_{plain[1:]}" if plain.startswith(".") else plain


def default_job_name(inputs: Sequence[Mapping[str, Any]], regions: Sequence[options.RegionRequest] = ()) -> str:
    """Return the name of a job whose request has none: "scene · painting", without the paintings of regions."""
    scene = next(entry["name"] for entry in inputs if entry["role"] == "scene")
    taken = region_styles(regions)
    shown = ("style", "painted")
    names = [entry["name"] for entry in inputs if entry["role"] in shown and entry["name"] not in taken]
    styles = [PurePosixPath(name).stem for name in names]
    format = format_of_name(scene)
    plain = scene[: -len(format.suffix)] if format else PurePosixPath(scene).stem
    return f"{plain} · {' + '.join(styles)}"[:MAX_JOB_NAME]


def scene_size(inputs: Sequence[Mapping[str, Any]]) -> int:
    """Return the size of a job's scene in bytes, once it is read."""
    return sum(scene_bytes(entry["name"], entry["size"]) for entry in inputs if entry["role"] == "scene")


def region_styles(regions: Sequence[options.RegionRequest]) -> list[str]:
    """Return the staged names of the style files of regions."""
    return [staged_name("style", str(file.path)) for region in regions for file in region.styles]


def region_mask(region: options.RegionRequest) -> Path | None:
    """Return the staged path of a region's mask or folder of masks; None if it is selected in another way."""
    path = region.selection and region.selection.path
    return Path("mask", staged_name("mask", str(path))) if path else None


def check_roles(
    inputs: Sequence[Mapping[str, Any]],
    *,
    orbit: bool,
    weights: Sequence[float] | None = None,
    regions: Sequence[options.RegionRequest] = (),
) -> None:
    """Raise an error unless a job has exactly the files that it needs.

    Args:
        orbit: Whether the parameters ask for an orbit, which excludes camera files; without these, it is the default.
        weights: Weights of the style images that belong to no region; None for equal weights.
        regions: Regions of the job, whose styles and masks must be among the inputs.

    Raises:
        INVALID_INPUT: If a file is missing, superfluous or inconsistent with the parameters.
    """
    by_role = {role: [entry for entry in inputs if entry["role"] == role] for role in ROLES}
    painted = bool(by_role["painted"])
    for role, most in (("scene", 1), ("painted", options.MOST_PAINTED) if painted else ("style", MOST_STYLES)):
        if not 1 <= len(by_role[role]) <= most:
            what = "is missing" if not by_role[role] else f"was sent {len(by_role[role])} times"
            times = "once" if most == 1 else f"once, or up to {most} of them"
            raise problems.INVALID_REQUEST(f"The file {role!r} {what}. Send it {times}.", input=role)
    if painted and (other := next((role for role in ("style", "photos", "mask") if by_role[role]), None)):
        raise problems.INVALID_REQUEST(f"A job with painted files has no file {other!r}. Omit it.", input=other)
    own = 0 if painted else _check_region_styles([entry["name"] for entry in by_role["style"]], region_styles(regions))
    _check_region_masks([entry["name"] for entry in by_role["mask"]], regions)
    if weights is not None and len(weights) != own:
        raise problems.INVALID_REQUEST(
            f"style_weights has {len(weights)} values for {own} files 'style' that belong to no region. Give one per "
            "file, in the same order.",
            input="style_weights",
        )
    unfit = partial(problems.INVALID_INPUT, code="invalid-cameras")
    if by_role["cameras"] and orbit:
        raise unfit("Both 'cameras' and the parameter 'orbit' were sent. Send only one of them.", input="cameras")
    if by_role["photos"] and not by_role["cameras"]:
        raise unfit(
            "'photos' requires 'cameras', and cannot be combined with an orbit. Send the cameras of the photos.",
            input="photos",
        )
    _check_camera_files([entry["name"] for entry in by_role["cameras"]])
    _check_names(inputs)


def _check_region_styles(names: Sequence[str], of_regions: Sequence[str]) -> int:
    """Verify that the styles of regions have been sent, and return the number of style images without a region."""
    missing = next((name for name in of_regions if name not in names), None)
    if missing is not None:
        raise problems.INVALID_REQUEST(
            f"A region's style is {missing!r}, but no file 'style' has that name; the names are "
            f"{', '.join(names)}. Send it, or correct the name.",
            input="style",
        )
    own = len([name for name in names if name not in of_regions])
    if not own:
        raise problems.INVALID_REQUEST(
            "Every file 'style' belongs to a region. Send one more for the rest of the scene.", input="style"
        )
    return own


def _check_region_masks(names: Sequence[str], regions: Sequence[options.RegionRequest]) -> None:
    """Verify that the masks of regions have been sent, and that every mask belongs to a region."""
    unused = set(names)
    for region in regions:
        path = region_mask(region)
        if path is None or region.selection is None:
            continue
        folder = region.selection.kind == "masks"
        sent = {name: Path("mask", name) for name in names}
        matching = {name for name, file in sent.items() if (path in file.parents if folder else path == file)}
        if not matching:
            raise problems.INVALID_REQUEST(
                f"Region {region.name!r} is selected by {region.selection.text}, but no file 'mask' has that "
                f"{'folder' if folder else 'name'}. Send it, or correct the name.",
                input="mask",
            )
        unused -= matching
    if unused:
        raise problems.INVALID_REQUEST(
            f"The mask {min(unused)!r} belongs to no region. Select a region by mask=NAME or masks=FOLDER, or leave "
            "out the file.",
            input="mask",
        )


def _check_names(inputs: Sequence[Mapping[str, Any]]) -> None:
    """Reject inputs of a role with the same name, except for case, or if the name of one is the folder of another."""
    paths = [PurePosixPath(entry["role"], entry["name"].lower()) for entry in inputs]
    taken = Counter(paths)
    for path, entry in zip(paths, inputs, strict=True):
        role, name = entry["role"], entry["name"]
        if taken[path] > 1:
            raise problems.INVALID_REQUEST(f"Two files of {role!r} have the name {name!r}. Rename one.")
        if any(folder in taken for folder in path.parents):
            raise problems.INVALID_REQUEST(f"A file of {role!r} is also the folder of {name!r}. Rename one.")


def _check_camera_files(names: Sequence[str]) -> None:
    if len(names) > MAX_CAMERA_FILES:
        raise problems.INVALID_INPUT(
            f"There are {len(names)} camera files. Send the three files of a COLMAP model.", code="invalid-cameras"
        )
    unsupported = next((name for name in names if PurePosixPath(name).suffix.lower() not in _CAMERA_SUFFIXES), None)
    if unsupported is not None:
        raise problems.INVALID_INPUT(
            f"The camera file {unsupported!r} is none of *.json, *.bin and *.txt.{advice_for_name(unsupported)} Send a "
            "cameras.json, a transforms.json, or the files of a COLMAP model, with their own names.",
            code="invalid-cameras",
            input="cameras",
        )


def layout(inputs: Sequence[Mapping[str, Any]]) -> tuple[Staged, list[tuple[Path, str]]]:
    """Return the staged paths by role, and the path and SHA-256 of each file.

    Args:
        inputs: Inputs with `role`, `name` (from `staged_name`) and `sha256`.
    """
    files = [(Path(entry["role"], entry["name"]), entry["sha256"]) for entry in inputs]
    by_role = {role: [path for path, _ in files if path.parts[0] == role] for role in ROLES}
    (scene,), photos = by_role["scene"], Path("photos") if by_role["photos"] else None
    cameras = _camera_path(by_role["cameras"])
    styles, painted = tuple(by_role["style"]), tuple(by_role["painted"])
    return Staged(scene=scene, styles=styles, cameras=cameras, photos=photos, painted=painted), files


def stage(folder: Path, inputs: Sequence[Mapping[str, Any]], blobs: Mapping[str, Path]) -> Staged:
    """Link a job's inputs into a folder.

    Args:
        blobs: Local paths of the files by digest.
    """
    staged, files = layout(inputs)
    for path, sha256 in files:
        link = folder / path
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(blobs[sha256])
    return staged


def _camera_path(files: Sequence[Path]) -> Path | None:
    """Return the path of the cameras: the only file, the transforms.json, or the folder of a COLMAP model."""
    jsons = [path for path in files if path.suffix.lower() == ".json" and path.name != "dataparser_transforms.json"]
    if len(jsons) == 1 or len(files) == 1:
        return (jsons or files)[0]
    return Path("cameras") if files else None


def _regions(staged: Staged, parameters: JobParameters) -> tuple[options.RegionRequest, ...]:
    """Return the regions with the paths of their staged styles and masks."""
    paths = {path.name: path for path in staged.styles}
    return tuple(
        replace(
            region,
            selection=region.selection and replace(region.selection, path=region_mask(region)),
            styles=tuple(replace(file, path=paths[staged_name("style", str(file.path))]) for file in region.styles),
        )
        for region in parameters.region_requests
    )


def job_spec(staged: Staged, parameters: JobParameters) -> JobSpec:
    """Return the specification of a job; its paths are relative to the staging folder."""
    taken = region_styles(parameters.region_requests)
    own = [path for path in staged.styles if path.name not in taken]
    weights = parameters.style_weights or [1.0] * len(own)
    views = [*(parameters.painted or ()), *[options.PaintedOptions()] * len(staged.painted)]
    return JobSpec(
        source=SceneRequest.of(staged.scene, staged.cameras, parameters),
        styles=tuple(options.StyleFile(path, weight) for path, weight in zip(own, weights, strict=True)),
        images=staged.photos,
        out=Path("out", RESULT),
        settings=parameters.settings(),
        backbone=parameters.backbone,
        regions=_regions(staged, parameters),
        colors=True,
        style_background=parameters.style_background,
        pad_sh=parameters.pad_sh,
        paintings=tuple(map(options.PaintedFile, staged.painted, views)),
    )


class WorkRequest(BaseModel):
    """Request to read the files of a job.

    Attributes:
        work: Kind of work, from `process.WORK`.
        staged: Paths of the files, relative to the folder, which for work on the job's result also has that (`RESULT`).
        seconds: Limit of CPU time in seconds.
        memory: Memory limit in bytes for reading.
        limits: Limits of the service for a job's inputs; empty for work on results.
        options: Values that only one kind of work needs.
        output: Name and maximum bytes of the only file that may be written; None for none.
    """

    model_config = ConfigDict(frozen=True)

    work: str
    folder: Path
    staged: Staged
    parameters: JobParameters
    seconds: float
    memory: int
    limits: dict[str, int] = {}
    options: dict[str, Any] = {}
    output: tuple[str, int] | None = None
    threads: int = 1

    @property
    def source(self) -> SceneRequest:
        """Return the request for scene and cameras."""
        return SceneRequest.of(self.staged.scene, self.staged.cameras, self.parameters)

    @property
    def output_file(self) -> Path:
        """Return the file to write, relative to the folder."""
        assert self.output is not None
        return Path(self.output[0])

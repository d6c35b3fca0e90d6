"""A job as data: what is asked (`JobSpec`), its files (`Outputs`), and what came out (`Result`).

They are dumped once and sent, stored and shown unchanged; `sgsst_core.progress` has what is happening. Output files of
jobs and commands are checked before any work starts. Neither PyTorch nor Ray is imported.
"""

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from sgsst_core.errors import CameraError, OutputError, SettingsError
from sgsst_core.files.atomic import ensure_writable_folder
from sgsst_core.files.camera_folder import cameras_beside
from sgsst_core.files.formats import RESULT_SUFFIXES, format_of_name, read_scene_header
from sgsst_core.files.formats.ply import PLY
from sgsst_core.files.formats.scene_format import SceneFormat
from sgsst_core.files.formats.sog import STREAMED_SOG
from sgsst_core.settings import Color, Settings
from worker.options import Backbone, PaintedFile, RegionRequest, StyleFile, ViewOptions

#: Reasons of an early end after which a job can be continued: it keeps its checkpoint.
CONTINUABLE = ("within", "on-request")
#: Bytes of a Gaussian of SH degree 3 in memory: 62 float32 values.
GAUSSIAN_BYTES = 248
#: Bytes that a rank needs in addition to the scene: libraries of CUDA and PyTorch, and pinned buffers.
_RANK_BYTES = 3_000_000_000
#: Copies of the scene that a rank has while it is loaded: the arrays read from the file, and those it computes with.
_SCENE_COPIES = 2


class SceneRequest(ViewOptions):
    """Scene and cameras of a request.

    Attributes:
        scene: Path of the 3DGS scene, in any of `FORMATS`.
        cameras: Camera file or folder; None for an orbit, whose number of views is automatic unless `orbit` has it.
    """

    scene: Path
    cameras: Path | None = None

    @staticmethod
    def of(scene: Path, cameras: Path | None, options: ViewOptions) -> "SceneRequest":
        """Return a request for these files with the view options of `options`, whose other fields are ignored."""
        seen = options.model_dump(include=set(ViewOptions.model_fields))
        return SceneRequest(scene=scene, cameras=cameras, **seen)


class JobSpec(BaseModel):
    """Specification of one job, which stylizes a scene or lets it follow painted views.

    Attributes:
        styles: Style images and their weights; empty with `paintings`.
        images: Folder of photos for the content term; None for unstylized renders.
        out: PLY to write, or compressed file to write beside a PLY; see `Outputs.of`.
        resume: Whether to resume from the checkpoint beside `out`.
        regions: Regions with their own style or frozen colors, from `region_requests`.
        colors: Whether to also write a file of the stylized colors alone, if nothing else of the scene changes.
        style_background: sRGB color behind transparent parts of style images, in 0..1.
        pad_sh: Whether the PLY has spherical harmonics of degree 3 in any case; see `write_stylized`.
        paintings: Painted views, which the scene follows. Then nothing is stylized, and of `settings` only the
            background counts.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    source: SceneRequest
    styles: tuple[StyleFile, ...]
    images: Path | None = None
    out: Path
    settings: Settings
    backbone: Backbone = "auto"
    resume: bool = False
    regions: tuple[RegionRequest, ...] = ()
    colors: bool = False
    style_background: Color = (1.0, 1.0, 1.0)
    pad_sh: bool = False
    paintings: tuple[PaintedFile, ...] = ()


class Result(BaseModel):
    """Result of a job. Its record in the service leaves out the last three fields, which the report has in detail.

    Attributes:
        stopped: Reason why the job ended; see `stylizing.loop.run`. If it is "interrupted", only a checkpoint was
            written.
        steps, total: Number of completed steps, and number of all steps.
        loss_before: Mean loss of the unstylized scene on the evaluation views; None if the job was interrupted.
        loss_after: Mean loss of the last round of views, over the same scales; None if the job was interrupted.
        psnr_before, psnr_after: Peak signal-to-noise ratio in dB on the painted pixels; None without painted views.
        report_error: Reason why the report, contact sheet or loss curves are missing; None if they were written.
        compressed: Text about the quality of the compressed file; None if no compressed file was requested.
        loss_views: Number of evaluation views, which are spread over all.
        loss_over_time: Summary for the report; None if no step was made on all scales.
    """

    model_config = ConfigDict(frozen=True)

    stopped: str
    steps: int
    total: int
    loss_before: float | None = None
    loss_after: float | None = None
    psnr_before: float | None = None
    psnr_after: float | None = None
    report_error: str | None = None
    compressed: str | None = Field(None, exclude=True)
    loss_views: int = Field(0, exclude=True)
    loss_over_time: dict[str, Any] | None = Field(None, exclude=True)


@dataclass(frozen=True)
class Resume:
    """Choice of the checkpoint that a job resumes from.

    Attributes:
        wanted: Whether to resume; False starts from the beginning.
        required: Whether a missing or unusable checkpoint is an error. If False, the job then starts from the
            beginning.
        run: Identifier of the run whose checkpoints are accepted; None accepts all checkpoints of the same job.
    """

    wanted: bool
    required: bool = True
    run: str | None = None


def default_cameras(scene: Path, options: ViewOptions) -> tuple[Path | None, str]:
    """Return the cameras of a scene for which none are given, and a line that says so.

    They are those beside the scene, or else an orbit (None), whose options exclude a search.

    Raises:
        CameraError: If it is unclear which file is meant; see `cameras_beside`.
    """
    if options.orbit is not None or options.elevation is not None or options.radius is not None:
        return None, ""
    if (cameras := cameras_beside(scene)) is not None:
        return cameras, f"The cameras are those of {cameras}; --cameras and --orbit choose others."
    return None, f"There are no cameras beside {scene}, so its views are on an orbit (--orbit auto)."


def check_choice(source: SceneRequest, images: Path | None = None) -> None:
    """Check that cameras come from one source, and that photos are given only with camera files.

    Raises:
        CameraError: If the options contradict each other.
    """
    if source.cameras is not None and source.orbit is not None:
        raise CameraError("Both --cameras and --orbit are given. Use only one of them.")
    if source.cameras is not None and (source.elevation is not None or source.radius is not None):
        raise CameraError("--elevation and --radius place an orbit. Omit --cameras or them.")
    if images is not None and source.cameras is None:
        raise CameraError("--images requires the cameras of the photos. Add --cameras, or omit --images.")


def check_steps(settings: Settings) -> None:
    """Check that there is at least one step.

    Raises:
        SettingsError: If both numbers of steps are 0.
    """
    if not settings.steps_coarse + settings.steps_sos:
        raise SettingsError("Both numbers of steps are 0, so that nothing would change. Give some.")


def scene_bytes(name: str, size: int) -> int:
    """Estimate the bytes of a scene in memory from its file.

    Args:
        name: Name of the file; its ending determines the format.
        size: Size of the file in bytes.
    """
    format = format_of_name(name)
    return size if format is None else size * GAUSSIAN_BYTES // format.bytes_per_gaussian


def memory_beside_gpus(ranks: int, scene: int) -> int:
    """Estimate the host memory in bytes of `ranks` ranks on one machine with a scene of `scene` bytes."""
    return ranks * (_RANK_BYTES + _SCENE_COPIES * scene)


#: Other suffixes of the same kind of file.
_OTHER_SUFFIXES = {".jpg": ".jpeg", ".html": ".htm"}


def result_format(out: Path) -> SceneFormat:
    """Return the format of a scene to write, by its file name.

    Raises:
        OutputError: If the name does not end in a suffix of a format that can be written.
    """
    format = format_of_name(out.name)
    if format is None or format.write is None:
        raise OutputError(f"{out}: does not end in {RESULT_SUFFIXES}. Name the scene file to write.")
    return format


def check_suffix(out: Path, kind: str, example: str) -> None:
    """Check the suffix of a file to write: a mistyped path must not overwrite a scene.

    Args:
        kind: Kind of the file, with its article, for the message.
        example: Name such as "plan.json", whose suffix the file must have.

    Raises:
        OutputError: If it has another suffix.
    """
    suffix = Path(example).suffix
    if out.suffix.lower() not in (suffix, _OTHER_SUFFIXES.get(suffix)):
        raise OutputError(f"{out}: not the name of {kind}. Give one, such as {example}.")


def check_is_not_input(out: Path, path: Path, description: str = "scene itself", remark: str = "") -> None:
    """Check that an output is not one of the inputs.

    Args:
        description: Name of the input in the message.
        remark: Text about the output for the message.

    Raises:
        OutputError: If both are the same file.
    """
    if out.exists() and path.exists() and out.samefile(path):
        raise OutputError(f"{out}{remark}: is the {description}, which would be overwritten. Give another file name.")


def check_file(out: Path) -> None:
    """Check that a file can be written, in a folder that may be missing. Creates nothing.

    Raises:
        OutputError: If it is a folder, or its folder cannot be written or created.
    """
    if out.is_dir():
        raise OutputError(f"{out}: is a folder. Name a file in it.")
    check_folder(Path(os.path.realpath(out)).parent)


def check_folder(folder: Path) -> None:
    """Check that a folder is writable or can be created, without creating it.

    Raises:
        OutputError: If the folder cannot be written or created.
    """
    while not (folder.exists() or folder.is_symlink()) and folder != folder.parent:
        folder = folder.parent
    ensure_writable_folder(folder)


#: Ending of each file beside a job's PLY, by its attribute.
_SUFFIXES = {
    "report": ".report.json",
    "page": ".report.html",
    "plan": ".plan.json",
    "views": ".views.jpg",
    "sheet": ".before_after.jpg",
    "curves": ".loss.png",
    "checkpoint": ".checkpoint.safetensors",
    "colors": ".colors.f16",
}


@dataclass(frozen=True)
class Outputs:
    """Output files of a job, named after its PLY so that jobs can share a folder.

    Attributes:
        compressed: Stylized scene in another format, which the suffix of its name determines; None if not requested.
        report, page, plan: Report as JSON and as HTML, and plan as JSON.
        views: Unstylized renders of an orbit's views.
        checkpoint: Newest checkpoint.
    """

    ply: Path
    compressed: Path | None = None
    report: Path = field(init=False)
    page: Path = field(init=False)
    plan: Path = field(init=False)
    views: Path = field(init=False)
    sheet: Path = field(init=False)
    curves: Path = field(init=False)
    checkpoint: Path = field(init=False)
    colors: Path = field(init=False)

    def __post_init__(self) -> None:
        """Name the files beside the PLY."""
        for name, suffix in _SUFFIXES.items():
            object.__setattr__(self, name, self.ply.with_name(self.ply.stem + suffix))

    @staticmethod
    def of(out: Path) -> "Outputs":
        """Return the output files of a job, given the name of its PLY or of the compressed file beside it.

        Raises:
            OutputError: If the name does not end in a suffix of a format that can be written.
        """
        format = STREAMED_SOG if format_of_name(out.name) is STREAMED_SOG else result_format(out)
        if format is PLY:
            return Outputs(out)
        return Outputs(out.with_name(out.name[: -len(format.suffix)] + PLY.suffix), out)

    @property
    def compressed_format(self) -> SceneFormat | None:
        """Return the format of the compressed file; None if there is none."""
        return None if self.compressed is None else format_of_name(self.compressed.name)

    @property
    def all(self) -> list[Path]:
        """Return the paths of all output files."""
        paths = [self.ply, *(getattr(self, name) for name in _SUFFIXES)]
        return paths if self.compressed is None else [*paths, self.compressed]


def check_request(request: JobSpec) -> Outputs:
    """Check a request as far as possible without reading the inputs, and return the output files. Creates nothing.

    Raises:
        InvalidInputError: If there are no steps, options contradict each other, or the outputs cannot be written.
    """
    check_choice(request.source, request.images)
    out = request.out
    check_file(out)
    outputs = Outputs.of(out)
    if request.paintings:
        result_format(out)  # which a streamed SOG has not
    else:
        check_steps(request.settings)
    written = [out, outputs.report, outputs.plan, outputs.colors] if request.paintings else outputs.all
    inputs = {request.source.scene: "scene itself"}
    if request.source.cameras is not None:
        inputs[request.source.cameras] = "camera file"
    every = (request.styles, *(region.styles for region in request.regions))
    inputs |= {style.path: "style image" for styles in every for style in styles}
    inputs |= {painting.path: "painted image" for painting in request.paintings}
    for path in written:
        remark = "" if path == out else f" (written beside {out.name})"
        for read, description in inputs.items():
            check_is_not_input(path, read, description, remark)
    if outputs.compressed_format is STREAMED_SOG:
        _check_levels(request)
    return outputs


def _check_levels(request: JobSpec) -> None:
    """Check that a job can write a streamed SOG: it takes all but colors from that of its scene.

    Raises:
        OutputError: If the scene is no streamed SOG, or the job changes more than its colors.
    """
    scene, out, settings = request.source.scene, request.out, request.settings
    if read_scene_header(scene).format is not STREAMED_SOG:
        raise OutputError(f"{out}: is written only if the scene is a streamed SOG. Name a {RESULT_SUFFIXES}.")
    if settings.growth > 1 or settings.sh_attenuation or request.source.drop_invalid:
        raise OutputError(
            f"{out}: a streamed SOG differs from that of the scene only in its colors. Omit --refine, --sh-attenuation "
            f"and --drop-invalid, or name a {RESULT_SUFFIXES}."
        )

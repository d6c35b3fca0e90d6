"""A job as data: what is asked (`JobSpec`) and what came out (`Result`); `sgsst_core.progress` has what is happening.

They are dumped once and sent, stored and shown unchanged. Neither PyTorch nor Ray is imported.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from sgsst_core.errors import CameraError, SettingsError
from sgsst_core.files.camera_folder import cameras_beside
from sgsst_core.files.formats import format_of_name
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
    def of(scene: Path, cameras: Path | None, options: ViewOptions) -> SceneRequest:
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

"""Requests and output files of jobs, checked before any input is read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from sgsst_core.errors import CameraError, SettingsError
from sgsst_core.files.formats import format_of_name
from sgsst_core.files.formats.ply import PLY
from sgsst_core.files.formats.scene_format import SceneFormat
from sgsst_core.settings import Settings
from sgsst_core.stylizing.checkpoint import Checkpoints
from worker.options import Backbone, JobVideo, ViewOptions
from worker.outputs import check_file, check_is_not_input, result_format
from worker.region_requests import RegionRequest
from worker.styles import StyleFile


class SceneRequest(ViewOptions):
    """Scene and cameras of a request.

    Attributes:
        scene: Path of the 3DGS scene, in any of `FORMATS`.
        cameras: Camera file or folder; None for an orbit.
    """

    scene: Path
    cameras: Path | None = None

    @staticmethod
    def of(scene: Path, cameras: Path | None, options: ViewOptions) -> SceneRequest:
        """Return a request for these files with the view options of `options`, whose other fields are ignored."""
        seen = options.model_dump(include=set(ViewOptions.model_fields))
        return SceneRequest(scene=scene, cameras=cameras, **seen)


@dataclass(frozen=True)
class StylizeRequest:
    """Request for one stylization job.

    Attributes:
        source: Scene and cameras.
        styles: Style images and their weights.
        images: Folder of photos for the content term; None for unstylized renders.
        out: PLY to write, or compressed file to write beside a PLY; see `Outputs.of`.
        backbone: Feature network.
        resume: Whether to resume from the checkpoint beside `out`.
        settings: Settings of the method.
        regions: Regions with their own style or frozen colors, from `region_requests`.
        colors: Whether to also write a file of the stylized colors alone, if nothing else of the scene changes.
        style_background: sRGB color behind transparent parts of style images, in 0..1.
        video: Options of a video of the result; None for no video.
    """

    source: SceneRequest
    styles: tuple[StyleFile, ...]
    images: Path | None
    out: Path
    backbone: Backbone
    resume: bool
    settings: Settings
    regions: tuple[RegionRequest, ...] = ()
    colors: bool = False
    style_background: tuple[float, float, float] = (1.0, 1.0, 1.0)
    video: JobVideo | None = None


@dataclass(frozen=True)
class Outputs:
    """Output files of a job, named after its PLY so that jobs can share a folder.

    Attributes:
        ply: Stylized scene.
        compressed: Stylized scene in another format, which the suffix of its name determines; None if not requested.
    """

    ply: Path
    compressed: Path | None = None

    @staticmethod
    def of(out: Path) -> Outputs:
        """Return the output files of a job, given the name of its PLY or of the compressed file beside it.

        Raises:
            OutputError: If the name does not end in a suffix of a format that can be written.
        """
        format = result_format(out)
        if format is PLY:
            return Outputs(out)
        return Outputs(out.with_name(out.name[: -len(format.suffix)] + PLY.suffix), out)

    @property
    def compressed_format(self) -> SceneFormat | None:
        """Return the format of the compressed file; None if there is none."""
        return None if self.compressed is None else format_of_name(self.compressed.name)

    def _beside(self, suffix: str) -> Path:
        return self.ply.with_name(self.ply.stem + suffix)

    @property
    def report(self) -> Path:
        """Return the path of the JSON report."""
        return self._beside(".report.json")

    @property
    def page(self) -> Path:
        """Return the path of the HTML report."""
        return self._beside(".report.html")

    @property
    def plan(self) -> Path:
        """Return the path of the JSON plan."""
        return self._beside(".plan.json")

    @property
    def sheet(self) -> Path:
        """Return the path of the contact sheet."""
        return self._beside(".before_after.jpg")

    @property
    def views(self) -> Path:
        """Return the path of the unstylized renders of an orbit's views."""
        return self._beside(".views.jpg")

    @property
    def curves(self) -> Path:
        """Return the path of the loss curves."""
        return self._beside(".loss.png")

    @property
    def colors(self) -> Path:
        """Return the path of the stylized colors alone."""
        return self._beside(".colors.f16")

    @property
    def video(self) -> Path:
        """Return the path of the video."""
        return self._beside(".video.mp4")

    @property
    def checkpoint(self) -> Path:
        """Return the path of the newest checkpoint."""
        return self._beside(".checkpoint.safetensors")

    @property
    def all(self) -> list[Path]:
        """Return the paths of all output files except the older checkpoint, which is only created by renaming."""
        paths = [self.ply, self.report, self.page, self.plan, self.views, self.sheet, self.curves, self.checkpoint]
        paths += [self.colors, self.video]
        return paths if self.compressed is None else [*paths, self.compressed]

    @property
    def checkpoints(self) -> Checkpoints:
        """Return the checkpoints from which an unfinished job can resume."""
        return Checkpoints(self.checkpoint)


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


def check_choice(source: SceneRequest, images: Path | None = None) -> None:
    """Check that cameras come from exactly one source, and that photos are given only with camera files.

    Raises:
        CameraError: If the options contradict each other or no cameras are given.
    """
    if source.cameras is None and source.orbit is None:
        raise CameraError(
            "There are no cameras. Give a camera file with --cameras, or --orbit N for N views around the scene."
        )
    if source.cameras is not None and source.orbit is not None:
        raise CameraError("Both --cameras and --orbit are given. Use only one of them.")
    if source.orbit is None and (source.elevation is not None or source.radius is not None):
        raise CameraError("--elevation and --radius require --orbit. Add it, or omit them.")
    if images is not None and source.orbit is not None:
        raise CameraError(
            "--images requires --cameras, and cannot be combined with --orbit. Use --cameras, or omit --images."
        )


def check_steps(settings: Settings) -> None:
    """Check that there is at least one step.

    Raises:
        SettingsError: If both numbers of steps are 0.
    """
    if not settings.steps_coarse + settings.steps_sos:
        raise SettingsError("Both numbers of steps are 0, so that nothing would change. Give some.")


def check_request(request: StylizeRequest) -> Outputs:
    """Check a request as far as possible without reading the inputs, and return the output files. Creates nothing.

    Raises:
        InvalidInputError: If there are no steps or no cameras, or the outputs cannot be written.
    """
    check_steps(request.settings)
    check_choice(request.source, request.images)
    out = request.out
    check_file(out)
    outputs = Outputs.of(out)
    for path in (outputs.ply, outputs.compressed):
        if path is not None:
            remark = "" if path == out else f" (the PLY beside {out.name})"
            check_is_not_input(path, request.source.scene, remark=remark)
    return outputs

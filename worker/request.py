"""What a job is asked for and which files it writes, checked before anything is read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from sgsst_core.errors import CameraError, OutputError, SettingsError
from sgsst_core.files.atomic import ensure_writable_folder
from sgsst_core.files.scene_headers import PackedForm, form_of_name
from sgsst_core.settings import Settings
from sgsst_core.stylizing.checkpoint import Checkpoints
from worker.options import Backbone, ViewOptions
from worker.regions import RegionRequest
from worker.styles import StyleFile


class SceneRequest(ViewOptions):
    """A scene and the cameras to see it with, as the user names them.

    Attributes:
        scene: 3DGS scene: PLY, compressed PLY, SPZ or .splat.
        cameras: camera file or folder; None for an orbit.
    """

    scene: Path
    cameras: Path | None = None

    @staticmethod
    def of(scene: Path, cameras: Path | None, options: ViewOptions) -> SceneRequest:
        """These files, seen as some options say, which may have others beside."""
        seen = options.model_dump(include=set(ViewOptions.model_fields))
        return SceneRequest(scene=scene, cameras=cameras, **seen)


@dataclass(frozen=True)
class StylizeRequest:
    """What `sgsst stylize` was asked for.

    Attributes:
        source: scene and cameras.
        styles: style pictures, with their weights.
        images: folder of photos for the content term; None for unstylized renders.
        out: PLY to write, or packed file to write beside one: see `Outputs.of`.
        backbone: feature network.
        resume: go on from the checkpoint beside `out`.
        settings: everything else.
        regions: of the scene, that have a style of their own or are kept; from `region_requests`.
        colors: write the stylized colors alone, too, where nothing else of the scene changes.
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


@dataclass(frozen=True)
class Outputs:
    """The files of a job, named after its PLY so that jobs can share a folder.

    Attributes:
        ply: the stylized scene.
        packed: the same in a packed form, which its name's ending tells; None where nobody wants it.
    """

    ply: Path
    packed: Path | None = None

    @staticmethod
    def of(out: Path) -> Outputs:
        """By the name that the user gave: a PLY's own, or that of a packed file beside it.

        Raises:
            OutputError: it has another ending.
        """
        form = form_of_name(out.name)
        if form is None:
            raise OutputError(f"{out}: does not end in .ply, .compressed.ply or .spz. Name the scene file to write.")
        if form == "ply":
            return Outputs(out)
        return Outputs(out.with_name(out.name[: -len(form) - 1] + ".ply"), out)

    @property
    def packed_form(self) -> PackedForm | None:
        """Form of the packed file."""
        return None if self.packed is None else "spz" if form_of_name(self.packed.name) == "spz" else "compressed.ply"

    def _beside(self, suffix: str) -> Path:
        return self.ply.with_name(self.ply.stem + suffix)

    @property
    def report(self) -> Path:
        """The report."""
        return self._beside(".report.json")

    @property
    def page(self) -> Path:
        """The report for people."""
        return self._beside(".report.html")

    @property
    def plan(self) -> Path:
        """The plan."""
        return self._beside(".plan.json")

    @property
    def sheet(self) -> Path:
        """The contact sheet."""
        return self._beside(".before_after.jpg")

    @property
    def views(self) -> Path:
        """The views of an orbit, before the start."""
        return self._beside(".views.jpg")

    @property
    def curves(self) -> Path:
        """The loss curves."""
        return self._beside(".loss.png")

    @property
    def colors(self) -> Path:
        """The stylized colors alone."""
        return self._beside(".colors.f16")

    @property
    def checkpoint(self) -> Path:
        """The newest of the `checkpoints`."""
        return self._beside(".checkpoint.safetensors")

    @property
    def all(self) -> list[Path]:
        """Every file, but for the older checkpoint, which is never written itself."""
        found = [self.ply, self.report, self.page, self.plan, self.views, self.sheet, self.curves, self.checkpoint]
        found.append(self.colors)
        return found if self.packed is None else [*found, self.packed]

    @property
    def checkpoints(self) -> Checkpoints:
        """Where an unfinished job can go on from."""
        return Checkpoints(self.checkpoint)


@dataclass(frozen=True)
class Resume:
    """Whether a job goes on from a checkpoint.

    Attributes:
        wanted: False starts from the beginning.
        required: a checkpoint that is missing or cannot be used is an error; otherwise the job starts from the
            beginning.
        run: take only what this run of the program has written; None takes any of the same job.
    """

    wanted: bool
    required: bool = True
    run: str | None = None


def check_choice(source: SceneRequest, images: Path | None = None) -> None:
    """Prove that there is one source of cameras, and photos only of known ones.

    Raises:
        CameraError: otherwise.
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
    """Prove that there is something to do.

    Raises:
        SettingsError: otherwise.
    """
    if not settings.steps_coarse + settings.steps_sos:
        raise SettingsError("Both numbers of steps are 0, so that nothing would change. Give some.")


def check_request(request: StylizeRequest) -> Outputs:
    """The output's file names, after a look at what can be checked without reading the inputs; creates nothing.

    Raises:
        InvalidInputError: no steps, no cameras, or outputs that cannot be written.
    """
    check_steps(request.settings)
    check_choice(request.source, request.images)
    out = request.out
    if out.is_dir():
        raise OutputError(f"{out}: is a folder. Give the PLY file to write, such as {out / 'stylized.ply'}.")
    outputs = Outputs.of(out)
    for path in (outputs.ply, outputs.packed):
        if path and path.exists() and request.source.scene.exists() and path.samefile(request.source.scene):
            beside = "" if path == out else f" (the PLY beside {out.name})"
            raise OutputError(
                f"{path}{beside}: is the scene itself, which would be overwritten. Give another file name."
            )
    check_folder(out.parent)
    return outputs


def check_folder(folder: Path) -> None:
    """Prove that a folder can be written to, or created, without creating it.

    Raises:
        OutputError: it cannot.
    """
    while not (folder.exists() or folder.is_symlink()) and folder != folder.parent:
        folder = folder.parent
    ensure_writable_folder(folder)

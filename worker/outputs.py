"""Output files of jobs and commands, checked before any work starts. PyTorch is not imported."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path

from sgsst_core.errors import OutputError
from sgsst_core.files.atomic import ensure_writable_folder
from sgsst_core.files.formats import RESULT_SUFFIXES, format_of_name, read_scene_header
from sgsst_core.files.formats.ply import PLY
from sgsst_core.files.formats.scene_format import SceneFormat
from sgsst_core.files.formats.sog import STREAMED_SOG
from worker.job import JobSpec, check_choice, check_steps

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
    def of(out: Path) -> Outputs:
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
    check_steps(request.settings)
    check_choice(request.source, request.images)
    out = request.out
    check_file(out)
    outputs = Outputs.of(out)
    inputs = {request.source.scene: "scene itself"}
    if request.source.cameras is not None:
        inputs[request.source.cameras] = "camera file"
    styles = (*request.styles, *(style for region in request.regions for style in region.styles))
    inputs |= {style.path: "style image" for style in styles}
    for path in outputs.all:
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

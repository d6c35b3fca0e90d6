"""Arguments and options that several commands have in common."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from api.cli.console import error_console
from sgsst_core.errors import OutputError, SettingsError
from sgsst_core.files.formats import SUFFIXES, scene_path
from worker.options import (
    ESSENTIALS,
    REGIONS,
    SHAPES,
    VIEWS,
    RegionOptions,
    StylizeOptions,
    ViewOptions,
    parse_styles,
    path_or_url,
    region_options,
    region_requests,
)
from worker.outputs import check_file, check_folder

if TYPE_CHECKING:
    from worker.job import JobSpec, SceneRequest


def local_path(text: str) -> Path:
    """Return the path of a local file.

    Raises:
        SettingsError: If `text` is a URL.
    """
    path = path_or_url(text)
    if isinstance(path, str):
        raise SettingsError(f"{text}: only `sgsst submit` takes URLs. Download the file, and give its path.")
    return path


def _checking(check: Callable[[Path], None]) -> Callable[..., Path | None]:
    """Return the callback of an option that names a path to write; the message of an error names the option."""

    def checked(context: typer.Context, parameter: typer.CallbackParam, path: Path | None) -> Path | None:
        try:
            if path is not None:
                context.obj.expect(path)
                check(path)
        except OutputError as error:
            raise OutputError(f"{parameter.metavar or parameter.opts[0]}: {error}") from error
        return path

    return checked


#: Callbacks that check the file or the folder that an option names, before the command reads anything; the last one is
#: for a path that the command itself checks.
file_to_write, folder_to_write, path_to_write = map(_checking, (check_file, check_folder, lambda path: None))


def path_to_read(help: str, **how: Any) -> Any:
    """Return an option that names a local file or folder to read, with further arguments of `typer.Option`."""
    return typer.Option(parser=local_path, metavar="PATH", help=help, **how)


_SCENE: dict[str, Any] = {"metavar": "SCENE", "help": f"3DGS scene: {SUFFIXES}.", "show_default": False}
_CAMERAS: dict[str, Any] = {
    "metavar": "PATH",
    "help": "cameras.json (INRIA), folder of a COLMAP sparse model, or transforms.json (nerfstudio, Blender). "
    "[default: those beside the scene, else an orbit]",
    "rich_help_panel": ESSENTIALS,
}
SceneArgument = Annotated[Path, typer.Argument(parser=local_path, **_SCENE)]
CamerasOption = Annotated[Path | None, typer.Option(parser=local_path, **_CAMERAS)]
_STYLE = path_to_read("Style image.", show_default=False, rich_help_panel=ESSENTIALS)
StyleOption = Annotated[Path, _STYLE]
OptionalStyleOption = Annotated[Path | None, _STYLE]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON.")]


def cameras_of(scene: str | Path, given: Any, options: ViewOptions) -> Any:
    """Return the given cameras of a scene; without any, those of `default_cameras`, and print which they are."""
    from worker.job import default_cameras

    path = path_or_url(scene)
    if given is not None or isinstance(path, str):
        return given
    cameras, line = default_cameras(scene_path(path), options)
    if line:
        error_console.print(line)
    return cameras


def source_of(scene: Path, cameras: Path | None, options: ViewOptions) -> SceneRequest:
    """Return the request for a scene, whose cameras are those of `cameras_of`."""
    from worker.job import SceneRequest

    return SceneRequest.of(scene, cameras_of(scene, cameras, options), options)


def _of_region(metavar: str, help: str) -> Any:
    """Return an option of regions."""
    return typer.Option(metavar=metavar, help=help, rich_help_panel=REGIONS)


@dataclass(frozen=True)
class JobInputs:
    """Files and regions of a job, as given on the command line; see `with_arguments`.

    Scene, style and cameras are texts, because `sgsst submit` also accepts URLs, which a `Path` would change.
    """

    scene: Annotated[str, typer.Argument(**_SCENE)]
    style: Annotated[
        list[str],
        typer.Option(
            metavar="FILE[:WEIGHT]",
            help="Style image; may be repeated. Several are mixed in proportion to their weights.",
            rich_help_panel=ESSENTIALS,
            show_default=False,
        ),
    ]
    cameras: Annotated[str | None, typer.Option(**_CAMERAS)] = None
    images: Annotated[
        Path | None,
        typer.Option(
            help="Folder of photos for the content term. [default: unstylized renders]", rich_help_panel=VIEWS
        ),
    ] = None
    region: Annotated[
        list[str] | None,
        _of_region(
            "NAME:SPEC",
            f"Region of the scene: {SHAPES}, mask=FILE (a flag for each Gaussian, in file order: packed bits in a "
            ".bin, or .npy) or masks=FOLDER (images of views, white inside the region). May be repeated; where regions "
            "overlap, the later one wins.",
        ),
    ] = None
    region_style: Annotated[
        list[str] | None,
        _of_region("NAME=FILE[:WEIGHT]", "Style image of a region. Several are mixed. [default: the job's style]"),
    ] = None
    region_weight: Annotated[
        list[str] | None, _of_region("NAME=WEIGHT", "Weight of a region's style in the loss. [default: 1]")
    ] = None
    region_freeze: Annotated[
        list[str] | None,
        _of_region("NAME", "Freeze a region: its colors stay bit-identical. rest: all Gaussians without a region."),
    ] = None
    region_content_weight: Annotated[
        list[str] | None,
        _of_region(
            "NAME=W",
            "Weight of the content term in a region: a number, light, balanced or strong. [default: the job's]",
        ),
    ] = None

    @property
    def regions(self) -> tuple[RegionOptions, ...]:
        """Regions of the job.

        Raises:
            SettingsError: If an option of a region is malformed.
        """
        return region_options(
            self.region or (),
            self.region_style or (),
            self.region_weight or (),
            self.region_freeze or (),
            self.region_content_weight or (),
        )

    def request(self, options: StylizeOptions, out: Path, *, resume: bool = False) -> JobSpec:
        """Return the request of a job on this machine.

        Raises:
            SettingsError: If options are malformed or contradict each other, or a file is a URL.
        """
        from worker.job import JobSpec

        for style in self.style:
            local_path(style)
        cameras = None if self.cameras is None else local_path(self.cameras)
        return JobSpec(
            source=source_of(local_path(self.scene), cameras, options),
            styles=parse_styles(self.style),
            images=self.images,
            out=out,
            backbone=options.backbone,
            resume=resume,
            settings=options.settings(),
            regions=region_requests(self.regions),
            style_background=options.style_background,
            pad_sh=options.pad_sh,
        )

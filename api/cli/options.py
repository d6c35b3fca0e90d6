"""Arguments and options of commands, from declarations of their own or the fields of a class."""

import inspect
import itertools
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

import typer
from pydantic import BaseModel, ValidationError

from api.cli.console import error_console
from sgsst_core.errors import OutputError, SettingsError
from sgsst_core.files.formats import SUFFIXES, scene_path
from sgsst_core.settings import BY_PRESET, Declared, declared, merged, reason
from worker.job import JobSpec, SceneRequest, check_file, check_folder, default_cameras
from worker.options import (
    ESSENTIALS,
    GROUPS,
    REGIONS,
    SHAPES,
    VIEWS,
    PaintedFile,
    RegionOptions,
    StylizeOptions,
    ViewOptions,
    parse_styles,
    path_or_url,
    region_options,
    region_requests,
)

Command = Callable[..., None]
M = TypeVar("M", bound=BaseModel)


def with_options(
    model: type[BaseModel],
    argument: str = "options",
    *,
    only: Collection[str] | None = None,
    without: Collection[str] = (),
) -> Callable[[Command], Command]:
    """Return a decorator that replaces one argument of a command by options, one per field of a model.

    The decorated function receives an instance of the model. Only options given on the command line are set in it.

    Args:
        argument: Name of the function's argument that receives the model.
        only: Names of the options to offer; None for all.
        without: Names of options to leave out.
    """
    options = declared(model)
    names = (options.keys() if only is None else set(only)) - set(without)
    in_order = [*itertools.chain(*GROUPS.values()), *options]
    parameters = {name: _parameter(options[name]) for name in in_order if name in options.keys() & names}

    def build(given: dict[str, Any]) -> BaseModel:
        return _checked(model, {name: value for name, value in given.items() if value is not None})

    return _expanding(argument, parameters, build)


def with_arguments(group: type) -> Callable[[Command], Command]:
    """Return a decorator that replaces the argument `inputs` of a command by the fields of a dataclass.

    Args:
        group: Dataclass whose fields are annotated with `typer.Argument` or `typer.Option`.
    """
    return _expanding("inputs", inspect.signature(group, eval_str=True).parameters, lambda given: group(**given))


def _expanding(
    argument: str, parameters: Mapping[str, inspect.Parameter], build: Callable[[dict[str, Any]], object]
) -> Callable[[Command], Command]:
    """Return a decorator that replaces one argument of a command by several parameters.

    typer reads options from a signature alone, so the decorator makes one; written by hand, each option would be
    repeated in every command that offers it.

    Args:
        build: Function that converts the values of the parameters to the argument of the decorated function.
    """

    def decorate(function: Command) -> Command:
        def command(**arguments: Any) -> None:
            given = {name: arguments.pop(name) for name in parameters}
            function(**arguments, **{argument: build(given)})

        expanded: list[inspect.Parameter] = []
        for parameter in inspect.signature(function, eval_str=True).parameters.values():
            expanded += parameters.values() if parameter.name == argument else [parameter]
        expanded = [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in expanded]
        command.__name__, command.__doc__ = function.__name__, function.__doc__
        command.__annotations__ = {each.name: each.annotation for each in expanded}
        command.__signature__ = inspect.Signature(expanded)  # type: ignore[attr-defined]
        return command

    return decorate


def flags(option: Declared) -> str:
    """Return the command-line flags of an option, such as "--seed" or "--bounded/--no-bounded"."""
    plain = "--" + option.name.replace("_", "-")
    if option.option.flags or not is_switch(option):
        return option.option.flags or plain
    return plain if option.info.default is False else f"{plain}/--no-{plain[2:]}"


def metavar(option: Declared) -> str:
    """Return the placeholder of an option's value in the help; empty for a switch."""
    kind = kind_of(option)
    if is_switch(option):
        return ""
    if get_origin(kind) is Literal:
        return f"<{'|'.join(get_args(kind))}>"
    return option.option.metavar or f"<{kind.__name__}>"


def help_text(option: Declared) -> str:
    """Return the help of an option: its meaning, its default and its valid values."""
    syntax = option.option.syntax
    parts = [option.help.removesuffix(".") + syntax if syntax else option.help]
    default = option.text(option.info.default)
    if not (is_switch(option) and option.info.default is False):
        parts.append(f"[{default}]" if default.startswith(BY_PRESET) else f"[default: {default}]")
    if option.bounds and not option.option.parse:
        parts.append(f"[{option.bounds}]")
    return "  ".join(parts)


def _parameter(option: Declared) -> inspect.Parameter:
    """Return an option as a function parameter. typer validates words and switches, the model all other values."""
    kind: Any = kind_of(option) if is_switch(option) or get_origin(kind_of(option)) is Literal else str
    placeholder: dict[str, Any] = {} if is_switch(option) else {"metavar": metavar(option)}
    group = next((title for title, names in GROUPS.items() if option.name in names), None)
    declaration = typer.Option(
        flags(option), help=help_text(option), parser=option.option.parse, rich_help_panel=group, **placeholder
    )
    return inspect.Parameter(
        option.name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=Annotated[kind | None, declaration]
    )


def kind_of(option: Declared) -> Any:
    """Return the type of an option's values, without None and bounds. For a union, return its first type."""
    annotation = option.info.annotation
    kinds = [kind for kind in get_args(annotation) if kind is not type(None)]
    first = kinds[0] if get_origin(annotation) in (Union, UnionType) else annotation
    return get_args(first)[0] if get_origin(first) is Annotated else first


def is_switch(option: Declared) -> bool:
    """Return whether an option is a switch, which takes no value."""
    return kind_of(option) is bool


def _checked(model: type[M], given: dict[str, object]) -> M:
    """Return an instance of a model with the given values.

    Raises:
        SettingsError: If a value is invalid; the message names the option.
    """
    try:
        return model.model_validate(given)
    except ValidationError as error:
        first = merged(error.errors())[0]
        option = flags(declared(model)[str(first["loc"][0])])
        raise SettingsError(f"{option} {first['input']}: {reason(first)}.") from error


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

    def checked(parameter: typer.CallbackParam, path: Path | None) -> Path | None:
        try:
            if path is not None:
                check(path)
        except OutputError as error:
            raise OutputError(f"{parameter.metavar or parameter.opts[0]}: {error}") from error
        return path

    return checked


#: Callbacks that check the file or the folder that an option names, before the command reads anything.
file_to_write, folder_to_write = _checking(check_file), _checking(check_folder)


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
PaintedOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="[NAME=]FILE",
        help="Painted image of a view, of the same size as the view; may be repeated. Transparent pixels are left "
        "alone. A PNG that states its view needs no name.",
        rich_help_panel=ESSENTIALS,
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON.")]
KeyOption = Annotated[str | None, typer.Option("--key", help="API key. [default: SGSST_KEY]")]


def cameras_of(scene: str | Path, given: Any, options: ViewOptions) -> Any:
    """Return the given cameras of a scene; without any, those of `default_cameras`, and print which they are."""
    path = path_or_url(scene)
    if given is not None or isinstance(path, str):
        return given
    cameras, line = default_cameras(scene_path(path), options)
    if line:
        error_console.print(line)
    return cameras


def source_of(scene: Path, cameras: Path | None, options: ViewOptions) -> SceneRequest:
    """Return the request for a scene, whose cameras are those of `cameras_of`."""
    return SceneRequest.of(scene, cameras_of(scene, cameras, options), options)


_STYLES = typer.Option(
    metavar="FILE[:WEIGHT]",
    help="Style image; may be repeated. Several are mixed in proportion to their weights.",
    rich_help_panel=ESSENTIALS,
    show_default=False,
)


def _of_region(metavar: str, help: str) -> Any:
    """Return an option of regions."""
    return typer.Option(metavar=metavar, help=help, rich_help_panel=REGIONS)


@dataclass(frozen=True)
class JobArguments:
    """Files and regions of a job, as given on the command line; see `with_arguments`.

    Scene, style and cameras are texts, because `sgsst submit` also accepts URLs, which a `Path` would change.
    """

    scene: Annotated[str, typer.Argument(**_SCENE)]
    style: Annotated[list[str], _STYLES]
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


@dataclass(frozen=True)
class SubmittedArguments(JobArguments):
    """Files and regions of a job for a service, which stylizes the scene or lets it follow painted views."""

    style: Annotated[list[str], _STYLES] = ()  # type: ignore[assignment]  # typer makes lists
    view: PaintedOption = None

    @property
    def painted(self) -> list[PaintedFile]:
        """Painted files.

        Raises:
            SettingsError: If there are style images too, or the name of a view cannot be one.
        """
        if self.view and self.style:
            raise SettingsError("--style and --view are given. Stylize first, then paint on the result, or vice versa.")
        return [PaintedFile.parse(text) for text in self.view or ()]

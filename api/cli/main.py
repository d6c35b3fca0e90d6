"""The `sgsst` command: its commands by group, and messages for expected errors."""

import io
import json
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from typing import Annotated, Any

import typer

from api import installed_version
from api.cli import ABORTED, INTERRUPTED
from api.cli.console import BAD_INPUT, CONFLICT, FAILURE, NOT_FOUND, Invocation, error_console
from service.states import ACTIONS
from sgsst_core.errors import InvalidInputError, SgsstError, is_out_of_memory
from sgsst_core.files.atomic import DISK_FULL
from worker.processes import process_start

#: Extra that installs a module, for modules that some commands need.
_EXTRAS = {
    **dict.fromkeys(("alembic", "fastapi", "fsspec", "pydantic_settings", "ray", "sqlalchemy", "uvicorn"), "service"),
    **{"av": "video", "mcp": "mcp", "psycopg": "postgresql", "s3fs": "s3"},
}
#: Summaries of commands and groups of commands, by their modules, which are imported when one is called.
_SUMMARIES: dict[str, dict[str, str]] = {
    "stylize_commands": {
        "stylize": "Stylize a scene with one or several style images.",
        "demo": "Stylize a built-in scene, lifted from a stereo photograph, in a few minutes.",
        "batch": "Stylize several scenes in each of several styles; what is done already is not repeated.",
    },
    "scene_commands": {
        "plan": "Show what a stylization would skip and why, and what a step would cost.",
        "check": "Report extreme values in a scene, its views and its style, and their consequences.",
        "render": "Render all views of a scene as images, a video along a camera path, or a 360-degree image.",
        "convert": "Convert a scene to another format, which the name of OUT determines.",
        "blend": "Blend scenes that differ only in color: a scene and its results, or several results.",
        "view": "Write a scene as one HTML file, which shows it in 3D in a browser, without a server.",
        "paint": "Paint one view or several, and the scene follows.",
        "bench": "Benchmarks for your own scene and machine.",
        "study": "Blind comparisons of results by eye.",
    },
    "machine_commands": {
        "doctor": "Examine this machine: GPU, precision, memory, weights, caches, and correct results.",
        "weights": "Weights of the feature network.",
        "serve": "Run the service on this machine: HTTP API and dispatcher.",
        "fsck": "Check all files of the service against its database; the service may be running.",
        "keys": "API keys of the service on this machine.",
    },
    "client_commands": {
        "submit": "Submit a job to a service, with the options of stylize.",
        "status": "Show the status of a job.",
        "watch": "Show the progress of a job until it ends; exit with 5 if it does not succeed.",
        "download": "Download a job's result or other files; an interrupted download resumes.",
        **{action.value: ACTIONS[action].help for action in ACTIONS},
        "share": "Create a read-only link to a result, for people without a key.",
        "delete": "Delete a finished job and its results.",
        "jobs": "List jobs, newest first.",
        "usage": "Show jobs, seconds and bytes by day and key.",
        "mcp": "Serve the tools of a language model on standard input and output, by the Model Context Protocol.",
    },
}
#: Module of each command.
_MODULES = {name: module for module, names in _SUMMARIES.items() for name in names}
#: Base of errors in the arguments, which typer does not export.
_UsageError: Any = typer.BadParameter.__base__


class _Commands(Mapping[str, Any]):
    """All commands by name. Each is made when it is needed, since NumPy and pydantic take most of a short call."""

    def __iter__(self) -> Iterator[str]:
        return iter(_MODULES)

    def __len__(self) -> int:
        return len(_MODULES)

    def __getitem__(self, name: str) -> Any:
        members = vars(import_module(f"api.cli.{_MODULES[name]}"))
        alone = typer.Typer(rich_markup_mode=None)
        if group := members.get(f"{name}_app"):
            alone.add_typer(group, name=name)
        else:
            alone.command(cls=_Command)(members[name] if name in members else members["ACTION_COMMANDS"][name])
        alone.callback()(lambda: None)
        commands: Any = typer.main.get_command(alone)
        return commands.commands[name]


class _Program(typer.core.TyperGroup):
    """The command `sgsst`. Ctrl-C aborts every command that does not handle it itself."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        self.commands = _Commands()  # type: ignore[assignment]

    def format_commands(self, ctx: Any, formatter: Any) -> None:  # noqa: ARG002 (of typer)
        """Write the summaries of all commands."""
        with formatter.section("Commands"):
            formatter.write_dl([item for names in _SUMMARIES.values() for item in names.items()])

    def invoke(self, ctx: Any) -> Any:
        """Run a command; KeyboardInterrupt becomes Abort, because typer would turn it into a silent exit."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt as interrupt:
            raise typer.Abort() from interrupt


class _Command(typer.core.TyperCommand):
    """Command whose help lists its options by group."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the arguments, then the options of each group; options without a group come before the experts'."""
        from worker.options import EXPERT, GROUPS

        titles = ("Arguments", *(title for title in GROUPS if title != EXPERT), "Options", EXPERT)
        sections: dict[str, list[tuple[str, str]]] = {title: [] for title in titles}
        for parameter in self.get_params(ctx):
            panel = getattr(parameter, "rich_help_panel", None)
            title = "Arguments" if parameter.param_type_name == "argument" else panel or "Options"
            if (record := parameter.get_help_record(ctx)) is not None:
                sections[title].append(record)
        for title, records in sections.items():
            if records:
                with formatter.section(title):
                    formatter.write_dl(records)


app = typer.Typer(
    cls=_Program,
    help="Style transfer for 3D Gaussian Splatting scenes (SGSST).",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 120},
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


@app.callback(invoke_without_command=True)
def program(version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False) -> None:
    """Style transfer for 3D Gaussian Splatting scenes (SGSST)."""
    if version:
        print(f"sgsst {installed_version()}")
        raise typer.Exit()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line, and return its exit code. Expected errors become one message on stderr, no traceback."""
    started = process_start() if arguments is None else time.time()
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":  # file names hold any characters
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        code = app(args=arguments, prog_name="sgsst", obj=Invocation(arguments, started), standalone_mode=False)
        return code if isinstance(code, int) else 0
    except _UsageError as error:
        error.message = error.message.removeprefix("Value error, ")  # typer validates by pydantic
        if "--json" in arguments:
            _print_error(arguments, "usage", error.format_message())
        else:
            error.show()
        return BAD_INPUT
    except SgsstError as error:
        _print_error(arguments, error.code, str(error), getattr(error, "problem", None))
        usual = BAD_INPUT if isinstance(error, InvalidInputError) else FAILURE
        codes = {404: NOT_FOUND, 409: CONFLICT, 422: BAD_INPUT}
        return codes.get(getattr(error, "status", 0), usual)  # status of a response, or of the service's own error
    except ModuleNotFoundError as error:
        module = (error.name or "").partition(".")[0]
        if module not in _EXTRAS:
            raise
        extra = f"which the extra `{_EXTRAS[module]}` installs. Run `pip install 'sgsst-service[{_EXTRAS[module]}]'`."
        _print_error(arguments, "missing-extra", f"this command needs {module}, {extra}")
        return BAD_INPUT
    except (KeyboardInterrupt, typer.Abort):
        error_console.print(ABORTED)
        return INTERRUPTED
    except OSError as error:  # such as a name that is too long, a folder that denies access, or a full disk
        full = error.errno in DISK_FULL
        if error.filename is None and not full:
            raise
        where = error.filename or "The standard output or a temporary file"
        problem = f"{where}: {error.strerror}. {'Free some space' if full else 'Check the path'}."
        _print_error(arguments, "path", problem)
        return BAD_INPUT
    except (MemoryError, RuntimeError) as error:
        if not is_out_of_memory(error):
            raise
        advice = "out of memory. Use a smaller --resolution, fewer --views or a --memory-limit."
        _print_error(arguments, "out-of-memory", advice)
        return FAILURE


def _print_error(arguments: Sequence[str], code: str, detail: str, problem: object = None) -> None:
    """Print an error on stderr; with --json, as a line of JSON with the fields of a problem document, if any."""
    if "--json" in arguments:
        document = problem if isinstance(problem, Mapping) else {}  # the service's own errors have its type instead
        print(json.dumps({"code": code, "detail": detail, **document}), file=sys.stderr)
    else:
        error_console.print(f"error: {detail}")

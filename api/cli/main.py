"""The `sgsst` command: its commands by group, and messages for expected errors."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Annotated

import typer

from api.cli import client_commands, operator_commands
from api.cli.bench_commands import bench_app
from api.cli.console import BAD_INPUT, FAILURE, error_console, out_console
from api.cli.doctor_command import doctor
from api.cli.extras import missing_extra
from api.cli.scene_commands import check, convert, plan, render
from api.cli.study_commands import study_app
from api.cli.stylize_commands import demo, stylize
from api.cli.weights_commands import weights_app
from sgsst_core.errors import InvalidInputError, SettingsError, SgsstError
from sgsst_core.options import renamed_hint

app = typer.Typer(
    help="Style transfer for 3D Gaussian Splatting scenes (SGSST).",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
for command in (
    stylize,
    plan,
    check,
    render,
    convert,
    demo,
    doctor,
    *client_commands.COMMANDS,
    *operator_commands.COMMANDS,
):
    app.command()(command)
app.add_typer(weights_app, name="weights")
app.add_typer(bench_app, name="bench")
app.add_typer(study_app, name="study")
app.add_typer(operator_commands.keys_app, name="keys")


@app.callback(invoke_without_command=True)
def program(version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False) -> None:
    """Style transfer for 3D Gaussian Splatting scenes (SGSST)."""
    if version:
        from sgsst_core.report.machine import program_version

        out_console.print(f"sgsst {program_version()}")
        raise typer.Exit()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line. Expected errors become one message on stderr and an exit code, without a traceback."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    try:
        _check_names(arguments)
        app(args=arguments, prog_name="sgsst", obj=arguments)
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    except SgsstError as error:
        error_console.print(f"error: {error}")
        return BAD_INPUT if isinstance(error, InvalidInputError) else FAILURE
    except ModuleNotFoundError as error:
        problem = missing_extra(error)
        if problem is None:
            raise
        error_console.print(f"error: {problem}")
        return BAD_INPUT
    except KeyboardInterrupt:
        error_console.print("Aborted.")
        return 130
    except BrokenPipeError:  # for example `sgsst weights list | head`
        return FAILURE
    except (MemoryError, RuntimeError) as error:
        if not _out_of_memory(error):
            raise
        error_console.print("error: out of memory. Use a smaller --resolution, fewer --views or a --memory-limit.")
        return FAILURE
    return 0


def _check_names(arguments: Sequence[str]) -> None:
    """Raise a SettingsError if an option is given by a former name."""
    for argument in arguments:
        flag = argument.partition("=")[0]
        if flag.startswith("--") and (hint := renamed_hint(flag)):
            raise SettingsError(f"{flag}: {hint}.")


def _out_of_memory(error: Exception) -> bool:
    """Return whether an error reports a lack of memory.

    PyTorch raises a plain RuntimeError on the CPU, and a subclass of it on GPUs.
    """
    text = str(error)
    return isinstance(error, MemoryError) or "can't allocate memory" in text or "out of memory" in text


if __name__ == "__main__":
    sys.exit(main())

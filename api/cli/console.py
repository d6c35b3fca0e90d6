"""Consoles of the command line, and exit codes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console

from sgsst_core.loss.convergence import ratio

#: Exit codes: an unusable input or option, and any other failure.
BAD_INPUT, FAILURE = 2, 1
#: Exit codes of client commands: no such job or file, a job whose status does not allow the request, and a job that
#: did not succeed.
NOT_FOUND, CONFLICT, JOB_FAILED = 3, 4, 5
#: Exit code after Ctrl-C, as in shells.
INTERRUPTED = 130

out_console = Console(highlight=False, markup=False, emoji=False, soft_wrap=True)
error_console = Console(stderr=True, highlight=False, markup=False, emoji=False, soft_wrap=True)


def loss_text(before: float, after: float) -> str:
    """Return the loss before and after a job, and their ratio; say so if the loss has risen."""
    relative = ratio(after, before)
    text = f"{before:.4g} before, {after:.4g} after" + ("" if relative is None else f" ({relative:.1%})")
    risen = "; it has risen: give more steps, unless the scene already matched the style"
    return text + (risen if after > before else "")


def print_field(name: str, value: object) -> None:
    """Print one line of a command's results; the values of all lines are aligned."""
    out_console.print(f"{name + ':':<22}{value}")


@contextmanager
def spinner(text: str) -> Iterator[None]:
    """Show a spinner on a terminal, and nothing elsewhere."""
    if not error_console.is_terminal:
        yield
        return
    with error_console.status(text):
        yield

"""Generator of the options reference: `python -m api.cli.options_table > docs/options.md`."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import Literal, get_args, get_origin

from api.cli.options import flags, is_switch, kind_of, metavar
from service.parameters import JobParameters
from sgsst_core.options import Declared, declared
from sgsst_core.settings import Settings
from worker.options import RunOptions, ViewOptions

_BEGINNING = """\
# Options

All options of a job, with what holds where one is not given. `sgsst stylize` and `sgsst submit` take them by the names
in the first column, a job's `parameters` (REST, `Client.submit`) by those in the second. `sgsst plan` takes what
`stylize` takes; `check`, `render` and `bench error-time` take what bears on them. Files are named in each command's
`--help`.

Made by `python -m api.cli.options_table > docs/options.md` from the fields that declare the options: `ViewOptions`,
`StylizeOptions` and `RunOptions` in `worker/options.py`, `Settings` in `sgsst_core/settings.py`, `JobParameters` in
`service/parameters.py`.
"""


def reference() -> str:
    """Return the reference page as Markdown."""
    told, settings = declared(JobParameters), declared(Settings).keys()
    seen = ViewOptions.model_fields.keys()
    groups = {
        "How a scene is seen": [told[name] for name in told if name in seen],
        "The method": [told[name] for name in told if name in settings and name not in seen],
        "The job": [told[name] for name in told if name not in settings and name not in seen],
    }
    parts = [_BEGINNING, *(_table(title, options) for title, options in groups.items())]
    run = _table("The run", declared(RunOptions).values(), api=False)
    return "\n".join([*parts, run, "Only `sgsst stylize` takes these; for a service they are its operator's.\n"])


def _table(title: str, options: Iterable[Declared], *, api: bool = True) -> str:
    lines = [f"## {title}\n", "| command line | parameter | values | default | |", "|---|---|---|---|---|"]
    for option in options:
        parameter = f"`{option.name}`" if api else ""
        shown = "" if is_switch(option) or _words(option) else f" {metavar(option)}"
        default = option.text(option.info.default)
        cells = (f"`{flags(option)}{shown}`", parameter, _values(option), default, option.help)
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join([*lines, ""])


def _values(option: Declared) -> str:
    """Return the valid values of an option, and their unit."""
    if is_switch(option) or _words(option):
        return ", ".join(_words(option)) or "on, off"
    bounds = f"`{option.bounds}`" if option.bounds else ""
    return ", ".join(part for part in (bounds, option.option.unit) if part) or "text"


def _words(option: Declared) -> tuple[str, ...]:
    """Return the words that an option accepts; empty if it accepts other values."""
    kind = kind_of(option)
    return get_args(kind) if get_origin(kind) is Literal else ()


if __name__ == "__main__":
    sys.stdout.write(reference())

"""Tests that command line, API and reference documentation use the same help text and bounds of each option."""

import json
import re
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import pytest
import typer
from annotated_types import Ge, Gt, Le
from pydantic import ValidationError

from api.cli.main import app
from api.cli.options import flags, help_text, is_switch, kind_of, metavar
from service.inputs import JobParameters
from sgsst_core.errors import SettingsError
from sgsst_core.settings import Declared, Settings, checked, declared, make_settings, parse_seconds, parse_strength
from tests.api.conftest import Sgsst
from worker.job import SceneRequest
from worker.options import GROUPS, RunOptions, StylizeOptions, ViewOptions

ROOT = Path(__file__).resolve().parents[3]
OPTIONS = declared(StylizeOptions)
#: Options that the API lacks, and parameters that `sgsst stylize` lacks, with the reason.
OPERATORS = {"resume", "checkpoint_seconds", "rank_timeout"}  # the service's operator sets these for all jobs
SERVICES = {"name", "retention_days"}  # a service lists jobs, and stores results


def shown(command: str) -> dict[str, str]:
    """Return the help texts of a command's options by their flags."""
    group: Any = typer.main.get_command(app)
    return {"/".join(each.opts + each.secondary_opts): each.help for each in group.commands[command].params}


def test_every_setting_has_an_option() -> None:
    options = declared(Settings)
    standing = {
        info.metadata[-1].instead for name, info in Settings.model_fields.items() if name not in fields(options)
    }
    assert standing == {"learning_rate", "within"}
    assert options.keys() | standing <= OPTIONS.keys()


def fields(options: dict[str, Declared]) -> set[str]:
    return {each.field for each in options.values()}


def test_commands_and_parameters_offer_every_option() -> None:
    assert declared(JobParameters).keys() - OPTIONS.keys() == SERVICES
    assert declared(RunOptions).keys() == OPERATORS
    texts = {flags(option): help_text(option) for option in OPTIONS.values()}
    for command in ("stylize", "submit"):
        assert texts.items() <= shown(command).items(), command
    assert {flags(option) for option in declared(RunOptions).values()} <= shown("stylize").keys()
    assert texts.keys() - shown("plan").keys() == {"--workers"}
    properties = JobParameters.model_json_schema()["properties"]
    for name, option in OPTIONS.items():
        assert properties[name]["description"] == option.help
        assert properties[name].get("x-unit", "") == option.option.unit


@pytest.mark.parametrize("command", ["stylize", "submit", "plan", "check"])
def test_help_has_the_groups_of_the_page(command: str, sgsst: Sgsst) -> None:
    parts = re.split(r"^(\w+):\n", sgsst([command, "--help"]), flags=re.MULTILINE)
    groups = {
        title: [name.replace("-", "_") for name in re.findall(r"^  (?:-h, )?--([\w-]+)", text, flags=re.MULTILINE)]
        for title, text in zip(parts[1::2], parts[2::2], strict=True)
    }
    on_page = JobParameters.model_json_schema()["x-groups"]
    assert on_page == GROUPS
    assert [title for title in groups if title in GROUPS] == [title for title in GROUPS if title in groups]
    assert list(groups)[:2] == ["Arguments", "Essentials"]
    assert {"style", "cameras", "resolution", "views"} <= set(groups["Essentials"])
    for title, names in groups.items():
        assert [name for name in names if name in OPTIONS] == [name for name in on_page.get(title, ()) if name in names]
    group: Any = typer.main.get_command(app)
    offered = [each.opts[0] for each in group.commands[command].params if each.param_type_name == "option"]
    listed = {"--" + name.replace("_", "-") for names in groups.values() for name in names}
    assert listed == {*offered, "--help"}


def outside(option: Declared) -> list[float]:
    """Return the numbers just outside an option's bounds."""
    values: list[float] = []
    for item in option.limits:
        if isinstance(item, Ge | Le):
            bound, away = (item.ge, -1) if isinstance(item, Ge) else (item.le, 1)
            values.append(bound + away * max(1, abs(bound) * 1e-9))  # type: ignore[operator, arg-type]
        else:
            values.append(item.gt if isinstance(item, Gt) else item.lt)  # type: ignore[arg-type]
    return values


BEYOND = [(name, value) for name, option in OPTIONS.items() for value in outside(option)]


@pytest.mark.parametrize(("name", "value"), BEYOND)
def test_bounds_match_across_interfaces(name: str, value: float, sgsst: Sgsst) -> None:
    with pytest.raises(ValidationError) as refused:
        JobParameters.model_validate({name: value})
    error = refused.value.errors()[0]  # a second one lists the words that may replace a number
    if name in declared(Settings):
        with pytest.raises(SettingsError, match=declared(Settings)[name].field):
            make_settings(**{declared(Settings)[name].field: value})  # type: ignore[arg-type]
    if name in ViewOptions.model_fields:
        with pytest.raises(SettingsError, match=name):
            checked(SceneRequest, {"scene": "scene.ply", name: value})
    if name == "memory_limit":  # its command-line format has no digits for these
        return
    for command in ("stylize", "submit"):
        said = sgsst([command, "scene.ply", "--style", "x.png", "--out", "x.ply", flags(OPTIONS[name]), str(value)], 2)
        assert flags(OPTIONS[name]) in said
        assert error["msg"] in said


@pytest.mark.parametrize("value", ["nan", "inf", "many", ""])
def test_non_finite_numbers_are_rejected(value: str, sgsst: Sgsst) -> None:
    for flag in ("--near", "--within", "--workers"):
        assert flag in sgsst(["stylize", "scene.ply", "--style", "x.png", "--out", "x.ply", flag, value], 2)


def row(option: Declared, parameter: str) -> str:
    """Return the row of an option in the reference."""
    kind = kind_of(option)
    words = ("on", "off") if is_switch(option) else get_args(kind) if get_origin(kind) is Literal else ()
    values = words or filter(None, (option.bounds and f"`{option.bounds}`", option.option.unit))
    shown = flags(option) if words else f"{flags(option)} {metavar(option)}"
    default = option.text(option.info.default)
    return f"| `{shown}` | {parameter} | {', '.join(values) or 'text'} | {default} | {option.help} |"


def test_options_reference_is_up_to_date() -> None:
    rows = [row(option, f"`{option.name}`") for option in declared(JobParameters).values()]
    rows += [row(option, "") for option in declared(RunOptions).values()]
    page = (ROOT / "docs" / "options.md").read_text().splitlines()
    assert [each for each in rows if each not in page] == [], "rows that docs/options.md lacks"
    assert sum(line.startswith("| `--") for line in page) == len(rows), "rows of options that do not exist"


def test_options_become_settings() -> None:
    options = StylizeOptions.model_validate({"preset": "preview", "steps_sos": "7", "near": 0.5})
    assert options.settings() == make_settings("preview", steps_sos=7, near=0.5)
    assert StylizeOptions().settings() == make_settings()
    assert StylizeOptions().given_settings() == {}
    assert StylizeOptions(resolution=80).settings().max_resolution == 80
    again = JobParameters.model_validate(json.loads(JobParameters().model_dump_json()))
    assert again.settings() == make_settings(), "null leaves a setting to the preset"


@pytest.mark.parametrize(("text", "weight"), [("light", 3e4), ("Balanced", 1e4), ("strong", 1.0), ("2.5", 2.5)])
def test_content_weight_accepts_numbers_and_strengths(text: str, weight: float) -> None:
    assert parse_strength(text) == weight


@pytest.mark.parametrize(
    ("text", "seconds"), [("90s", 90), ("90", 90), ("5m", 300), ("1.5 h", 5400), ("2min", 120), (".5H", 1800)]
)
def test_times_have_units(text: str, seconds: float) -> None:
    assert parse_seconds(text) == seconds


@pytest.mark.parametrize("text", ["", "5 days", "-5m", "m", "1e3s", "5m30"])
def test_what_is_no_time_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(ValueError, match="Give one such as 90s, 5m or 1h"):
        parse_seconds(text)

"""Command-line options that come from the fields of a class, declared once for all commands that offer them."""

from __future__ import annotations

import inspect
import itertools
from collections.abc import Callable, Collection, Mapping
from types import UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

import typer
from pydantic import BaseModel, ValidationError

from sgsst_core.errors import SettingsError
from sgsst_core.settings import BY_PRESET, Declared, declared, merged, reason
from worker.options import GROUPS

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
    parameters = inspect.signature(group, eval_str=True).parameters
    return _expanding("inputs", parameters, lambda given: group(**given))


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
        flags(option), help=help_text(option), parser=_parser(option), rich_help_panel=group, **placeholder
    )
    return inspect.Parameter(
        option.name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=Annotated[kind | None, declaration]
    )


def _parser(option: Declared) -> Callable[[str], object] | None:
    """Return the parser of an option for typer, which would drop the message of a ValueError."""
    parse = option.option.parse
    if parse is None:
        return None

    def parse_or_refuse(text: str) -> object:
        try:
            return parse(text)
        except ValueError as error:
            raise typer.BadParameter(str(error)) from error

    return parse_or_refuse


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

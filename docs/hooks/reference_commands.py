"""Reference of the command lines, from their typer applications."""

import importlib
import re
from collections.abc import Iterator
from typing import Any

import typer

from reference_text import code, default_text, number, paragraphs, sentence, table

_OF_THE_SHELL = ("install_completion", "show_completion")
_DEFAULT = re.compile(r" ?\[default: (.*)\]$")


def commands_of(module: str, program: str) -> str:
    """Return the reference of every command of the typer application `app` in a module, with arguments and options."""
    root = typer.main.get_command(importlib.import_module(module).app)
    return "\n".join(_described(path, command) for path, command in _walk(program, root))


def _walk(path: str, command: Any) -> Iterator[tuple[str, Any]]:
    yield path, command
    for name in getattr(command, "commands", {}):
        yield from _walk(f"{path} {name}", command.commands[name])


def _described(path: str, command: Any) -> str:
    heading = f"{'##' if ' ' not in path else '###'} `{path}`\n\n{paragraphs(command.help)}\n"
    if hasattr(command, "commands"):
        rows = [_row(each) for each in command.params if each.name not in {"help", *_OF_THE_SHELL}]
        return heading + ("\n" + table(["parameter", "default", "meaning"], rows) if rows else "")
    arguments = [each for each in command.params if each.param_type_name == "argument"]
    usage = " ".join([path, *(_place(each) for each in arguments), "[OPTIONS]"])
    rows = [_row(each) for each in command.params if each.name != "help"]
    return f"{heading}\n```text\n{usage}\n```\n\n{table(['parameter', 'default', 'meaning'], rows)}"


def _place(argument: Any) -> str:
    name = argument.name.upper() + ("..." if argument.nargs == -1 else "")
    return name if argument.required else f"[{name}]"


def _row(parameter: Any) -> tuple[str, str, str]:
    is_argument = parameter.param_type_name == "argument"
    names = [_place(parameter)] if is_argument else [*parameter.opts, *parameter.secondary_opts]
    if not is_argument and not parameter.is_flag and parameter.metavar:
        names[0] += f" {parameter.metavar}"
    help_text = parameter.help or ""
    told = _DEFAULT.search(help_text)
    meaning = sentence(_DEFAULT.sub("", help_text)) + _range(parameter)
    return ", ".join(map(code, names)), _default(parameter, told), meaning


def _default(parameter: Any, told: re.Match[str] | None) -> str:
    if parameter.required:
        return "required"
    if told is not None:
        return told[1]
    value = parameter.default
    if value is None or value is False or value == "" or callable(value):
        return ""
    return default_text(value)


def _range(parameter: Any) -> str:
    low, high = getattr(parameter, "min", None), getattr(parameter, "max", None)
    if low is None and high is None:
        return ""
    if high is None:
        return f" At least {number(low)}."
    return f" At most {number(high)}." if low is None else f" From {number(low)} to {number(high)}."

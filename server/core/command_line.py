"""Strict command lines: one grammar for numbers, each option at most once, no options that contradict each other, and
output paths that are checked before the work begins.

Without these checks `--yaw-deg 0_1` would mean 1, `--yaw-deg 90 --yaw-deg 0` would drop the first value without a word,
and a command could work for an hour and then find that its output folder is a file. `writable_file`, `writable_folder`
and `figure_file` are callbacks of options: typer calls them before the command.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, get_args

import typer
from typer.core import TyperCommand

from server.core.errors import NafirError
from server.core.files import require_figure, require_writable, require_writable_folder
from server.core.numerals import parse_decimal, parse_integer

_PARSERS: dict[Any, Callable[[str], float]] = {int: parse_integer, float: parse_decimal}


class StrictCommand(TyperCommand):
    """A command that reads numbers by the grammar of `server.core.numerals` and refuses an option that is given twice,
    unless the option is repeatable. The NafirError it raises names the option."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        values, _, given = self.make_parser(ctx).parse_args(args=list(args))
        if not ctx.resilient_parsing:
            for option, times in Counter(given).items():
                if times > 1 and not self._may_repeat(option):
                    raise NafirError(f"{option.opts[0]} is given {times} times: give it once")
            for parameter in self.params:
                _check_numbers(parameter, values.get(parameter.name or ""))
        return super().parse_args(ctx, args)

    @staticmethod
    def _may_repeat(option: Any) -> bool:
        return bool(option.multiple or option.nargs == -1 or getattr(option, "count", False))


class StrictTyper(typer.Typer):
    """A typer application whose commands are `StrictCommand`s."""

    def command(self, *args: Any, **options: Any) -> Callable[[Any], Any]:
        options.setdefault("cls", StrictCommand)
        return super().command(*args, **options)


def writable_file(parameter: typer.CallbackParam, path: Path | None) -> Path | None:
    """Option callback. Raises NafirError, which names the option, if no file can be written to `path`."""
    return _checked(require_writable, parameter, path)


def writable_folder(parameter: typer.CallbackParam, path: Path | None) -> Path | None:
    """Option callback. Raises NafirError, which names the option, if `path` neither is nor can become a folder that can
    be written to."""
    return _checked(require_writable_folder, parameter, path)


def figure_file(parameter: typer.CallbackParam, path: Path | None) -> Path | None:
    """Option callback. Raises NafirError, which names the option, if matplotlib cannot draw a picture to `path`."""
    return _checked(require_figure, parameter, path)


def _checked(require: Callable[[Path, str], None], parameter: typer.CallbackParam, path: Path | None) -> Path | None:
    if path is not None:
        require(path, parameter.opts[0])
    return path


def require_at_most_one(options: Mapping[str, bool]) -> None:
    """Raises NafirError if more than one of these mutually exclusive options is given. `options` maps each name to
    whether it is given."""
    given = [name for name, is_given in options.items() if is_given]
    if len(given) > 1:
        raise NafirError(f"{' and '.join(given)} contradict each other: leave one out")


def _check_numbers(parameter: Any, given: Any) -> None:
    """Raises NafirError if a parameter of a number type was given text that is not a number."""
    descriptor = getattr(parameter, "type_descriptor", None)
    if descriptor is None:
        return
    parse = next((_PARSERS[kind] for kind in _kinds(descriptor.annotation) if kind in _PARSERS), None)
    texts: Iterable[Any] = given if isinstance(given, list | tuple) else (given,)
    for text in texts:
        if parse is not None and isinstance(text, str):
            try:
                parse(text)
            except ValueError as exc:
                raise NafirError(f"{parameter.opts[0]}: {exc}") from exc


def _kinds(annotation: Any) -> tuple[Any, ...]:
    """The annotated type and the types of its items, if it is generic."""
    return (annotation, *get_args(annotation))

"""Command lines that take what they are told: numbers by one grammar, every option at most once, no two that contradict
each other, and no output that cannot be written.

Without this, `--yaw-deg 0_1` is 1, of `--yaw-deg 90 --yaw-deg 0` the first is dropped without a word, and a command
that worked for an hour says at its end that its folder is a file. `writable_file`, `writable_folder` and `figure_file`
are callbacks of options: they are called before the command is.
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
    """A command whose numbers are those of `server.core.numerals`, and which takes an option twice only where it is
    repeatable. Raises NafirError otherwise, naming the option."""

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
    """An application whose commands are strict."""

    def command(self, *args: Any, **options: Any) -> Callable[[Any], Any]:
        options.setdefault("cls", StrictCommand)
        return super().command(*args, **options)


def writable_file(parameter: typer.CallbackParam, path: Path | None) -> Path | None:
    """Raises NafirError, naming the option, where a file cannot be written to what it was given."""
    return _checked(require_writable, parameter, path)


def writable_folder(parameter: typer.CallbackParam, path: Path | None) -> Path | None:
    """As `writable_file`, of a folder, which may not exist yet."""
    return _checked(require_writable_folder, parameter, path)


def figure_file(parameter: typer.CallbackParam, path: Path | None) -> Path | None:
    """As `writable_file`, of a picture that matplotlib will draw."""
    return _checked(require_figure, parameter, path)


def _checked(require: Callable[[Path, str], None], parameter: typer.CallbackParam, path: Path | None) -> Path | None:
    if path is not None:
        require(path, parameter.opts[0])
    return path


def require_at_most_one(options: Mapping[str, bool]) -> None:
    """`options` are those of which only one can have its way, by name whether they are given. Raises NafirError for
    several."""
    given = [name for name, is_given in options.items() if is_given]
    if len(given) > 1:
        raise NafirError(f"{' and '.join(given)} contradict each other: leave one out")


def _check_numbers(parameter: Any, given: Any) -> None:
    """Raises NafirError for a text that is no number where one is wanted."""
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
    """A type, or those of its items."""
    return (annotation, *get_args(annotation))

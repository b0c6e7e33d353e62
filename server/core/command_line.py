"""Command lines that take what they are told: numbers by one grammar, and every option at most once.

Without this, `--yaw-deg 0_1` is 1, and of `--yaw-deg 90 --yaw-deg 0` the first is dropped without a word.
"""

from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any, get_args

import typer
from typer.core import TyperCommand

from server.core.numerals import parse_decimal, parse_integer
from server.errors import NafirError

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

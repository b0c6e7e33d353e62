"""Logs of the server: one line for each event, for people (`console`) or for programs (`json`).

Modules log through the standard library; what belongs to a line besides its text goes into `extra`. structlog only
writes the lines: with a time, the level, and what `about` has bound for the request or stream at hand.

Keys and tokens never come into a log. No module logs them; and if one did, or a library does, `hide` blots them out of
the finished line, tracebacks included.
"""

import logging
import re
import sys
from collections.abc import MutableMapping
from typing import Any, Final, Literal, TextIO

import structlog
from structlog.contextvars import bind_contextvars, clear_contextvars, merge_contextvars
from structlog.stdlib import ExtraAdder, ProcessorFormatter, add_log_level, add_logger_name

Form = Literal["console", "json"]
_QUIET: Final = {"uvicorn": "WARNING", "uvicorn.access": "CRITICAL", "websockets": "WARNING", "asyncio": "WARNING"}
"""Loggers that would say again, and with less, what the server's own lines say."""
_SECRETS: Final = (
    (re.compile(r"\b(nafir_[0-9a-f]{12})_[\w-]+", re.ASCII), r"\1_***"),
    (re.compile(r"nafir\.key\.[\w=-]+", re.ASCII), "nafir.key.***"),
    (re.compile(r"\b(bearer|basic)(\s+)[\w.~+/=-]{8,}", re.ASCII | re.IGNORECASE), r"\1\2***"),
    (re.compile(r"\bey[\w-]{8,}\.[\w-]+\.[\w-]*", re.ASCII), "***"),
    (re.compile(r"((?:authorization|sec-websocket-protocol)\W{1,8})[^\s'\"\\,][^'\"\\\n]*", re.IGNORECASE), r"\1***"),
)
"""What looks like a key, a token or a header with one, and what is written in its place. A key's id is no secret."""


def hide(text: str) -> str:
    """The text without keys and tokens."""
    for pattern, shown in _SECRETS:
        text = pattern.sub(shown, text)
    return text


def begin_about(**known: object) -> None:
    """Begin anew with what the lines of this task, and of those it starts, are about."""
    clear_contextvars()
    bind_contextvars(**known)


def about(**known: object) -> None:
    """Add to what the lines of this task, and of those it starts, are about."""
    bind_contextvars(**known)


def formatter(form: Form, *, colors: bool = False) -> logging.Formatter:
    """Writes records of any logger."""
    end: list[Any]
    if form == "json":
        end = [structlog.processors.format_exc_info, structlog.processors.JSONRenderer(ensure_ascii=False)]
    else:
        # The tracebacks of rich would show local variables, and with them keys.
        plain = structlog.dev.plain_traceback
        end = [structlog.dev.ConsoleRenderer(colors=colors, exception_formatter=plain, pad_event_to=0)]
    return ProcessorFormatter(
        foreign_pre_chain=[
            merge_contextvars,
            add_log_level,
            add_logger_name,
            ExtraAdder(),
            structlog.processors.TimeStamper(fmt="iso", utc=True),
        ],
        processors=[ProcessorFormatter.remove_processors_meta, *end, _hide_secrets],
    )


def configure_logs(form: Form, level: str, *, stream: TextIO | None = None) -> None:
    """Write everything from `level` on to `stream`, standard error by default. A second call replaces the first."""
    stream = sys.stderr if stream is None else stream
    handler = logging.StreamHandler(stream)
    handler.setFormatter(formatter(form, colors=stream.isatty()))
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(level.upper())
    for name, least in _QUIET.items():
        logging.getLogger(name).setLevel(max(logging.getLevelName(least), root.level))


def _hide_secrets(_: object, __: str, line: str | MutableMapping[str, Any]) -> str:
    assert isinstance(line, str)
    return hide(line)

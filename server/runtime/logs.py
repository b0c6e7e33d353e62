"""Logs of the server: one line for each event, for people (`console`) or for programs (`json`).

Modules log through the standard library; what belongs to a line besides its text goes into `extra`. structlog only
writes the lines: with a time, the level, and what `about` has bound for the request or stream at hand.

Clients make a log grow no faster than it can be rotated: of lines that say the same for the same reason, and of all
lines together, `BoundedHandler` writes so many in a minute, and then how many it has left out.

Keys and tokens never come into a log. No module logs them; and if one did, or a library does, `hide` blots them out of
the finished line, tracebacks included.
"""

import contextlib
import contextvars
import logging
import math
import re
import sys
import time
from collections.abc import Callable, MutableMapping
from dataclasses import dataclass
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
_REASON: Final = ("status", "code", "reason")
"""Fields of a line that say why it is written."""
_WINDOW_S: Final = 60.0
_MOST_KINDS: Final = 256
"""Kinds of lines that are counted apart from each other."""
_MOST_TOGETHER: Final = 5
"""Times as many lines of all kinds together as of one."""
LEFT_OUT: Final = "lines left out"
OF_SEVERAL_KINDS: Final = "of several kinds"
_TOGETHER: Final = ()
"""Stands for all kinds."""


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


@dataclass
class _Window:
    """Lines of one kind since `began_s`: how many came, and what to say of those that were not written, which are all
    but the first `most`."""

    began_s: float
    most: int
    lines: int = 0
    summary: logging.LogRecord | None = None


class BoundedHandler(logging.StreamHandler[TextIO]):
    """Writes at most so many lines of a kind in a minute, and of all kinds together five times as many; with 0, all.
    Lines are of a kind if they say the same (before their values are filled in) with the same status, code and reason.
    How many were left out is said with the first line of any kind after that minute, and when the handler is closed.

    Clients cause few kinds of warnings and errors, so these do not count together, and no flood of other lines hides
    them. Beyond 256 kinds in a minute, errors are written, and all other lines count together.
    """

    def __init__(self, stream: TextIO, *, most_per_min: int, time_s: Callable[[], float] = time.monotonic) -> None:
        super().__init__(stream)
        self._most = most_per_min
        self._time_s = time_s
        self._windows: dict[tuple[object, ...], _Window] = {}
        self._due_s: float | None = None
        """When the first of the windows ends that lack lines."""

    def emit(self, record: logging.LogRecord) -> None:
        if self._most:
            now_s = self._time_s()
            if self._due_s is not None and now_s >= self._due_s:
                self._tell(now_s)
            if not self._is_written(record, now_s):
                return
        super().emit(record)

    def close(self) -> None:
        with self.lock or contextlib.nullcontext():
            self._tell(math.inf)
        super().close()

    def _is_written(self, record: logging.LogRecord, now_s: float) -> bool:
        kind = (record.name, str(record.msg), *(getattr(record, name, None) for name in _REASON))
        if kind not in self._windows and len(self._windows) >= _MOST_KINDS:
            self._tell(now_s)  # and forget what came earlier
        if kind not in self._windows and len(self._windows) >= _MOST_KINDS:
            return record.levelno >= logging.ERROR or self._has_room(_TOGETHER, record, now_s)
        if not self._has_room(kind, record, now_s):
            return False
        return record.levelno >= logging.WARNING or self._has_room(_TOGETHER, record, now_s)

    def _has_room(self, kind: tuple[object, ...], record: logging.LogRecord, now_s: float) -> bool:
        window = self._windows.get(kind)
        if window is None or now_s >= window.began_s + _WINDOW_S:
            most = self._most if kind else _MOST_TOGETHER * self._most
            window = self._windows[kind] = _Window(now_s, most)
        window.lines += 1
        if window.lines <= window.most:
            return True
        if window.summary is None:
            window.summary = _summary_of(record) if kind else _summary_of_several()
            end_s = window.began_s + _WINDOW_S
            self._due_s = end_s if self._due_s is None else min(self._due_s, end_s)
        return False

    def _tell(self, now_s: float) -> None:
        """Say how many lines were left out in windows that have ended by now, and forget these."""
        for kind, window in list(self._windows.items()):
            if now_s < window.began_s + _WINDOW_S:
                continue
            del self._windows[kind]
            if window.summary is not None:
                window.summary.__dict__["lines"] = window.lines - window.most
                # Without what the task at hand is about.
                contextvars.Context().run(super().emit, window.summary)
        lacking = [each.began_s + _WINDOW_S for each in self._windows.values() if each.summary is not None]
        self._due_s = min(lacking, default=None)


def _summary_of(record: logging.LogRecord) -> logging.LogRecord:
    """A record that stands for others like this one, and refers to nothing of it."""
    said = {"name": record.name, "levelno": record.levelno, "levelname": record.levelname, "msg": LEFT_OUT}
    why = {name: getattr(record, name) for name in _REASON if getattr(record, name, None) is not None}
    return logging.makeLogRecord({**said, "line": str(record.msg), **why})


def _summary_of_several() -> logging.LogRecord:
    said = {"name": __name__, "levelno": logging.WARNING, "levelname": "WARNING", "msg": LEFT_OUT}
    return logging.makeLogRecord({**said, "line": OF_SEVERAL_KINDS})


def configure_logs(form: Form, level: str, *, lines_per_min: int = 0, stream: TextIO | None = None) -> None:
    """Write everything from `level` on to `stream`, standard error by default, and of a kind at most so many lines a
    minute; 0 sets no limit. A second call replaces the first."""
    stream = sys.stderr if stream is None else stream
    handler = BoundedHandler(stream, most_per_min=lines_per_min)
    handler.setFormatter(formatter(form, colors=stream.isatty()))
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(level.upper())
    for name, least in _QUIET.items():
        logging.getLogger(name).setLevel(max(logging.getLevelName(least), root.level))


def _hide_secrets(_: object, __: str, line: str | MutableMapping[str, Any]) -> str:
    assert isinstance(line, str)
    return hide(line)

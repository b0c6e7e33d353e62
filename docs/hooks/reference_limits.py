"""Reference of every limit on what a client may take: settings, and numbers that are fixed."""

from typing import Final

from reference_text import code, default_text, number, sentence, table
from server.api import api_keys, http_protocol, inflow, routes, tokens
from server.api.connection_limits import ConnectionLimits
from server.api.settings import Settings
from server.core.docstrings import attribute_docstrings
from server.responses import loudness, response_batch
from server.streaming import inbox

_ENDINGS: Final = ("_per_min", "_per_h", "_timeout_s", "keep_alive_s", "window_blocks", "drain_s")


def is_limit(setting: str) -> bool:
    """Whether a setting limits what a client may take."""
    return setting.startswith("max_") or setting.endswith(_ENDINGS)


def limits() -> str:
    """Return a table of the settings that are limits, and one of the limits that are fixed."""
    meanings = attribute_docstrings(Settings)
    adjustable = [
        (code(f"NAFIR_{name.upper()}"), default_text(field.default), sentence(meanings[name]))
        for name, field in Settings.model_fields.items()
        if is_limit(name)
    ]
    always = ConnectionLimits.of(Settings())
    fixed = [
        ("length of a request line", number(always.max_request_line_bytes), "bytes; beyond it 414"),
        ("length of one header, keys and tokens included", number(always.max_header_bytes), "bytes; beyond it 431"),
        ("headers of a request", number(always.max_headers), "beyond them 431"),
        ("connections in reserve for health checks", number(always.reserve_connections), "others get 503 there"),
        (
            "requests that are sent before earlier ones are answered",
            number(http_protocol._MOST_WAITING_BYTES),
            "bytes; beyond them the connection ends after the answer",
        ),
        ("poses of a listener", number(inflow.POSES_PER_S), "a second; beyond that, reading slows down"),
        ("moves of an emitter", number(inflow.MOVES_PER_S), "a second; beyond that, reading slows down"),
        ("messages of a stream in one block", number(inbox.MAX_WAITING_MESSAGES), "beyond them `too_many_messages`"),
        ("points of a map of loudness", number(loudness.MAX_POINTS), "beyond them 409"),
        ("estimated time of a map", number(routes.MAX_MAP_S), "s; beyond it 409"),
        ("emitters of a plan", number(routes.MAX_PLANNED), "beyond them 422"),
        ("estimated size of a batch of responses", number(response_batch.MOST_BYTES), "bytes; beyond it refused"),
        ("file of API keys", number(api_keys._LARGEST_FILE_BYTES), "bytes"),
        ("set of keys for tokens", number(tokens._MOST_KEYS), "keys"),
    ]
    return (
        table(["setting", "default", "meaning"], adjustable)
        + "\nThese are fixed:\n\n"
        + table(["limit", "value", "unit, and what happens beyond it"], fixed)
    )

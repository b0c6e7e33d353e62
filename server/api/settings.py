"""What an operator can set: by argument, or by an environment variable that begins with NAFIR_."""

import os
import re
from pathlib import Path
from typing import Annotated, Any, Self, get_args

from pydantic import AfterValidator, BeforeValidator, Field, ValidationInfo, field_validator, model_validator
from pydantic_core import PydanticCustomError
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict

from server.assets.names import named_by_stem
from server.core.near_names import suggestion
from server.core.numerals import parse_decimal, parse_integer

_PREFIX = "NAFIR_"
_SERVICE_LINK = re.compile(r"(\w+_)?SERVICE_(HOST|PORT(_\w+)?)|(\w+_)?PORT_\d+_(TCP|UDP|SCTP)(_\w+)?")
"""What Kubernetes puts into every container about a service called nafir, behind the prefix."""


def _usable_cores() -> int:
    """Fewer than the machine's where the process is confined to some."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _split_paths(value: Any) -> Any:
    return tuple(part for part in value.split(os.pathsep) if part) if isinstance(value, str) else value


def _require_different_names(files: tuple[Path, ...]) -> tuple[Path, ...]:
    named_by_stem(files)
    return files


def _split_names(value: Any) -> Any:
    return tuple(part.strip() for part in value.split(",") if part.strip()) if isinstance(value, str) else value


def _require_origin(value: str) -> str:
    if not re.fullmatch(r"https?://[^/\s*]+/?", value):
        raise PydanticCustomError(
            "origin", "{value} is no origin: give scheme and host, as in https://example.org", {"value": repr(value)}
        )
    return value


Names = Annotated[tuple[str, ...], NoDecode, BeforeValidator(_split_names)]
"""In the environment, separated by commas."""
Origins = Annotated[
    tuple[Annotated[str, AfterValidator(_require_origin)], ...], NoDecode, BeforeValidator(_split_names)
]
"""In the environment, separated by commas."""
Paths = Annotated[tuple[Path, ...], NoDecode, BeforeValidator(_split_paths)]
"""In the environment, separated as in PATH."""
NamedFiles = Annotated[Paths, AfterValidator(_require_different_names)]
"""Files that are offered by their stems, no two alike."""


class Settings(BaseSettings):
    """Built once, at the edge, and handed down."""

    model_config = SettingsConfigDict(env_prefix=_PREFIX, frozen=True)

    host: str = "127.0.0.1"
    """Address to listen on; 0.0.0.0 is every IPv4 address of the machine."""
    port: Annotated[int, Field(ge=0, le=65535)] = 8000
    """Port to listen on; 0 takes a free one."""
    allowed_hosts: Names = ()
    """Names by which the server may be asked for, beside `host`, localhost and addresses in numbers; `*` is any."""
    allowed_origins: Origins = ()
    """Sites whose pages may use the server, as https://example.org; its own page may."""
    bundles: Paths = ()
    """Scene bundles to serve beside those that come with the package."""
    clips: NamedFiles = ()
    """Audio files to offer as clips, named by their stem, beside those that come with the package."""
    hrtfs: NamedFiles = ()
    """SOFA files (SimpleFreeFieldHRIR) to offer as heads, named by their stem, beside KEMAR."""

    audio_threads: Annotated[int, Field(ge=1)] = _usable_cores()
    """Threads that render streams."""
    realtime: bool = True
    """Whether to ask for real-time priority for them; where the system refuses, they run without."""
    ir_workers: Annotated[int, Field(ge=1)] = max(1, _usable_cores() - 1)
    """Threads that compute impulse responses, behind all others. One core is left to the audio threads."""
    ir_share: Annotated[float, Field(gt=0)] = 0.25
    """Cores' worth of impulse responses that streams of one audio thread may take between them under load, or less
    where rendering leaves less."""
    max_streams: Annotated[int, Field(ge=1)] = 64
    """Live streams that may be open at once; one more is told `server_busy`."""
    shared_tail: bool = False
    """Let all emitters of a stream share one late tail, each at the level of its own: many cost less, and only what
    comes after 32 blocks is another's."""
    max_emitters: Annotated[int, Field(ge=1, le=64)] = 16
    """Of one stream."""
    window_blocks: Annotated[int, Field(ge=1)] = 32
    """Blocks that may be unacknowledged, beyond those a client asks to have in hand."""
    max_message_bytes: Annotated[int, Field(ge=1024)] = 64 * 1024
    """A longer WebSocket message is refused; one longer than `max_frame_bytes` closes the connection."""
    max_frame_bytes: Annotated[int, Field(ge=1024)] = 1024 * 1024
    """A longer WebSocket message closes the connection with code 1009."""
    hello_timeout_s: Annotated[float, Field(gt=0)] = 10.0
    """How long a WebSocket client may take to send its hello."""
    request_timeout_s: Annotated[float, Field(gt=0)] = 10.0
    """For a whole HTTP request to come, from the connection or from its first byte: half-sent requests are answered
    408, connections that say nothing are closed."""
    response_timeout_s: Annotated[float, Field(gt=0)] = 30.0
    """For a client to take 64 KiB of a response, or what is left of it."""
    keep_alive_s: Annotated[float, Field(gt=0)] = 5.0
    """For the next request on a connection."""
    max_headers_bytes: Annotated[int, Field(ge=1024)] = 32 * 1024
    """Of all headers of a request together; of one, and of the request line, at most 8,000."""
    max_body_bytes: Annotated[int, Field(ge=0, le=64 * 1024)] = 64 * 1024
    """Of a request. No route has a use for one."""
    max_connections: Annotated[int, Field(ge=1)] = 1024
    """In all. When all are taken, who comes gets that on which nothing has been under way for longest; where there is
    none such, health checks alone are answered."""
    max_connections_per_address: Annotated[int, Field(ge=1)] = 256
    """Of one IP address, or IPv6 network of 64 bits. Behind a proxy everybody comes from its address."""
    max_silent: Annotated[int, Field(ge=1)] = 64
    """WebSocket connections that may be open without a hello; one more ends that which has been silent for longest."""
    stall_timeout_s: Annotated[float, Field(gt=0)] = 15.0
    """How long a client may acknowledge nothing while its window is full, before its connection is closed."""
    max_waiting_requests: Annotated[int, Field(ge=1)] = 32
    """HTTP computations that may wait for a thread, equal requests as one; with one more, a client is answered 503."""
    drain_s: Annotated[float, Field(ge=2, le=3600)] = 8.0
    """How long the server may take to end once it is told to (SIGTERM, SIGINT): streams are told at once, requests may
    go on for 0.7 of it, and whatever has not ended by then is cut off."""

    @field_validator("*", mode="before")
    @classmethod
    def _read_number(cls, value: Any, info: ValidationInfo) -> Any:
        """By the grammar of every other number that comes as text, where the setting is one."""
        annotation = cls.model_fields[info.field_name or ""].annotation
        kinds = {annotation, *get_args(annotation)}
        if isinstance(value, str) and kinds & {int, float}:
            return parse_decimal(value) if float in kinds else parse_integer(value)
        return value

    @model_validator(mode="after")
    def _knows_the_environment(self) -> Self:
        """A misspelt variable would otherwise be a setting that stays as it is."""
        known = [name.upper() for name in type(self).model_fields]
        for variable in sorted(os.environ):
            name = variable.upper().removeprefix(_PREFIX)
            if not variable.upper().startswith(_PREFIX) or _SERVICE_LINK.fullmatch(name):
                continue
            if name not in known:
                problem = f"the environment has {variable}, which is no setting{suggestion(name, known, _PREFIX)}"
                raise PydanticCustomError("unknown_setting", "{problem}", {"problem": problem})
        return self

"""Settings of the server, given by arguments or by environment variables that begin with NAFIR_."""

import ipaddress
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_args

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    SecretStr,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic_core import PydanticCustomError
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict

from server.assets.names import named_by_stem
from server.core.errors import NafirError
from server.core.files import require_readable, require_writable_folder
from server.core.near_names import suggestion
from server.core.numerals import parse_decimal, parse_integer
from server.protocol.client_messages import MOST_LISTENERS
from server.runtime.open_files import allow_connections
from server.scene.signatures import BundleKeys

_PREFIX = "NAFIR_"
_SERVICE_LINK = re.compile(r"(\w+_)?SERVICE_(HOST|PORT(_\w+)?)|(\w+_)?PORT_\d+_(TCP|UDP|SCTP)(_\w+)?")
"""Names after the prefix that Kubernetes sets in every container for a service called nafir."""


def usable_cores() -> int:
    """Number of cores that this process may use."""
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
"""Names, which the environment separates by commas."""
Origins = Annotated[
    tuple[Annotated[str, AfterValidator(_require_origin)], ...], NoDecode, BeforeValidator(_split_names)
]
"""Origins, which the environment separates by commas."""
Paths = Annotated[tuple[Path, ...], NoDecode, BeforeValidator(_split_paths)]
"""Paths, which the environment separates as in PATH."""
NamedFiles = Annotated[Paths, AfterValidator(_require_different_names)]
"""Files offered by their stems, no two of which may be equal."""


class Settings(BaseSettings):
    """All settings of a server. They are read once at start-up and do not change."""

    model_config = SettingsConfigDict(env_prefix=_PREFIX, frozen=True)

    host: str = "127.0.0.1"
    """Address to listen on; 0.0.0.0 stands for every IPv4 address of the machine."""
    port: Annotated[int, Field(ge=0, le=65535)] = 8000
    """Port to listen on; 0 takes a free one."""
    allowed_hosts: Names = ()
    """Host names that the server answers to, besides `host`, localhost and numeric addresses; `*` allows any."""
    allowed_origins: Origins = ()
    """Sites whose pages may use the server, such as https://example.org. The server's own page always may."""
    keys_file: Path | None = None
    """File of API keys, made by `nafir keys create`. With it, or with `jwt_keys_file`, whoever uses the server needs a
    key or a token. It is read again when it changes."""
    jwt_keys_file: Path | None = None
    """JSON Web Key Set with the keys that tokens (JWT) are signed by. It is read again when it changes."""
    jwt_audience: str | None = None
    """The audience (`aud`) that tokens have to be for; `jwt_keys_file` needs it."""
    jwt_issuer: str | None = None
    """The issuer (`iss`) that tokens have to be from; by default any whose key is in `jwt_keys_file`."""
    jwt_leeway_s: Annotated[float, Field(ge=0, le=300)] = 10.0
    """By how much the clocks of the server and of a token's issuer may differ."""
    require_auth: bool = False
    """Whether the server refuses to start without keys. Without it, one that others can reach warns."""
    page: bool = True
    """Whether the server has a page, and `/docs` and `/redoc`. With keys, any of them opens their files."""
    log_format: Literal["console", "json"] = "console"
    """How `nafir serve` writes its log to standard error: lines for people, or JSON for programs."""
    log_level: Literal["debug", "info", "warning", "error"] = "info"
    """The least important lines that are written."""
    log_lines_per_min: Annotated[int, Field(ge=0)] = 600
    """Lines of the log that may say the same for the same reason in a minute, by each process; all below warnings
    together may be five times as many. Then it says how many were left out. 0 sets no limit."""
    traces_url: str | None = None
    """Where OpenTelemetry traces go, by OTLP over HTTP, such as http://127.0.0.1:4318/v1/traces. They need the extra
    `otel`."""
    bundles: Paths = ()
    """Scene bundles to serve besides those that come with the package."""
    offer_bundles: bool = True
    """Whether clients may read the files of scene bundles, trained fields included, and of clips, to render scenes
    themselves."""
    bundle_folder: Path | None = None
    """Folder whose sub-folders are scene bundles too. Bundles that come, change or go are loaded, replaced or dropped
    while the server runs; streams that are open finish with what they have."""
    bundle_url: str | None = None
    """The same in a store that fsspec reads, such as s3://games/scenes, from where each process copies the bundles to a
    folder for temporary files. It needs the extra `store` and the package of the store, such as s3fs."""
    bundle_folder_s: Annotated[float, Field(ge=0.1)] = 5.0
    """Seconds between two looks at `bundle_folder` or `bundle_url`. What has changed is loaded at the look after."""
    bundle_keys: Path | None = None
    """File of public keys as minisign writes them. With it only bundles that one of them has signed are served
    (`nafir sign-bundle`), besides those that come with the package."""
    clips: NamedFiles = ()
    """Audio files to offer as clips, named by their stem, besides those that come with the package."""
    clips_folder: Path | None = None
    """Folder for clips that clients upload with `POST /v1/clips`; it is made if need be. Without it, and without
    `clips_url`, there are no uploads."""
    clips_url: str | None = None
    """Store that fsspec writes to, such as s3://games/clips, for the clips that clients upload: all machines that name
    it have the same ones. Each keeps copies in `clips_folder`, or else in a folder for temporary files. It needs the
    extra `store` and the package of the store, such as s3fs."""
    clips_quota_bytes: Annotated[int, Field(ge=2**20)] = 2**30
    """Bytes that uploaded clips may take together in `clips_url`, or else in `clips_folder`, where they are kept
    decoded: 4 bytes a sample."""
    clips_expire_s: Annotated[float, Field(ge=60)] = 7 * 86_400.0
    """How long a clip is kept after it was uploaded last."""
    max_clip_bytes: Annotated[int, Field(ge=1024, le=2**30)] = 16 * 2**20
    """Longest file of a clip that may be uploaded."""
    max_clip_s: Annotated[float, Field(gt=0, le=600)] = 120.0
    """Longest clip that may be uploaded."""
    upload_timeout_s: Annotated[float, Field(gt=0)] = 60.0
    """Time for a whole upload to arrive, in place of `request_timeout_s`."""
    hrtfs: NamedFiles = ()
    """SOFA files (SimpleFreeFieldHRIR) to offer as heads, named by their stem, besides KEMAR."""

    processes: Annotated[int, Field(ge=1)] = 1
    """Processes that serve at the port, each on an equal part of the cores. All other settings hold for each of
    them."""
    cores: Annotated[int, Field(ge=1)] = usable_cores()
    """Cores that streams may take together: fewer than the machine has where others use it too."""
    audio_threads: Annotated[int, Field(ge=1)] = usable_cores()
    """Threads that render streams."""
    realtime: bool = True
    """Whether to ask for real-time priority for the audio threads. If the system refuses, they run without."""
    ir_workers: Annotated[int, Field(ge=1)] = max(1, usable_cores() - 1)
    """Threads that compute impulse responses, at low priority. The default leaves one core to the audio threads."""
    ir_share: Annotated[float, Field(gt=0)] = 0.25
    """CPU time, in cores, that impulse responses for the streams of one audio thread may take under load. They get less
    if rendering leaves less."""
    max_streams: Annotated[int, Field(ge=1)] = 64
    """Live streams that may be open at once; one more is refused with `server_busy`."""
    admission: bool = True
    """Whether a stream, an emitter, a listener, a level or an effect is refused (`server_busy`) where it would break
    somebody's sound. Without it only `max_streams` limits them, and under load all streams lose quality together."""
    shared_tail: bool = False
    """Whether all emitters of a stream share one late reverberation, each at its own level. Many emitters cost less,
    and only the part of a response after 32 blocks is shared."""
    max_emitters: Annotated[int, Field(ge=1, le=64)] = 16
    """Emitters that one stream may have at once."""
    max_listeners: Annotated[int, Field(ge=1, le=MOST_LISTENERS)] = 8
    """Listeners that one stream may have at once. Each costs about as much as a stream of its own."""
    window_blocks: Annotated[int, Field(ge=1)] = 32
    """Blocks that may be unacknowledged, in addition to the `buffer_blocks` that a client asks for. At another sample
    rate than the scene's there are more or fewer, which last as long."""
    max_message_bytes: Annotated[int, Field(ge=1024)] = 64 * 1024
    """A longer WebSocket message is refused; one longer than `max_frame_bytes` closes the connection."""
    max_frame_bytes: Annotated[int, Field(ge=1024)] = 1024 * 1024
    """A longer WebSocket message closes the connection with code 1009."""
    hello_timeout_s: Annotated[float, Field(gt=0)] = 10.0
    """How long a WebSocket client may take to send its hello."""
    request_timeout_s: Annotated[float, Field(gt=0)] = 10.0
    """Time for a whole HTTP request to arrive, from the connection or from its first byte. A half-sent request is then
    answered 408, and a silent connection is closed."""
    response_timeout_s: Annotated[float, Field(gt=0)] = 30.0
    """Time for a client to read 64 KiB of a response, or the rest of it."""
    keep_alive_s: Annotated[float, Field(gt=0)] = 5.0
    """Time to wait for the next request on a connection."""
    max_headers_bytes: Annotated[int, Field(ge=1024)] = 32 * 1024
    """Longest headers of a request, all together. A single header and the request line may have 8,000 bytes each."""
    max_body_bytes: Annotated[int, Field(ge=0, le=64 * 1024)] = 64 * 1024
    """Longest body of a request other than an upload."""
    max_poses: Annotated[int, Field(ge=1)] = 256
    """Impulse responses that one request may ask for."""
    requests_per_min: Annotated[int, Field(ge=0)] = 6_000
    """Requests that may come at once from one address, and with one key, and as many more in every minute; one too many
    is answered 429 with `Retry-After`. 0 sets no limit, and addresses of this machine have none."""
    stream_openings_per_min: Annotated[int, Field(ge=0)] = 300
    """The same for streams that are opened."""
    upload_bytes_per_h: Annotated[int, Field(ge=0)] = 1024**3
    """The same for bytes of clips that are uploaded, in an hour."""
    max_connections: Annotated[int, Field(ge=1)] = 1024
    """Connections in total. If all are taken, a new one replaces the one that has been idle for longest; if none is
    idle, only health checks are answered."""
    max_connections_per_address: Annotated[int, Field(ge=1)] = 256
    """Connections from one IP address, or from one IPv6 network of 64 bits. Behind a proxy all clients have the proxy's
    address."""
    max_silent: Annotated[int, Field(ge=1)] = 64
    """WebSocket connections that may be open without a hello; one more ends the one that has been silent for
    longest."""
    stall_timeout_s: Annotated[float, Field(gt=0)] = 15.0
    """How long a client may acknowledge nothing while its window is full, before its connection is closed."""
    resume_s: Annotated[float, Field(ge=0, le=600)] = 15.0
    """How long a stream whose connection was lost is kept for its client to resume it; 0 keeps none."""
    resume_secret: Annotated[SecretStr, Field(min_length=16)] | None = None
    """What servers sign snapshots of streams with, at least 16 characters. A client resumes its stream from a snapshot
    at any server that has the same scenes and the same secret, also after a restart. Without it there are none."""
    snapshot_lifetime_s: Annotated[float, Field(gt=0, le=3600)] = 120.0
    """How long a snapshot is good: longer than a server takes to restart."""
    max_waiting_requests: Annotated[int, Field(ge=1)] = 32
    """HTTP computations that may wait for a thread; equal requests count once. Beyond that a client is answered 503."""
    drain_s: Annotated[float, Field(ge=2, le=3600)] = 8.0
    """How long the server may take to shut down (SIGTERM, SIGINT). Streams end at once with an error message, requests
    may go on for 0.7 of this time, and anything still open at its end is cut off."""

    @field_validator("*", mode="before")
    @classmethod
    def _read_number(cls, value: Any, info: ValidationInfo) -> Any:
        """Read a number given as text by the grammar of `server.core.numerals`."""
        annotation = cls.model_fields[info.field_name or ""].annotation
        kinds = {annotation, *get_args(annotation)}
        if isinstance(value, str) and kinds & {int, float}:
            return parse_decimal(value) if float in kinds else parse_integer(value)
        return value

    def read_bundle_keys(self) -> BundleKeys | None:
        """The keys that bundles have to be signed by; None if any bundle is served. Raises NafirError."""
        return None if self.bundle_keys is None else BundleKeys.read(self.bundle_keys)

    @property
    def takes_clips(self) -> bool:
        """Whether clients may upload clips."""
        return self.clips_folder is not None or self.clips_url is not None

    @property
    def is_loopback(self) -> bool:
        """Whether `host` stands for this machine alone."""
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return self.host.lower() == "localhost"

    @model_validator(mode="after")
    def _knows_whom_tokens_are_for(self) -> Self:
        """Tokens for other services of the same issuer must not open this one."""
        if self.jwt_keys_file is not None and not self.jwt_audience:
            raise PydanticCustomError("audience", "jwt_keys_file needs jwt_audience: name whom tokens have to be for")
        return self

    @model_validator(mode="after")
    def _has_one_place_of_bundles(self) -> Self:
        if self.bundle_folder is not None and self.bundle_url is not None:
            raise PydanticCustomError("bundles", "bundle_url is given, and bundle_folder too: leave one of them out")
        return self

    @model_validator(mode="after")
    def _knows_the_environment(self) -> Self:
        """Refuse misspelt variables, which would otherwise have no effect."""
        known = [name.upper() for name in type(self).model_fields]
        for variable in sorted(os.environ):
            name = variable.upper().removeprefix(_PREFIX)
            if not variable.upper().startswith(_PREFIX) or _SERVICE_LINK.fullmatch(name):
                continue
            if name not in known:
                problem = f"the environment has {variable}, which is no setting{suggestion(name, known, _PREFIX)}"
                raise PydanticCustomError("unknown_setting", "{problem}", {"problem": problem})
        return self


def settings_of(given: Mapping[str, Any]) -> Settings:
    """Settings from options of a command, where None is an option that was not given; the environment has the others.
    Raises NafirError, which names the setting at fault."""
    try:
        return Settings(**{name: value for name, value in given.items() if value is not None})
    except ValidationError as exc:
        first = exc.errors()[0]
        place = f"setting {'.'.join(str(part) for part in first['loc'])}: " if first["loc"] else ""
        raise NafirError(f"{place}{first['msg'].removeprefix('Value error, ')}") from exc


def checked_settings(given: Mapping[str, Any]) -> Settings:
    """Settings from options of the command and the environment. Raises NafirError, also for a file that cannot be
    read."""
    settings = settings_of(given)
    allow_connections(settings.max_connections)
    for name in ("clips", "hrtfs"):
        for path in getattr(settings, name):
            require_readable(path, name)
    for name in ("keys_file", "jwt_keys_file", "bundle_keys"):
        if (path := getattr(settings, name)) is not None:
            require_readable(path, name)
    if settings.clips_folder is not None:
        require_writable_folder(settings.clips_folder, "clips_folder")
    return settings

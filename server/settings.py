"""What an operator can set: by argument, or by an environment variable that begins with NAFIR_."""

import os
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, Field
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict

from server.assets.names import named_by_stem


def _usable_cores() -> int:
    """Fewer than the machine's where the process is confined to some."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _split_paths(value: Any) -> Any:
    return tuple(part for part in value.split(os.pathsep) if part) if isinstance(value, str) else value


def _require_different_names(files: tuple[Path, ...]) -> tuple[Path, ...]:
    named_by_stem(files)
    return files


Paths = Annotated[tuple[Path, ...], NoDecode, BeforeValidator(_split_paths)]
"""In the environment, separated as in PATH."""
NamedFiles = Annotated[Paths, AfterValidator(_require_different_names)]
"""Files that are offered by their stems, no two alike."""


class Settings(BaseSettings):
    """Built once, at the edge, and handed down."""

    model_config = SettingsConfigDict(env_prefix="NAFIR_", frozen=True)

    host: str = "127.0.0.1"
    port: Annotated[int, Field(ge=0, le=65535)] = 8000
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
    hello_timeout_s: Annotated[float, Field(gt=0)] = 10.0
    max_waiting_requests: Annotated[int, Field(ge=1)] = 32
    """HTTP requests that may wait for a worker; one more is answered 503."""

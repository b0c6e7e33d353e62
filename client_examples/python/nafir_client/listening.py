"""A walk heard and shown in a terminal: `nafir-client listen`, and `nafir listen` of the server's command line."""

import contextlib
import math
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from nafir_client import threaded
from nafir_client.errors import MissingExtraError
from nafir_client.playback import Player
from nafir_client.recording import PathAsHeard, Recording, write_wav
from nafir_client.session import Message, StreamOptions
from nafir_client.walk import POSES_PER_S, Walk
from nafir_client.wire import Block

if TYPE_CHECKING:
    from rich.table import Table

_SHOWN_PER_S = 10
_QUIETEST_DB = -60.0
_BAR = 30
_CALL_S = 15.0
_KEY = "NAFIR_API_KEY"


@dataclass(frozen=True)
class Listening:
    """What to listen to. The walk takes `walk_s` one way, and goes back and forth until `seconds` have passed. With
    `stays` the listener stays at the start. Sound is played, unless `is_silent`, by the sound card of the name or
    number `device`, and written to `output`, beside it the path as it was heard. Without an `api_key` that of the
    environment is used, NAFIR_API_KEY."""

    url: str
    scene: str = "apartment"
    clip: str = "woman-reading"
    seconds: float = math.inf
    walk_s: float = 12.0
    stays: bool = False
    level: str = "auto"
    sample_rate: int | None = None
    output: Path | None = None
    is_silent: bool = False
    device: str = ""
    api_key: str | None = None


class Meter:
    """Levels of the channels, and what else is worth showing. One thread notes blocks, another shows."""

    def __init__(self) -> None:
        self._peaks = np.zeros(0)
        self.reason = ""

    def note(self, block: Block) -> None:
        peaks = np.abs(block.samples).max(axis=0)
        # Falls by some 20 dB a second where nothing louder comes.
        fallen = self._peaks * 0.97 if len(self._peaks) == len(peaks) else 0 * peaks
        self._peaks = np.maximum(peaks, fallen)

    def levels_db(self) -> list[float]:
        """The channels' peaks, relative to full scale."""
        return [20 * math.log10(peak) if peak > 0 else -math.inf for peak in self._peaks.tolist()]

    def table(self, stream: threaded.ThreadedStream, passed_s: float) -> "Table":
        """What is shown of a stream."""
        from rich.table import Table

        counts, table = stream.statistics, Table.grid(padding=(0, 2))
        for number, level_db in enumerate(self.levels_db()):
            table.add_row(_channel(number, stream.welcome.channels), f"{_bar(level_db)} {level_db:6.1f} dB")
        summary = counts.summary()
        table.add_row("time", f"{passed_s:.1f} s of {stream.scene.name}")
        table.add_row("level", f"{stream.level} {self.reason}")
        table.add_row(
            "after a pose",
            f"sound {_ms(summary['pose_to_sound_ms'])}, reverberation {_ms(summary['pose_to_reverberation_ms'])}, "
            f"round trip {_ms(summary['round_trip_ms'])}",
        )
        table.add_row("buffer", f"{1000 * stream.delay_s:.0f} ms, {counts.underruns} underruns")
        table.add_row(
            "blocks",
            f"{counts.blocks}, {counts.blocks_late} late, {counts.blocks_skipped} skipped, "
            f"{counts.reconnections} reconnections",
        )
        return table


def listen(wish: Listening, say: Callable[[str], None]) -> None:
    """Listen until the end or until Ctrl+C. `say` gets what is worth a line. Raises NafirClientError, OSError where a
    file cannot be written, and ValueError for a wish that contradicts itself."""
    if wish.is_silent and wish.output is None:
        raise ValueError("silent: nothing is played and nothing written; name a file with output")
    meter, recording, path = Meter(), Recording(), PathAsHeard()
    keeps = wish.output is not None

    def note_block(block: Block) -> None:
        meter.note(block)
        if keeps:
            recording.add(block)
            path.note_block(block)

    def note_message(message: Message) -> None:
        path.note_message(message)
        if message["type"] == "level_changed":
            meter.reason = f"({message['reason']})"

    options: StreamOptions = {"level": wish.level}
    if wish.sample_rate is not None:
        options["sample_rate"] = wish.sample_rate
    stream = threaded.connect(
        wish.url,
        scene=wish.scene,
        api_key=wish.api_key or os.environ.get(_KEY),
        on_message=note_message,
        on_block=note_block,
        **options,
    )
    with stream, contextlib.ExitStack() as opened:
        show = opened.enter_context(_shown(meter, stream))
        if not wish.is_silent:
            device = int(wish.device) if wish.device.isdigit() else wish.device or None
            opened.enter_context(Player(stream, device=device))
        start_clock = _walk(wish, stream, path, show)
        rate, counts = stream.sample_rate, stream.statistics
        if stream.failure is not None:
            raise stream.failure
    if wish.output is not None:
        write_wav(wish.output, recording.samples(), rate)
        beside = wish.output.with_suffix(".csv")
        rows = path.write(beside, start_clock, stream.welcome.level)
        say(f"{wish.output}: {recording.frames / rate:.2f} s; {beside}: {rows} poses")
    say(f"{counts.blocks} blocks, {counts.blocks_late} late, {counts.underruns} underruns")


def _walk(wish: Listening, stream: threaded.ThreadedStream, path: PathAsHeard, show: Callable[[float], None]) -> int:
    """Walk until the end. Returns the clock at which the clip began."""
    walk, step = Walk.through(stream.scene, wish.walk_s), 0

    def go(passed_s: float) -> None:
        pose = walk.pose_at(0.0 if wish.stays else abs(math.remainder(passed_s, 2 * wish.walk_s)))
        path.note_pose(stream.move_listener(pose.position, orientation=pose.orientation).result(_CALL_S), pose)

    go(0.0)  # before the clip begins, so that it begins with this pose and not with the scene's
    clip, begun_s = stream.add_emitter(clip=wish.clip), time.monotonic()
    with contextlib.suppress(KeyboardInterrupt):
        while stream.failure is None and (passed_s := time.monotonic() - begun_s) < wish.seconds:
            go(passed_s)
            if step % (POSES_PER_S // _SHOWN_PER_S) == 0:
                show(passed_s)
            step += 1
            time.sleep(max(0.0, begun_s + step / POSES_PER_S - time.monotonic()))
    return clip.start_clock


@contextlib.contextmanager
def _shown(meter: Meter, stream: threaded.ThreadedStream) -> Iterator[Callable[[float], None]]:
    """A function that shows the state after so many seconds."""
    try:
        from rich.console import Console
        from rich.live import Live
    except ImportError as exc:
        raise MissingExtraError("rich", "listen", "the meter in the terminal") from exc
    with Live(console=Console(stderr=True), auto_refresh=False, transient=True) as live:
        yield lambda passed_s: live.update(meter.table(stream, passed_s), refresh=True)


def _channel(number: int, channels: int) -> str:
    return ("left", "right")[number] if channels == 2 else f"channel {number + 1}"


def _bar(level_db: float) -> str:
    filled = round(_BAR * min(1.0, max(0.0, 1 - level_db / _QUIETEST_DB)))
    return "█" * filled + "░" * (_BAR - filled)


def _ms(duration_ms: float) -> str:
    return "-" if math.isnan(duration_ms) else f"{duration_ms:.0f} ms"

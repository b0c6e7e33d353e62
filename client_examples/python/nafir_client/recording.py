"""Streams on disk: the sound as it arrived, and the path as it was heard."""

import csv
import math
from collections.abc import AsyncIterable, Callable, Mapping
from pathlib import Path

import numpy as np

from nafir_client.errors import MissingExtraError
from nafir_client.pose import Pose
from nafir_client.scene import Scene
from nafir_client.session import Message
from nafir_client.wire import Block, Samples

Row = tuple[int, int, int | str, str]


def write_wav(path: Path | str, samples: Samples, sample_rate: int) -> None:
    """Write samples (frame, channel) or (frame,) as single precision. Raises MissingExtraError, and OSError where the
    file cannot be written."""
    try:
        import soundfile
    except ImportError as exc:
        raise MissingExtraError("soundfile", "record", "writing sound files") from exc
    try:
        soundfile.write(path, samples, sample_rate, subtype="FLOAT")
    except soundfile.LibsndfileError as exc:
        raise OSError(f"{path}: {exc.error_string}") from exc


class Recording:
    """Blocks by their clock, with silence where blocks are missing. `start_clock` is the first sample to keep;
    what lies before it is left out."""

    def __init__(self, start_clock: int = 0) -> None:
        self.start_clock = start_clock
        self._blocks: dict[int, Samples] = {}

    def add(self, block: Block) -> None:
        before = max(0, self.start_clock - block.sample_clock)
        if before < len(block.samples):
            self._blocks[block.sample_clock + before] = block.samples[before:]

    @property
    def frames(self) -> int:
        """Samples of each channel from the start to the end of the last block."""
        if not self._blocks:
            return 0
        last = next(reversed(self._blocks))
        return last + len(self._blocks[last]) - self.start_clock

    def samples(self, frames: int | None = None) -> Samples:
        """(frame, channel) all of them, or the first `frames`."""
        frames = self.frames if frames is None else frames
        channels = next(iter(self._blocks.values())).shape[1] if self._blocks else 2
        samples = np.zeros((frames, channels), np.float32)
        for clock, block in self._blocks.items():
            at = clock - self.start_clock
            samples[at : at + len(block)] = block[: max(0, frames - at)]
        return samples


async def record(
    listener: AsyncIterable[Block],
    frames: int,
    *,
    start_clock: int = 0,
    note_block: Callable[[Block], None] | None = None,
) -> Recording:
    """What a stream or a listener of it hears, of at least so many frames from a clock on. `note_block` gets each
    block. Raises NafirClientError if the stream ends first."""
    recording = Recording(start_clock)
    async for block in listener:
        recording.add(block)
        if note_block is not None:
            note_block(block)
        if recording.frames >= frames:
            break
    return recording


class PathAsHeard:
    """From which sample on each pose and each quality level was heard by the first listener of a stream, or by the one
    with the id `listener`.

    `nafir render --path` makes the same sound from the file that `write` makes, to the sample unless
    `was_under_load`.
    """

    def __init__(self, listener: str | None = None) -> None:
        self.was_under_load = False
        """Whether the server has lowered the quality for load. It then uses the later parts of responses again at other
        poses, which the path does not tell."""
        self._listener = listener
        self._poses: dict[int, Pose] = {}
        self._levels: dict[int, str] = {}
        """Quality level by its first sample, of those that were not the first."""
        self._heard: list[tuple[int, int, int]] = []
        """The clock of each block, and the pose ids of its direct sound and of its reverberation."""

    def note_pose(self, pose_id: int, pose: Pose) -> None:
        self._poses[pose_id] = pose

    def note_message(self, message: Message) -> None:
        if message["type"] == "level_changed" and message.get("listener") == self._listener:
            self._levels[message["sample_clock"]] = message["level"]
            self.was_under_load |= message["reason"] == "load"

    def note_block(self, block: Block) -> None:
        self._heard.append((block.sample_clock, block.pose_id, block.reverberation_pose_id))

    def rows(self, start_clock: int, level: str) -> list[Row]:
        """Pose id, sample of the direct sound, and sample and level of the reverberation (or empty), in rising order,
        for a stream that began with `level` and whose first emitter began at `start_clock`.

        A pose whose reverberation was heard at two levels has two rows.
        """
        direct: dict[int, int] = {}
        reverberation: dict[int, int] = {}
        followed = [*(following for following, _, _ in self._heard[1:]), math.inf]
        for (began, pose, reverberation_pose), ended in zip(self._heard, followed, strict=True):
            if ended <= start_clock:
                continue
            clock = max(began, start_clock)  # a packet of Opus may have begun before
            direct.setdefault(pose, clock)
            if reverberation_pose != next(reversed(reverberation.values()), None):
                reverberation[clock] = reverberation_pose
        levels = {0: level}
        for clock, name in self._levels.items():
            if name != next(reversed(levels.values())):  # otherwise only the rate of responses has changed
                levels[clock] = name
        return self._merged(direct, reverberation, levels)

    def _merged(self, direct: dict[int, int], reverberation: dict[int, int], levels: dict[int, str]) -> list[Row]:
        """Rows from the first sample of each pose's direct sound, the pose by the first sample of its reverberation,
        and the level by its first sample."""
        heard: dict[int, list[tuple[int | str, str]]] = {}
        pose, level = None, ""
        for sample in sorted(reverberation.keys() | levels.keys()):
            pose, level = reverberation.get(sample, pose), levels.get(sample, level)
            if pose is not None:
                heard.setdefault(pose, []).append((sample, level))
        rows: list[Row] = []
        for pose in sorted(direct.keys() | heard.keys()):
            # A pose that a newer one replaced within a block was never heard directly. It gets the sample of the newer
            # one, whose row comes later and counts.
            sample = direct.get(pose, min(at for newer, at in direct.items() if newer >= pose))
            rows += [(pose, sample, *each) for each in heard.get(pose, [("", "")])]
        return rows

    def write(self, path: Path | str, start_clock: int, level: str) -> int:
        """Write the rows as a CSV file. Returns how many there are."""
        rows = self.rows(start_clock, level)
        with Path(path).open("w", newline="") as stream:
            writer = csv.writer(stream)
            writer.writerow(["sample", "reverberation_sample", "level", "x", "y", "z", "qx", "qy", "qz", "qw"])
            for pose_id, *clocks in rows:
                pose = self._poses[pose_id]
                writer.writerow([*clocks, *pose.position, *pose.orientation])
        return len(rows)


def level_sentence(change: Message, sample_rate: int) -> str:
    """What a `level_changed` says."""
    at_s, rate_hz = change["sample_clock"] / sample_rate, change["ir_rate_hz"]
    pace = "with every pose" if rate_hz is None else f"at most {rate_hz:g} times a second"
    reasons: Mapping[str, str] = {
        "chosen": "as chosen",
        "load": "the server is under load",
        "recovered": "the server has recovered",
    }
    return f"{at_s:.2f} s: level {change['level']}, responses {pace}: {reasons.get(change['reason'], change['reason'])}"


def render_command(scene: Scene, clip: str, path: Path, duration_s: float) -> str:
    """The command that renders again what was heard along a path, of a clip in a loop where the scene suggests, with
    every effect."""
    x, y, z = scene.emitter.position
    return (
        f"nafir render {scene.id} --effects all --emitter {clip}@{x:g},{y:g},{z:g} --loop "
        f"--path {path} --duration-s {duration_s:.6f} -o again.wav"
    )

"""Reads SOFA files (AES69) of rooms: SingleRoomSRIR, MultiSpeakerBRIR, SingleRoomMIMOSRIR, and SimpleFreeFieldHRIR
files that hold binaural room responses.

Positions of listener and source are in the room's frame: x ahead, y left, z up. Positions of receivers and emitters are
relative to their listener or source, rotated by its View and Up. Type and Units are read for every variable, because
published files differ from the defaults of their convention. Some published files also have the ears or the sense of
azimuth the wrong way round, so the sound decides which channel is the left ear.
"""

from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from server.rendering.sofa_file import SofaError, SofaFile, delay_rows
from training.data.importers.conditioning import SourceError
from training.data.importers.evidence import ears_agree, remedy, swap_ears
from training.data.importers.receivers import Receivers
from training.data.importers.report import ImportReport
from training.data.responses import Measurement

_Floats = npt.NDArray[np.float64]

_MOST_PITCH = np.radians(10.0)
_LONGEST_DELAY_S = 10.0


_CONVENTIONS = {
    "SimpleFreeFieldHRIR": Receivers.EARS,
    "MultiSpeakerBRIR": Receivers.EARS,
    "SingleRoomSRIR": Receivers.MICROPHONES,
    "SingleRoomMIMOSRIR": Receivers.MICROPHONES,
}


@dataclass(frozen=True)
class _Room:
    """The contents of a file. `head` (measurement, xyz, axis); `origin` (measurement, 3); `emitter_at`, `receiver_at`
    (measurement, emitter or receiver, 3); `responses` (measurement, receiver, emitter, sample)."""

    sample_rate: int
    head: _Floats
    origin: _Floats
    emitter_at: _Floats
    receiver_at: _Floats | None
    """None if the receivers are ears."""
    responses: npt.NDArray[np.float32]


def read(
    path: Path,
    report: ImportReport,
    *,
    receivers: Receivers | None = None,
    checks_ears: bool = True,
    track: Callable[[list[int]], Iterable[int]] = iter,
) -> Generator[tuple[str, Measurement]]:
    """Yields a name and a measurement for each response. `receivers` overrides the kind of receivers that the
    convention has. `checks_ears`: swap ears if the sound shows that they are the wrong way round.

    Raises SourceError for another convention, or for variables that do not fit it.
    """
    try:
        room = _room(SofaFile.open(path), receivers)
    except SofaError as exc:
        raise SourceError(path, exc.variable, exc.problem) from exc
    measurements, channels, emitters, _ = room.responses.shape
    if room.receiver_at is None:
        rows = [
            (
                m,
                e,
                Measurement(
                    tuple(room.origin[m]), tuple(room.emitter_at[m, e]), room.responses[m, :, e], room.sample_rate, yaw
                ),
            )
            for m, yaw in enumerate(np.arctan2(room.head[:, 1, 0], room.head[:, 0, 0]))
            for e in range(emitters)
        ]
        if checks_ears and _are_ears_swapped(path, [row for *_, row in rows], report):
            rows = [(m, e, swap_ears(row)) for m, e, row in rows]
        pitch = np.arcsin(np.clip(room.head[:, 2, 0], -1.0, 1.0))
        for index in track(list(range(len(rows)))):
            m, e, row = rows[index]
            name = f"measurement {m}" + (f", emitter {e}" if emitters > 1 else "")
            if abs(pitch[m]) > _MOST_PITCH:
                report.skip(name, "head not level")
                continue
            yield name, row
        return
    for m in track(list(range(measurements))):
        for r in range(channels):
            for e in range(emitters):
                ends = tuple(room.receiver_at[m, r]), tuple(room.emitter_at[m, e])
                row = Measurement(*ends, room.responses[m, [r], e], room.sample_rate)
                yield f"measurement {m}, receiver {r}" + (f", emitter {e}" if emitters > 1 else ""), row


def _room(sofa: SofaFile, receivers: Receivers | None) -> _Room:
    """Raises SofaError."""
    convention = sofa.text("GLOBAL_SOFAConventions")
    if convention not in _CONVENTIONS:
        raise SofaError(sofa.path, "SOFAConventions", f"is {convention}; known are {', '.join(_CONVENTIONS)}")
    kind = receivers or _CONVENTIONS[convention]
    rate = sofa.sampling_rate_hz()
    sofa.require("Data_SamplingRate", rate % 1 == 0, f"is {rate:g}, not a whole number of hertz")
    responses = _responses(sofa)
    measurements, channels, emitters, _ = responses.shape
    if kind == Receivers.EARS and channels != 2:
        raise SofaError(sofa.path, "Data.IR", f"has {channels} receivers, not two ears")
    head = sofa.frames("Listener", measurements)
    origin = sofa.points("ListenerPosition", measurements)
    beside_source = sofa.parts("EmitterPosition", emitters, measurements)
    emitter_at = sofa.points("SourcePosition", measurements)[:, np.newaxis] + np.einsum(
        "mxa,mea->mex", sofa.frames("Source", measurements), beside_source
    )
    receiver_at = None
    if kind == Receivers.MICROPHONES:
        beside_origin = sofa.parts("ReceiverPosition", channels, measurements)
        receiver_at = origin[:, np.newaxis] + np.einsum("mxa,mra->mrx", head, beside_origin)
    return _Room(int(rate), head, origin, emitter_at, receiver_at, responses)


def _are_ears_swapped(path: Path, rows: list[Measurement], report: ImportReport) -> bool:
    """Whether the first channel is the right ear, judged by the direct sound. Raises SourceError if responses disagree
    about it."""
    rows = [row for row in rows if np.isfinite(row.response).all()]
    agreeing = [agrees for row in rows if (agrees := ears_agree(row)) is not None]
    if not agreeing:
        report.note("ears not checked: no emitter to the side")
        return False
    share = float(np.mean(agreeing))
    if 0.25 < share < 0.75:
        problem = "its channels are not those of ears: neither is louder on its side"
        raise SourceError(path, "Data.IR", f"{problem}; {remedy(rows)}")
    if share < 0.5:
        report.note("receivers swapped: the first sounds like the right ear (or azimuth is stored clockwise)")
    return share < 0.5


def _responses(sofa: SofaFile) -> npt.NDArray[np.float32]:
    """(measurement, receiver, emitter, sample), with `Data.Delay` applied."""
    responses = sofa.numbers("Data_IR")
    kind = sofa.text("GLOBAL_DataType").upper()
    if kind == "FIR-E":  # as in the standard; its drafts have FIRE, with emitters before samples
        responses = np.swapaxes(responses, -1, -2) if responses.ndim == 4 else responses
    elif kind == "FIR":
        responses = responses[:, :, np.newaxis] if responses.ndim == 3 else responses
    elif kind != "FIRE":
        raise SofaError(sofa.path, "DataType", f"is {kind}, not FIR, FIRE or FIR-E")
    if responses.ndim != 4 or 0 in responses.shape:
        raise SofaError(sofa.path, "Data.IR", f"has shape {sofa.numbers('Data_IR').shape}")
    delays = np.atleast_2d(sofa.numbers("Data_Delay", 0.0))
    delays = delays[..., np.newaxis] if delays.ndim == 2 else delays
    try:
        delays = np.broadcast_to(delays, responses.shape[:3])
    except ValueError as exc:
        raise SofaError(sofa.path, "Data.Delay", f"has shape {delays.shape}") from exc
    if not delays.any():
        return responses.astype(np.float32)
    longest = _LONGEST_DELAY_S * sofa.sampling_rate_hz()
    if not (delays.min() >= 0 and delays.max() < longest):  # NaN too
        raise SofaError(sofa.path, "Data.Delay", "is negative, not finite, or too long")
    most = float(delays.max())
    delayed = [delay_rows(*of_measurement, most) for of_measurement in zip(responses, delays, strict=True)]
    return np.array(delayed, dtype=np.float32)

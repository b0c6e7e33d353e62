"""SOFA files (AES69) of rooms: SingleRoomSRIR, MultiSpeakerBRIR, SimpleFreeFieldHRIR that hold binaural room responses,
and SingleRoomMIMOSRIR.

Positions of listener and source are in the room's frame, x ahead, y left, z up; those of receivers and emitters in
that of the listener or source they belong to, turned by its View and Up. Type and Units are read for every variable:
published files differ from their convention's defaults. Which channel is the left ear is asked of the sound, since
published files have it, or the sense of azimuth, wrong.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from training.importers.conditioning import SourceError, ears_agree
from training.importers.receivers import Receivers
from training.importers.report import ImportReport
from training.responses import Measurement

_Floats = npt.NDArray[np.float64]

_MOST_PITCH = np.radians(10.0)
_LONGEST_DELAY_S = 10.0


_CONVENTIONS = {
    "SimpleFreeFieldHRIR": Receivers.EARS,
    "MultiSpeakerBRIR": Receivers.EARS,
    "SingleRoomSRIR": Receivers.MICROPHONES,
    "SingleRoomMIMOSRIR": Receivers.MICROPHONES,
}


def read(
    path: Path,
    report: ImportReport,
    *,
    receivers: Receivers | None = None,
    track: Callable[[list[int]], Iterable[int]] = iter,
) -> Iterator[tuple[str, Measurement]]:
    """receivers: instead of what the convention has them be.

    Raises SourceError for another convention, or variables that do not fit it.
    """
    sofa = _opened(path)
    convention = sofa.text("GLOBAL_SOFAConventions")
    if convention not in _CONVENTIONS:
        raise SourceError(path, "SOFAConventions", f"is {convention}; known are {', '.join(_CONVENTIONS)}")
    kind = receivers or _CONVENTIONS[convention]
    responses = _responses(sofa)
    measurements, channels, emitters, _ = responses.shape
    if kind == Receivers.EARS and channels != 2:
        raise SourceError(path, "Data.IR", f"has {channels} receivers, not two ears")
    rate = np.unique(sofa.numbers("Data_SamplingRate"))
    if rate.size != 1 or not 0 < rate[0] < np.inf or rate[0] % 1:
        raise SourceError(path, "Data.SamplingRate", f"is {rate}, not one whole number of hertz")
    head = sofa.frames("Listener", measurements)
    origin = sofa.points("ListenerPosition", measurements)
    source = sofa.points("SourcePosition", measurements)
    emitter_at = source[:, np.newaxis] + np.einsum(
        "mxa,mea->mex", sofa.frames("Source", measurements), sofa.parts("EmitterPosition", emitters, measurements)
    )
    if kind == Receivers.EARS:
        rows = [
            (m, e, Measurement(tuple(origin[m]), tuple(emitter_at[m, e]), responses[m, :, e], int(rate[0]), yaw))
            for m, yaw in enumerate(np.arctan2(head[:, 1, 0], head[:, 0, 0]))
            for e in range(emitters)
        ]
        if _swapped(path, [row for *_, row in rows], report):
            rows = [(m, e, _ears_exchanged(row)) for m, e, row in rows]
        pitch = np.arcsin(np.clip(head[:, 2, 0], -1.0, 1.0))
        for index in track(list(range(len(rows)))):
            m, e, row = rows[index]
            name = f"measurement {m}" + (f", emitter {e}" if emitters > 1 else "")
            if abs(pitch[m]) > _MOST_PITCH:
                report.skip(name, "head not level")
                continue
            yield name, row
        return
    receiver_at = origin[:, np.newaxis] + np.einsum(
        "mxa,mra->mrx", head, sofa.parts("ReceiverPosition", channels, measurements)
    )
    for m in track(list(range(measurements))):
        for r in range(channels):
            for e in range(emitters):
                row = Measurement(tuple(receiver_at[m, r]), tuple(emitter_at[m, e]), responses[m, [r], e], int(rate[0]))
                yield f"measurement {m}, receiver {r}" + (f", emitter {e}" if emitters > 1 else ""), row


def _swapped(path: Path, rows: list[Measurement], report: ImportReport) -> bool:
    """Raises SourceError where the ears contradict each other."""
    agreeing = [agrees for row in rows if np.isfinite(row.response).all() and (agrees := ears_agree(row)) is not None]
    if not agreeing:
        report.note("ears not told apart: no emitter to the side")
        return False
    share = float(np.mean(agreeing))
    if 0.25 < share < 0.75:
        raise SourceError(path, "Data.IR", "its channels are not those of ears: neither is louder on its side")
    if share < 0.5:
        report.note("receivers exchanged: the first sounds like the right ear (or azimuth is stored clockwise)")
    return share < 0.5


def _ears_exchanged(row: Measurement) -> Measurement:
    return Measurement(row.listener, row.emitter, row.response[::-1], row.sample_rate, row.yaw)


@dataclass(frozen=True)
class _File:
    path: Path
    content: Any

    def text(self, name: str) -> str:
        return str(getattr(self.content, name, ""))

    def numbers(self, name: str, default: npt.ArrayLike | None = None) -> _Floats:
        value = getattr(self.content, name, default)
        if value is None:
            raise SourceError(self.path, name.replace("_", "."), "is missing")
        try:
            # What a file leaves out is masked when read.
            return np.ma.filled(np.ma.asarray(value, dtype=np.float64), np.nan)
        except (TypeError, ValueError) as exc:
            raise SourceError(self.path, name.replace("_", "."), f"is not of numbers ({exc})") from exc

    def cartesian(self, name: str, values: _Floats, *, described_by: str | None = None) -> _Floats:
        """(..., 3) by the variable's own Type and Units."""
        kind = self.text(f"{described_by or name}_Type").strip().lower()
        units = [unit.strip().lower() for unit in self.text(f"{described_by or name}_Units").split(",")]
        if kind == "cartesian":
            self._require(name, set(units) <= {"metre", "meter", "metres", "meters", "m"}, f"Units are {units}")
            return values
        self._require(name, kind == "spherical", f"Type is {kind!r}, neither cartesian nor spherical")
        by_unit = {"degree": np.pi / 180, "degrees": np.pi / 180, "radian": 1.0, "radians": 1.0}
        # Some files repeat one unit, or leave out the last.
        angles = units[:2] if len(units) >= 2 else units * 2
        self._require(name, all(unit in by_unit for unit in angles), f"Units are {units}")
        azimuth, elevation = values[..., 0] * by_unit[angles[0]], values[..., 1] * by_unit[angles[1]]
        radius = values[..., 2]
        towards = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
        return np.asarray(radius[..., np.newaxis] * np.stack(towards, axis=-1))

    def points(self, name: str, measurements: int) -> _Floats:
        """(measurement, 3)"""
        values = np.atleast_2d(self.numbers(name))
        self._require(name, values.shape in {(1, 3), (measurements, 3)}, f"has shape {values.shape}")
        return np.broadcast_to(self.cartesian(name, values), (measurements, 3))

    def parts(self, name: str, count: int, measurements: int) -> _Floats:
        """(measurement, part, 3) of receivers or emitters, stored (part, 3), (part, 3, 1) or (part, 3, measurement)."""
        values = self.numbers(name)
        if values.ndim == 2:
            values = values[..., np.newaxis]
        fits = values.ndim == 3 and values.shape[0] in {1, count} and values.shape[1] == 3
        self._require(name, fits and values.shape[2] in {1, measurements}, f"has shape {values.shape}")
        return np.broadcast_to(self.cartesian(name, np.moveaxis(values, -1, 0)), (measurements, count, 3))

    def frames(self, owner: str, measurements: int) -> _Floats:
        """(measurement, xyz, axis) of the room's frame; columns are ahead, left and up of a listener or source."""
        view, up = f"{owner}View", f"{owner}Up"
        if not hasattr(self.content, view):
            return np.broadcast_to(np.eye(3), (measurements, 3, 3))
        ahead = self._directions(view, measurements, view)
        ahead /= np.linalg.norm(ahead, axis=-1, keepdims=True)
        # Up shares the type of View in published files, and says so in none.
        upward = self._directions(up, measurements, up if self.text(f"{up}_Type") else view)
        left = np.cross(upward, ahead)
        length = np.linalg.norm(left, axis=-1, keepdims=True)
        self._require(up, bool((length > 1e-6).all()), f"is parallel to {view}, or not finite")
        left /= length
        return np.stack([ahead, left, np.cross(ahead, left)], axis=-1)

    def _directions(self, name: str, measurements: int, described_by: str) -> _Floats:
        values = np.atleast_2d(self.numbers(name, [0.0, 0.0, 1.0]))
        self._require(name, values.shape in {(1, 3), (measurements, 3)}, f"has shape {values.shape}")
        directions = self.cartesian(name, values, described_by=described_by)
        self._require(name, bool((np.linalg.norm(directions, axis=-1) > 1e-6).all()), "is no direction")
        return np.broadcast_to(directions, (measurements, 3)).copy()

    def _require(self, name: str, condition: bool, problem: str) -> None:
        if not condition:
            raise SourceError(self.path, name, problem)


def _opened(path: Path) -> _File:
    if path.suffix != ".sofa":  # sofar would open another file: it replaces any other suffix
        raise SourceError(path, "file", "a SOFA file's name ends in .sofa")
    if not path.is_file():
        raise SourceError(path, "file", "no such file")
    import sofar

    try:
        # As stored: sofar's check of a whole file refuses harmless faults that published files are full of.
        return _File(path, sofar.read_sofa_as_netcdf(str(path)))
    except (OSError, ValueError) as exc:
        raise SourceError(path, "file", f"not a readable SOFA file ({exc})") from exc


def _responses(sofa: _File) -> npt.NDArray[np.float32]:
    """(measurement, receiver, emitter, sample), `Data.Delay` applied."""
    responses = sofa.numbers("Data_IR")
    kind = sofa.text("GLOBAL_DataType").upper()
    if kind == "FIR-E":  # of the standard; FIRE, of its drafts, has emitters before samples
        responses = np.swapaxes(responses, -1, -2) if responses.ndim == 4 else responses
    elif kind == "FIR":
        responses = responses[:, :, np.newaxis] if responses.ndim == 3 else responses
    elif kind != "FIRE":
        raise SourceError(sofa.path, "DataType", f"is {kind}, not FIR, FIRE or FIR-E")
    if responses.ndim != 4 or 0 in responses.shape:
        raise SourceError(sofa.path, "Data.IR", f"has shape {sofa.numbers('Data_IR').shape}")
    delays = np.atleast_2d(sofa.numbers("Data_Delay", 0.0))
    delays = delays[..., np.newaxis] if delays.ndim == 2 else delays
    try:
        delays = np.broadcast_to(delays, responses.shape[:3])
    except ValueError as exc:
        raise SourceError(sofa.path, "Data.Delay", f"has shape {delays.shape}") from exc
    if not delays.any():
        return responses.astype(np.float32)
    longest = _LONGEST_DELAY_S * float(sofa.numbers("Data_SamplingRate").max())
    if not (delays.min() >= 0 and delays.max() < longest):  # NaN too
        raise SourceError(sofa.path, "Data.Delay", "is negative, not finite, or too long")
    samples = responses.shape[-1] + int(np.ceil(delays.max()))
    n_fft = 2 * samples
    shift = np.exp(-2j * np.pi * np.fft.rfftfreq(n_fft) * delays[..., np.newaxis])
    return np.fft.irfft(np.fft.rfft(responses, n_fft) * shift, n_fft)[..., :samples].astype(np.float32)

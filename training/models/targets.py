"""Training targets of the factorised field: what it should say of each response, in the heads' layout.

Responses are aligned first: the moment sound can first arrive (path length over the speed of sound) is moved to a
fixed sample. Reflections follow it at once wherever the two ends are, so the field is smooth. Aligning the earliest
possible reflection instead, which the floor plan gives as well, was measured to change nothing.
"""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from rich.progress import Progress
from scipy.fft import irfft, next_fast_len, rfft

from server.acoustics.codec import Codec
from training.dataset import DatasetError
from training.models.cells import Cells
from training.responses import ResponseSet, SimulatedResponses
from training.simulation.expected import ExpectedSpectrograms

LEAD_SAMPLES = 64
N_FFT = 256
LOG_FLOOR = 1e-5


def codec_of(responses: ResponseSet, n_fft: int = N_FFT) -> Codec:
    return Codec(responses.sample_rate, n_fft, n_fft // 4, responses.samples, LOG_FLOOR)


def align(responses: npt.NDArray[np.floating], delay_samples: float) -> npt.NDArray[np.float64]:
    """(..., sample) responses advanced by a fractional delay; the length stays, the end fills with silence."""
    samples = responses.shape[-1]
    size = next_fast_len(samples + 512)
    spectrum = rfft(responses.astype(np.float64), size)
    spectrum *= np.exp(2j * np.pi * np.arange(spectrum.shape[-1]) / size * delay_samples)
    return np.asarray(irfft(spectrum, size)[..., :samples])


def flat_targets(aligned: npt.NDArray[np.floating], cells: Cells) -> npt.NDArray[np.float16]:
    """(..., channel, sample) aligned responses to (..., heads.size): fine, late, phasor and, for two channels,
    interaural, in `Heads` order."""
    codec = cells.codec
    spectrogram = codec.transform(aligned)
    fine = codec.log_magnitude(spectrogram[..., : cells.fine_frames])
    bands, late_frames, all_frames = cells.bands.pool(), cells.late_frames.pool(), cells.all_frames.pool()
    # Pooled as power: a cell's level is what noise of that power has.
    late = codec.log_magnitude(np.sqrt(bands.T @ np.abs(spectrogram[..., cells.fine_frames :]) ** 2 @ late_frames))
    known = spectrogram[..., : cells.known_frames]
    phasor = known / np.maximum(np.abs(known), 1e-12)
    parts = [fine, late, _complex_parts(phasor, -4)]
    if aligned.shape[-2] == 2:
        power = bands.T @ np.abs(spectrogram) ** 2 @ all_frames
        cross = bands.T @ (spectrogram[..., 0, :, :] * np.conj(spectrogram[..., 1, :, :])) @ all_frames
        interaural = cross / np.maximum(np.sqrt(power[..., 0, :, :] * power[..., 1, :, :]), 1e-20)
        parts.append(_complex_parts(interaural, -3))
    lead = aligned.shape[:-2]
    return np.concatenate([part.reshape(*lead, -1) for part in parts], axis=-1).astype(np.float16)


def _complex_parts(values: npt.NDArray[np.complexfloating], axis: int) -> npt.NDArray[np.floating]:
    return np.stack([values.real, values.imag], axis=axis)


@dataclass(frozen=True)
class Targets:
    """Poses and flat targets, one row per response that is not held out; `flat` is a memory map."""

    listener: npt.NDArray[np.float32]
    emitter: npt.NDArray[np.float32]
    yaw: npt.NDArray[np.float32]
    flat: npt.NDArray[np.float16]


def load_targets(
    responses: ResponseSet, cells: Cells, folder: Path, progress: Progress, *, expected: bool = False
) -> Targets:
    """Targets of all responses that are not held out, computed once and kept in `folder`.

    With `expected`, of simulated responses only, levels are those of the expected power of each response, over all
    draws of its noise. Raises DatasetError if the dataset keeps no energies.
    """
    rows = np.flatnonzero(~responses.held_out)
    key = json.dumps({"cells": asdict(cells), "rows": len(rows), "written": _written(responses), "expected": expected})
    path, key_path = folder / "targets.npy", folder / "targets.json"
    if not (key_path.exists() and key_path.read_text() == key):
        key_path.unlink(missing_ok=True)
        _compute(responses, cells, rows, path, progress, expected=expected)
        key_path.write_text(key)
    poses = (part[rows].astype(np.float32) for part in (responses.listener, responses.emitter, responses.yaw))
    return Targets(*poses, np.load(path, mmap_mode="r"))


def _written(responses: ResponseSet) -> float:
    file = responses.dataset.folder / "pairs.h5" if isinstance(responses, SimulatedResponses) else None
    return 0.0 if file is None else file.stat().st_mtime


def delay_samples(responses: ResponseSet, row: int) -> float:
    """How much earlier than emitted an aligned response starts."""
    return float(responses.onset_s[row]) * responses.sample_rate - LEAD_SAMPLES


def expected_levels(power: npt.NDArray[np.floating], cells: Cells) -> npt.NDArray[np.float16]:
    """(..., channel, frequency, frame) expected power to the levels, fine and late, that flat targets begin with."""
    codec = cells.codec
    fine = np.sqrt(power[..., : cells.fine_frames])
    late = np.sqrt(cells.bands.pool().T @ power[..., cells.fine_frames :] @ cells.late_frames.pool())
    parts = [codec.log_magnitude(part).reshape(*power.shape[:-3], -1) for part in (fine, late)]
    return np.concatenate(parts, axis=-1).astype(np.float16)


def _compute(
    responses: ResponseSet,
    cells: Cells,
    rows: npt.NDArray[np.int64],
    path: Path,
    progress: Progress,
    *,
    expected: bool,
) -> None:
    """Row by row into a file; those of one pair, which are stored together, are read together."""
    starts = np.flatnonzero(np.diff(responses.pair[rows], prepend=-1))
    task = progress.add_task("targets", total=len(starts))
    flat: npt.NDArray[np.float16] | None = None
    spectra = _ExpectedPower(responses, cells.codec) if expected else None
    for start, stop in zip(starts, [*starts[1:], len(rows)], strict=True):
        some = rows[start:stop]
        target = flat_targets(align(responses.read(some), delay_samples(responses, some[0])), cells)
        if spectra is not None:
            levels = expected_levels(spectra.of_rows(some), cells)
            target[..., : levels.shape[-1]] = levels
        if flat is None:
            flat = np.lib.format.open_memmap(path, "w+", np.float16, (len(rows), target.shape[-1]))
        flat[start:stop] = target
        progress.advance(task)
    if flat is not None:
        flat.flush()


class _ExpectedPower:
    """Of aligned simulated responses: the power of what is the same in every draw, and the variance of the rest."""

    def __init__(self, responses: ResponseSet, codec: Codec) -> None:
        if not isinstance(responses, SimulatedResponses):
            raise DatasetError("what is expected of a response is known of simulated ones only")
        self._responses, self._codec = responses, codec
        self._spectra = ExpectedSpectrograms(responses.dataset, codec)

    def of_rows(self, rows: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
        """(row, ear, frequency, frame) of rows that are all of one pair."""
        responses, dataset = self._responses, self._responses.dataset
        ends = (responses.emitter[rows[0]], responses.listener[rows[0]])
        emitter, listener = (int(np.argmin(np.sum((dataset.probes - end) ** 2, axis=1))) for end in ends)
        yaws = rows % len(dataset.yaws)
        delay = delay_samples(responses, rows[0])
        mean = self._codec.transform(align(self._spectra.specular(emitter, listener)[yaws], delay))
        return np.abs(mean) ** 2 + self._spectra.diffuse_power(emitter, listener, delay)[yaws]

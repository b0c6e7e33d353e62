"""Training targets: what a field should say of each simulated pair, in the heads' layout.

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
from training.dataset import Dataset
from training.models.cells import Cells

LEAD_SAMPLES = 64
N_FFT = 256
LOG_FLOOR = 1e-5


def codec_of(dataset: Dataset) -> Codec:
    return Codec(dataset.sample_rate, N_FFT, N_FFT // 4, dataset.samples, LOG_FLOOR)


def align(responses: npt.NDArray[np.floating], delay_samples: float) -> npt.NDArray[np.float64]:
    """(..., sample) responses advanced by a fractional delay; the length stays, the end fills with silence."""
    samples = responses.shape[-1]
    size = next_fast_len(samples + 512)
    spectrum = rfft(responses.astype(np.float64), size)
    spectrum *= np.exp(2j * np.pi * np.arange(spectrum.shape[-1]) / size * delay_samples)
    return np.asarray(irfft(spectrum, size)[..., :samples])


def flat_targets(aligned: npt.NDArray[np.floating], cells: Cells) -> npt.NDArray[np.float16]:
    """(..., ear, sample) aligned responses to (..., heads.size): fine, late, phasor, interaural, in `Heads` order."""
    codec = cells.codec
    spectrogram = codec.transform(aligned)
    fine = codec.log_magnitude(spectrogram[..., : cells.fine_frames])
    bands, late_frames, all_frames = cells.bands.pool(), cells.late_frames.pool(), cells.all_frames.pool()
    # Pooled as power: a cell's level is what noise of that power has.
    late = codec.log_magnitude(np.sqrt(bands.T @ np.abs(spectrogram[..., cells.fine_frames :]) ** 2 @ late_frames))
    known = spectrogram[..., : cells.known_frames]
    phasor = known / np.maximum(np.abs(known), 1e-12)
    power = bands.T @ np.abs(spectrogram) ** 2 @ all_frames
    cross = bands.T @ (spectrogram[..., 0, :, :] * np.conj(spectrogram[..., 1, :, :])) @ all_frames
    interaural = cross / np.maximum(np.sqrt(power[..., 0, :, :] * power[..., 1, :, :]), 1e-20)
    lead = aligned.shape[:-2]
    parts = [fine, late, _complex_parts(phasor, -4), _complex_parts(interaural, -3)]
    return np.concatenate([part.reshape(*lead, -1) for part in parts], axis=-1).astype(np.float16)


def _complex_parts(values: npt.NDArray[np.complexfloating], axis: int) -> npt.NDArray[np.floating]:
    return np.stack([values.real, values.imag], axis=axis)


@dataclass(frozen=True)
class Targets:
    """Poses and flat targets of a set of pairs, one row per pair and yaw; `flat` is a memory map."""

    listener: npt.NDArray[np.float32]
    emitter: npt.NDArray[np.float32]
    yaw: npt.NDArray[np.float32]
    pair: npt.NDArray[np.int64]
    flat: npt.NDArray[np.float16]


def load_targets(dataset: Dataset, cells: Cells, folder: Path, progress: Progress) -> Targets:
    """Targets of all pairs that are not held out, computed once and kept in `folder`."""
    pairs = dataset.pairs(held_out=False)
    yaws = len(dataset.yaws)
    key = {"cells": asdict(cells), "simulated": (dataset.folder / "pairs.h5").stat().st_mtime}
    path, key_path = folder / "targets.npy", folder / "targets.json"
    if not (key_path.exists() and json.loads(key_path.read_text()) == json.loads(json.dumps(key))):
        key_path.unlink(missing_ok=True)
        _compute(dataset, cells, pairs, path, progress)
        key_path.write_text(json.dumps(key))
    flat = np.load(path, mmap_mode="r").reshape(len(pairs) * yaws, -1)
    emitter, listener = (np.repeat(dataset.probes[pairs[:, side]], yaws, axis=0).astype(np.float32) for side in (0, 1))
    yaw = np.tile(dataset.yaws, len(pairs)).astype(np.float32)
    return Targets(listener, emitter, yaw, np.repeat(np.arange(len(pairs)), yaws), flat)


def _compute(dataset: Dataset, cells: Cells, pairs: npt.NDArray[np.int64], path: Path, progress: Progress) -> None:
    task = progress.add_task("targets", total=len(pairs))
    flat = None
    for row, (emitter, listener) in enumerate(pairs):
        delay = dataset.onset_s[emitter, listener] * dataset.sample_rate - LEAD_SAMPLES
        target = flat_targets(align(dataset.read(pairs[row : row + 1])[0], delay), cells)
        if flat is None:
            flat = np.lib.format.open_memmap(path, "w+", np.float16, (len(pairs), *target.shape))
        flat[row] = target
        progress.advance(task)
    if flat is not None:
        flat.flush()

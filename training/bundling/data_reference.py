"""Measures a dataset's responses as `nafir check` measures fields. The results are the reference for the relative laws
of the check, and are shown before training."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from server.health import laws
from server.health.energies import Windows
from server.health.findings import DECAY
from server.scene.manifest import DataReference, Manifest
from training.data.dataset import TAKES
from training.data.responses import ResponseSet
from training.models.targets import LEAD_SAMPLES, codec_of
from training.models.whole_transform import transform_at_once
from training.simulation.references import References
from training.simulation.responses import SimulatedResponses

_MOST_ROWS = 192
_REPEATED_PAIRS = 24
_HEARD_DB = 60.0
_MOST_DIFFERENCE_DB = 3.0
"""If two simulations of a pair differ by more in a window, its level is not known to within a factor of two in
energy."""


@dataclass(frozen=True)
class DataHealth:
    """`median_rise_db` and `largest_rise_db` are increases of level in responses; the largest comes `rises_at_s` after
    the first sound. `uncertain_from_s` is when two simulations of a pair begin to differ by more than 3 dB in 20 ms, on
    average. It is None if they never do, or if no pair was simulated twice."""

    median_rise_db: float
    largest_rise_db: float
    rises_at_s: float
    uncertain_from_s: float | None

    def lines(self, rays: int | None) -> list[str]:
        """Warnings to print before training; empty if there are none."""
        warnings = []
        if self.largest_rise_db > DECAY.bound:
            warnings.append(
                f"responses rise by up to {self.largest_rise_db:.0f} dB (half of them by {self.median_rise_db:.0f} dB "
                f"or more), {self.rises_at_s:.2f} s after their first sound at most: the fields may do the same there"
            )
        if self.uncertain_from_s is not None and rays is not None:
            warnings.append(
                f"from {self.uncertain_from_s:.2f} s on two simulations of one pair differ by more than "
                f"{_MOST_DIFFERENCE_DB:g} dB: "
                f"few rays decide their late sound. simulation.rays = {4 * rays} halves the difference"
            )
        return warnings


def window_energies(
    responses: ResponseSet, rows: npt.NDArray[np.int64], windows: Windows | None = None
) -> npt.NDArray[np.float64]:
    """(row, channel, band, window) energies of responses that are aligned like a field's, to a whole sample."""
    codec = codec_of(responses)
    windows = windows or Windows(codec)
    energies = []
    for row in rows:
        (response,) = responses.read([row])
        later = round(float(responses.onset_s[row]) * responses.sample_rate) - LEAD_SAMPLES
        energies.append(windows.energies(np.abs(transform_at_once(codec, advance(response, later)))))
    return np.array(energies)


def advance(response: npt.NDArray[np.floating], samples: int) -> npt.NDArray[np.floating]:
    """(..., sample) moved earlier by `samples`, or later if negative; silence fills the gap."""
    moved = np.zeros_like(response)
    if samples >= 0:
        moved[..., : response.shape[-1] - samples] = response[..., samples:]
    else:
        moved[..., -samples:] = response[..., :samples]
    return moved


def _some_rows(responses: ResponseSet) -> npt.NDArray[np.int64]:
    """At most _MOST_ROWS rows, spread over all pairs, and the same every time."""
    count = len(responses.yaw)
    order = np.random.default_rng(0).permutation(count)[:_MOST_ROWS]
    return np.sort(order)


def reference_of(responses: ResponseSet, manifest: Manifest) -> DataReference:
    """The reference in the manifest of fields that were trained on these responses."""
    rows = _some_rows(responses)
    windows = Windows(codec_of(responses))
    energies = window_energies(responses, rows, windows)
    rises = laws.rises_db(energies).max(axis=(0, 1))
    excess_db = None
    # The bound for fields that include direct sound differs from that of stored responses, which lack it.
    if manifest.geometry is not None and manifest.direct_sound == "geometry":
        poses = np.column_stack([responses.listener, responses.emitter, responses.yaw])[rows]
        excess_db = round(float(laws.energy_excess_db(manifest, manifest.geometry, poses, energies).max()), 2)
    return DataReference(
        responses=len(rows),
        window_s=windows.window_s,
        rises_db=tuple(np.round(rises, 1).tolist()),
        energy_excess_db=excess_db if excess_db is not None and np.isfinite(excess_db) else None,
    )


def health_of(responses: ResponseSet) -> DataHealth:
    """Findings from a sample of the responses."""
    windows = Windows(codec_of(responses))
    rises = laws.rises_db(window_energies(responses, _some_rows(responses), windows))
    of_each = rises.max(axis=(1, 2))
    latest = int(np.max(np.flatnonzero(rises.max(axis=(0, 1)) > DECAY.bound), initial=0))
    uncertain = _uncertain_from(responses, windows) if isinstance(responses, SimulatedResponses) else None
    return DataHealth(
        median_rise_db=float(np.median(of_each)),
        largest_rise_db=float(of_each.max()),
        rises_at_s=latest * windows.window_s,
        uncertain_from_s=None if uncertain is None else uncertain * windows.window_s,
    )


def _uncertain_from(responses: SimulatedResponses, windows: Windows) -> int | None:
    """The first window in which two takes of the held-out pairs differ, on average, by more than
    _MOST_DIFFERENCE_DB."""
    dataset = responses.dataset
    pairs = dataset.pairs(held_out=True)[:_REPEATED_PAIRS]
    codec = codec_of(responses)
    levels = []
    for take in TAKES:
        references = References(dataset, take, heads=dataset.yaws[:1])
        energies = []
        for emitter, listener in pairs.tolist():
            (response,) = references.reflected(emitter, listener)
            later = round(float(dataset.onset_s[emitter, listener]) * dataset.sample_rate) - LEAD_SAMPLES
            energies.append(windows.energies(np.abs(transform_at_once(codec, advance(response, later)))))
        levels.append(laws.window_levels_db(np.array(energies)))
    first, second = levels
    loudest = first.max(axis=-1, keepdims=True)
    is_heard = np.maximum(first, second) > loudest - _HEARD_DB
    difference = np.where(is_heard, np.abs(first - second), 0.0).sum(axis=(0, 1))
    counted = is_heard.sum(axis=(0, 1))
    mean = np.divide(difference, counted, out=np.zeros_like(difference), where=counted > 0)
    late = np.flatnonzero(mean > _MOST_DIFFERENCE_DB)
    return int(late[0]) if len(late) else None

"""How far a response errs whose later part is that of a pose nearby, or of another emitter."""

import numpy as np
import pytest

from server.acoustics.audibility import in_jnd
from server.acoustics.metrics import parameter_errors
from server.acoustics.room_parameters import measure
from server.field.field import AcousticField
from server.rendering.hrtf import kemar
from server.responses.full_response import FullResponse
from server.scene.bundle import Bundle, find_bundle
from server.streaming.load_thresholds import THRESHOLDS

BLOCK = 256


@pytest.fixture(scope="module")
def apartment():
    field = AcousticField.load(Bundle.load(find_bundle("apartment")))
    return field, FullResponse(field, kemar(field.sample_rate))


def walks(field, count, step_m):
    """Listeners, others `step_m` away from them, and emitters: places of the scene in the first room."""
    rng = np.random.default_rng(4)
    bounds = field.bundle.manifest.bounds
    low, high = np.array(bounds.minimum) + 0.6, np.array(bounds.maximum) - 0.6
    low[2] = high[2] = 1.5
    listeners, emitters = rng.uniform(low, high, (2, count, 3))
    ways = rng.uniform(0, 2 * np.pi, count)
    return listeners, listeners + step_m * np.stack([np.cos(ways), np.sin(ways), 0 * ways], axis=-1), emitters


def errors_jnd(field, reference, estimate):
    """The mean error of each parameter, in just noticeable differences."""
    there, heard = (measure(each, field.sample_rate) for each in (reference, estimate))
    errors = in_jnd(parameter_errors(there, heard), there)
    return {name: float(np.nanmean(np.abs(values))) for name, values in errors.items()}


def late_of(late, early):
    both = early.copy()
    both[..., 8 * BLOCK :] = late[..., 8 * BLOCK :]
    return both


def test_late_parts_of_half_a_metre_away_are_hardly_told_apart(apartment):
    field, full = apartment
    listeners, before, emitters = walks(field, 40, THRESHOLDS.late_reach_m)
    yaws = np.zeros(len(listeners))
    there, kept = (full.impulse_responses(each, emitters, yaws) for each in (listeners, before))
    errors = errors_jnd(field, there, late_of(kept, there))
    assert max(errors.values()) < 0.5, errors
    # Whole responses of there differ.
    assert max(errors_jnd(field, there, kept).values()) > 1.5


def test_reverberation_of_another_emitter_differs_in_its_decay_alone(apartment):
    """By less than one just noticeable difference in the mean, in a flat of two rooms with emitters anywhere."""
    field, full = apartment
    listeners, _, emitters = walks(field, 40, 0.0)
    yaws = np.zeros(len(listeners))
    there = full.impulse_responses(listeners, emitters, yaws)
    other = full.impulse_responses(listeners, np.roll(emitters, 1, axis=0), yaws)
    late, own = other[..., 8 * BLOCK :], there[..., 8 * BLOCK :]
    gain = np.sqrt((own**2).sum(axis=(1, 2)) / (late**2).sum(axis=(1, 2)))
    errors = errors_jnd(field, there, late_of(gain[:, None, None] * other, there))
    assert errors.pop("t60") < 1.0
    assert max(errors.values()) < 0.1, errors

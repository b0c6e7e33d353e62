"""Training on responses that hardly are any, and from places that say nothing of a room."""

import dataclasses
from types import SimpleNamespace

import h5py
import numpy as np
import pytest

from tests.hard_cases.small_trainings import (
    GRID,
    KINDS,
    NAF,
    RATE,
    SAMPLES,
    assert_finite,
    measured_at,
    response,
    single_precision,  # noqa: F401 - on a busy machine not always chosen alike
    trained,
    write,
)
from tests.training.conftest import one_thread  # noqa: F401 - sums in parallel are not repeatable
from training.data.dataset import DatasetError
from training.data.responses import FILE, ImportedDataset, ResponsesError
from training.learning.train import load_learner
from training.models.targets import codec_of, delay_samples

# Responses that hardly are any.


def test_a_response_without_samples_is_refused_with_its_number(tmp_path):
    for first_bad in (0, 3):
        some = measured_at(GRID, lambda n, bad=first_bad: response(n, 0 if n == bad else SAMPLES))
        with pytest.raises(ResponsesError, match=f"row {first_bad} has no samples"):
            write(tmp_path, some)
    assert not (tmp_path / "data" / FILE).exists()


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_response_that_is_not_finite_is_refused_with_its_number(tmp_path, value):
    some = measured_at(GRID, lambda n: response(n) if n != 5 else np.full((2, SAMPLES), value, np.float32))
    with pytest.raises(ResponsesError, match="row 5 is not finite"):
        write(tmp_path, some)


@pytest.mark.parametrize("end", ["listener", "emitter"])
def test_a_place_that_is_not_finite_is_refused_with_its_number(tmp_path, end):
    some = measured_at(GRID)
    some[2] = dataclasses.replace(some[2], **{end: (0.0, float("nan"), 1.0)})
    with pytest.raises(ResponsesError, match="row 2 is not finite"):
        write(tmp_path, some)


def damage(folder):
    with h5py.File(folder / FILE, "r+") as file:
        file["responses"][4, 1, 700] = np.nan


def test_a_file_damaged_after_it_was_written_is_not_opened(tmp_path):
    write(tmp_path, measured_at(GRID))
    damage(tmp_path / "data")
    with pytest.raises(ResponsesError, match=r"row 4 .* not finite"):
        ImportedDataset.open(tmp_path / "data")


@KINDS
def test_a_file_damaged_after_it_was_opened_is_told_before_a_step_is_taken(tmp_path, configuration):
    write(tmp_path, measured_at(GRID), share=0.0)
    responses = ImportedDataset.open(tmp_path / "data")
    damage(tmp_path / "data")
    with pytest.raises(ResponsesError, match="not finite"):
        trained(responses, tmp_path / "run", configuration)


@KINDS
def test_responses_shorter_than_a_window_are_refused(tmp_path, configuration):
    responses = write(tmp_path, measured_at(GRID, lambda n: response(n, 100)))
    with pytest.raises(DatasetError, match="100 samples are too short"):
        trained(responses, tmp_path / "run", configuration)


@KINDS
@pytest.mark.parametrize("silent", [1, 6, len(GRID)])
def test_silent_responses_are_learned_from(tmp_path, configuration, silent):
    """A receiver that nothing reaches. With all of them silent, no bin varies: a spread of zero."""
    responses = write(tmp_path, measured_at(GRID, lambda n: response(n) * np.float32(n >= silent)))
    assert_finite(trained(responses, tmp_path / "run", configuration))


@KINDS
def test_responses_that_are_all_the_same_are_learned(tmp_path, configuration):
    """Every bin has a spread of zero."""
    responses = write(tmp_path, measured_at(GRID, lambda _: response(0)))
    assert_finite(trained(responses, tmp_path / "run", configuration))


def test_a_spread_of_zero_is_not_divided_by(tmp_path):
    responses = write(tmp_path, measured_at(GRID, lambda _: response(0)))
    trained(responses, tmp_path / "run", NAF)
    spread = load_learner(responses, tmp_path / "run").field.spread
    assert float(spread.min()) > 0.01


@KINDS
def test_responses_that_end_before_sound_arrives_are_learned_as_silence(tmp_path, configuration):
    """A receiver out of reach: 100 m away, in responses of 50 m."""
    far = [*GRID, ((1.0, 1.0, 1.5), (101.0, 1.0, 1.5))]
    assert_finite(trained(write(tmp_path, measured_at(far)), tmp_path / "run", configuration))


def test_a_pair_that_no_way_connects_is_told_with_its_row():
    enclosed = SimpleNamespace(onset_s=np.array([0.01, np.inf]), sample_rate=RATE, file="pairs.h5")
    assert delay_samples(enclosed, 0) == 80 - 64
    with pytest.raises(DatasetError, match="row 1: no way leads"):
        delay_samples(enclosed, 1)


# Places that say nothing of a room.


@KINDS
@pytest.mark.parametrize("count", [1, 2])
def test_too_few_places_are_told_as_such(tmp_path, configuration, count):
    responses = write(tmp_path, measured_at(GRID[:count]))
    with pytest.raises(DatasetError, match="nothing is left to train on"):
        trained(responses, tmp_path / "run", configuration)


@KINDS
def test_three_places_are_enough_to_begin_with(tmp_path, configuration):
    assert_finite(trained(write(tmp_path, measured_at(GRID[:3])), tmp_path / "run", configuration))


@KINDS
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_places_on_a_line_make_a_field(tmp_path, configuration, axis):
    def on_line(step):
        place = [1.0, 1.0, 1.0]
        place[axis] += step
        return tuple(place)

    poses = [(on_line(step / 2), on_line(9.0)) for step in range(10)]
    assert_finite(trained(write(tmp_path, measured_at(poses)), tmp_path / "run", configuration))


@KINDS
def test_places_measured_again_and_again_make_a_field(tmp_path, configuration):
    poses = [GRID[0]] * 6 + GRID[1:6] + [GRID[1]] * 2
    assert_finite(trained(write(tmp_path, measured_at(poses)), tmp_path / "run", configuration))


@KINDS
def test_one_place_measured_again_and_again_is_no_room(tmp_path, configuration):
    responses = write(tmp_path, measured_at([GRID[0]] * 6))
    with pytest.raises(DatasetError, match="nothing is left to train on"):
        trained(responses, tmp_path / "run", configuration)


@KINDS
def test_an_emitter_in_the_listeners_head_is_learned_from(tmp_path, configuration):
    poses = [((1.4, 1.6, 1.2), (1.4, 1.6, 1.2)), *GRID]
    assert_finite(trained(write(tmp_path, measured_at(poses)), tmp_path / "run", configuration))


def test_the_codec_of_responses_just_long_enough_has_frames():
    for n_fft in (256, 512):
        codec = codec_of(SimpleNamespace(samples=n_fft, sample_rate=RATE, file="r"), n_fft)
        assert codec.frames >= 1
        assert np.isfinite(codec.encode(np.ones(n_fft))[0]).all()

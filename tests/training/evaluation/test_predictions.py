import numpy as np
import pytest
import soundfile

from tests.training.written_layouts import RATE, SAMPLES, response, wav
from training.evaluation.predictions import PADDED_S, PredictionError, Predictions

SCORED, KNOWN = {"0/1_2", "90/1_2"}, {"0/1_2", "90/1_2", "0/1_3"}


def plain(name):
    return name.rsplit(".", 1)[0]


@pytest.fixture
def folder(tmp_path):
    root = tmp_path / "predictions"
    for name in SCORED:
        wav(root / f"{name}.wav", response(name, 2))
    return root


def find(folder, **options):
    return Predictions.find(folder, SCORED, KNOWN, plain, npy_rate=RATE, **options)


def read(folder, *, channels=2, samples=SAMPLES, sample_rate=RATE):
    return find(folder).read("0/1_2", channels=channels, samples=samples, sample_rate=sample_rate)


def test_a_prediction_is_read_to_the_bit(folder):
    fitted = read(folder)
    np.testing.assert_array_equal(fitted.response, response("0/1_2", 2))
    assert (fitted.rate, fitted.padded, fitted.cut) == (RATE, 0, 0)


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_an_array_is_read_like_a_file_of_sound(folder, dtype):
    (folder / "0/1_2.wav").unlink()
    np.save(folder / "0/1_2.npy", response("0/1_2", 2).astype(dtype))
    np.testing.assert_allclose(read(folder).response, response("0/1_2", 2), atol=1e-3)


def test_an_array_of_one_channel_may_be_flat(folder):
    (folder / "0/1_2.wav").unlink()
    np.save(folder / "0/1_2.npy", response("0/1_2", 1)[0])
    np.testing.assert_array_equal(read(folder, channels=1).response, response("0/1_2", 1))


def test_another_rate_is_resampled_and_told_and_keeps_amplitudes(folder):
    tone = 0.5 * np.sin(2 * np.pi * 440 * np.arange(2 * SAMPLES) / (2 * RATE))
    wav(folder / "0/1_2.wav", np.stack([tone, tone]), 2 * RATE)
    fitted = read(folder)
    assert (fitted.rate, fitted.response.shape) == (2 * RATE, (2, SAMPLES))
    assert np.abs(fitted.response[:, 200:-200]).max() == pytest.approx(0.5, abs=0.01)


def test_a_few_samples_too_few_are_padded_and_too_many_are_cut(folder):
    lacking = round(PADDED_S * RATE)
    wav(folder / "0/1_2.wav", response("0/1_2", 2)[:, :-lacking])
    fitted = read(folder)
    assert fitted.padded == lacking
    np.testing.assert_array_equal(fitted.response[:, -lacking:], 0)
    fitted = read(folder, samples=SAMPLES - 500)
    assert (fitted.cut, fitted.response.shape[-1]) == (500 - lacking, SAMPLES - 500)


@pytest.mark.parametrize(
    ("samples", "problem"),
    [
        (response("x", 2)[:, :1_000], r"lasts 0\.062 s, and its reference 0\.250 s: .*--duration-s 0\.062"),
        (response("x", 1), "has 1 channel, and the dataset 2 channels: predict 2 channels"),
        (np.zeros((2, SAMPLES)), "channel 0 and 1 is silent: .*--allow-missing"),
        (np.stack([response("x", 1)[0], np.zeros(SAMPLES)]), "channel 1 is silent"),
        (np.full((2, SAMPLES), np.nan), "not a number or infinite at sample 0: predict finite samples"),
        (np.full((2, SAMPLES), np.inf), "not a number or infinite"),
    ],
)
@pytest.mark.parametrize("suffix", [".wav", ".npy"])
def test_what_is_no_prediction_is_refused_by_its_name(folder, samples, problem, suffix):
    (folder / "0/1_2.wav").unlink()
    if suffix == ".wav":
        wav(folder / "0/1_2.wav", samples.astype(np.float32))
    else:
        np.save(folder / "0/1_2.npy", samples)
    with pytest.raises(PredictionError, match=rf"0/1_2\{suffix}: .*{problem}"):
        read(folder)


def test_a_response_that_is_silent_where_it_is_scored_is_refused(folder):
    late = np.zeros((2, SAMPLES), np.float32)
    late[:, -1] = 1.0
    wav(folder / "0/1_2.wav", late)
    with pytest.raises(PredictionError, match="is silent"):
        read(folder, samples=100)


@pytest.mark.parametrize(
    ("name", "content", "problem"),
    [
        ("0/1_2.wav", b"no sound", "not an audio file.*write it anew, as 32-bit float WAV"),
        ("0/1_2.wav", b"", "not an audio file"),
        ("0/1_2.npy", b"no array", "is no array file of NumPy's: write it anew by numpy.save"),
    ],
)
def test_a_file_that_is_no_audio_is_refused(folder, name, content, problem):
    (folder / "0/1_2.wav").unlink()
    (folder / name).write_bytes(content)
    with pytest.raises(PredictionError, match=rf"{name}: .*{problem}"):
        read(folder)


def test_a_file_that_breaks_off_is_refused(folder):
    path = folder / "0/1_2.wav"
    path.write_bytes(path.read_bytes()[:-4_000])
    with pytest.raises(PredictionError, match="cut off"):
        read(folder)


@pytest.mark.parametrize(
    ("values", "problem"),
    [
        (np.ones((2, SAMPLES), np.int16), "holds int16: write floats"),
        (np.ones((2, SAMPLES), complex), "holds complex128: write floats"),
        (response("x", 2).T, r"has shape \(4000, 2\): write \(channel, sample\)"),
        (np.ones((2, 2, 50)), r"has shape \(2, 2, 50\): write \(channel, sample\)"),
    ],
)
def test_an_array_of_another_kind_is_refused(folder, values, problem):
    (folder / "0/1_2.wav").unlink()
    np.save(folder / "0/1_2.npy", values)
    with pytest.raises(PredictionError, match=problem):
        read(folder)


def test_integers_in_a_file_of_sound_are_fractions_of_full_scale(folder):
    soundfile.write(folder / "0/1_2.wav", response("0/1_2", 2).T, RATE, subtype="PCM_16")
    np.testing.assert_allclose(read(folder).response, response("0/1_2", 2), atol=2**-15)


def test_a_name_that_no_response_has_is_refused(folder):
    wav(folder / "45/1_2.wav", response("x", 2))
    with pytest.raises(PredictionError, match=r"1 files are named by no response .*: 45/1_2\.wav; .*like 0/1_2\.wav"):
        find(folder)


def test_two_files_of_one_response_are_refused(folder):
    np.save(folder / "0/1_2.npy", response("x", 2))
    with pytest.raises(PredictionError, match=r"1_2\.wav: 1_2\.npy is the same response"):
        find(folder)


def test_no_link_leads_out_of_the_folder(folder, tmp_path):
    outside = wav(tmp_path / "outside.wav", response("x", 2))
    (folder / "0/1_2.wav").unlink()
    (folder / "0/1_2.wav").symlink_to(outside)
    with pytest.raises(PredictionError, match=r"1_2\.wav: is a link out of the folder"):
        find(folder)
    (folder / "0/1_2.wav").unlink()
    (folder / "45").symlink_to(tmp_path, target_is_directory=True)
    with pytest.raises(PredictionError, match="45: is a link to a folder"):
        find(folder)


def test_what_is_not_scored_is_counted_and_what_is_no_prediction_is_named(folder):
    wav(folder / "0/1_3.wav", response("x", 2))
    (folder / "README.md").write_text("")
    (folder / ".hidden").write_text("")
    found = find(folder)
    assert (found.unused, found.others, found.missing(SCORED)) == (1, ("README.md",), [])
    (folder / "90/1_2.wav").unlink()
    assert find(folder).missing(SCORED) == ["90/1_2"]


def test_a_folder_that_is_none_is_refused(tmp_path):
    with pytest.raises(PredictionError, match="there is no such folder"):
        find(tmp_path / "none")

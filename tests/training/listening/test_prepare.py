"""Tests made from the smallest scene: equally loud, of one size, again the same, and clear about what cannot be."""

from dataclasses import replace

import numpy as np
import pytest
import soundfile

from server.acoustics.audibility import THRESHOLDS
from server.listening.design import LOW_PASS, REFERENCE, WRONG_PLACE, ListeningTest
from server.scene.bundle import Bundle, find_bundle, write_bundle
from server.scene.manifest import Accuracy
from training.baselines.held_out import EvaluationError, open_held_out
from training.data.dataset_check import DatasetError
from training.listening.loudness import loudness_lufs
from training.listening.methods import MethodCatalogue
from training.listening.prepare import Options, prepare

OPTIONS = Options(methods=("LEVEL", "nearest"), places=2, seconds=2.0, anchors=4, hidden=1)


@pytest.fixture(scope="module")
def level(tiny_bundle) -> str:
    return tiny_bundle.manifest.levels[0].name


@pytest.fixture(scope="module")
def options(level) -> Options:
    return replace(OPTIONS, methods=(level, "nearest"))


@pytest.fixture(scope="module")
def test(tiny_bundle, dataset, options, tmp_path_factory) -> ListeningTest:
    made, was_there = prepare([tiny_bundle], dataset.folder, tmp_path_factory.mktemp("made") / "test", options)
    assert not was_there
    return made


def sounds_of(test):
    for place in test.design.places:
        for name, file in place.sounds.items():
            yield name, *soundfile.read(test.sound(file))


def test_all_sounds_are_equally_loud_within_a_tenth_of_a_unit(test):
    design = test.design
    lufs = [loudness_lufs(samples.T, rate) for _, samples, rate in sounds_of(test)]
    assert np.ptp(lufs) < 0.1
    assert lufs == pytest.approx([design.loudness_lufs] * len(lufs), abs=0.1)
    assert max(np.abs(samples).max() for _, samples, _ in sounds_of(test)) < 1.0


def test_sizes_and_names_tell_nothing(test):
    assert len({path.stat().st_size for path in (test.folder / "sounds").iterdir()}) == 1
    assert {len(samples) for _, samples, _ in sounds_of(test)} == {test.design.samples}
    names = " ".join(path.name for path in (test.folder / "sounds").iterdir())
    assert not [name for name in test.design.methods if name in names]


def test_the_trials_are_those_that_were_asked_for(test, level):
    parts = [trial.part for trial in test.design.trials]
    assert {part: parts.count(part) for part in parts} == {
        "practice": 2,
        "test": 2,
        "hidden-reference": 2,
        "anchor": 4,
    }
    anchors = [trial.methods[1] for trial in test.design.trials if trial.part == "anchor"]
    assert sorted(anchors) == [LOW_PASS] * 2 + [WRONG_PLACE] * 2
    assert test.design.rated == (level, "nearest")
    places = [(place.listener, place.emitter) for place in test.design.places]
    assert len(set(places)) == 4


def test_the_truth_is_heard_at_pairs_that_training_never_saw(test, dataset):
    held_out = [
        np.concatenate(dataset.probes[[listener, emitter]]) for emitter, listener in dataset.pairs(held_out=True)
    ]
    for place in test.design.places:
        assert any(np.allclose([*place.listener, *place.emitter], ends) for ends in held_out)


def test_the_same_seed_makes_the_same_test(test, tiny_bundle, dataset, options, tmp_path):
    again, _ = prepare([tiny_bundle], dataset.folder, tmp_path / "again", options)
    assert again.design == test.design
    for file in (test.folder / "sounds").iterdir():
        assert file.read_bytes() == again.sound(file.name).read_bytes()
    other, _ = prepare([tiny_bundle], dataset.folder, tmp_path / "other", replace(options, seed=1))
    assert other.design.places != test.design.places


def test_a_test_goes_on_and_another_is_not_written_over_it(test, tiny_bundle, dataset, options, tmp_path):
    assert prepare([tiny_bundle], dataset.folder, test.folder, options) == (test, True)
    with pytest.raises(EvaluationError, match=r"--output: .* holds another test"):
        prepare([tiny_bundle], dataset.folder, test.folder, replace(options, seed=1))
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(EvaluationError, match="holds other files"):
        prepare([tiny_bundle], dataset.folder, tmp_path, options)


def test_a_rating_asks_about_all_levels_beside_reference_and_anchors(tiny_bundle, dataset, tmp_path):
    made, _ = prepare([tiny_bundle], dataset.folder, tmp_path / "rating", Options(rating=True, places=2, seconds=2.0))
    assert made.design.kind == "rating"
    (trial, *_) = made.design.trials
    levels = {each.name for each in tiny_bundle.manifest.levels}
    assert set(trial.methods) == {REFERENCE, LOW_PASS, WRONG_PLACE, *levels}
    assert [each.part for each in made.design.trials].count("test") == 2


def test_the_errors_of_levels_in_jnd_come_from_the_manifest(tiny_bundle, dataset, level):
    accuracy = Accuracy(pairs=2, yaws=1, errors={"t60": 10.0, "c50": 1.0, "edt": 99.0}, floor={}, steps={})
    (first, *others) = tiny_bundle.manifest.levels
    levels = (first.model_copy(update={"accuracy": accuracy}), *others)
    measured = replace(tiny_bundle, manifest=tiny_bundle.manifest.model_copy(update={"levels": levels}))
    with open_held_out(dataset.folder) as held_out:
        heard = MethodCatalogue([measured], held_out).heard([level, "nearest"], lambda steps, _: steps)
    thresholds = [10.0 / THRESHOLDS["t60"].amount, 1.0 / THRESHOLDS["c50"].amount]
    assert heard[level].method.jnd == pytest.approx(np.mean(thresholds))
    assert heard["nearest"].method.jnd is None


@pytest.fixture(scope="module")
def apartment_bundle() -> Bundle:
    return Bundle.load(find_bundle("apartment"))


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"methods": ("nearst", "linear")}, "--methods: there is no 'nearst'; did you mean 'nearest'"),
        ({"methods": ("nearest", "nearest")}, "nearest is given twice"),
        ({"methods": ("nearest", LOW_PASS)}, "lowpass-3500 is an anchor"),
        ({"methods": ("nearest",)}, "a choice is between two"),
        ({"places": 40}, "--at: .* holds out 4 pairs"),
        ({"clips": ("trumpt",)}, "--clip: .*'trumpt'; did you mean 'trumpet'"),
        ({"seconds": 20.0}, "--clip: trumpet is 5.3 s long"),
        ({"clips": ("{tmp}/silent.wav",)}, "--clip: silent is silent"),
        ({"clips": ("{tmp}/hum.wav",)}, "--clip: hum has next to nothing above 3500 Hz"),
        ({"clips": ("{tmp}/text.wav",)}, "--clip: text.wav"),
        ({"rating": True, "methods": (REFERENCE,)}, "nothing to rate but the reference"),
        (
            {"methods": ("nearest", "linear", "linear-aligned", "shaped-nearest"), "places": 40},
            "ask each listener .* questions, more than 200",
        ),
    ],
)
def test_what_cannot_be_asked_names_the_option_and_the_remedy(changes, told, tiny_bundle, dataset, options, tmp_path):
    rate = 16_000
    time_s = np.arange(3 * rate) / rate
    soundfile.write(tmp_path / "silent.wav", np.zeros(3 * rate), rate)
    soundfile.write(tmp_path / "hum.wav", 0.3 * np.sin(2 * np.pi * 200 * time_s), rate)
    (tmp_path / "text.wav").write_text("no sound")
    if "clips" in changes:
        changes = {"clips": tuple(clip.format(tmp=tmp_path) for clip in changes["clips"])}
    with pytest.raises(EvaluationError, match=told):
        prepare([tiny_bundle], dataset.folder, tmp_path / "test", replace(options, **changes))


def test_a_bundle_of_another_scene_is_refused(dataset, apartment_bundle, options, tmp_path):
    with pytest.raises(DatasetError, match="is not of the scene of"):
        prepare([apartment_bundle], dataset.folder, tmp_path / "test", options)


def test_a_method_that_is_silent_cannot_be_made_as_loud(tiny_bundle, monkeypatch, dataset, options, tmp_path):
    monkeypatch.setattr("training.listening.prepare._response", lambda *_: np.zeros((2, 100)))
    with pytest.raises(EvaluationError, match="is silent at a held-out place"):
        prepare([tiny_bundle], dataset.folder, tmp_path / "test", options)


def test_levels_that_a_bundle_could_offer_and_plain_fields_have_names(tiny_bundle, dataset):
    with open_held_out(dataset.folder) as held_out:
        catalogue = MethodCatalogue([tiny_bundle], held_out)
        (field,) = tiny_bundle.manifest.fields
        catalogue.require([field, f"{field}-gl4", REFERENCE, "linear"])
        heard = catalogue.heard([field, f"{field}-gl4"], lambda steps, _: steps)
        responses = [heard[name].source(0, np.array([0])) for name in (field, f"{field}-gl4")]
        assert responses[0].shape == responses[1].shape == (1, 2, dataset.samples)
        assert not np.allclose(*responses)


def test_levels_of_two_bundles_are_told_apart_by_their_folders(tiny_bundle, dataset, level, tmp_path):
    files = {name: (tiny_bundle.folder / name).read_bytes() for name in tiny_bundle.manifest.files}
    other = write_bundle(tmp_path / "other", tiny_bundle.manifest, files)
    with open_held_out(dataset.folder) as held_out:
        catalogue = MethodCatalogue([tiny_bundle, other], held_out)
        assert catalogue.defaults == (f"bundle {level}", f"other {level}")
        with pytest.raises(EvaluationError, match=f"there is no '{level}'"):
            catalogue.require([level])

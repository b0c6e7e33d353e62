"""`nafir-train listening-test`: the folder of a test from bundles and the held-out pairs of a dataset."""

import hashlib
import itertools
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import soundfile

from server.acoustics.room_parameters import measure
from server.listening.design import (
    ANCHORS,
    DESIGN_FILE,
    LOW_PASS,
    MID_PASS,
    REFERENCE,
    SOUNDS_FOLDER,
    WRONG_PLACE,
    Design,
    ListeningTest,
    Method,
    Place,
    Trial,
    TrialPart,
)
from server.listening.options import ANCHOR_TRIALS, HIDDEN_TRIALS, PLACES, SECONDS
from server.scene.bundle import Bundle
from training.baselines.coded import Track
from training.baselines.held_out import EvaluationError, HeldOut, open_held_out
from training.evaluation.evaluate import Source
from training.evaluation.stored_errors import signature
from training.listening.loudness import loudness_lufs
from training.listening.methods import HeardMethod, MethodCatalogue
from training.listening.music import DEFAULT_CLIPS, Music
from training.listening.sounds import (
    TARGET_LUFS,
    Sound,
    auralised,
    common_loudness,
    has_low_pass,
    low_passed,
    matched,
)

DEFAULT_BASELINE = "aac-nearest"
MOST_QUESTIONS = 200
MOST_RATED_SOUNDS = 12
"""As ITU-R BS.1534 recommends, hidden reference and anchors included."""
_PRACTICE = {"choice": 2, "rating": 1}
_LONGEST_TAIL_S = 2.0
_OTHER_PLACES = 12
"""Held-out pairs among which the wrong place is sought."""
_LEAST_ANCHOR_LU = -30.0
"""What the low-pass anchor lacks is no quieter than this beside the whole, or nobody would hear the difference."""


@dataclass(frozen=True)
class Options:
    """What a test asks. Without `methods`, the default levels and aac-nearest are compared, or all levels rated."""

    methods: tuple[str, ...] | None = None
    rating: bool = False
    places: int = PLACES
    anchors: int = ANCHOR_TRIALS
    hidden: int = HIDDEN_TRIALS
    clips: tuple[str, ...] = DEFAULT_CLIPS
    seconds: float = SECONDS
    screening: bool = True
    seed: int = 0


def prepare(
    bundles: Sequence[Bundle],
    data: Path,
    output: Path,
    options: Options,
    *,
    track: Track = lambda steps, _: steps,
) -> tuple[ListeningTest, bool]:
    """Make a test in the folder `output`. Returns it, and whether it was there already.

    Raises EvaluationError, which names the option at fault, for what cannot be asked or heard; DatasetError for data of
    another scene; DesignError for a damaged test.
    """
    made_from = _made_from(bundles, data, options)
    if (output / DESIGN_FILE).is_file():
        existing = ListeningTest.open(output)
        if existing.design.made_from != made_from:
            raise EvaluationError(
                f"--output: {output} holds another test ({existing.design.name}, of other options, bundles or data): "
                "choose an empty folder"
            )
        return existing, True
    if output.is_dir() and any(path.name != SOUNDS_FOLDER for path in output.iterdir()):
        raise EvaluationError(f"--output: {output} holds other files: choose an empty folder")
    with open_held_out(data) as held_out:
        return _Preparation(held_out, bundles, options, track).write(output, made_from), False


class _Preparation:
    """A test that is being made."""

    def __init__(self, held_out: HeldOut, bundles: Sequence[Bundle], options: Options, track: Track) -> None:
        self._held_out = held_out
        self._options = options
        self._track = track
        self._bundles = bundles
        catalogue = MethodCatalogue(bundles, held_out)
        self._names = _chosen(options, catalogue)
        catalogue.require(self._names)
        self._anchors = [name for name in self._possible_anchors() if options.rating or name != MID_PASS]
        self._trials = self._all_trials()
        self._music = Music(options.clips, held_out.sample_rate, options.seconds)
        self._rng = np.random.default_rng([options.seed, 34])
        self._indices = self._draw_places()
        self._heard: Mapping[str, HeardMethod] = catalogue.heard(
            [name for name in self._names if name != REFERENCE], track
        )

    def _possible_anchors(self) -> list[str]:
        return [
            name
            for name, edge_hz in ANCHORS.items()
            if not edge_hz or has_low_pass(edge_hz, self._held_out.sample_rate)
        ]

    def _all_trials(self) -> tuple[Trial, ...]:
        """Raises EvaluationError if there are too many."""
        trials = self._ratings() if self._options.rating else self._choices()
        counted = sum(trial.part != "practice" for trial in trials)
        if counted > MOST_QUESTIONS:
            raise EvaluationError(
                f"--methods, --at: ask each listener {counted} questions, more than {MOST_QUESTIONS}: give fewer"
            )
        return tuple(trials)

    def _choices(self) -> list[Trial]:
        options = self._options
        if len(self._names) < 2:
            raise EvaluationError("--methods: a choice is between two: give another, or --rating")
        anchors = list(itertools.islice(itertools.cycle(self._anchors), options.anchors))
        practice = itertools.islice(itertools.cycle(self._anchors), _PRACTICE["choice"])
        trials = [_trial("practice", options.places + at, REFERENCE, name) for at, name in enumerate(practice)]
        for pair in itertools.combinations(self._names, 2):
            trials += [_trial("test", place, *pair) for place in range(options.places)]
        compared = {frozenset(trial.methods) for trial in trials if trial.part == "test"}
        place = itertools.cycle(range(options.places))
        for name in self._names:
            if name != REFERENCE and frozenset({name, REFERENCE}) not in compared:
                trials += [_trial("hidden-reference", next(place), REFERENCE, name) for _ in range(options.hidden)]
        return [*trials, *(_trial("anchor", next(place), REFERENCE, name) for name in anchors)]

    def _ratings(self) -> list[Trial]:
        options = self._options
        rated = (REFERENCE, *self._anchors, *(name for name in self._names if name != REFERENCE))
        if len(rated) == 1 + len(self._anchors):
            raise EvaluationError("--methods: there is nothing to rate but the reference: give a level or a baseline")
        if len(rated) > MOST_RATED_SOUNDS:
            most = MOST_RATED_SOUNDS - 1 - len(self._anchors)
            raise EvaluationError(
                f"--methods: {len(self._names)} are more than can be rated beside each other: give at most {most}"
            )
        places = options.places + _PRACTICE["rating"]
        return [
            _trial("practice" if place >= options.places else "test", place, *rated)
            for place in reversed(range(places))
        ]

    def _draw_places(self) -> list[int]:
        """Held-out pairs by index, no pair of points twice if that can be avoided; the last ones are for practice."""
        held_out = self._held_out
        needed = 1 + max(trial.place for trial in self._trials)
        if len(held_out) < needed:
            practice = needed - self._options.places
            most = len(held_out) - practice
            remedy = f"give at most {most}" if most > 0 else "import or simulate data with a larger share held out"
            raise EvaluationError(
                f"--at: {held_out.name} holds out {len(held_out)} pairs, and the test takes {needed} ({practice} to "
                f"practise): {remedy}"
            )
        new: list[int] = []
        others: list[int] = []
        seen = set()
        for index in self._rng.permutation(len(held_out)):
            couple = frozenset({tuple(held_out.listeners[index]), tuple(held_out.emitters[index])})
            (others if couple in seen else new).append(int(index))
            seen.add(couple)
        return [*new, *others][:needed]

    def write(self, output: Path, made_from: Mapping[str, Any]) -> ListeningTest:
        options, held_out = self._options, self._held_out
        rate = held_out.sample_rate
        sounds: list[dict[str, Sound]] = []
        places: list[Place] = []
        for at in self._track(range(len(self._indices)), "playing music at held-out places"):
            of_place, place = self._sounds_at(at)
            sounds.append(of_place)
            places.append(place)
        lufs = common_loudness([np.abs(sound).max() for of_place in sounds for sound in of_place.values()])
        folder = output / SOUNDS_FOLDER
        folder.mkdir(parents=True, exist_ok=True)
        for of_place, place in zip(sounds, places, strict=True):
            for name, sound in of_place.items():
                samples = sound.T * 10 ** ((lufs - TARGET_LUFS) / 20)
                soundfile.write(folder / place.sounds[name], samples, rate, subtype="PCM_24")
        compared = [name for name in self._names if name != REFERENCE]
        methods = {REFERENCE: Method(kind="reference"), **{name: self._heard[name].method for name in compared}}
        played = {name for trial in self._trials for name in trial.methods}
        methods |= {name: Method(kind="anchor") for name in self._anchors if name in played}
        manifest = self._bundles[0].manifest
        design = Design(
            kind="rating" if options.rating else "choice",
            scene=manifest.id,
            name=manifest.name,
            seed=options.seed,
            sample_rate=rate,
            samples=self._samples,
            loudness_lufs=lufs,
            screening=options.screening,
            methods=methods,
            places=tuple(places),
            trials=self._trials,
            made_from=made_from,
        )
        test = ListeningTest(output, design)
        test.write()
        return ListeningTest.open(output)

    @property
    def _samples(self) -> int:
        tail = min(self._held_out.samples, round(_LONGEST_TAIL_S * self._held_out.sample_rate))
        return round(self._options.seconds * self._held_out.sample_rate) + tail

    def _sounds_at(self, at: int) -> tuple[dict[str, Sound], Place]:
        """The sounds of a place by method, each at TARGET_LUFS."""
        held_out, rng = self._held_out, self._rng
        index = self._indices[at]
        yaw = held_out.yaw_indices[rng.integers(len(held_out.yaw_indices))]
        clip = self._music.names[at % len(self._music.names)]
        music = self._music.stretch(clip, rng)
        needed = {name for trial in self._trials if trial.place == at for name in trial.methods} | {REFERENCE}
        truth = held_out.reference(index)[int(np.flatnonzero(held_out.yaw_indices == yaw)[0])]

        def heard(response: npt.NDArray[np.floating]) -> Sound:
            return auralised(music, response, self._samples, held_out.sample_rate)

        unmatched = {REFERENCE: heard(truth)}
        for name in sorted(needed - {REFERENCE}):
            if name in self._heard:
                unmatched[name] = heard(_response(self._heard[name].source, name, index, yaw))
            elif name == WRONG_PLACE:
                unmatched[name] = heard(self._other_truth(index, truth, yaw))
        sounds = {name: self._matched(name, sound) for name, sound in unmatched.items()}
        for name in sorted(needed & {LOW_PASS, MID_PASS}):
            edge_hz = ANCHORS[name]
            assert edge_hz is not None
            sounds[name] = self._low_passed(name, sounds[REFERENCE], edge_hz, clip)
        listener, emitter = (tuple(map(float, ends[index])) for ends in (held_out.listeners, held_out.emitters))
        place = Place(
            listener=listener,
            emitter=emitter,
            yaw_deg=math.degrees(float(held_out.yaws[yaw])),
            clip=clip,
            sounds={name: f"{rng.bytes(16).hex()}.wav" for name in sorted(sounds)},
        )
        return sounds, place

    def _matched(self, name: str, sound: Sound) -> Sound:
        rate = self._held_out.sample_rate
        if not math.isfinite(loudness_lufs(sound, rate)):
            raise EvaluationError(
                f"--methods: {name} is silent at a held-out place, and cannot be made as loud as the truth: leave it "
                "out, or give another --seed"
            )
        return matched(sound, TARGET_LUFS, rate)

    def _low_passed(self, name: str, truth: Sound, edge_hz: float, clip: str) -> Sound:
        """Raises EvaluationError if nobody would hear that the lowest anchor lacks anything."""
        rate = self._held_out.sample_rate
        sound = low_passed(truth, edge_hz, rate)
        if name == LOW_PASS and loudness_lufs(truth - sound, rate) < TARGET_LUFS + _LEAST_ANCHOR_LU:
            raise EvaluationError(
                f"--clip: {clip} has next to nothing above {edge_hz:g} Hz, which the anchor {name} lacks: give "
                "brighter music"
            )
        return self._matched(name, sound)

    def _other_truth(self, index: int, truth: npt.NDArray[np.floating], yaw: np.integer) -> npt.NDArray[np.floating]:
        """The response of the held-out pair whose clarity differs most, of some drawn at random."""
        held_out = self._held_out
        others = [other for other in range(len(held_out)) if other != index]
        if not others:
            raise EvaluationError(f"DATA: {held_out.name} holds out one pair, and the anchor {WRONG_PLACE} needs two")
        drawn = self._rng.permutation(others)[:_OTHER_PLACES]
        at = int(np.flatnonzero(held_out.yaw_indices == yaw)[0])
        responses = [held_out.reference(int(other))[at] for other in drawn]
        clarity_db = [self._clarity_db(response) for response in responses]
        differences = np.abs(np.array(clarity_db) - self._clarity_db(truth))
        return np.asarray(responses[int(np.argmax(np.nan_to_num(differences, nan=-1.0)))])

    def _clarity_db(self, response: npt.NDArray[np.floating]) -> float:
        return float(np.mean(measure(response, self._held_out.sample_rate).clarity_db))


def _chosen(options: Options, catalogue: MethodCatalogue) -> tuple[str, ...]:
    if options.methods is not None:
        return options.methods
    return catalogue.offered if options.rating else (*catalogue.defaults, DEFAULT_BASELINE)


def _trial(part: TrialPart, place: int, *methods: str) -> Trial:
    return Trial(part=part, place=place, methods=methods)


def _response(source: Source, name: str, index: int, yaw: np.integer) -> npt.NDArray[np.floating]:
    responses = source(index, np.array([yaw]))
    if responses is None:
        raise EvaluationError(f"--methods: {name} has no estimate at a held-out place: leave it out")
    return np.asarray(responses[0])


def _made_from(bundles: Sequence[Bundle], data: Path, options: Options) -> dict[str, Any]:
    files = [Path(clip) for clip in options.clips if Path(clip).is_file()]
    described = {
        "bundles": [bundle.digest for bundle in bundles],
        "data": _digest(repr(signature(data)).encode() if data.is_dir() else b""),
        "files": [_digest(file.read_bytes()) for file in files],
        "options": asdict(options),
    }
    as_stored: dict[str, Any] = json.loads(json.dumps(described))
    return as_stored


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()

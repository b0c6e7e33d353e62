"""A listening test as a folder: `test.json`, `sounds/*.wav` and, as soon as somebody listens, `results/`.

In a test by choice, a listener says which of two sounds is nearer to a reference. In a test by rating, a listener rates
several sounds by their likeness to a reference from 0 to 100 (ITU-R BS.1534). `test.json` says which method each sound
was made by; no listener gets to see it. File names are random.
"""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import Field, ValidationError

from server.core.errors import NafirError
from server.scene.geometry import Point, Strict

DESIGN_FILE: Final = "test.json"
SOUNDS_FOLDER: Final = "sounds"
RESULTS_FOLDER: Final = "results"

REFERENCE: Final = "reference"
"""The method whose sounds are the truth."""
LOW_PASS: Final = "lowpass-3500"
MID_PASS: Final = "lowpass-7000"
WRONG_PLACE: Final = "wrong-place"
ANCHORS: Final = {LOW_PASS: 3_500.0, MID_PASS: 7_000.0, WRONG_PLACE: None}
"""Sounds that are worse on purpose: the truth without what lies above so many hertz, and the truth of another place."""

Kind = Literal["choice", "rating"]
TrialPart = Literal["practice", "test", "hidden-reference", "anchor"]
Share = Annotated[float, Field(ge=0, le=1)]


class DesignError(NafirError):
    """A folder that is not a listening test, or one that cannot be used."""

    def __init__(self, path: Path, field: str, problem: str) -> None:
        super().__init__(f"{path}: {field}: {problem}")
        self.field = field


class Method(Strict):
    """What made a sound. `jnd` is the mean error of a quality level in just-noticeable differences, if it was
    measured."""

    kind: Literal["reference", "field", "baseline", "anchor"]
    jnd: float | None = None


class Place(Strict):
    """A held-out pair, how the head was turned, and the music that was played there. `sounds` are files by method."""

    listener: Point
    emitter: Point
    yaw_deg: float
    clip: str
    sounds: Mapping[str, Annotated[str, Field(pattern=r"^[0-9a-f]{32}\.wav$")]]


class Trial(Strict):
    """A question about one place, counted from 0. Which method is heard as A is drawn for each listener."""

    part: TrialPart
    place: Annotated[int, Field(ge=0)]
    methods: Annotated[tuple[str, ...], Field(min_length=2)]


class Rules(Strict):
    """When a listener's answers do not count. They are stated before anybody listens.

    Of the six tones that tell headphones, `tones_right` are right at least, at the first or at the second try. In a
    test by choice, the truth is chosen over an anchor in at least this share of such trials. In a test by rating, the
    hidden truth is rated below 90, or the lowest anchor above 90, in at most this share of trials (ITU-R BS.1534-3,
    4.1.2, has the first of these, and the second for its middle anchor).
    """

    tones_right: Annotated[int, Field(ge=1, le=6)] = 5
    anchors_right: Share = 0.8
    ratings_wrong: Share = 0.15
    rated_good: Annotated[float, Field(ge=0, le=100)] = 90.0


class Design(Strict):
    """The whole of `test.json`. `samples` is the length of every sound, `loudness_lufs` its loudness (ITU-R BS.1770).
    `made_from` holds what the test was made from: another of the same is this test."""

    format_version: Literal[1] = 1
    kind: Kind
    scene: str
    name: str
    seed: Annotated[int, Field(ge=0)]
    sample_rate: Annotated[int, Field(ge=2_000, le=768_000)]
    samples: Annotated[int, Field(ge=1)]
    loudness_lufs: float
    screening: bool
    rules: Rules = Rules()
    methods: Mapping[str, Method]
    places: tuple[Place, ...]
    trials: Annotated[tuple[Trial, ...], Field(min_length=1)]
    made_from: Mapping[str, Any]

    @property
    def rated(self) -> tuple[str, ...]:
        """The methods that the test asks about: all but the truth and the anchors."""
        return tuple(name for name, method in self.methods.items() if method.kind not in {"reference", "anchor"})

    def sound(self, trial: Trial, method: str) -> str:
        """The name of a file in `sounds/`."""
        return self.places[trial.place].sounds[method]

    def _problems(self) -> Iterator[tuple[str, str]]:
        if REFERENCE not in self.methods:
            yield "methods", f"{REFERENCE!r} is missing"
        for number, trial in enumerate(self.trials):
            if trial.place >= len(self.places):
                yield f"trials.{number}.place", f"{trial.place} is not below {len(self.places)}"
                continue
            for method in (REFERENCE, *trial.methods):
                if method not in self.places[trial.place].sounds:
                    yield f"places.{trial.place}.sounds", f"{method!r} is missing, which trial {number} plays"
                if method not in self.methods:
                    yield f"trials.{number}.methods", f"{method!r} is none of methods"
            if self.kind == "choice" and len(trial.methods) != 2:
                yield f"trials.{number}.methods", "a choice is between two"

    def require_whole(self, path: Path) -> None:
        """Raises DesignError if trials ask for what is not there."""
        for field, problem in self._problems():
            raise DesignError(path, field, f"{problem}; prepare the test again in an empty folder")


@dataclass(frozen=True)
class ListeningTest:
    """A folder whose design was read and whose sounds are all there, each of the same size."""

    folder: Path
    design: Design

    @classmethod
    def open(cls, folder: Path) -> "ListeningTest":
        """Raises DesignError, which names the file and the field."""
        path = folder / DESIGN_FILE
        if not path.is_file():
            hint = "" if folder.is_dir() else "; there is no such folder"
            raise DesignError(
                folder, DESIGN_FILE, f"is missing{hint}: prepare a test with nafir-train listening-test BUNDLE DATA"
            )
        try:
            design = Design.model_validate_json(path.read_bytes())
        except ValidationError as exc:
            first = exc.errors()[0]
            field = ".".join(str(part) for part in first["loc"]) or "document"
            problem = first["msg"].removeprefix("Value error, ")
            raise DesignError(path, field, f"{problem}; prepare the test again in an empty folder") from exc
        design.require_whole(path)
        test = cls(folder, design)
        test._require_sounds()
        return test

    def sound(self, name: str) -> Path:
        return self.folder / SOUNDS_FOLDER / name

    @property
    def results(self) -> Path:
        return self.folder / RESULTS_FOLDER

    def _require_sounds(self) -> None:
        """Sounds of different sizes would tell methods apart."""
        first: tuple[Path, int] | None = None
        for place in self.design.places:
            for name in place.sounds.values():
                path = self.sound(name)
                if not path.is_file():
                    raise DesignError(path, "sounds", "is missing; prepare the test again in an empty folder")
                size = path.stat().st_size
                first = first or (path, size)
                if size != first[1]:
                    raise DesignError(
                        path,
                        "sounds",
                        f"has {size} bytes and {first[0].name} has {first[1]}, which would tell methods apart; prepare "
                        "the test again in an empty folder",
                    )

    def write(self) -> None:
        """Writes `test.json`. The folder is a test from then on."""
        path = self.folder / DESIGN_FILE
        partial = path.with_suffix(".partial")
        partial.write_text(json.dumps(self.design.model_dump(mode="json"), indent=1) + "\n")
        partial.replace(path)

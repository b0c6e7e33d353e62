"""Listening tests made of tones, and listeners whose answers are known."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import soundfile

from server.listening.answers import AnswerFile, rows_of
from server.listening.design import (
    LOW_PASS,
    REFERENCE,
    WRONG_PLACE,
    Design,
    ListeningTest,
    Method,
    Place,
    Rules,
    Trial,
)
from server.listening.plan import QUIET, ListenerPlan, PlannedTrial
from server.listening.progress import progress

RATE = 24_000
SAMPLES = 4_800
FIELD, CODED = "field", "aac-nearest"
JND = {"level-0": 0.4, "level-1": 0.8, "level-2": 1.6}
METHODS = {
    REFERENCE: Method(kind="reference"),
    FIELD: Method(kind="field", jnd=0.4),
    CODED: Method(kind="baseline"),
    LOW_PASS: Method(kind="anchor"),
    WRONG_PLACE: Method(kind="anchor"),
}
RATED = {
    REFERENCE: Method(kind="reference"),
    LOW_PASS: Method(kind="anchor"),
    **{name: Method(kind="field", jnd=jnd) for name, jnd in JND.items()},
}

Choose = Callable[[PlannedTrial], str]
"""Takes a trial and returns the method that is chosen."""


def choices(places: int, anchors: int = 6, hidden: int = 2) -> tuple[Trial, ...]:
    trials = [Trial(part="practice", place=0, methods=(REFERENCE, LOW_PASS))]
    trials += [Trial(part="test", place=place, methods=(FIELD, CODED)) for place in range(places)]
    for method in (FIELD, CODED):
        trials += [Trial(part="hidden-reference", place=0, methods=(REFERENCE, method))] * hidden
    trials += [Trial(part="anchor", place=0, methods=(REFERENCE, WRONG_PLACE))] * anchors
    return tuple(trials)


def ratings(places: int) -> tuple[Trial, ...]:
    parts = ["practice"] + ["test"] * places
    return tuple(Trial(part=part, place=place % places, methods=tuple(RATED)) for place, part in enumerate(parts))


def design_of(
    kind: str = "choice", *, places: int = 4, screening: bool = True, trials: tuple[Trial, ...] | None = None
) -> Design:
    methods = METHODS if kind == "choice" else RATED
    return Design(
        kind=kind,
        scene="flat",
        name="A flat",
        seed=7,
        sample_rate=RATE,
        samples=SAMPLES,
        loudness_lufs=-23.0,
        screening=screening,
        rules=Rules(),
        methods=methods,
        places=tuple(
            Place(
                listener=(1, 2, 1.5),
                emitter=(3, 2, 1.5),
                yaw_deg=0,
                clip="trumpet",
                sounds={name: f"{place:016x}{number:016x}.wav" for number, name in enumerate(methods)},
            )
            for place in range(places)
        ),
        trials=trials or (choices(places) if kind == "choice" else ratings(places)),
        made_from={},
    )


def write_test(folder: Path, design: Design) -> ListeningTest:
    """A test whose sounds are tones, of a pitch for each method."""
    (folder / "sounds").mkdir(parents=True)
    time_s = np.arange(SAMPLES) / RATE
    for place in design.places:
        for number, name in enumerate(place.sounds):
            tone = 0.1 * np.sin(2 * np.pi * 110 * (number + 2) * time_s)
            soundfile.write(folder / "sounds" / place.sounds[name], np.stack([tone, tone], 1), RATE, subtype="PCM_24")
    ListeningTest(folder, design).write()
    return ListeningTest.open(folder)


def answers_of(trial: PlannedTrial, method: str) -> dict[str, float]:
    """The answer by slot that chooses a method."""
    return {slot: float(each == method) for slot, each in trial.slots.items()}


def listen(
    test: ListeningTest,
    number: int,
    choose: Choose | None = None,
    *,
    rate: Callable[[PlannedTrial, str], float] | None = None,
    tone: Callable[[PlannedTrial], str] = lambda _: QUIET,
    most: int = 10_000,
) -> ListenerPlan:
    """A listener who answers all that is asked, or `most` trials of it, without a server."""
    plan = ListenerPlan.draw(test.design, f"listener{number:02d}", number)
    test.results.mkdir(exist_ok=True)
    plan.write(test.results / f"{plan.code}.json")
    file = AnswerFile(test.results / f"{plan.code}.csv", plan)
    for _ in range(most):
        at = progress(plan, file.read(), test.design.rules).trial
        if at is None:
            break
        trial = plan.trials[at]
        if trial.place is None:
            answers = answers_of(trial, tone(trial))
        elif rate is not None:
            answers = {slot: rate(trial, method) for slot, method in trial.slots.items()}
        else:
            assert choose is not None
            answers = answers_of(trial, choose(trial))
        file.append(rows_of(at, trial, test.design, answers, dict.fromkeys(trial.slots, 1), 3.0))
    return plan

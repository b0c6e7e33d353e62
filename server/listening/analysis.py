"""What the answers to a listening test say, and whose answers do not count."""

import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import scipy.stats

from server.listening.answers import AnsweredTrial, AnswerFile
from server.listening.design import LOW_PASS, REFERENCE, Design, Kind, ListeningTest, Method, Rules
from server.listening.plan import SCREENINGS, ListenerPlan
from server.listening.progress import has_headphones, tones_right
from server.listening.statistics import RankAgreement, Share, Spread, holm
from server.scene.geometry import Strict

_COUNTED: Final = ("test", "hidden-reference", "anchor")


class Published(Strict):
    """A published share: `count` of `trials` that `listeners` decided, at ten places each."""

    source: str
    over: tuple[str, str]
    listeners: int
    places: int
    result: Share


PAPER: Final = Published(
    source="Luo et al., NeurIPS 2022",
    over=("NAF", "AAC-nearest"),
    listeners=21,
    places=10,
    # Printed is 82.38 %, which is 173 of 210. How listeners differed is not printed.
    result=Share.of([(173, 210)]),
)


class Comparison(Strict):
    """How often `first` was said to be nearer to the reference than `second`. `p_corrected` is corrected for the number
    of comparisons between methods (Holm); checks have none."""

    part: Literal["test", "hidden-reference", "anchor"]
    first: str
    second: str
    result: Share
    p_corrected: float | None = None
    published: Published | None = None


class Won(Strict):
    """In which share of all its comparisons with other methods a method was nearer."""

    method: str
    result: Share


class Rated(Strict):
    """The ratings of a method, beside its error in just-noticeable differences if that is known."""

    method: str
    kind: str
    jnd: float | None
    result: Spread


class Excluded(Strict):
    """A listener whose answers do not count."""

    listener: str
    reason: str


class Screening(Strict):
    """How many listeners were told to wear headphones at the first try and at the second, how many were not, and how
    many broke off before it was decided."""

    first_try: int
    second_try: int
    failed: int
    undecided: int


class Results(Strict):
    """The result of a test. Comparisons and won are of a test by choice, rated and agreement of one by rating.
    `agreement` is that of median ratings and errors in just-noticeable differences, and -1 if they agree fully."""

    kind: Kind
    scene: str
    name: str
    begun: int
    counted: int
    rules: tuple[str, ...]
    screening: Screening | None
    excluded: tuple[Excluded, ...]
    comparisons: tuple[Comparison, ...] = ()
    won: tuple[Won, ...] = ()
    rated: tuple[Rated, ...] = ()
    agreement: RankAgreement | None = None


@dataclass(frozen=True)
class _Listener:
    plan: ListenerPlan
    answered: dict[int, AnsweredTrial]

    def trials(self, *parts: str) -> Iterator[AnsweredTrial]:
        return (trial for trial in self.answered.values() if trial.part in parts)


def analyse(test: ListeningTest) -> Results:
    """Raises DesignError for a damaged plan."""
    design = test.design
    listeners = [_read(path) for path in sorted(test.results.glob("*.json"))]
    excluded: list[Excluded] = []
    counted: list[_Listener] = []
    for listener in sorted(listeners, key=lambda each: each.plan.number):
        reason = _reason(listener, design)
        if reason is None:
            counted.append(listener)
        else:
            excluded.append(Excluded(listener=listener.plan.code, reason=reason))
    is_choice = design.kind == "choice"
    comparisons = _comparisons(design, counted) if is_choice else ()
    rated = () if is_choice else _rated(design, counted)
    known = [(each.jnd, each.result.median) for each in rated if each.jnd is not None]
    return Results(
        kind=design.kind,
        scene=design.scene,
        name=design.name,
        begun=len(listeners),
        counted=len(counted),
        rules=tuple(_rules(design)),
        screening=_screening(listeners, design.rules) if design.screening else None,
        excluded=tuple(excluded),
        comparisons=comparisons,
        won=_won(design, counted) if is_choice else (),
        rated=rated,
        agreement=RankAgreement.of([jnd for jnd, _ in known], [median for _, median in known]),
    )


def _read(path: Path) -> _Listener:
    plan = ListenerPlan.read(path)
    return _Listener(plan, AnswerFile(path.with_suffix(".csv"), plan).read())


def _reason(listener: _Listener, design: Design) -> str | None:
    """Why the answers of a listener do not count; None if they do."""
    rules = design.rules
    if has_headphones(listener.plan, listener.answered, rules) is False:
        right = " and ".join(str(tones_right(listener.answered, part)) for part in SCREENINGS)
        return f"no headphones: named the quiet tone {right} times of 6"
    asked = [number for number, trial in enumerate(listener.plan.trials) if trial.part in _COUNTED]
    answered = sum(number in listener.answered for number in asked)
    if answered < len(asked):
        return f"not finished: {answered} of {len(asked)} questions"
    if design.kind == "choice":
        anchors = list(listener.trials("anchor"))
        right_anchors = sum(trial.chosen == REFERENCE for trial in anchors)
        if right_anchors < _anchors_needed(len(anchors), rules):
            return f"anchors: chose the truth in {right_anchors} of {len(anchors)}"
        return None
    ratings = [trial.ratings for trial in listener.trials("test")]
    low = sum(given[REFERENCE] < rules.rated_good for given in ratings)
    if low > rules.ratings_wrong * len(ratings):
        return f"hidden reference: rated below {rules.rated_good:g} in {low} of {len(ratings)}"
    high = sum(given.get(LOW_PASS, 0.0) > rules.rated_good for given in ratings)
    if high > rules.ratings_wrong * len(ratings):
        return f"lowest anchor: rated above {rules.rated_good:g} in {high} of {len(ratings)}"
    return None


def _anchors_needed(trials: int, rules: Rules) -> int:
    return math.ceil(rules.anchors_right * trials - 1e-9)


def _rules(design: Design) -> Iterator[str]:
    rules = design.rules
    if design.screening:
        yield f"headphones: named the quiet tone {rules.tones_right} times of 6, at the first try or at the second"
    yield "finished: answered every question"
    anchors = sum(trial.part == "anchor" for trial in design.trials)
    if design.kind == "rating":
        yield (
            f"hidden reference rated below {rules.rated_good:g}, and {LOW_PASS} above it, in at most "
            f"{100 * rules.ratings_wrong:g} % of trials"
        )
    elif anchors:
        needed = _anchors_needed(anchors, rules)
        guessed = float(scipy.stats.binom.sf(needed - 1, anchors, 0.5))
        yield (
            f"anchors: chose the truth {needed} times of {anchors} at least; of listeners who guess, "
            f"{100 * guessed:.1f} % do"
        )


def _screening(listeners: Sequence[_Listener], rules: Rules) -> Screening:
    told = [has_headphones(each.plan, each.answered, rules) for each in listeners]
    at_first = sum(tones_right(each.answered, SCREENINGS[0]) >= rules.tones_right for each in listeners)
    at_second = sum(is_told is True for is_told in told) - at_first
    return Screening(first_try=at_first, second_try=at_second, failed=told.count(False), undecided=told.count(None))


def _comparisons(design: Design, listeners: Sequence[_Listener]) -> tuple[Comparison, ...]:
    """One for each couple of methods and part, in the order of the design."""
    asked = {(trial.part, frozenset(trial.methods)): trial.methods for trial in design.trials if trial.part in _COUNTED}
    found = []
    for (part, methods), (one, other) in asked.items():
        first, second = _ordered(part, one, other, design)
        by_listener = [
            _count([trial for trial in listener.trials(part) if trial.methods == methods], first)
            for listener in listeners
        ]
        if by_listener:
            published = PAPER if _is_like_the_paper(design.methods[first], second) else None
            result = Share.of(by_listener)
            found.append(Comparison(part=part, first=first, second=second, result=result, published=published))
    corrected = iter(holm([each.result.p for each in found if each.part == "test"]))
    return tuple(
        each.model_copy(update={"p_corrected": next(corrected)}) if each.part == "test" else each for each in found
    )


def _ordered(part: str, one: str, other: str, design: Design) -> tuple[str, str]:
    """The one whose share is counted comes first: a method before the hidden reference, a field before a baseline."""
    kinds = design.methods[one].kind, design.methods[other].kind
    swaps = part == "hidden-reference" or (part == "test" and kinds == ("baseline", "field"))
    return (other, one) if swaps else (one, other)


def _is_like_the_paper(first: Method, second: str) -> bool:
    return first.kind == "field" and second == "aac-nearest"


def _won(design: Design, listeners: Sequence[_Listener]) -> tuple[Won, ...]:
    found = []
    for method in design.methods:
        by_listener = [
            _count([trial for trial in listener.trials("test") if method in trial.methods], method)
            for listener in listeners
        ]
        if sum(trials for _, trials in by_listener):
            found.append(Won(method=method, result=Share.of(by_listener)))
    return tuple(sorted(found, key=lambda each: -each.result.share))


def _count(trials: Iterable[AnsweredTrial], method: str) -> tuple[int, int]:
    answers = [trial.chosen == method for trial in trials]
    return sum(answers), len(answers)


def _rated(design: Design, listeners: Sequence[_Listener]) -> tuple[Rated, ...]:
    ratings: dict[str, list[list[float]]] = defaultdict(list)
    for listener in listeners:
        of_listener: dict[str, list[float]] = defaultdict(list)
        for trial in listener.trials("test"):
            for method, rating in trial.ratings.items():
                of_listener[method].append(rating)
        for method, given in of_listener.items():
            ratings[method].append(given)
    found = [
        Rated(method=name, kind=method.kind, jnd=method.jnd, result=Spread.of(ratings[name]))
        for name, method in design.methods.items()
        if name in ratings
    ]
    return tuple(sorted(found, key=lambda each: -each.result.median))

"""What one listener is asked, in which order, and what is heard as A and as B. All of it is drawn once, when the
listener begins, and stored.

Within a listener, each of two methods is A in half of the trials of that comparison. Where their number is odd, the one
that is left over alternates from listener to listener.
"""

import itertools
import json
import secrets
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Final, Literal

import numpy as np
from pydantic import ValidationError

from server.listening.design import Design, DesignError, Trial
from server.scene.geometry import Strict

QUIET: Final = "quiet"
ANTIPHASE: Final = "antiphase"
PLAIN: Final = "plain"
SCREENINGS: Final = ("screening-1", "screening-2")
"""Parts of a plan in which tones tell headphones. The second is asked only if the first fails."""
CODE_LENGTH: Final = 10
_CODE_ALPHABET: Final = "23456789abcdefghjkmnpqrstuvwxyz"
"""Without characters that are read for one another."""

Part = Literal["screening-1", "screening-2", "practice", "test", "hidden-reference", "anchor"]


class PlannedTrial(Strict):
    """A trial as one listener hears it: methods by slot, which is a letter, or the number of a tone. `place` is the
    index of the design's place; tones have none."""

    part: Part
    place: int | None
    slots: dict[str, str]


class ListenerPlan(Strict):
    """The trials of a listener in their order. `number` counts listeners from 0."""

    code: str
    number: int
    trials: tuple[PlannedTrial, ...]

    @classmethod
    def draw(cls, design: Design, code: str, number: int) -> "ListenerPlan":
        """The same for the same design, code and number."""
        rng = np.random.default_rng([design.seed, number, *code.encode()])
        trials = list(_screening(rng)) if design.screening else []
        practice = [trial for trial in design.trials if trial.part == "practice"]
        asked = [trial for trial in design.trials if trial.part != "practice"]
        for part in (practice, asked):
            planned = _on_sides(part, number, rng) if design.kind == "choice" else _in_slots(part, rng)
            trials += [planned[index] for index in rng.permutation(len(planned))]
        return cls(code=code, number=number, trials=tuple(trials))

    @classmethod
    def read(cls, path: Path) -> "ListenerPlan":
        """Raises DesignError for a file that is damaged."""
        try:
            return cls.model_validate_json(path.read_bytes())
        except ValidationError as exc:
            field = ".".join(str(part) for part in exc.errors()[0]["loc"]) or "document"
            raise DesignError(path, field, "is damaged: remove this listener's .json and .csv") from exc

    def write(self, path: Path) -> None:
        """The file gets its name when it is whole."""
        partial = path.with_suffix(".partial")
        partial.write_text(json.dumps(self.model_dump(mode="json")) + "\n")
        partial.replace(path)


def new_code() -> str:
    """A random code, which says nothing of the listener."""
    return "".join(secrets.choice(_CODE_ALPHABET) for _ in range(CODE_LENGTH))


def _screening(rng: np.random.Generator) -> list[PlannedTrial]:
    """Both tries, each with all six orders of the three tones."""
    orders = list(itertools.permutations((QUIET, ANTIPHASE, PLAIN)))
    return [
        PlannedTrial(part=part, place=None, slots=dict(zip("123", orders[index], strict=True)))
        for part in SCREENINGS
        for index in rng.permutation(len(orders))
    ]


def _on_sides(trials: Sequence[Trial], number: int, rng: np.random.Generator) -> list[PlannedTrial]:
    groups: dict[tuple[str, frozenset[str]], list[Trial]] = defaultdict(list)
    for trial in trials:
        groups[trial.part, frozenset(trial.methods)].append(trial)
    planned = []
    for index, ((part, _), of_group) in enumerate(groups.items()):
        first, second = sorted(of_group[0].methods)
        is_left_over_first = (number + index) % 2
        firsts = (len(of_group) + is_left_over_first) // 2
        is_first_a = rng.permutation(np.arange(len(of_group)) < firsts)
        for trial, is_a in zip(of_group, is_first_a, strict=True):
            a, b = (first, second) if is_a else (second, first)
            planned.append(PlannedTrial(part=part, place=trial.place, slots={"a": a, "b": b}))
    return planned


def _in_slots(trials: Sequence[Trial], rng: np.random.Generator) -> list[PlannedTrial]:
    letters = "abcdefghijklmnopqrstuvwxyz"
    planned = []
    for trial in trials:
        methods = [trial.methods[index] for index in rng.permutation(len(trial.methods))]
        slots = dict(zip(letters, methods, strict=False))
        planned.append(PlannedTrial(part=trial.part, place=trial.place, slots=slots))
    return planned

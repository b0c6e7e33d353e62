"""The listeners of a test that is served: what each is asked next, and what they answered.

A listener is known by a random code alone. No address, name, time of day or browser is stored.
"""

import re
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from threading import Lock
from typing import Final

from server.core.errors import RequestError
from server.listening.answers import OPEN_REFERENCE, TONES, AnswerFile, rows_of
from server.listening.design import REFERENCE, ListeningTest
from server.listening.plan import CODE_LENGTH, ListenerPlan, PlannedTrial, new_code
from server.listening.progress import Progress, progress

MOST_LISTENERS: Final = 2_000
"""Beyond that nobody can begin, so that a visitor cannot fill the disk."""
_CODE: Final = re.compile(rf"[0-9a-z]{{{CODE_LENGTH}}}")
_MOST_PLAYS: Final = 100_000
_MOST_SECONDS: Final = 1e6


class Listeners:
    """The listeners of one test. Safe to use from any thread: one answer is written at a time."""

    def __init__(self, test: ListeningTest) -> None:
        self.test = test
        self._lock = Lock()
        self._plans: dict[str, ListenerPlan] = {}
        test.results.mkdir(exist_ok=True)

    def begin(self) -> str:
        """Draws the plan of a new listener and returns its code. Raises RequestError `test_full`."""
        with self._lock:
            number = sum(1 for _ in self.test.results.glob("*.json"))
            if number >= MOST_LISTENERS:
                problem = f"{number} people have begun this test, and no more are taken; tell who asked you to listen"
                raise RequestError("test_full", problem, status=503)
            code = new_code()
            plan = ListenerPlan.draw(self.test.design, code, number)
            plan.write(self._plan_file(code))
            self._plans[code] = plan
        return code

    def plan(self, code: str) -> ListenerPlan:
        """Raises RequestError `unknown_listener`."""
        if code not in self._plans:
            path = self._plan_file(code)
            # guard: a code that is none names no file
            if not _CODE.fullmatch(code) or not path.is_file():
                problem = f"nobody has begun this test with the code {code[:20]!r}: check it, or begin anew"
                raise RequestError("unknown_listener", problem, field="code", status=404)
            self._plans[code] = ListenerPlan.read(path)
        return self._plans[code]

    def progress(self, code: str) -> Progress:
        """Raises RequestError `unknown_listener`."""
        plan = self.plan(code)
        with self._lock:
            answered = self._file(plan).read()
        return progress(plan, answered, self.test.design.rules)

    def trial(self, code: str, number: int) -> PlannedTrial:
        """The trial that the listener is asked now. Raises RequestError `not_this_trial` for any other."""
        if self.progress(code).trial != number:
            raise _not_this_trial(number)
        return self.plan(code).trials[number]

    def sound(self, code: str, number: int, slot: str) -> Path | tuple[str, ...]:
        """The file of a sound, or the kinds of three tones. Raises RequestError."""
        trial = self.trial(code, number)
        if trial.place is None and slot == TONES:
            return tuple(trial.slots[each] for each in sorted(trial.slots))
        sounds = {} if trial.place is None else self.test.design.places[trial.place].sounds
        method = REFERENCE if slot == OPEN_REFERENCE else trial.slots.get(slot, "")
        if method not in sounds:
            raise RequestError("not_found", f"trial {number} has no sound {slot[:20]!r}", field="slot", status=404)
        return self.test.sound(sounds[method])

    @cached_property
    def volume_sound(self) -> Path:
        """A sound that all listeners set their volume with: the truth at the first place."""
        return self.test.sound(self.test.design.places[0].sounds[REFERENCE])

    def answer(
        self, code: str, number: int, answers: Mapping[str, float], plays: Mapping[str, int], seconds: float
    ) -> PlannedTrial:
        """Stores the answers by slot and returns the trial. The first answer to a trial stands: a second one, sent by a
        page that did not hear of the first, changes nothing.

        Raises RequestError: `unknown_listener`, `not_this_trial` or `malformed_answer`.
        """
        plan = self.plan(code)
        design = self.test.design
        with self._lock:
            file = self._file(plan)
            answered = file.read()
            if number not in answered:
                if progress(plan, answered, design.rules).trial != number:
                    raise _not_this_trial(number)
                trial = plan.trials[number]
                _check(trial, is_choice=design.kind == "choice", answers=answers)
                played = {slot: min(count, _MOST_PLAYS) for slot, count in plays.items()}
                file.append(rows_of(number, trial, design, answers, played, min(seconds, _MOST_SECONDS)))
        return plan.trials[number]

    def _file(self, plan: ListenerPlan) -> AnswerFile:
        return AnswerFile(self.test.results / f"{plan.code}.csv", plan)

    def _plan_file(self, code: str) -> Path:
        return self.test.results / f"{code}.json"


def _not_this_trial(number: int) -> RequestError:
    problem = f"trial {number} is not the one that is asked now: ask where the listener stands"
    return RequestError("not_this_trial", problem, field="number", status=409)


def _check(trial: PlannedTrial, *, is_choice: bool, answers: Mapping[str, float]) -> None:
    """Raises RequestError `malformed_answer`."""
    if set(answers) != set(trial.slots):
        problem = f"answers are needed for {', '.join(trial.slots)}, and for nothing else"
        raise RequestError("malformed_answer", problem, field="answers")
    if is_choice or trial.place is None:
        if sorted(answers.values()) != [0.0] * (len(answers) - 1) + [1.0]:
            raise RequestError("malformed_answer", "one sound is chosen, by 1, and the others have 0", field="answers")
    elif not all(0 <= rating <= 100 for rating in answers.values()):
        raise RequestError("malformed_answer", "a rating is from 0 to 100", field="answers")

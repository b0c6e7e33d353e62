"""Where a listener stands: which trial comes next, and whether the tones told headphones."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from server.listening.answers import AnsweredTrial
from server.listening.design import Rules
from server.listening.plan import QUIET, SCREENINGS, ListenerPlan

Stage = Literal["screening", "practice", "test", "done", "no-headphones"]


@dataclass(frozen=True)
class Progress:
    """The next `trial`, None at the end. `done` of the `total` trials of this stage are answered. `tries` counts the
    tries at the tones, this one included."""

    stage: Stage
    trial: int | None
    done: int = 0
    total: int = 0
    tries: int = 0


def tones_right(answered: Mapping[int, AnsweredTrial], part: str) -> int:
    """In how many trials of this part the quiet tone was chosen."""
    return sum(trial.part == part and trial.chosen == QUIET for trial in answered.values())


def has_headphones(plan: ListenerPlan, answered: Mapping[int, AnsweredTrial], rules: Rules) -> bool | None:
    """None if it is not decided yet."""
    if all(trial.part not in SCREENINGS for trial in plan.trials):
        return True
    for part in SCREENINGS:
        if tones_right(answered, part) >= rules.tones_right:
            return True
        if any(trial.part == part and number not in answered for number, trial in enumerate(plan.trials)):
            return None
    return False


def progress(plan: ListenerPlan, answered: Mapping[int, AnsweredTrial], rules: Rules) -> Progress:
    """Tones are asked to the end of a try, even if its result is known before."""
    told = has_headphones(plan, answered, rules)
    for tries, part in enumerate(SCREENINGS, 1):
        of_part = [number for number, trial in enumerate(plan.trials) if trial.part == part]
        missing = [number for number in of_part if number not in answered]
        is_begun = len(missing) < len(of_part)
        if missing and (told is None or is_begun):
            return Progress("screening", missing[0], len(of_part) - len(missing), len(of_part), tries)
        if tones_right(answered, part) >= rules.tones_right:
            break
    if told is False:
        return Progress("no-headphones", None)
    for stage in ("practice", "test"):
        of_stage = [number for number, trial in enumerate(plan.trials) if _stage(trial.part) == stage]
        missing = [number for number in of_stage if number not in answered]
        if missing:
            return Progress(stage, missing[0], len(of_stage) - len(missing), len(of_stage))
    return Progress("done", None)


def _stage(part: str) -> str:
    return "screening" if part in SCREENINGS else part if part == "practice" else "test"

"""The web application of a listening test: the page, and what the page asks.

Nothing that a page receives tells the method behind a sound. URLs name the trial and the slot, all sounds have the same
size, and they carry no tag, date or name of a file. Their last bits are drawn anew each time, so that even the bytes of
the hidden reference are not those of the open one.
"""

import io
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
import numpy.typing as npt
import soundfile
from fastapi import APIRouter, Depends, FastAPI, Request, Response
from fastapi.responses import FileResponse
from pydantic import BaseModel, ConfigDict, Field

from server.api.app import WEB
from server.api.cross_site import CrossSiteGate, SitePolicy
from server.api.drain_gate import DrainGate
from server.api.page_files import PageFiles
from server.api.problems import install_problems
from server.api.settings import Settings
from server.api.strict_requests import StrictRequests
from server.listening.answers import OPEN_REFERENCE, TONES
from server.listening.design import REFERENCE
from server.listening.listeners import Listeners
from server.listening.plan import PlannedTrial
from server.listening.progress import Stage
from server.listening.tones import PAUSE_S, RATE_HZ, TONE_S, three_tones
from server.runtime.drain import Drain

PAGE: Final = Path(__file__).parent / "page"
_SHARED: Final = ("base.css", "icon.svg", "fonts/instrument-sans.woff2", "notices.js")
"""Files of the main page that this one uses too."""
_PRIVATE: Final = {"Cache-Control": "no-store"}


class _Document(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class About(_Document):
    """What the page says before anybody begins. `questions` are those that count, after practice."""

    kind: Literal["choice", "rating"]
    name: str
    screening: bool
    practice: int
    questions: int
    sound_s: float


class Question(_Document):
    """What is asked now. `sounds` are the slots to play, `slots` those to answer for."""

    number: int
    sounds: tuple[str, ...]
    slots: tuple[str, ...]
    onsets_s: tuple[float, ...] = ()
    tone_s: float = 0.0


class Standing(_Document):
    """Where a listener stands: `done` of the `total` questions of this stage are answered. `nearest` tells after a
    practice trial which sound was the reference itself."""

    code: str
    stage: Stage
    done: int
    total: int
    tries: int
    question: Question | None
    nearest: str | None = None


class Answer(_Document):
    """`answers` by slot: 1 for the sound that is chosen and 0 for the others, or ratings. `plays`: how often each sound
    was played. `seconds` since the question was shown."""

    answers: dict[str, Annotated[float, Field(allow_inf_nan=False)]]
    plays: dict[str, Annotated[int, Field(ge=0)]]
    seconds: Annotated[float, Field(ge=0, allow_inf_nan=False)]


def _listeners(request: Request) -> Listeners:
    found: Listeners = request.app.state.listeners
    return found


_Listeners = Annotated[Listeners, Depends(_listeners)]
routes = APIRouter(prefix="/v1")


@routes.get("/test")
def about(listeners: _Listeners) -> About:
    design = listeners.test.design
    practice = sum(trial.part == "practice" for trial in design.trials)
    return About(
        kind=design.kind,
        name=design.name,
        screening=design.screening,
        practice=practice,
        questions=len(design.trials) - practice,
        sound_s=design.samples / design.sample_rate,
    )


@routes.get("/volume")
def volume(listeners: _Listeners) -> Response:
    """A sound to set the volume with."""
    return _wav(*soundfile.read(listeners.volume_sound, dtype="float64"))


@routes.post("/listeners", status_code=201)
def begin(listeners: _Listeners) -> Standing:
    return _standing(listeners, listeners.begin())


@routes.get("/listeners/{code}")
def standing(listeners: _Listeners, code: str) -> Standing:
    return _standing(listeners, code)


@routes.get("/listeners/{code}/trials/{number}/sounds/{slot}")
def sound(listeners: _Listeners, code: str, number: int, slot: str) -> Response:
    """A sound of the question that is asked now, as WAV."""
    found = listeners.sound(code, number, slot)
    if isinstance(found, Path):
        return _wav(*soundfile.read(found, dtype="float64"))
    return _wav(three_tones(found).T, RATE_HZ)


@routes.post("/listeners/{code}/trials/{number}/answer")
def answer(listeners: _Listeners, code: str, number: int, given: Answer) -> Standing:
    trial = listeners.answer(code, number, given.answers, given.plays, given.seconds)
    told = listeners.test.design.kind == "choice" and trial.part == "practice"
    nearest = next((slot for slot, method in trial.slots.items() if method == REFERENCE), None) if told else None
    return _standing(listeners, code).model_copy(update={"nearest": nearest})


def create_app(listeners: Listeners, settings: Settings, drain: Drain) -> FastAPI:
    app = FastAPI(title="Nafir listening test", version=version("nafir"), docs_url=None, redoc_url=None)
    app.state.listeners = listeners
    app.add_middleware(DrainGate, drain=drain)
    install_problems(app)
    app.include_router(routes)
    for name in _SHARED:
        app.add_api_route(f"/{name}", _shared(name), include_in_schema=False)
    app.add_middleware(StrictRequests, routes=app.router.routes)
    app.add_middleware(CrossSiteGate, policy=SitePolicy.of(settings))
    app.mount("/", PageFiles(directory=PAGE, html=True, check_dir=False), name="page")
    return app


def _shared(name: str) -> Any:
    def shared() -> Response:
        return FileResponse(WEB / name)

    return shared


def _standing(listeners: Listeners, code: str) -> Standing:
    at = listeners.progress(code)
    question = None if at.trial is None else _question(at.trial, listeners.plan(code).trials[at.trial])
    return Standing(code=code, stage=at.stage, done=at.done, total=at.total, tries=at.tries, question=question)


def _question(number: int, trial: PlannedTrial) -> Question:
    slots = tuple(sorted(trial.slots))
    if trial.place is None:
        onsets_s = tuple(index * (TONE_S + PAUSE_S) for index in range(len(slots)))
        return Question(number=number, sounds=(TONES,), slots=slots, onsets_s=onsets_s, tone_s=TONE_S)
    return Question(number=number, sounds=(OPEN_REFERENCE, *slots), slots=slots)


def _wav(samples: npt.NDArray[np.floating], sample_rate: int) -> Response:
    """Samples (sample, channel) as WAV of 24 bits, with noise of one bit."""
    noise = np.random.default_rng().integers(-1, 2, samples.shape)
    content = io.BytesIO()
    integers = np.round(samples * 2**23).astype(np.int32) + noise.astype(np.int32)
    soundfile.write(content, integers << 8, sample_rate, format="WAV", subtype="PCM_24")
    return Response(content.getvalue(), media_type="audio/wav", headers=_PRIVATE)

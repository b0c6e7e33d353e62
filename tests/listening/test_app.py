"""What a page receives tells no method, and a listener can stop and go on anywhere."""

import io

import numpy as np
import pytest
import soundfile
from starlette.testclient import TestClient

from server.api.settings import Settings
from server.core.errors import RequestError
from server.listening.app import create_app
from server.listening.design import REFERENCE
from server.listening.listeners import Listeners
from server.listening.plan import QUIET, ListenerPlan
from server.runtime.drain import Drain
from tests.listening.listeners import CODED, FIELD, SAMPLES, answers_of, design_of, write_test


@pytest.fixture
def test(tmp_path):
    return write_test(tmp_path / "test", design_of(places=2))


def client_of(test):
    settings = Settings(port=0)
    return TestClient(create_app(Listeners(test), settings, Drain(settings.drain_s)), base_url="http://localhost")


@pytest.fixture
def client(test):
    with client_of(test) as client:
        yield client


def plan_of(test, code):
    return ListenerPlan.read(test.results / f"{code}.json")


def send(client, code, number, answers, status=200):
    answer = {"answers": answers, "plays": {}, "seconds": 1.5}
    response = client.post(f"/v1/listeners/{code}/trials/{number}/answer", json=answer)
    assert response.status_code == status, response.text
    return response.json()


def go_on(client, test, standing, until):
    """Answers rightly until a stage begins; returns where the listener stands then."""
    code = standing["code"]
    plan = plan_of(test, code)
    while standing["stage"] != until:
        number = standing["question"]["number"]
        trial = plan.trials[number]
        methods = set(trial.slots.values())
        standing = send(client, code, number, answers_of(trial, (methods & {QUIET, FIELD} or {REFERENCE}).pop()))
    return standing


def test_a_listener_is_led_from_tones_to_the_end(client, test):
    begun = client.post("/v1/listeners")
    assert begun.status_code == 201
    standing = begun.json()
    assert (standing["stage"], standing["done"], standing["total"]) == ("screening", 0, 6)
    assert standing["question"]["sounds"] == ["tones"]
    standing = go_on(client, test, standing, "practice")
    trial = plan_of(test, standing["code"]).trials[standing["question"]["number"]]
    told = send(client, standing["code"], standing["question"]["number"], answers_of(trial, REFERENCE))
    assert trial.slots[told["nearest"]] == REFERENCE
    assert told["stage"] == "test"
    end = go_on(client, test, told, "done")
    assert end["question"] is None
    assert end["nearest"] is None


def test_nothing_that_the_page_gets_tells_the_method(client, test):
    standing = go_on(client, test, client.post("/v1/listeners").json(), "test")
    code = standing["code"]
    names = {FIELD, CODED, REFERENCE, "hidden", "anchor", "lowpass", "wrong-place"} - {REFERENCE}
    lengths, headers = set(), set()
    while standing["question"]:
        question = standing["question"]
        said = client.get(f"/v1/listeners/{code}").text + client.get("/v1/test").text
        assert not [name for name in names if name in said]
        assert question["slots"] == ["a", "b"]
        for slot in question["sounds"]:
            sound = client.get(f"/v1/listeners/{code}/trials/{question['number']}/sounds/{slot}")
            lengths.add(len(sound.content))
            headers.add(tuple(sorted(sound.headers.items())))
        trial = plan_of(test, code).trials[question["number"]]
        standing = send(client, code, question["number"], answers_of(trial, trial.slots["a"]))
    assert len(lengths) == len(headers) == 1
    assert {name for name, _ in headers.pop()} <= {"cache-control", "content-length", "content-type"}


def test_the_hidden_reference_sounds_like_the_open_one_and_has_other_bytes(client, test):
    standing = go_on(client, test, client.post("/v1/listeners").json(), "practice")
    number = standing["question"]["number"]
    slots = plan_of(test, standing["code"]).trials[number].slots
    hidden = next(slot for slot, method in slots.items() if method == REFERENCE)
    sounds = [
        client.get(f"/v1/listeners/{standing['code']}/trials/{number}/sounds/{slot}").content
        for slot in ("reference", hidden, next(slot for slot in slots if slot != hidden))
    ]
    assert len(set(sounds)) == 3
    heard = [soundfile.read(io.BytesIO(sound))[0] for sound in sounds]
    assert heard[0].shape == (SAMPLES, 2)
    assert np.abs(heard[0] - heard[1]).max() <= 2 * 2**-23 + 1e-12
    assert np.abs(heard[0] - heard[2]).max() > 0.01


def test_the_first_answer_stands_when_it_is_sent_again(client, test):
    standing = client.post("/v1/listeners").json()
    code, number = standing["code"], standing["question"]["number"]
    trial = plan_of(test, code).trials[number]
    first = send(client, code, number, answers_of(trial, QUIET))
    content = (test.results / f"{code}.csv").read_bytes()
    again = send(client, code, number, answers_of(trial, "plain"))
    assert again == first
    assert (test.results / f"{code}.csv").read_bytes() == content


def test_a_listener_goes_on_by_the_code_after_the_server_was_restarted(test):
    with client_of(test) as client:
        standing = go_on(client, test, client.post("/v1/listeners").json(), "test")
    with client_of(test) as client:
        assert client.get(f"/v1/listeners/{standing['code']}").json() == {**standing, "nearest": None}


@pytest.mark.parametrize(
    ("answers", "told"),
    [
        ({}, "answers are needed for 1, 2, 3"),
        ({"1": 1, "2": 0}, "answers are needed for 1, 2, 3"),
        ({"1": 1, "2": 1, "3": 0}, "one sound is chosen"),
        ({"1": 0, "2": 0, "3": 0}, "one sound is chosen"),
        ({"1": 2, "2": -1, "3": 0}, "one sound is chosen"),
    ],
)
def test_an_answer_that_cannot_be_is_refused(client, answers, told):
    standing = client.post("/v1/listeners").json()
    problem = send(client, standing["code"], standing["question"]["number"], answers, 422)
    assert problem["code"] == "malformed_answer"
    assert told in problem["detail"]
    assert client.get(f"/v1/listeners/{standing['code']}").json() == standing


def test_ratings_are_from_0_to_100(tmp_path):
    test = write_test(tmp_path / "rating", design_of("rating", places=1, screening=False))
    with client_of(test) as client:
        standing = client.post("/v1/listeners").json()
        number, slots = standing["question"]["number"], standing["question"]["slots"]
        problem = send(client, standing["code"], number, dict.fromkeys(slots, 100.5), 422)
        assert problem["code"] == "malformed_answer"
        assert send(client, standing["code"], number, dict.fromkeys(slots, 100.0))["done"] == 0


def test_only_what_is_asked_now_can_be_heard_or_answered(client, test):
    standing = client.post("/v1/listeners").json()
    code = standing["code"]
    later = client.get(f"/v1/listeners/{code}/trials/13/sounds/a")
    assert (later.status_code, later.json()["code"]) == (409, "not_this_trial")
    trial = plan_of(test, code).trials[13]
    assert send(client, code, 13, answers_of(trial, trial.slots["a"]), 409)["code"] == "not_this_trial"
    unheard = client.get(f"/v1/listeners/{code}/trials/0/sounds/a")
    assert (unheard.status_code, unheard.json()["code"]) == (404, "not_found")


@pytest.mark.parametrize("code", ["nobodyhere", "..%2Ftest", "x"])
def test_a_code_that_nobody_has_is_refused(client, code):
    response = client.get(f"/v1/listeners/{code}")
    assert response.status_code == 404
    assert response.json()["code"] in {"unknown_listener", "not_found"}


def test_a_code_that_is_none_names_no_file(test):
    listeners = Listeners(test)
    (test.results.parent / "plan.json").write_bytes((test.results / f"{listeners.begin()}.json").read_bytes())
    with pytest.raises(RequestError, match="nobody has begun"):
        listeners.plan("../plan")


def test_a_full_test_takes_nobody_more(test, monkeypatch):
    monkeypatch.setattr("server.listening.listeners.MOST_LISTENERS", 1)
    with client_of(test) as client:
        assert client.post("/v1/listeners").status_code == 201
        full = client.post("/v1/listeners")
        assert (full.status_code, full.json()["code"]) == (503, "test_full")


def test_the_design_and_the_results_are_not_served(client):
    for path in ("test.json", "results/", "sounds/", "../test.json"):
        assert client.get(f"/{path}").status_code == 404
    page = client.get("/")
    assert "Listening test" in page.text
    for file in ("base.css", "style.css", "main.js", "notices.js", "icon.svg", "fonts/instrument-sans.woff2"):
        assert client.get(f"/{file}").status_code == 200, file


def test_other_sites_may_not_answer(client):
    headers = {"Origin": "https://evil.example"}
    assert client.post("/v1/listeners", headers=headers).status_code == 403

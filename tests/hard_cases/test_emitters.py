"""Emitters that come and go faster than they sound."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from server.core.errors import NafirError
from server.protocol.client_messages import AddEmitter, MoveEmitter, RemoveEmitter, SetGain
from server.rendering.renderer import DuplicateEmitterError, RendererFullError, UnknownEmitterError
from tests.hard_cases.listening import (
    SIZE,
    THERE,
    Listening,
    ahead,
    convolved,
    hear,
    not_finite,
    play,
    played,
    renderer,
    room,
)
from tests.signals import error_db, noise


def test_one_added_and_removed_in_every_block(measured, filters):
    engine, ir = renderer(filters, max_emitters=16), room(1)
    clip = np.sign(noise(2, 3_000))
    heard, refused = [], 0
    for step in range(200):
        try:
            play(engine, clip, ir, path=ahead(), name=str(step))
        except RendererFullError:
            refused += 1
        else:
            heard.append(hear(engine, 1))
            engine.remove_emitter(str(step))
        heard.append(hear(engine, 1))
    wet = np.concatenate(heard, axis=1)
    assert not_finite(wet) == 0
    # One plays at a time, and fades out while the next fades in: no more than two of them at once.
    bound = 2 * (np.abs(ir).sum(axis=-1).max() + 0.5 * 8)
    measured("peak beside the bound", np.abs(wet).max() / bound, 1.0)
    assert refused < 200


def test_a_session_in_which_one_comes_and_goes_in_every_block(measured, field, filters):
    listening = Listening(field, filters)
    bad = 0
    for step in range(300):
        listening.add(str(step))
        bad += not_finite(listening.hear(1))
        listening.say(RemoveEmitter(id=str(step)))
        bad += not_finite(listening.hear(1))
    measured("samples not finite", bad, 0)
    hushed = listening.hear(120)[:, -20 * SIZE :]
    measured("largest sample when all have gone", np.abs(hushed).max(), 0.0)
    assert listening.add("last") == []


def test_the_others_sound_as_if_nobody_came_or_went(measured):
    engine, clip, ir = renderer(max_emitters=40), noise(3, 5_000), room(4)
    play(engine, clip, ir, name="stays")
    heard = []
    for step in range(60):
        # Silent, but there: what it plays is nothing.
        play(engine, np.zeros(10, np.float32), room(step), name=str(step))
        heard.append(hear(engine, 1))
        engine.remove_emitter(str(step))
    wet = np.concatenate(heard, axis=1)
    expected = convolved(played(clip, wet.shape[1]), ir, wet.shape[1])
    measured("error", error_db(wet, expected), -120, "dB")


def test_one_removed_before_its_response_came_was_never_heard(measured, filters):
    engine = renderer(filters)
    for _ in range(50):
        engine.add_emitter("a", _Clip())
        engine.remove_emitter("a")
        measured("largest sample", np.abs(hear(engine, 1)).max(), 0.0)


class _Clip:
    def process(self, _out):
        raise AssertionError("played before it can be heard")

    def reset(self):
        pass


def test_ids_taken_unknown_and_too_many_are_refused_and_change_nothing(measured):
    engine, clip, ir = renderer(max_emitters=2), noise(5, 5_000), room(6)
    play(engine, clip, ir)
    with pytest.raises(DuplicateEmitterError):
        play(engine, clip, ir)
    for change in (
        lambda: engine.remove_emitter("b"),
        lambda: engine.set_gain("b", 0.0),
        lambda: engine.set_ir("b", ir),
        lambda: engine.set_path("b", ahead()),
    ):
        with pytest.raises(UnknownEmitterError):
            change()
    play(engine, np.zeros(9, np.float32), ir, name="silent")
    with pytest.raises(RendererFullError):
        play(engine, clip, ir, name="third")
    samples = 30 * SIZE
    measured("error", error_db(hear(engine, 30), convolved(played(clip, samples), ir, samples)), -120, "dB")


@pytest.mark.parametrize("identifier", ["", "x" * 65, "\x00", "\ud800", "🎻", " " * 64])
def test_an_id_of_any_letters_is_taken_or_refused_and_never_breaks(field, filters, identifier):
    listening = Listening(field, filters)
    try:
        message = AddEmitter(id=identifier, clip="noise", position=THERE)
    except ValueError:
        return
    assert listening.say(message) == []
    assert listening.say(RemoveEmitter(id=identifier)) == []
    listening.hear(2)


_STEPS = st.lists(
    st.tuples(
        st.sampled_from(["add", "remove", "ir", "gain", "path", "drop", "blocks"]),
        st.integers(0, 5),
        st.integers(0, 3),
    ),
    max_size=40,
)


@given(_STEPS)
def test_any_order_of_calls_is_finite_bounded_and_the_same_twice(measured, filters, script):
    irs = [room(seed, decay_samples=100) for seed in range(4)]
    clip = np.sign(noise(7, 700))
    gains = (0.0, -1.0, 1.0, 0.5)

    def run():
        engine = renderer(filters, max_emitters=4)
        heard = [np.zeros((2, 1))]
        for what, number, choice in script:
            name = str(number)
            try:
                if what == "add":
                    play(engine, clip, irs[choice], path=ahead(float(choice)), name=name, gain=gains[choice])
                elif what == "remove":
                    engine.remove_emitter(name)
                elif what == "ir":
                    engine.set_ir(name, irs[choice])
                elif what == "gain":
                    engine.set_gain(name, gains[choice])
                elif what == "path":
                    engine.set_path(name, ahead(10.0 * choice))
                elif what == "drop":
                    engine.drop_ir(name)
                else:
                    heard.append(hear(engine, 1 + choice))
            except NafirError:
                continue
        return np.concatenate(heard, axis=1)

    first, again = run(), run()
    assert not_finite(first) == 0
    # Eight slots, each at most as loud as the loudest response and the nearest direct sound.
    loudest = np.abs(irs).max(axis=0).sum(axis=-1).max() + 4 * 8
    measured("peak beside the bound", np.abs(first).max() / (8 * loudest), 1.0)
    measured("largest difference of a rerun", np.abs(first - again).max(), 0.0)


def test_a_session_under_everything_at_once_goes_on(measured, field, filters):
    """A thousand blocks of whatever a client may say, each as likely as the others."""
    listening = Listening(field, filters, clip=0.1 * noise(8, 2_000))
    rng = np.random.default_rng(9)
    bounds = field.bundle.manifest.bounds
    pose_id, bad, peak = 0, 0, 0.0
    for _ in range(1_000):
        for _ in range(rng.integers(0, 4)):
            name = str(rng.integers(0, 20))
            pose_id += 1
            position = tuple(rng.uniform(bounds.minimum, bounds.maximum))
            listening.say(
                [
                    AddEmitter(id=name, clip="noise", position=position),
                    RemoveEmitter(id=name),
                    MoveEmitter(id=name, position=position, pose_id=pose_id),
                    SetGain(id=name, gain_db=float(rng.uniform(-80, 24))),
                ][rng.integers(0, 4)]
            )
        if rng.integers(0, 3) == 0:
            listening.answer()
        samples = listening.session.render_block().samples
        bad += not_finite(samples)
        peak = max(peak, float(np.abs(samples).max()))
    measured("samples not finite", bad, 0)
    measured("peak", peak, 10 ** (-1 / 20) * (1 + 1e-6))

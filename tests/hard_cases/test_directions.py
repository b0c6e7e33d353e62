"""Fields of directions: heads turned to the poles and on their sides, sound from one direction alone, and none."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from server.acoustics.geometry import LEVEL, Quaternion
from server.acoustics.spherical_harmonics import HIGHEST_ORDER, even_directions, real_harmonics
from server.field.directional_graph import LEAST_POWER, Arrivals
from server.field.field import AcousticField
from server.health.findings import LEVEL_PER_DEGREE
from server.rendering.ear_products import EarProducts
from server.rendering.hrtf import kemar
from tests.directional_flat import BANDS, COLUMNS, write_directional

LISTENER, EMITTER = (2.0, 2.5, 1.5), (6.0, 3.0, 1.4)
ORDERS = range(1, HIGHEST_ORDER + 1)
TAILS = ("stft", "bands")
FLOOR = np.log(1e-5)


@pytest.fixture(scope="module")
def fields(tmp_path_factory) -> dict[tuple[int, str], AcousticField]:
    """Sound from the north-east and above, by order and tail."""
    folder = tmp_path_factory.mktemp("scenes")
    towards = tuple(np.array([2.0, 2.0, 1.0]) / 3)
    return {
        (order, tail): AcousticField.load(write_directional(folder / f"{order}-{tail}", order, towards, tail))
        for order in ORDERS
        for tail in TAILS
    }


@pytest.fixture(params=[(order, tail) for order in ORDERS for tail in TAILS], ids=lambda of: f"order {of[0]}, {of[1]}")
def field(fields, request) -> AcousticField:
    return fields[request.param]


def turned(yaw, pitch, roll):
    """Degrees; up and to the right are positive."""
    z, y, x = (math.radians(angle) / 2 for angle in (yaw, -pitch, roll))
    cz, sz, cy, sy, cx, sx = math.cos(z), math.sin(z), math.cos(y), math.sin(y), math.cos(x), math.sin(x)
    return Quaternion(
        cz * cy * sx - sz * sy * cx,
        cz * sy * cx + sz * cy * sx,
        sz * cy * cx - cz * sy * sx,
        cz * cy * cx + sz * sy * sx,
    )


def responses(field, heads):
    return field.impulse_responses([LISTENER] * len(heads), [EMITTER] * len(heads), heads).astype(np.float64)


def level_db(response):
    return 10 * np.log10(np.sum(response**2, axis=-1))


@pytest.mark.parametrize("pole", [90.0, -90.0, 89.999999, 90.000001])
@pytest.mark.parametrize("roll", [0.0, 90.0, 180.0, -90.0])
def test_a_head_that_looks_straight_up_or_down_hears_what_its_neighbours_hear(field, pole, roll, measured):
    """There yaw and roll are one: angles have a pole, orientations have none."""
    heads = [turned(yaw, pole, roll + yaw) if pole < 0 else turned(yaw, pole, roll - yaw) for yaw in (0.0, 77.0)]
    near = [turned(0.0, pole - 0.5, roll), turned(0.0, pole, roll + 0.5)]
    here, same, *beside = level_db(responses(field, [*heads, *near]))
    assert np.isfinite(here).all()
    measured("level of one orientation told by two yaws", np.abs(here - same).max(), 1e-3, "dB")
    measured("level within half a degree of a pole", np.abs(here - np.array(beside)).max(), 0.3, "dB")


@pytest.mark.parametrize("axis", ["yaw", "pitch", "roll"])
def test_nothing_pops_as_a_head_turns_by_a_degree(field, axis, measured):
    steps = np.arange(0.0, 361.0, 15.0)
    heads = [
        turned(**{"yaw": 20.0, "pitch": 0.0, "roll": 0.0} | {axis: angle}) for at in steps for angle in (at, at + 1)
    ]
    levels = level_db(responses(field, heads)).reshape(len(steps), 2, 2)
    measured(f"level per degree of {axis}", np.abs(np.diff(levels, axis=1)).max(), LEVEL_PER_DEGREE.bound, "dB")


def test_an_orientation_and_its_negative_are_one(field):
    for head in (turned(10, 20, 30), turned(-170, -80, 175)):
        one, other = responses(field, [head, Quaternion(*(-part for part in head))])
        np.testing.assert_array_equal(one, other)


def test_a_head_upside_down_hears_left_what_was_right(fields, measured):
    # Sound from the level plane: turned over about the nose, a head has it at the other ear.
    for order in ORDERS:
        graph = fields[order, "stft"].graph
        at_left = np.array([[0.0, 1.0, 0.0]])
        arrivals = arrivals_of(at_left, np.ones(1), order)
        upright, over = (graph.at_ears(arrivals, [head]).log_magnitude[0] for head in (LEVEL, turned(0, 0, 180)))
        assert upright[0, 20:].mean() > upright[1, 20:].mean()
        assert over[1, 20:].mean() > over[0, 20:].mean()
        apart_db = 20 / np.log(10) * np.abs(over[::-1].mean(axis=(1, 2)) - upright.mean(axis=(1, 2))).max()
        measured("mean level at ears that changed sides", apart_db, 1.5, "dB")  # a head is not quite symmetrical


def arrivals_of(directions, powers, order, level=0.0):
    """What a network would predict of waves, the same in all bands and columns."""
    relative = powers @ real_harmonics(directions, order) / np.sum(powers)
    log_magnitude = np.full((1, BANDS, COLUMNS), level, np.float32)
    rest = np.ones((1, len(relative) - 1, BANDS, COLUMNS), np.float32) * relative[None, 1:, None, None]
    return Arrivals(log_magnitude, rest.astype(np.float32))


def says(patch, field, arrivals):
    """Let the field's network predict these arrivals."""
    patch.setattr(field.graph, "run", lambda *_: [arrivals.log_magnitude, arrivals.directions])


@pytest.mark.parametrize("order", ORDERS)
@given(number=st.integers(0, 199), yaw=st.floats(-180, 180), pitch=st.floats(-90, 90), roll=st.floats(-180, 180))
def test_sound_from_one_direction_alone_leaves_power_at_both_ears(fields, measured, order, number, yaw, pitch, roll):
    """The harmonics of one direction, cut at a low order, are negative in others."""
    graph = fields[order, "stft"].graph
    direction = even_directions(200)[number : number + 1]
    heard = graph.at_ears(arrivals_of(direction, np.ones(1), order), [turned(yaw, pitch, roll)])
    assert np.isfinite(heard.log_magnitude).all()
    products = EarProducts.of(kemar(24_000), bins=129, order=order).matrix
    least = 0.5 * np.log(LEAST_POWER * products[:, :2, 0].T)[None, ..., None]
    measured("power below the least", float(np.max(least - heard.log_magnitude)), 1e-3, "Np")
    measured("coherence of the ears", float(np.max(np.sum(heard.interaural**2, axis=1))), 1 + 1e-5)


@pytest.mark.parametrize("tail", TAILS)
@pytest.mark.parametrize("relative", [1.0, -1.0, 50.0])
def test_directions_that_cannot_be_stay_finite(fields, tail, relative):
    """A network may say what no sound can: the harmonics of several directions at once, or of none."""
    for order in ORDERS:
        field = fields[order, tail]
        arrivals = Arrivals(
            np.zeros((1, BANDS, COLUMNS), np.float32),
            np.full((1, (order + 1) ** 2 - 1, BANDS, COLUMNS), relative, np.float32),
        )
        with pytest.MonkeyPatch.context() as patch:
            says(patch, field, arrivals)
            response = responses(field, [turned(30, 40, 50)])
        assert np.isfinite(response).all()
        assert response.any()


@pytest.mark.parametrize("tail", TAILS)
def test_silence_has_neither_level_nor_coherence(fields, tail, measured):
    for order in ORDERS:
        field = fields[order, tail]
        silent = arrivals_of(np.array([[1.0, 0.0, 0.0]]), np.ones(1), order, level=FLOOR - 1.0)
        heard = field.graph.at_ears(silent, [LEVEL])
        assert not heard.interaural.any()
        with pytest.MonkeyPatch.context() as patch:
            says(patch, field, silent)
            measured("samples of silence", np.abs(responses(field, [LEVEL])).max(), 1e-9)


@pytest.mark.parametrize("tail", TAILS)
def test_one_loud_band_beside_silent_ones_is_heard(fields, tail):
    field = fields[2, tail]
    said = arrivals_of(np.array([[0.0, 0.0, 1.0]]), np.ones(1), 2, level=FLOOR - 1.0)
    said.log_magnitude[:, 3] = 0.0
    with pytest.MonkeyPatch.context() as patch:
        says(patch, field, said)
        response = responses(field, [LEVEL])
    assert np.isfinite(response).all()
    assert response.any(axis=-1).all()

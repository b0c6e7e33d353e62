"""Ambisonic sound in the browser: turned and decoded as the server would."""

import base64

import numpy as np
import pytest

from server.acoustics.spherical_harmonics import even_directions, harmonic_count, real_harmonics, rotation
from server.rendering.head_decoder import HeadDecoder
from server.rendering.hrtf import kemar
from tests import visitor

browser = visitor.browser
page = visitor.one_page
pytestmark = visitor.needs_browser

ORDERS = pytest.mark.parametrize("order", [1, 2, 3])
QUANTUM = 128
QUANTA = 12
RATE = 24_000

ROTATE = """async ({ orientations, order }) => {
  const { rotation } = await import(new URL("nafir/ambisonics.js", document.baseURI));
  return orientations.map((orientation) => Array.from(rotation(orientation, order)));
}"""

DECODE = """async ({ order, channels, heads, turns }) => {
  const { HeadDecoder } = await import(new URL("nafir/ambisonics.js", document.baseURI));
  const floats = (text) => new Float32Array(Uint8Array.from(atob(text), (char) => char.charCodeAt(0)).buffer);
  const sound = channels.map(floats);
  const decoder = new HeadDecoder({ order, frames: 128 });
  const played = [new Float32Array(sound[0].length), new Float32Array(sound[0].length)];
  for (let quantum = 0; 128 * quantum < sound[0].length; quantum++) {
    if (heads[quantum]) decoder.use(heads[quantum].map((ear) => ear.map(floats)));
    if (turns[quantum]) decoder.turn(turns[quantum]);
    const ears = [new Float32Array(128), new Float32Array(128)];
    const some = sound.map((samples) => samples.slice(128 * quantum, 128 * (quantum + 1)));
    decoder.decode(some, ...ears);
    ears.forEach((ear, index) => played[index].set(ear, 128 * quantum));
  }
  return played.map((ear) => btoa(String.fromCharCode(...new Uint8Array(ear.buffer))));
}"""


def random_orientations(count):
    quaternions = np.random.default_rng(5).standard_normal((count, 4))
    return quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)


def as_text(samples):
    """Float32 as base64: playwright passes an array number by number, which takes seconds."""
    return base64.b64encode(np.float32(samples).tobytes()).decode()


def decode(page, order, channels, *, heads, turns=()):
    """(2, n) what the browser makes of channels (k, n); `heads` and `turns` by the quantum where they begin."""
    parameters = {
        "order": order,
        "channels": [as_text(channel) for channel in channels],
        "heads": {
            str(quantum): [[as_text(taps) for taps in ear] for ear in filters] for quantum, filters in heads.items()
        },
        "turns": {str(quantum): list(turn) for quantum, turn in dict(turns).items()},
    }
    played = page.evaluate(DECODE, parameters)
    return np.array([np.frombuffer(base64.b64decode(ear), np.float32) for ear in played], np.float64)


def by_server(decoder, channels):
    """(2, n) channels (k, n) in the axes of the head, convolved."""
    heard = [
        sum(np.convolve(channel, taps) for channel, taps in zip(channels, ear, strict=True)) for ear in decoder.filters
    ]
    return np.array(heard)[:, : channels.shape[1]]


def noise(count=1):
    return np.float32(np.random.default_rng(6).standard_normal((count, QUANTA * QUANTUM)))


@ORDERS
def test_rotations_are_those_of_the_server_and_keep_the_energy_of_each_degree(page, order):
    orientations = random_orientations(12)
    count = harmonic_count(order)
    matrices = np.reshape(
        page.evaluate(ROTATE, {"orientations": orientations.tolist(), "order": order}), (-1, count, count)
    )
    expected = [rotation(orientation, order) for orientation in orientations]
    np.testing.assert_allclose(matrices, expected, atol=1e-12)
    np.testing.assert_allclose(matrices @ np.swapaxes(matrices, 1, 2), [np.eye(count)] * 12, atol=1e-12)


@ORDERS
def test_plane_waves_are_heard_as_the_servers_filters_have_them(page, order):
    decoder = HeadDecoder.of(kemar(RATE), order)
    for direction in even_directions(5):
        channels = noise() * real_harmonics(direction, order)[:, None]
        heard = decode(page, order, channels, heads={0: decoder.filters})
        expected = by_server(decoder, channels)
        # In the first quantum the filters take over.
        np.testing.assert_allclose(heard[:, QUANTUM:], expected[:, QUANTUM:], atol=1e-5 * np.abs(expected).max())


@ORDERS
def test_a_turned_head_hears_a_plane_wave_as_one_from_the_other_side(page, order):
    decoder = HeadDecoder.of(kemar(RATE), order)
    channels = noise(harmonic_count(order))
    for orientation in random_orientations(3):
        heard = decode(page, order, channels, heads={0: decoder.filters}, turns={0: orientation})
        expected = by_server(decoder, rotation(orientation, order) @ channels)
        reach = 2 * QUANTUM  # the first quantum turns, and the filters reach back to it
        np.testing.assert_allclose(heard[:, reach:], expected[:, reach:], atol=1e-5 * np.abs(expected).max())


def test_a_turn_is_heard_within_its_quantum_and_without_a_click(page):
    decoder = HeadDecoder.of(kemar(RATE), 1)
    time = np.arange(QUANTA * QUANTUM)
    left = np.sin(2 * np.pi * 220 * time / RATE) * real_harmonics([0.0, 1.0, 0.0], 1)[:, None]
    about = (0.0, 0.0, 1.0, 0.0)
    heard = decode(page, 1, left, heads={0: decoder.filters}, turns={6: about})
    unturned = decode(page, 1, left, heads={0: decoder.filters})
    at = 6 * QUANTUM
    np.testing.assert_array_equal(heard[:, :at], unturned[:, :at])
    differs = np.abs(heard - unturned).max(axis=0) > 1e-3
    assert at <= np.argmax(differs) < at + QUANTUM
    turned = by_server(decoder, rotation(about, 1) @ left)
    np.testing.assert_allclose(heard[:, at + 2 * QUANTUM :], turned[:, at + 2 * QUANTUM :], atol=1e-5)
    settled = slice(2 * QUANTUM, None)
    steepest = np.abs(np.diff(unturned[:, settled])).max()
    ramp = 2 * np.abs(unturned).max() / QUANTUM  # from one side to the other
    assert np.abs(np.diff(heard[:, settled])).max() < 1.2 * (steepest + ramp)


def test_another_head_takes_over_in_one_quantum(page):
    one, other = HeadDecoder.of(kemar(RATE), 1).filters, HeadDecoder.of(kemar(RATE), 1).filters[::-1, :, :96]
    channels = noise(4)
    heard = decode(page, 1, channels, heads={0: one, 6: other})
    before, after = (decode(page, 1, channels, heads={0: filters}) for filters in (one, other))
    at = 6 * QUANTUM
    np.testing.assert_array_equal(heard[:, :at], before[:, :at])
    np.testing.assert_allclose(heard[:, at + QUANTUM :], after[:, at + QUANTUM :], atol=1e-5)
    share = (np.arange(QUANTUM) + 1) / QUANTUM
    between = slice(at, at + QUANTUM)
    np.testing.assert_allclose(
        heard[:, between], (1 - share) * before[:, between] + share * after[:, between], atol=1e-5
    )


@ORDERS
def test_without_filters_two_cardioids_hear(page, order):
    channels = noise() * real_harmonics([0.0, 1.0, 0.0], order)[:, None]
    left, right = decode(page, order, channels, heads={})
    np.testing.assert_allclose(left, np.sqrt(3) * channels[0], atol=1e-5)
    np.testing.assert_allclose(right, 0, atol=1e-6)


WIRE = """async ({ count, frames }) => {
  const { parseBlock } = await import(new URL("nafir/wire.js", document.baseURI));
  const buffer = new ArrayBuffer(28 + 4 * count * frames);
  const view = new DataView(buffer);
  view.setUint8(0, 1);
  view.setUint16(2, count, true);
  view.setUint32(24, frames, true);
  for (let i = 0; i < count * frames; i++) view.setFloat32(28 + 4 * i, i, true);
  try {
    return parseBlock(buffer).channels.map((channel) => Array.from(channel));
  } catch (error) {
    return error.message;
  }
}"""


@pytest.mark.parametrize("count", [1, 2, 4, 9, 16])
def test_blocks_of_any_output_are_read(page, count):
    channels = page.evaluate(WIRE, {"count": count, "frames": 3})
    expected = np.arange(3 * count).reshape(3, count).T
    np.testing.assert_array_equal(channels, np.repeat(expected, 2, axis=0) if count == 1 else expected)


def test_blocks_of_no_output_are_refused(page):
    assert page.evaluate(WIRE, {"count": 3, "frames": 3}) == "audio block of 64 bytes for 3 frames, 3 channels"

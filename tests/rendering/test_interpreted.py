"""A session sounds as it does where nothing is compiled."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]

PLAY = """
import sys
if sys.argv[1] == "interpreted":
    sys.path.insert(0, "tests/oracles")
    import interpreted
    interpreted.install()
import numpy as np
from server.rendering import direct_path_kernel, mixing
from server.rendering.direct_path import PathTarget
from server.rendering.hrtf import KEMAR, Hrtf, HeadFilters
from server.rendering.renderer import Renderer, render_all
from server.rendering.sources import ClipPlayer

assert hasattr(direct_path_kernel.ask, "py_func") == (sys.argv[1] == "compiled")
assert mixing.is_power_of_two(128) == (sys.argv[1] == "compiled")
rng = np.random.default_rng(1)
air = np.array([0.0004, 0.001, 0.002, 0.005, 0.01, 0.03, 0.1])
filters = HeadFilters.from_hrtf(Hrtf.read(KEMAR, 24_000))
engines = [
    Renderer(block_size=128, ir_samples=6_000, sample_rate=24_000, filters=filters, speed_of_sound=343.0,
             air_db_per_m=air, max_emitters=3, shared_tail=number == 1)
    for number in range(2)
]
heard = []
for block in range(120):
    for number, engine in enumerate(engines):
        if block % 40 == 10 * number:
            name = f"{block}"
            engine.add_emitter(name, ClipPlayer(rng.standard_normal(2_000).astype(np.float32), loop=True), gain=0.3)
            engine.set_ir(name, rng.standard_normal((2, 5_500)).astype(np.float32) * 0.02)
        for name in list(engine._emitters):
            angle = block / 20 + number
            engine.set_path(name, PathTarget(2 + block / 50, (np.cos(angle), np.sin(angle), 0.0),
                                             np.full(7, -3.0, np.float32)))
            if block % 25 == 7:
                engine.set_ir(name, rng.standard_normal((2, 6_000)).astype(np.float32) * 0.02)
                engine.set_gain(name, 0.1 + block / 200)
                engine.set_reverberation_gain(name, 0.5)
        engine.set_orientation((0.0, 0.0, np.sin(block / 60), np.cos(block / 60)))
    heard.append(np.concatenate([rendered.samples for rendered in render_all(engines)], axis=0))
np.save(sys.argv[2], np.concatenate(heard, axis=1))
"""


@pytest.fixture(scope="module")
def heard(tmp_path_factory):
    folder = tmp_path_factory.mktemp("heard")
    outputs = []
    for how in ("compiled", "interpreted"):
        subprocess.run([sys.executable, "-c", PLAY, how, str(folder / f"{how}.npy")], check=True, cwd=ROOT)
        outputs.append(np.load(folder / f"{how}.npy").astype(float))
    return outputs


def test_the_same_session_sounds_the_same(heard):
    compiled, plain = heard
    assert np.abs(compiled).max() > 0.1
    assert 20 * np.log10(np.abs(compiled - plain).max() / np.abs(plain).max()) < -100

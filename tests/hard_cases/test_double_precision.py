"""From pose to samples: what is streamed and written, single precision in compiled code, beside two oracles in double.

One is the package itself with nothing compiled (`tests.oracles.interpreted`), in a process in which single precision
does not exist: NumPy's `float32` is `float64` there, and `complex64` is `complex128`. It follows poses, Doppler and
exchanges of responses as the original does. The other is a convolution with responses from
`server.health.double_precision`, which shares little code with the original, for listeners at rest. Both read the
network's outputs as the graph gives them, in single precision.
"""

import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import scipy.signal

from server.acoustics.geometry import Pose
from server.field.fields_by_level import FieldsByLevel
from server.health.double_precision import DoubleFullResponse
from server.offline.render import PathPoint, RenderedEmitter, render
from server.rendering.hrtf import kemar
from server.responses.direct_sound import DirectSound
from server.scene.bundle import Bundle, bundled_scenes

ROOT = Path(__file__).parents[2]
BOUND_DB = -90.0
BUNDLES = {folder.name: Bundle.load(folder) for folder in bundled_scenes()}
MESH = {scene: bundle.mesh is not None for scene, bundle in BUNDLES.items()}
LEVELS = [
    pytest.param(scene, level.name, id=f"{scene} {level.name}")
    for scene, bundle in BUNDLES.items()
    for level in bundle.manifest.levels
]
WALKS = [
    # With nothing compiled, the ways round the edges of a mesh take minutes to find.
    pytest.param(*each.values, id=each.id, marks=[pytest.mark.long] if MESH[each.values[0]] else [])
    for each in LEVELS
]
SECONDS = 0.7

RENDER = """
import json, sys
if sys.argv[1] == "double":
    sys.path.insert(0, "tests/oracles")
    import interpreted
    interpreted.install(in_double_precision=True)
import numpy as np
from server.acoustics.geometry import Pose
from server.rendering import direct_path_kernel
from server.responses.direct_sound import DirectSound
from server.field.fields_by_level import FieldsByLevel
from server.offline.render import PathPoint, RenderedEmitter, render
from server.scene.bundle import Bundle, find_bundle
from server.rendering.hrtf import kemar

assert hasattr(direct_path_kernel.ask, "py_func") == (sys.argv[1] == "single")
scene, out, seconds = sys.argv[2], sys.argv[3], float(sys.argv[4])
levels = FieldsByLevel.load(Bundle.load(find_bundle(scene)))
bundle = levels.bundle
start, rate = bundle.manifest.start, bundle.manifest.codec.sample_rate
rng = np.random.default_rng(11)
clips = [rng.standard_normal(rate // 2).astype(np.float32) * 0.02 for _ in range(2)]
there, here = np.array(start.emitter), np.array(start.listener)
places = [tuple(there), tuple(0.7 * there + 0.3 * here)]
emitters = [
    RenderedEmitter(clip, Pose(place), gain=gain, loop=True) for clip, place, gain in zip(clips, places, (1.0, 0.5))
]
path = []
for number in range(24):
    share = number / 24
    place = tuple(here + 0.15 * share * (there - here) + np.array([0.0, 0.05 * np.sin(6 * share), 0.0]))
    sample = round(share * seconds * rate)
    path.append(PathPoint(sample, Pose.from_yaw(place, 3.0 + 2 * share), sample if number % 2 == 0 else None))
rendered = {}
for name, field in levels.items():
    direct = DirectSound.of(bundle, kemar(rate))
    rendered[name] = render(field, direct, emitters, path, length=round(seconds * rate))
    assert rendered[name].dtype == np.float32, rendered[name].dtype  # which is float64 where there is no other
np.savez(out, **{name: samples.astype("f8") for name, samples in rendered.items()})
"""


def difference_db(found, expected):
    return 20 * np.log10(np.linalg.norm(found - expected) / np.linalg.norm(expected))


@pytest.fixture(scope="module")
def walks(tmp_path_factory):
    """What is heard on a walk through a scene, at every level, in single precision and in double."""
    folder = tmp_path_factory.mktemp("walks")

    @cache
    def walked(scene):
        found = {}
        for how in ("single", "double"):
            out = folder / f"{scene}-{how}.npz"
            command = [sys.executable, "-c", RENDER, how, scene, str(out), str(SECONDS)]
            subprocess.run(command, check=True, cwd=ROOT)
            found[how] = np.load(out)
        return found

    return walked


@pytest.mark.parametrize(("scene", "level"), WALKS)
def test_a_walk_is_heard_as_in_double_precision(walks, scene, level, measured):
    """Two emitters, a listener who walks and turns, responses exchanged on the way."""
    single, double = (walks(scene)[how][level] for how in ("single", "double"))
    assert np.isfinite(single).all()
    assert np.abs(single).max() > 1e-3
    measured("difference", difference_db(single, double), BOUND_DB, "dB")
    blocks = [half.reshape(2, -1, 480) for half in (single - double, double)]
    worst = np.max(np.sum(blocks[0] ** 2, axis=(0, 2)) / np.max(np.sum(blocks[1] ** 2, axis=(0, 2))))
    measured("difference of the worst 20 ms", 10 * np.log10(worst), BOUND_DB, "dB")


@pytest.mark.parametrize(("scene", "level"), LEVELS)
def test_a_listener_at_rest_hears_a_convolution_with_exact_responses(scene, level, measured):
    levels = FieldsByLevel.load(BUNDLES[scene])
    field, start = levels[level], levels.bundle.manifest.start
    head = kemar(field.sample_rate)
    clip = 0.02 * np.random.default_rng(4).standard_normal(4_000).astype(np.float32)
    yaw = 0.4
    length = 4_000 + field.ir_samples
    heard = render(
        field,
        DirectSound.of(levels.bundle, head),
        [RenderedEmitter(clip, Pose(start.emitter))],
        [PathPoint.at(0, Pose.from_yaw(start.listener, yaw))],
        length=length,
    )
    response = DoubleFullResponse(field, head).impulse_responses([start.listener], [start.emitter], [yaw])[0]
    expected = scipy.signal.fftconvolve(clip[None].astype(np.float64), response.astype(np.float64), axes=-1)
    count = min(length, expected.shape[-1])
    measured("difference", difference_db(heard[:, :count], expected[:, :count]), BOUND_DB, "dB")

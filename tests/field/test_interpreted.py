"""A field answers as it does where nothing is compiled."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from server.scene.bundle import BUNDLED

ROOT = Path(__file__).parents[2]

RESPOND = """
import sys
from pathlib import Path
if sys.argv[1] == "interpreted":
    sys.path.insert(0, "tests/oracles")
    import interpreted
    interpreted.install()
import numpy as np
from server.acoustics.sound_path_kernel import find_sound_paths
from server.field.fields_by_level import FieldsByLevel
from server.scene.bundle import Bundle

assert hasattr(find_sound_paths, "py_func") == (sys.argv[1] == "compiled")
field = FieldsByLevel.load(Bundle.load(Path(sys.argv[2]))).default
rng = np.random.default_rng(2)
listeners, emitters = rng.uniform((1, 1, 1.3), (7, 4, 1.8), (2, 12, 3))
np.save(sys.argv[3], field.impulse_responses(listeners, emitters, rng.uniform(-3, 3, 12)))
"""


@pytest.mark.parametrize("scene", ["flat", "apartment"])
def test_a_field_answers_the_same(scene, bundle, tmp_path):
    folder = bundle.folder if scene == "flat" else BUNDLED / scene
    answers = []
    for how in ("compiled", "interpreted"):
        output = tmp_path / f"{how}.npy"
        subprocess.run([sys.executable, "-c", RESPOND, how, str(folder), str(output)], check=True, cwd=ROOT)
        answers.append(np.load(output).astype(np.float64))
    compiled, plain = answers
    difference = np.linalg.norm(compiled - plain, axis=(1, 2)) / np.linalg.norm(plain, axis=(1, 2))
    assert difference.max() < 1e-5

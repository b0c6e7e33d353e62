"""Checks whether two checkouts compute the same impulse responses, to the bit: `python benchmarks/same_responses.py OLD
NEW`.

Each checkout is a folder with its own `pyproject.toml`; the Python that runs this script runs both. The script calls
`nafir ir` of each checkout for some poses of every bundled scene at every quality level. It prints one line for each
scene and level, and exits with 1 if any differs.
"""

import hashlib
import json
import os
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

POSES = {
    "apartment": [
        ("1.0,2.0,1.5", "6.0,3.0,1.5", 90.0),
        ("3.1,1.7,1.6", "1.2,3.4,1.4", -35.0),
        ("6.5,1.1,1.5", "6.9,3.9,1.2", 200.0),
    ],
    "open-field": [("0.0,0.0,1.5", "3.0,0.0,1.5", 0.0), ("-4.0,2.0,1.6", "5.0,-6.0,1.2", 77.0)],
}
"""Poses in each bundled scene: positions of listener and emitter in metres, and heading in degrees."""


def nafir(checkout: Path, *arguments: str) -> subprocess.CompletedProcess[bytes]:
    entry = tomllib.loads((checkout / "pyproject.toml").read_text())["project"]["scripts"]["nafir"]
    module, _, name = entry.partition(":")
    code = f"import sys; from {module} import {name}; sys.argv[0] = 'nafir'; {name}()"
    environment = os.environ | {"PYTHONPATH": str(checkout)}
    run = [sys.executable, "-c", code, *arguments]
    return subprocess.run(run, cwd=checkout, env=environment, check=True, capture_output=True)


def levels_of(checkout: Path, scene: str) -> list[str]:
    manifest = json.loads((checkout / "server" / "scene" / "bundles" / scene / "scene.json").read_text())
    return [level["name"] for level in manifest["levels"]]


def digest(checkout: Path, scene: str, level: str) -> str:
    """Return the SHA-256 of the responses at all poses."""
    found = hashlib.sha256()
    with tempfile.TemporaryDirectory() as folder:
        for number, (listener, emitter, yaw_deg) in enumerate(POSES[scene]):
            file = Path(folder) / f"{number}.npy"
            asked = f"--listener={listener}", f"--emitter={emitter}", f"--yaw-deg={yaw_deg}", f"--level={level}"
            nafir(checkout, "ir", scene, *asked, "--output", str(file))
            found.update(file.read_bytes())
    return found.hexdigest()


def main(old: Path, new: Path) -> int:
    differs = False
    for scene in POSES:
        for level in levels_of(new, scene):
            before, after = digest(old, scene, level), digest(new, scene, level)
            differs |= before != after
            sys.stdout.write(f"{scene} {level}: {'same' if before == after else 'DIFFERENT'} {after[:16]}\n")
            sys.stdout.flush()
    return int(differs)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]).resolve(), Path(sys.argv[2]).resolve()))

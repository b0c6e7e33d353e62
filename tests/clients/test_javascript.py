"""The package for JavaScript in Node: poses, messages, what npm packs, and types."""

import json
import shutil
import subprocess
import tarfile
from pathlib import Path

import numpy as np
import pytest

from tests.clients.vectors import CLIENTS, TABLE, assert_same_poses, poses

NODE, NPM = shutil.which("node"), shutil.which("npm")
PACKAGE = CLIENTS / "javascript"
MODULES = CLIENTS.parent / "server" / "web" / "nafir"
HERE = Path(__file__).parent

pytestmark = pytest.mark.skipif(NODE is None, reason="no node on the PATH (Debian: apt-get install nodejs)")
needs_npm = pytest.mark.skipif(NPM is None, reason="no npm on the PATH")
needs_packages = pytest.mark.skipif(
    not (PACKAGE / "node_modules").exists(), reason="run npm install in client_examples/javascript"
)


@pytest.fixture(scope="module")
def found(tmp_path_factory) -> dict:
    # Node takes files of a folder with a package.json of this type for modules, and those of the server have none.
    folder = tmp_path_factory.mktemp("modules")
    shutil.copytree(MODULES, folder, dirs_exist_ok=True)
    (folder / "package.json").write_text('{"type": "module"}')
    command = [NODE, HERE / "javascript_driver.mjs", folder, CLIENTS / "vectors" / "vectors.json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_poses_of_three_js_are_the_servers_and_come_back(found):
    assert_same_poses([each["here"] for each in found["poses"]], poses("nafir"))
    assert_same_poses([each["back"] for each in found["poses"]], poses("three"))


def test_binary_messages_are_those_of_the_server(found):
    assert found["listener"] == TABLE["listener"]["hex"]
    assert found["byYaw"] == TABLE["listener"]["hex"]
    assert found["dry"] == [each["hex"] for each in TABLE["dry_blocks"] if each["encoding"] == "f32"]


def test_audio_blocks_are_read_as_the_server_wrote_them(found):
    for block, wanted in zip(found["wet"], TABLE["audio_blocks"], strict=True):
        assert block["sequence"] == wanted["sequence"]
        assert block["sampleClock"] == wanted["sample_clock"]
        assert (block["poseId"], block["reverberationPoseId"]) == (wanted["pose_id"], wanted["reverberation_pose_id"])
        assert block["flags"] == wanted["flags"]
        # A single channel is heard by both ears.
        wanted_channels = np.repeat(wanted["channels"], 2 if len(wanted["channels"]) == 1 else 1, axis=0)
        np.testing.assert_allclose(block["channels"], wanted_channels, atol=1e-7)
        assert block["buffers"] == 1
    assert found["damaged"] == []


def test_a_binding_says_a_pose_once(found):
    assert found["said"] == [["ears", 1, -3, 2], ["trumpet", 4, -6, 5], ["trumpet", 7, -6, 5], ["trumpet", "removed"]]


def _contents(folder: Path) -> dict[str, bytes]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


@needs_npm
def test_what_npm_packs_is_what_the_page_is_built_on(tmp_path):
    command = [NPM, "pack", "--silent", f"--pack-destination={tmp_path}"]
    subprocess.run(command, cwd=PACKAGE, check=True, capture_output=True, timeout=60)
    [packed] = tmp_path.glob("*.tgz")
    with tarfile.open(packed) as archive:
        archive.extractall(tmp_path, filter="data")
    packed_files = _contents(tmp_path / "package" / "src")
    assert packed_files == _contents(MODULES)
    assert {"react.js", "field/field.js"} <= packed_files.keys()

    # Installed elsewhere, its names are found.
    (tmp_path / "user").mkdir()
    (tmp_path / "user" / "package.json").write_text('{"type": "module"}')
    install = [NPM, "install", "--offline", "--no-audit", "--no-fund", str(packed)]
    subprocess.run(install, cwd=tmp_path / "user", check=True, capture_output=True, timeout=60)
    script = """
      import { connect, RefusedError } from "nafir-client";
      import { bind } from "nafir-client/three";
      import { JitterBuffer } from "nafir-client/jitterbuffer.js";
      import { Field } from "nafir-client/field";
      console.log([connect, RefusedError, bind, JitterBuffer, Field].map((each) => typeof each).join());
    """
    done = subprocess.run(
        [NODE, "--input-type=module", "-e", script], cwd=tmp_path / "user", capture_output=True, text=True, check=False
    )
    assert done.stdout.split(",") == ["function"] * 4 + ["function\n"], done.stderr


@needs_packages
def test_types_say_what_the_code_does():
    source = PACKAGE / "types_test.ts"
    options = ["--noEmit", "--strict", "--target", "es2022", "--module", "nodenext", "--skipLibCheck"]
    try:
        shutil.copy(HERE / "javascript_types.ts", source)  # beside the packages that it imports
        done = subprocess.run(
            [PACKAGE / "node_modules" / ".bin" / "tsc", *options, source.name],
            cwd=PACKAGE,
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
    finally:
        source.unlink()
    assert done.returncode == 0, done.stdout

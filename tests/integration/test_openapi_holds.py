"""What /openapi.json says of the server holds: schemathesis asks it by the document, and judges the answers."""

import json
import subprocess
import sys
import urllib.request

import pytest

pytestmark = pytest.mark.untimed

A_SCENE = '[parameters]\n"path.scene" = "flat"\n"path.file" = "arithmetic.onnx"\n'


def schemathesis(address, folder, *, config, examples):
    """Ends by itself; with a seed, so that what fails fails again."""
    (folder / "schemathesis.toml").write_text(config)
    return subprocess.run(
        [
            *(sys.executable, "-m", "schemathesis.cli", "run", f"http://{address}/openapi.json"),
            *("--checks", "all", "--seed", "1", "--max-examples", str(examples), "--no-color"),
            *("--request-timeout", "60", "--max-response-time", "60"),  # on a busy machine
            # Not stateful: sequences of requests follow links, and the document has none.
            *("--phases", "examples,coverage,fuzzing"),
        ],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )


def operations_of(address):
    with urllib.request.urlopen(f"http://{address}/openapi.json", timeout=10) as answer:
        document = json.load(answer)
    return [each for path in document["paths"].values() for each in path.values()]


@pytest.mark.parametrize(
    ("config", "examples"),
    [
        pytest.param("", 5, id="any scene, which there is hardly ever", marks=pytest.mark.long),
        pytest.param(A_SCENE, 10, id="a scene there is, asked more", marks=pytest.mark.long),
        pytest.param(A_SCENE, 3, id="a scene there is"),
    ],
)
def test_the_server_is_as_its_document_says(served, tmp_path, config, examples):
    ran = schemathesis(served, tmp_path, config=config, examples=examples)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    count = len(operations_of(served))
    assert f"{count} selected / {count} total" in ran.stdout


def test_every_refusal_is_told_with_its_type(served):
    operations = operations_of(served)
    assert len(operations) >= 21
    for operation in operations:
        responses = operation["responses"]
        assert {"400", "403", "413", "414", "422", "431", "500", "503"} <= set(responses)
        for status, response in responses.items():
            if status[0] in "45":
                assert set(response["content"]) == {"application/problem+json"}

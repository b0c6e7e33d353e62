"""Strong entity tags (RFC 9110): equal tags mean equal bytes.

A tag that is known before its body is computed has to cover everything the body depends on: the request, the code, the
libraries and the processor. Another processor or another release of a library changes the last bits of a response.
"""

import hashlib
import json
import platform
import sys
from functools import cache
from importlib.metadata import version
from pathlib import Path

import llvmlite.binding as llvm

_COMPUTE = (
    *("numpy", "scipy", "numba", "llvmlite", "onnxruntime"),
    *("netcdf4", "pillow", "pydantic", "sofar", "soxr", "soundfile"),
)
"""Python distributions whose arithmetic or encoding affects the bytes of a body."""
_PACKAGE = Path(__file__).parents[1]


@cache
def fingerprint() -> str:
    """Digest of everything that computes a body: this package's code and data, its libraries, the interpreter and the
    processor."""
    source = hashlib.sha256()
    for path in sorted(_PACKAGE.rglob("*.py")):
        source.update(f"{path.relative_to(_PACKAGE)}\0".encode() + path.read_bytes())
    for path in sorted((_PACKAGE / "rendering" / "hrtf_data").rglob("*")):
        if path.is_file():
            source.update(f"{path.name}\0".encode() + path.read_bytes())
    features = sorted(name for name, has in llvm.get_host_cpu_features().items() if has)
    return _digest(
        [
            version("nafir"),
            source.hexdigest(),
            {name: version(name) for name in _COMPUTE},
            sys.version,
            platform.machine(),
            llvm.get_host_cpu_name(),
            features,
        ]
    )


def computed_tag(*inputs: object) -> str:
    """Tag of a body that this process computes from `inputs` alone. JSON has to be able to hold the inputs."""
    return f'"{_digest([fingerprint(), *inputs])[:32]}"'


def content_tag(body: bytes) -> str:
    """Tag of a body whose inputs cannot be listed beforehand, such as measurements of this host."""
    return f'"{hashlib.sha256(body).hexdigest()[:32]}"'


def _digest(what: object) -> str:
    return hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()

"""Description of the machine that a benchmark ran on."""

import os
import platform
import re
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import llvmlite.binding
from numba.core import config

_INSTRUCTION_SETS = {
    "avx512f": "AVX-512",
    "avx2": "AVX2",
    "avx": "AVX",
    "sse4.2": "SSE4.2",
    "sve": "SVE",
    "neon": "NEON",
}
"""Instruction sets by LLVM's name of the feature, the widest of each family first."""


def describe_machine() -> dict[str, Any]:
    """Properties of the host, for every report. A load above a few tenths makes measurements unreliable."""
    return {
        "processor": processor(),
        "instruction_set": instruction_set(),
        "cores": os.cpu_count(),
        "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "python": platform.python_version(),
        **{name: _version(name) for name in ("numpy", "scipy", "numba", "pedalboard")},
    }


def processor() -> str:
    """Name of the processor."""
    cpuinfo = Path("/proc/cpuinfo")
    names = re.findall(r"^model name\s*: (.*)$", cpuinfo.read_text(), re.MULTILINE) if cpuinfo.exists() else []
    return names[0] if names else platform.processor() or platform.machine()


def instruction_set(features: str | None = None) -> str:
    """The widest instruction set that compiled code uses, by LLVM's `features` ("+avx2,-avx512f,..."). By default these
    are NUMBA_CPU_FEATURES if that is set, or else the processor's."""
    if features is None:
        features = config.CPU_FEATURES
    if features is None:
        features = llvmlite.binding.get_host_cpu_features().flatten()
    usable = {feature[1:] for feature in features.split(",") if feature.startswith("+")}
    return next((name for feature, name in _INSTRUCTION_SETS.items() if feature in usable), platform.machine())


def has_wide_vectors(instructions: str | None = None) -> bool:
    """Whether the goals of AVX-512 hold for these instructions, by default for this processor's, and not those of
    AVX2."""
    return (instructions or instruction_set()) == "AVX-512"


def _version(distribution: str) -> str | None:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return None

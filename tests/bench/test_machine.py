"""Figures name the machine that they were measured on."""

import re
from pathlib import Path

import pytest

from server.bench.machine import describe_machine, instruction_set, processor


@pytest.mark.parametrize(
    ("features", "widest"),
    [
        ("+sse4.2,+avx,+avx2,+avx512f,+avx512bw", "AVX-512"),
        ("+sse4.2,+avx,+avx2,-avx512f", "AVX2"),
        ("-avx2,+avx,+sse4.2", "AVX"),
        ("+neon,-sve", "NEON"),
    ],
)
def test_the_widest_instruction_set_is_named(features, widest):
    assert instruction_set(features) == widest


@pytest.mark.skipif(not Path("/proc/cpuinfo").exists(), reason="the system does not say what the processor has")
def test_the_machine_is_what_the_system_says():
    cpuinfo = Path("/proc/cpuinfo").read_text()
    if flags := re.search(r"^flags\s*: (.*)$", cpuinfo, re.MULTILINE):
        known = flags[1].split()
        expected = "AVX-512" if "avx512f" in known else "AVX2" if "avx2" in known else instruction_set()
        assert instruction_set() == expected
    assert processor()
    machine = describe_machine()
    assert (machine["processor"], machine["instruction_set"]) == (processor(), instruction_set())

"""Responses in the layout of the compiled convolver: what an exchange may leave out, and what callers may hand in."""

import numpy as np
import pytest

from server.rendering.packed_filter import pack
from server.rendering.partitions import Partitioning

SAMPLES = 6000
PARTITIONING = Partitioning(64, 8000)


@pytest.fixture
def ir(rng):
    return rng.standard_normal((2, SAMPLES)).astype(np.float32)


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def digests(samples):
    return [of_stage.tolist() for of_stage in pack(samples, PARTITIONING).digests]


def test_zeros_at_the_end_are_no_difference(ir):
    longer = np.pad(ir, ((0, 0), (0, 1500)))
    for short, long in zip(digests(ir), digests(longer), strict=True):
        assert long[: len(short)] == short


def test_rows_of_an_odd_length_are_no_difference(ir):
    """The second row then begins at no multiple of eight bytes."""
    odd = np.ascontiguousarray(ir[:, :-1])
    ir[:, -1] = 0
    assert digests(odd) == digests(ir)


@pytest.mark.parametrize("samples", [1, 511, 512, SAMPLES - 1, 8000])
def test_energies_are_sums_of_squares_of_the_samples_of_each_stage(rng, samples):
    ir = rng.standard_normal((2, samples)).astype(np.float32)
    expected = [np.sum(ir[:, stage.start : stage.end].astype(np.float64) ** 2) for stage in PARTITIONING.stages]
    packed = pack(ir, PARTITIONING)
    np.testing.assert_allclose(packed.energies, expected, rtol=1e-12)
    early = pack(0.5 * ir[:, :512], PARTITIONING, packed, 512)
    np.testing.assert_allclose(early.energies, [0.25 * expected[0], *expected[1:]], rtol=1e-12)


@pytest.mark.parametrize("at", [0, 63, 64, 511, 512, 4000, SAMPLES - 1])
def test_one_sample_is_a_difference_in_its_partition_alone(ir, at):
    other = ir.copy()
    other[1, at] = -other[1, at]
    different = [
        (stage.start + number * stage.size, stage.size)
        for stage, before, after in zip(PARTITIONING.stages, digests(ir), digests(other), strict=True)
        for number in range(len(before))
        if before[number] != after[number]
    ]
    assert len(different) == 1
    ((begin, size),) = different
    assert begin <= at < begin + size


def test_signs_of_every_other_sample_are_a_difference(ir):
    """Such changes cancel in a digest that does not mix the highest bit of a word."""
    for every in (1, 2, 4):
        other = ir.copy()
        other[:, ::every] *= -1
        for before, after in zip(digests(ir), digests(other), strict=True):
            assert not set(before) & set(after)


def test_channels_that_change_places_are_a_difference(ir):
    for before, after in zip(digests(ir), digests(ir[::-1]), strict=True):
        assert not set(before) & set(after)


@pytest.mark.parametrize("kind", ["read only", "of every other sample", "double precision", "of the other order"])
def test_any_kind_of_array_is_packed_alike(ir, kind):
    given = {
        "read only": ir.copy(),
        "of every other sample": np.repeat(ir, 2, axis=1)[:, ::2],
        "double precision": ir.astype(np.float64),
        "of the other order": np.asfortranarray(ir),
    }[kind]
    if kind == "read only":
        given.flags.writeable = False
    packed, expected = pack(given, PARTITIONING), pack(ir, PARTITIONING)
    for one, other in zip(packed.spectra, expected.spectra, strict=True):
        np.testing.assert_array_equal(one, other)
    assert digests(given) == digests(ir)


def test_what_is_taken_over_is_not_made_again(ir):
    first = pack(ir, PARTITIONING)
    begin = PARTITIONING.stages[1].start
    other = ir.copy()
    other[:, :begin] *= 0.5
    second = pack(other, PARTITIONING, first, begin)
    assert second.spectra[1] is first.spectra[1]
    for one, whole in zip(second.spectra, pack(other, PARTITIONING).spectra, strict=True):
        np.testing.assert_array_equal(one, whole)
    whole = pack(ir, PARTITIONING, first, 0)
    assert all(one is of_first for one, of_first in zip(whole.spectra, first.spectra, strict=True))
    assert whole.header.tolist() == first.header.tolist()

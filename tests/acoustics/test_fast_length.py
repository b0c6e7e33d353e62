"""Lengths that transforms are fast at are SciPy's."""

from scipy.fft import next_fast_len

from server.acoustics.fast_length import next_fast_length


def test_the_next_fast_length_is_scipys():
    for samples in [*range(1, 5_000), 65_535, 65_537, 99_999, 1_000_001]:
        assert next_fast_length(samples) == next_fast_len(samples, real=True)

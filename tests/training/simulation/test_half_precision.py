import numpy as np

from training.simulation.half_precision import to_half

LARGEST = np.finfo(np.float16).max


def bits(values):
    return np.asarray(values).view(np.uint16)


def test_every_half_stays_what_it_is():
    everything = np.arange(2**16, dtype=np.uint16).view(np.float16)
    numbers = everything[~np.isnan(everything)]
    np.testing.assert_array_equal(bits(to_half(numbers.astype(np.float32))), bits(numbers))


def test_what_lies_between_is_rounded_as_numpy_rounds():
    finite = np.arange(0x7C00, dtype=np.uint16).view(np.float16).astype(np.float32)
    middle = (finite[:-1] + finite[1:]) / 2
    around = np.concatenate([middle, np.nextafter(middle, 0), np.nextafter(middle, np.float32(np.inf)), -middle])
    np.testing.assert_array_equal(bits(to_half(around)), bits(around.astype(np.float16)))


def test_numbers_too_large_are_infinite_and_no_number_stays_none():
    too_large = np.float32(65520)  # halfway from the largest to the next power of two
    values = np.array([1e30, -1e30, np.inf, too_large, np.nextafter(too_large, np.float32(0))], dtype=np.float32)
    np.testing.assert_array_equal(to_half(values), [np.inf, -np.inf, np.inf, np.inf, LARGEST])
    assert np.isnan(to_half(np.array([np.nan], dtype=np.float32))).all()

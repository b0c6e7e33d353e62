import numpy as np
import pytest

from server.acoustics.codec import Codec
from training.models.whole_transform import transform_at_once


@pytest.mark.parametrize(("n_fft", "samples"), [(256, 9600), (512, 8001), (64, 300)])
def test_it_is_the_codecs_transform(n_fft, samples):
    codec = Codec(24_000, n_fft, n_fft // 4, samples, 1e-5)
    signal = np.random.default_rng(0).standard_normal((3, 2, samples))
    expected = codec.transform(signal)
    np.testing.assert_allclose(transform_at_once(codec, signal), expected, atol=1e-12)
    single = transform_at_once(codec, signal.astype(np.float32))
    assert single.dtype == np.complex64
    np.testing.assert_allclose(single, expected, atol=1e-4)

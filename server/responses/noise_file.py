"""The file of the noises behind ambisonic responses, for clients that compute these by themselves."""

import io

import numpy as np

from server.acoustics.spherical_harmonics import harmonic_count
from server.field.ambisonic_noise import even_noises
from server.field.field import AcousticField


def noise_file(field: AcousticField, order: int) -> bytes:
    """The noises (k, sample) of a field's ambisonic channels of an order, of unit variance, as float32 in a file for
    NumPy."""
    manifest = field.bundle.manifest
    file = manifest.fields.get(field.level.field)
    codec = manifest.codec if file is None or file.codec is None else file.codec
    buffer = io.BytesIO()
    noises = even_noises(codec.sample_rate, codec.samples, harmonic_count(order))
    np.save(buffer, noises.astype("<f4"), allow_pickle=False)
    return buffer.getvalue()

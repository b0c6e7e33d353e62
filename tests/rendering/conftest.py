from functools import cache

import numpy as np
import pytest

from server.rendering.direct_path import DirectPath
from server.rendering.hrtf import KEMAR, HeadFilters, Hrtf
from server.rendering.sphere import triangulate

SPEED_OF_SOUND = 343.0


@pytest.fixture(scope="session")
def kemar() -> Hrtf:
    return Hrtf.read(KEMAR, 24_000)


@pytest.fixture(scope="session")
def kemar_at():
    """Of a sample rate, the responses and the filters."""

    @cache
    def at(sample_rate: int) -> tuple[Hrtf, HeadFilters]:
        hrtf = Hrtf.read(KEMAR, sample_rate)
        return hrtf, HeadFilters.from_hrtf(hrtf)

    return at


def no_head(sample_rate: int, taps: int) -> HeadFilters:
    """What a microphone hears: no filter and no delay."""
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    cepstra, delays_s = np.zeros((6, 2, taps), np.float32), np.zeros((6, 2))
    return HeadFilters(sample_rate, axes, cepstra, delays_s, triangulate(axes))


class MeasuredPath(DirectPath):
    """A direct path that a response can be taken of, at rest."""

    def __init__(self, **settings):
        super().__init__(**settings)
        self._settings = settings

    def impulse_response(self, target, orientation, samples):
        """(2, samples); sample 0 is emission."""
        alone = DirectPath(**(self._settings | {"slots": 1}))
        alone.set_target(0, target)
        alone.set_orientation(orientation)
        impulse = np.zeros((-(-samples // self.block_size), 1, self.block_size), np.float32)
        impulse[0, 0, 0] = 1
        heard = np.zeros((2, impulse.size), np.float32)
        for number, block in enumerate(impulse):
            alone.process(block, heard[:, number * self.block_size : (number + 1) * self.block_size])
        return heard[:, :samples]


@pytest.fixture
def headless():
    return no_head


@pytest.fixture
def make_path(kemar_at):
    def make(*, head=True, slots=1, block_size=256, sample_rate=48_000, taps=64, air_db_per_m=0.0, **rest):
        filters = kemar_at(sample_rate)[1] if head else no_head(sample_rate, taps)
        return MeasuredPath(
            slots=slots,
            block_size=block_size,
            sample_rate=sample_rate,
            filters=filters,
            speed_of_sound=SPEED_OF_SOUND,
            air_db_per_m=np.full(7, air_db_per_m) if np.ndim(air_db_per_m) == 0 else air_db_per_m,
            **rest,
        )

    return make

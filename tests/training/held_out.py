"""Held-out pairs whose responses are known in closed form, without a simulation."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from training.baselines.baselines import TrainingPairs
from training.baselines.held_out import HeldOut

RATE = 8_000
SAMPLES = 4_000

Responses = npt.NDArray[np.float64]
Take = Callable[[int], Responses]


class Takes:
    """Responses by pair from a function of the pair's number."""

    def __init__(self, take: Take) -> None:
        self._take = take

    def __getitem__(self, pair: int) -> Responses:
        return self._take(pair)


def held_out_in(
    folder: Path,
    take: Take,
    *,
    repeat: Take | None = None,
    pairs: int = 8,
    held_out: tuple[int, ...] = (1, 3, 5),
    yaws: int = 1,
    visible: tuple[bool, ...] | None = None,
    spacing_m: float = 1.0,
) -> HeldOut:
    """Pairs on a line, one emitter and a listener per metre; those in `held_out` are."""
    listeners = np.column_stack([spacing_m * (1.0 + np.arange(pairs)), np.zeros(pairs), np.full(pairs, 1.5)])
    training = ~np.isin(np.arange(pairs), held_out)
    first = take(0)
    return HeldOut(
        folder=folder,
        name="line",
        sample_rate=RATE,
        samples=first.shape[-1],
        channels=first.shape[-2],
        pairs=TrainingPairs(
            Takes(take), np.arange(pairs), np.zeros(pairs, int), listeners, np.array([[0.0, 0.0, 1.5]]), training
        ),
        held_out=np.array(held_out),
        repeats=None if repeat is None else Takes(repeat),
        delays_s=listeners[:, 0] / 343.0,
        yaws=2 * np.pi * np.arange(yaws) / yaws,
        yaw_indices=np.arange(yaws),
        visible=np.ones(len(held_out), bool) if visible is None else np.array(visible),
        simulated=None,
    )


@pytest.fixture
def make_held_out(tmp_path: Path) -> Callable[..., HeldOut]:
    """`held_out_in` the folder of the test."""
    return partial(held_out_in, tmp_path)

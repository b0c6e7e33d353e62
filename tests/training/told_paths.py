"""Paths as a field is told of them, in tests."""

import tomllib
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

from server.acoustics.geometry import FloorPlan
from server.acoustics.sound_path import PlanPathFinder

_GEOMETRY = tomllib.loads((Path(__file__).parents[1] / "data" / "tiny.toml").read_text())["geometry"]
TINY = FloorPlan(tuple((x, y) for x, y in _GEOMETRY["corners"]), _GEOMETRY["height_m"])
"""The plan of the scene that most tests simulate."""


def in_tiny(listeners: npt.NDArray[np.floating], emitters: npt.NDArray[np.floating]) -> npt.NDArray[np.float32]:
    """(B, DESCRIPTION) the paths of pairs in that scene."""
    return PlanPathFinder(TINY, 343.0).describe(listeners, emitters).described


def told_paths(plan: FloorPlan, listener: torch.Tensor, emitter: torch.Tensor) -> torch.Tensor:
    """(B, DESCRIPTION)"""
    paths = PlanPathFinder(plan, 343.0).describe(np.asarray(listener), np.asarray(emitter))
    return torch.from_numpy(paths.described)

"""A small scene whose field is arithmetic, not a network: exact and instant."""

from pathlib import Path

import numpy as np
import pytest

from server.scene.bundle import Bundle
from server.scene.geometry import Geometry, Material, Materials
from server.scene.manifest import Bounds, CodecParameters, FieldFile, Manifest, QualityLevel, Start

PLAIN = Material(absorption=(0.2,) * 7, scattering=(0.1,) * 7)


class ArithmeticField:
    """IRs that depend on every coordinate: decaying noise, louder nearby, and louder in the ear on that side."""

    channels = 2

    def __init__(self, bundle: Bundle) -> None:
        self.bundle = bundle
        self.level = bundle.manifest.levels[0]
        self.sample_rate = bundle.manifest.codec.sample_rate
        self.ir_samples = bundle.manifest.codec.samples
        decay = np.exp(-np.arange(self.ir_samples) / (0.05 * self.sample_rate))
        self._tail = np.random.default_rng(7).standard_normal((2, self.ir_samples)) * decay * 0.1
        self.calls: list[int] = []

    def impulse_responses(self, listeners, emitters, yaws):
        listeners, emitters, yaws = (np.asarray(value, np.float64) for value in (listeners, emitters, yaws))
        self.calls.append(len(yaws))
        offset = emitters - listeners
        distance = np.maximum(np.linalg.norm(offset, axis=-1), 0.2)
        bearing = np.arctan2(offset[:, 1], offset[:, 0]) - yaws
        ears = np.stack([1 + 0.8 * np.sin(bearing), 1 - 0.8 * np.sin(bearing)], axis=-1) / distance[:, None]
        return (ears[..., None] * self._tail).astype(np.float32)


def make_manifest(identifier: str = "flat") -> Manifest:
    return Manifest(
        id=identifier,
        name="A flat",
        geometry=Geometry(
            height_m=2.8,
            corners=((0, 0), (8, 0), (8, 5), (0, 5)),
            materials=Materials(walls=PLAIN, floor=PLAIN, ceiling=PLAIN),
        ),
        bounds=Bounds(minimum=(0.3, 0.3, 0.5), maximum=(7.7, 4.7, 2.3)),
        speed_of_sound=343.0,
        start=Start(listener=(2.0, 2.5, 1.5), listener_yaw_deg=90.0, emitter=(6.0, 3.0, 1.5)),
        codec=CodecParameters(
            sample_rate=24_000, n_fft=512, hop=128, samples=4_000, lead_samples=64, known_frames=4, log_floor=1e-3
        ),
        fields={"arithmetic": FieldFile(file="arithmetic.onnx", architecture="arithmetic", rank=1)},
        levels=(QualityLevel(name="standard", field="arithmetic"),),
        files={"arithmetic.onnx": "0" * 64, "arrays.npz": "0" * 64},
    )


@pytest.fixture
def field() -> ArithmeticField:
    manifest = make_manifest()
    noise = np.zeros((2, manifest.codec.samples), np.float32)
    return ArithmeticField(Bundle(Path("flat"), manifest, "d1" * 32, {}, noise))

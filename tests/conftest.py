"""A small scene whose field is arithmetic written as an ONNX graph: no training, and what it should say is known.

Sound decays, is louder nearby (1 / distance), and louder in the ear on its side.
"""

import gc
import io
import os
import sys
from collections.abc import Iterator, Sequence
from itertools import zip_longest
from pathlib import Path

# Before NumPy is imported. The waiting threads of its products and torch's would take the time of other workers.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

# isort: split
import numpy as np
import onnx
import pytest
from hypothesis import settings
from onnx import TensorProto, helper, numpy_helper

from server.assets.hrtfs import DEFAULT_HRTF, HrtfLibrary
from server.field.field import AcousticField
from server.field.fields_by_level import FieldsByLevel
from server.rendering.hrtf import HeadFilters
from server.runtime import memory
from server.scene.bundle import Bundle, write_bundle
from server.scene.geometry import Geometry, Material, Materials, Opening
from server.scene.manifest import Bounds, CodecParameters, FieldFile, Manifest, QualityLevel, Reuse, Start

# How long an example takes depends on what else the machine does.
settings.register_profile("shared machine", deadline=None)
settings.load_profile("shared machine")

_COMPUTING = (
    "training/bundling/test_export.py",
    "training/simulation/",
    "training/bundling/",
    "training/",
    "streaming/",
    "scene/",
    "cli/",
)
"""Files that take long, by how their names begin, in this order: what begins last should be short. The first makes the
bundle for which others of its folder would wait, if they came next."""
_WAITING = ("page/", "integration/", "clients/", "api/", "soak/")
"""Files that take long as well, but wait: for browsers, for sound and for time to pass."""


@pytest.hookimpl(tryfirst=True, optionalhook=True)
def pytest_xdist_auto_num_workers() -> int | None:
    """Twice as many as there are cores: for a third of the time tests wait, for browsers and for sound to pass.
    PYTEST_XDIST_AUTO_NUM_WORKERS says otherwise."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return None if "PYTEST_XDIST_AUTO_NUM_WORKERS" in os.environ else 2 * cores


def pytest_sessionstart(session: pytest.Session) -> None:
    """Before workers start, what they would all compile is compiled."""
    if session.config.getoption("dist", "no") != "no" and not hasattr(session.config, "workerinput"):
        from tests.compiling import compile_kernels

        compile_kernels()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    names = {path: path.relative_to(Path(__file__).parent).as_posix() for path in {item.path: None for item in items}}
    turn = {name: number for number, name in enumerate(in_turn(list(names.values())))}
    items.sort(key=lambda item: turn[names[item.path]])


@pytest.hookimpl(wrapper=True)
def pytest_collection(session: pytest.Session) -> Iterator[None]:  # noqa: ARG001  pytest looks for the name
    """What all tests have imported stays: the collector of garbage looks through it neither while it comes, which takes
    a fifth of that time, nor later, half a second each time."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def in_turn(names: Sequence[str]) -> list[str]:
    """Names of files in the order in which they begin. Those that take long come first, one that computes and one that
    waits by turns: while some workers wait, others have the cores."""
    computing, waiting = (
        [name for start in starts for name in names if start == next(filter(name.startswith, starts), None)]
        for starts in (_COMPUTING, _WAITING)
    )
    long = [name for couple in zip_longest(computing, waiting) for name in couple if name is not None]
    return [*long, *(name for name in names if not name.startswith(_COMPUTING + _WAITING))]


CODEC = CodecParameters(
    sample_rate=24_000, n_fft=256, hop=64, samples=4_000, lead_samples=64, known_frames=4, log_floor=1e-3
)
PLAIN = Material(absorption=(0.2,) * 7, scattering=(0.1,) * 7)
MANIFEST = Manifest(
    id="flat",
    name="A flat",
    geometry=Geometry(
        height_m=2.8,
        corners=((0, 0), (8, 0), (8, 5), (0, 5)),
        openings=(Opening(name="middle", start=(4.0, 1.0), end=(4.0, 4.0)),),
        materials=Materials(walls=PLAIN, floor=PLAIN, ceiling=PLAIN),
    ),
    bounds=Bounds(minimum=(0.3, 0.3, 0.5), maximum=(7.7, 4.7, 2.3)),
    speed_of_sound=343.0,
    start=Start(listener=(2.0, 2.5, 1.5), listener_yaw_deg=90.0, emitter=(6.0, 3.0, 1.5)),
    codec=CODEC,
    fields={"arithmetic": FieldFile(file="arithmetic.onnx", architecture="arithmetic", rank=1)},
    levels=(QualityLevel(name="standard", field="arithmetic"),),
    files={"arithmetic.onnx": "0" * 64, "arrays.npz": "0" * 64},
)


def arithmetic_graph() -> bytes:
    bins, frames, known = CODEC.codec.bins, CODEC.codec.frames, CODEC.known_frames
    decay = np.linspace(-1.0, -8.0, frames, dtype=np.float32)[None, None, None] * np.ones((1, 1, bins, 1), np.float32)
    constants = {
        "decay": decay,
        "zero": np.float32(0),
        "one": np.float32(1),
        "reach": np.float32(0.2),
        "side_strength": np.float32(0.8),
        "axis": np.array([1]),
        "column": np.array([-1, 1]),
        "cube": np.array([-1, 1, 1, 1]),
        "ears": np.array([-1, 2, 1, 1]),
        "no_phase": np.zeros((1, 2, bins, known), np.float32),
        "no_coherence": np.zeros((1, 2, bins, frames), np.float32),
        "x": np.array([0]),
        "y": np.array([1]),
    }
    steps = [
        ("Sub", ["emitter", "listener"], "offset"),
        ("ReduceL2", ["offset", "axis"], "range"),
        ("Add", ["range", "reach"], "distance"),
        ("Log", ["distance"], "log_distance"),
        ("Reshape", ["log_distance", "cube"], "attenuation"),
        ("Gather", ["offset", "x"], "east"),
        ("Gather", ["offset", "y"], "north"),
        ("Reshape", ["yaw", "column"], "heading"),
        ("Sin", ["heading"], "sine"),
        ("Cos", ["heading"], "cosine"),
        ("Mul", ["north", "cosine"], "north_part"),
        ("Mul", ["east", "sine"], "east_part"),
        ("Sub", ["north_part", "east_part"], "leftward"),
        ("Div", ["leftward", "distance"], "side"),
        ("Mul", ["side", "side_strength"], "left_excess"),
        ("Neg", ["left_excess"], "right_excess"),
        ("Concat", ["left_excess", "right_excess"], "excess"),
        ("Add", ["excess", "one"], "ear_gain"),
        ("Log", ["ear_gain"], "log_ear_gain"),
        ("Reshape", ["log_ear_gain", "ears"], "ear_level"),
        ("Sub", ["ear_level", "attenuation"], "level"),
        ("Add", ["level", "decay"], "log_magnitude"),
        ("Mul", ["attenuation", "zero"], "nothing"),
        ("Add", ["nothing", "no_phase"], "instantaneous_frequency"),
        ("Add", ["nothing", "no_phase"], "phase_certainty"),
        ("Add", ["nothing", "no_coherence"], "interaural_coherence"),
    ]
    attributes = {"Gather": {"axis": 1}, "Concat": {"axis": 1}, "ReduceL2": {"keepdims": 1}}
    nodes = [helper.make_node(kind, inputs, [output], **attributes.get(kind, {})) for kind, inputs, output in steps]
    shapes = {
        "log_magnitude": [bins, frames],
        "instantaneous_frequency": [bins, known],
        "phase_certainty": [bins, known],
        "interaural_coherence": [bins, frames],
    }
    graph = helper.make_graph(
        nodes,
        "arithmetic",
        [
            helper.make_tensor_value_info("listener", TensorProto.FLOAT, ["B", 3]),
            helper.make_tensor_value_info("emitter", TensorProto.FLOAT, ["B", 3]),
            helper.make_tensor_value_info("yaw", TensorProto.FLOAT, ["B"]),
        ],
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["B", 2, *shape]) for name, shape in shapes.items()],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    onnx.checker.check_model(model)
    return model.SerializeToString()


def write_flat(folder: Path, manifest: Manifest) -> Bundle:
    noise = io.BytesIO()
    np.savez(noise, frozen_noise=np.random.default_rng(7).standard_normal((2, CODEC.samples), dtype=np.float32))
    return write_bundle(folder, manifest, {"arithmetic.onnx": arithmetic_graph(), "arrays.npz": noise.getvalue()})


@pytest.fixture(autouse=True, scope="session")
def _settings_of_servers():
    """Servers that tests begin let in Starlette's test client, by its name, and refuse nobody because other tests take
    the processor. A test may set otherwise."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("NAFIR_ALLOWED_HOSTS", "testserver")
        patch.setenv("NAFIR_ADMISSION", "false")
        yield


@pytest.fixture(autouse=True, scope="session")
def _collections_of_servers() -> Iterator[None]:
    """Servers within this process neither look through all that the tests have loaded when they begin, nor have it
    looked through again once they end."""
    with pytest.MonkeyPatch.context() as patch:
        if (app := sys.modules.get("server.api.app")) is not None:
            patch.setattr(app, "collect_rarely", lambda: gc.set_threshold(*memory._RARE_COLLECTIONS))
            patch.setattr(app, "collect_as_usual", lambda: gc.set_threshold(*memory._USUAL_COLLECTIONS))
        yield


@pytest.fixture(scope="session")
def bundle(tmp_path_factory) -> Bundle:
    return write_flat(tmp_path_factory.mktemp("scenes") / "flat", MANIFEST)


@pytest.fixture
def field(bundle) -> AcousticField:
    return AcousticField.load(bundle)


@pytest.fixture(scope="session")
def mirrored_bundle(tmp_path_factory) -> Bundle:
    """The same scene, whose field leaves the first reflections to geometry."""
    return write_flat(tmp_path_factory.mktemp("scenes") / "flat", MANIFEST.model_copy(update={"image_order": 1}))


@pytest.fixture
def mirrored_field(mirrored_bundle) -> AcousticField:
    return AcousticField.load(mirrored_bundle)


MEASURED = MANIFEST.model_copy(
    update={
        "id": "measured",
        "name": "A measured place",
        "geometry": None,
        "direct_sound": "field",
        "channels": ("mono",),
        "bounds": Bounds(minimum=(-0.2, -0.2, -0.1), maximum=(1.8, 1.0, 0.1)),
        "start": Start(listener=(0.0, 0.4, 0.0), emitter=(1.5, 0.4, 0.0)),
        "fields": {"measured": FieldFile(file="measured.onnx", architecture="measured")},
        "levels": (QualityLevel(name="standard", field="measured"),),
        "files": {"measured.onnx": "0" * 64, "arrays.npz": "0" * 64},
    }
)


def measured_response() -> np.ndarray:
    """(sample,) aligned, heard at one metre: a smooth pulse as the direct sound, then a diffuse tail."""
    after = np.arange(CODEC.samples) - CODEC.lead_samples
    pulse = np.exp(-0.5 * (after / 3.0) ** 2)
    tail = 0.05 * np.random.default_rng(8).standard_normal(CODEC.samples) * np.exp(-np.maximum(after, 0) / 600.0)
    return (pulse + np.where(after > 0.004 * CODEC.sample_rate, tail, 0.0)).astype(np.float32)


def measured_graph() -> bytes:
    """Answers with `measured_response`, louder nearby (1 / distance)."""
    floats = TensorProto.FLOAT
    poses = [helper.make_tensor_value_info(name, floats, ["B", 3]) for name in ("listener", "emitter")]
    graph = helper.make_graph(
        [
            helper.make_node("Sub", ["emitter", "listener"], ["offset"]),
            helper.make_node("ReduceL2", ["offset", "axis"], ["range"]),
            helper.make_node("Max", ["range", "nearest"], ["distance"]),
            helper.make_node("Reshape", ["distance", "cube"], ["spread"]),
            helper.make_node("Div", ["response", "spread"], ["impulse_response"]),
        ],
        "measured",
        [*poses, helper.make_tensor_value_info("yaw", floats, ["B"])],
        [helper.make_tensor_value_info("impulse_response", floats, ["B", 1, CODEC.samples])],
        [
            numpy_helper.from_array(measured_response()[None, None], "response"),
            numpy_helper.from_array(np.array([1]), "axis"),
            numpy_helper.from_array(np.array([-1, 1, 1]), "cube"),
            numpy_helper.from_array(np.float32(0.1), "nearest"),
        ],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    onnx.checker.check_model(model)
    return model.SerializeToString()


@pytest.fixture(scope="session")
def measured_bundle(tmp_path_factory) -> Bundle:
    """A scene as it is measured: one microphone, the direct sound in the responses, and no walls known."""
    noise = io.BytesIO()
    np.savez(noise, frozen_noise=np.zeros((2, CODEC.samples), np.float32))
    files = {"measured.onnx": measured_graph(), "arrays.npz": noise.getvalue()}
    return write_bundle(tmp_path_factory.mktemp("scenes") / "measured", MEASURED, files)


@pytest.fixture
def field_at_nodes(mirrored_bundle) -> AcousticField:
    """It reuses responses, without their first reflections."""
    return at_nodes(mirrored_bundle, first_reflections="pose")


@pytest.fixture
def whole_at_nodes(mirrored_bundle) -> AcousticField:
    """It reuses responses together with their first reflections."""
    return at_nodes(mirrored_bundle, first_reflections="node")


def at_nodes(bundle: Bundle, **reuse: object) -> AcousticField:
    level = QualityLevel(name="at-nodes", field="arithmetic", reuse=Reuse(spacing_m=0.8, turn_deg=45, **reuse))
    return AcousticField(bundle, level, AcousticField.load(bundle).graph)


@pytest.fixture
def levels(field) -> FieldsByLevel:
    """The scene's only level, whose field is `field`."""
    return FieldsByLevel([field])


@pytest.fixture(scope="session")
def hrtfs() -> HrtfLibrary:
    """KEMAR at the scene's rate."""
    return HrtfLibrary((), [CODEC.sample_rate])


@pytest.fixture(scope="session")
def filters(hrtfs) -> HeadFilters:
    return hrtfs.filters(DEFAULT_HRTF, CODEC.sample_rate)


@pytest.fixture(scope="session")
def server() -> Iterator[str]:
    """Address of `nafir serve` with two of its scenes, for all tests of the page that leave it as it was."""
    from tests import visitor  # without playwright, importing it skips what asks for it

    scenes = ("apartment", "open-field")
    with visitor.serving(visitor.free_port(), scenes=scenes, costs_after_s=5.0) as url:
        yield url


@pytest.fixture
def bundle_copy(bundle, tmp_path) -> Path:
    """The bundle's folder, to damage."""
    folder = tmp_path / "copy"
    folder.mkdir()
    for path in bundle.folder.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    return folder

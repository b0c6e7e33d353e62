"""Graphs in eight bits: weights have a scale per column, what they are multiplied by has one per call. A field with
random weights, whose numbers fill the scales as those of a trained one do."""

from itertools import product

import numpy as np
import onnx
import pytest
import torch
from onnx import helper, numpy_helper

from server.acoustics.codec import Codec
from server.acoustics.geometry import FloorPlan
from server.acoustics.sound_path import PlanPathFinder
from server.field.graph import INPUTS, OUTPUTS, PATH
from server.field.runtime import open_session
from training.bundling.graphs import to_int8, to_onnx
from training.models.cells import Cells
from training.models.encoders import FieldShape
from training.models.factorised import ExportedField, FactorisedField
from training.models.site import Extent

PLAN = FloorPlan(((0.0, 0.0), (4.0, 0.0), (4.0, 3.0), (0.0, 3.0)), 2.5)
EXTENT = Extent.of_plan(PLAN)
DB = 20 / np.log(10)

# The field's levels vary by 0.73 dB from pose to pose: a bound above that would let a field pass that says nothing.
NEARLY_DB = 0.5


@pytest.fixture(scope="module")
def graphs():
    """The same field in 32 bits and in eight, and in eight with one weight a thousand times the others."""
    torch.manual_seed(3)
    cells = Cells(Codec(8_000, 256, 64, 2_000, 1e-5), fine_frames=8, known_frames=1)
    shape = FieldShape(rank=8, width=32, depth=2, grid_spacing_m=1.0, grid_features=4)
    field = FactorisedField(EXTENT, cells, shape)
    with torch.no_grad():
        field.mean[field.heads.slices["fine"]] = -3.0
        field.mean[field.heads.slices["late"]] = -6.0
    poses = tuple(torch.from_numpy(part[:2]) for part in scattered(2))
    plain = to_onnx(ExportedField(field, cells).eval(), poses, OUTPUTS, inputs=(*INPUTS, PATH))
    uneven = onnx.ModelProto()
    uneven.CopyFrom(plain)
    (basis,) = [tensor for tensor in uneven.graph.initializer if tensor.name == "_basis"]
    weights = numpy_helper.to_array(basis).copy()
    weights[3, field.heads.slices["fine"].start + 70] *= 1_000.0
    basis.CopyFrom(numpy_helper.from_array(weights, basis.name))
    return [
        open_session(model.SerializeToString())
        for exact in (plain, uneven)
        for model in (exact, to_int8(exact, least_weights=weights.size))
    ]


def scattered(count):
    rng = np.random.default_rng(count)
    ends = [rng.uniform((0.0, 0.0, 1.0), (4.0, 3.0, 2.0), (count, 3)) for _ in range(2)]
    return told(*ends, rng.uniform(-np.pi, np.pi, count))


def told(listeners, emitters, yaws):
    """Poses as the graph's inputs."""
    paths = PlanPathFinder(PLAN, 343.0).describe(listeners, emitters).described
    return [part.astype(np.float32) for part in (listeners, emitters, yaws, paths)]


def corners():
    ends = np.array(list(product((0.0, 4.0), (0.0, 3.0), (1.0, 2.0))), np.float32)
    pairs = np.array(list(product(range(8), range(8))))
    return told(ends[pairs[:, 0]], ends[pairs[:, 1]], np.linspace(-np.pi, np.pi, 64))


def levels(session, poses):
    """Logarithms of magnitude, with all outputs finite."""
    outputs = session.run(list(OUTPUTS), dict(zip((*INPUTS, PATH), poses, strict=True)))
    assert all(np.isfinite(output).all() for output in outputs)
    return outputs[0].astype(float)


def root_mean_square(values):
    return float(np.sqrt(np.mean(values**2)))


@pytest.mark.parametrize("poses", [pytest.param(scattered(64), id="anywhere"), pytest.param(corners(), id="corners")])
def test_eight_bits_say_nearly_what_thirty_two_do(graphs, poses, measured):
    exact, small, _, _ = graphs
    error = root_mean_square(levels(small, poses) - levels(exact, poses))
    measured("error of levels", DB * error, NEARLY_DB, "dB")


def test_one_weight_that_fills_its_scale_spoils_its_own_column_alone(graphs, measured):
    """With one scale for all, the others would have none of the 256 steps left."""
    _, _, exact, small = graphs
    error = levels(small, scattered(64)) - levels(exact, scattered(64))
    by_output = np.sqrt(np.mean(error**2, axis=0))
    measured("median error of levels", DB * float(np.median(by_output)), 0.1, "dB")
    assert np.isfinite(by_output).all()


def test_a_product_of_few_weights_is_computed_exactly():
    rng = np.random.default_rng(5)
    weights, given = (rng.standard_normal((8, 8)).astype(np.float32) for _ in range(2))
    ends = [helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, [8, 8]) for name in ("given", "told")]
    product = helper.make_node("MatMul", ["given", "weights"], ["told"], name="product")
    graph = helper.make_graph(
        [product], "one product", ends[:1], ends[1:], [numpy_helper.from_array(weights, "weights")]
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)

    def told(least_weights):
        session = open_session(to_int8(model, least_weights=least_weights).SerializeToString())
        return session.run(None, {"given": given})[0]

    exact = open_session(model.SerializeToString()).run(None, {"given": given})[0]
    np.testing.assert_array_equal(told(weights.size + 1), exact)
    assert np.abs(told(weights.size) - exact).max() > 1e-4


@pytest.mark.parametrize("where_m", [50.0, 1e3, 1e6])
def test_a_pose_that_saturates_the_scale_of_a_call_leaves_numbers(graphs, where_m):
    """No client may ask for it."""
    _, small, _, _ = graphs
    poses = scattered(8)
    poses[0][5] = where_m
    levels(small, poses)


def test_what_else_is_asked_in_a_call_changes_levels_by_less_than_is_heard(graphs, measured):
    _, small, _, _ = graphs
    poses = scattered(32)
    together = levels(small, poses)
    for row in (0, 9, 31):
        alone = levels(small, [part[row : row + 1] for part in poses])[0]
        measured("change of levels", DB * root_mean_square(together[row] - alone), NEARLY_DB, "dB")

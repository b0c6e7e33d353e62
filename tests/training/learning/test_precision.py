"""What a GPU computes in bfloat16 and compiled is what a processor computes."""

import numpy as np
import pytest
import torch

from training.learning.precision import autocast, bfloat16_gains, compiled
from training.models.local_geometry import GaussianGrid
from training.models.naf import Naf, NafShape
from training.models.site import Site
from training.sight.nerf import Radiance
from training.simulation.responses import SimulatedResponses

CPU, GPU = torch.device("cpu"), torch.device("cuda", 0)


@pytest.fixture
def traced(monkeypatch):
    """`torch.compile` traces in one piece, as for a GPU, and runs what it traced without a compiler of machine code."""
    compile_ = torch.compile
    monkeypatch.setattr(torch, "compile", lambda call, **_: compile_(call, backend="eager", fullgraph=True))
    yield
    torch._dynamo.reset()
    torch._dynamo.config.suppress_errors = False


def test_a_processor_computes_things_as_they_are():
    layer = torch.nn.Linear(2, 2)
    assert compiled(layer, CPU) is layer


@pytest.mark.parametrize("has_units", [False, True])
def test_a_gpu_tells_whether_it_has_units_for_bfloat16(monkeypatch, has_units):
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda **_: has_units)
    steps = []
    assert bfloat16_gains(steps.append, GPU) is has_units
    assert steps == []


@pytest.mark.usefixtures("traced")
def test_the_papers_network_is_traced_in_one_piece(dataset):
    torch.manual_seed(0)
    shape = NafShape(width=16, grid_features=4, grid_spacing_m=1.0)
    field = Naf(Site.of(SimulatedResponses(dataset)), (33, 20), 2, shape)
    generator = torch.Generator().manual_seed(3)
    listener, emitter = torch.rand(2, 3, 3, generator=generator)
    indices = [torch.randint(0, size, (3, 7), generator=generator) for size in field.axes]
    inputs = listener, emitter, torch.zeros(3), *indices
    torch.testing.assert_close(compiled(field, GPU)(*inputs), field(*inputs))


@pytest.mark.usefixtures("traced")
def test_a_radiance_field_is_traced_in_one_piece():
    torch.manual_seed(0)
    network = Radiance(width=8, layers=4, features=5)
    inputs = torch.rand(6, 3), torch.rand(6, 3), torch.rand(6, 5)
    torch.testing.assert_close(compiled(network, GPU)(*inputs), network(*inputs))


@pytest.mark.usefixtures("traced")
def test_many_points_have_the_features_that_single_ones_have():
    torch.manual_seed(0)
    grid = GaussianGrid(np.array([-3.0, 20.0, 0.0]), np.array([9.0, 28.0, 2.7]), 0.25, 8)
    with torch.no_grad():
        grid.offset.normal_()
        grid.bandwidth_logit.normal_()
    points = torch.rand(200, 3) * torch.tensor([12.0, 8.0, 2.7]) + torch.tensor([-3.0, 20.0, 0.0])
    expected = grid(points)
    torch.testing.assert_close(grid.of_many(points), expected, atol=2e-3, rtol=0)
    torch.testing.assert_close(compiled(grid.of_many, GPU)(points), expected, atol=2e-3, rtol=0)
    # Distances stay in single precision where products are in bfloat16.
    with autocast(CPU, bfloat16=True):
        rough = grid.of_many(points)
    assert (rough - expected).abs().max() < 0.02 * expected.abs().max()
    wanted = torch.autograd.grad(expected.square().sum(), list(grid.parameters()))
    found = torch.autograd.grad(grid.of_many(points).square().sum(), list(grid.parameters()))
    for one, other in zip(found, wanted, strict=True):
        assert (one - other).abs().max() < 0.01 * other.abs().max()

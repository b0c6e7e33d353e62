import numpy as np
import pytest
import torch

from server.acoustics.codec import Codec
from server.acoustics.geometry import FloorPlan
from tests.training.told_paths import told_paths
from training.models.cells import Cells
from training.models.directional import DirectionalField, ExportedDirections
from training.models.encoders import FieldShape
from training.models.site import Extent

PLAN = FloorPlan(((0, 0), (6, 0), (6, 2), (2, 2), (2, 5), (0, 5)), 3.0)
EXTENT = Extent.of_plan(PLAN)
CELLS = Cells(Codec(16_000, 256, 64, 4_000, 1e-5), known_frames=0)
SHAPE = FieldShape(rank=8, width=16, depth=2, grid_features=4)
COLUMNS = CELLS.all_frames.cells


def made(order=2):
    torch.manual_seed(0)
    return DirectionalField(EXTENT, CELLS, SHAPE, order).eval()


def places(count, seed=0):
    rng = np.random.default_rng(seed)
    ends = [
        torch.from_numpy(rng.uniform((0.3, 0.3, 1), (1.7, 4.7, 2), (count, 3)).astype(np.float32)) for _ in range(2)
    ]
    return [*ends, told_paths(PLAN, *ends)]


@pytest.mark.parametrize("order", [0, 1, 2, 3])
def test_outputs_are_those_of_the_contract(order):
    outputs = ExportedDirections(made(order), CELLS)(*places(3))
    shapes = [(3, 7, COLUMNS), (3, (order + 1) ** 2 - 1, 7, COLUMNS)]
    assert [tuple(output.shape) for output in outputs] == shapes[: 1 + (order > 0)]


def test_constant_heads_come_out_where_they_belong():
    field = made()
    with torch.no_grad():
        field.basis.zero_()
        field.mean[field.heads.slices["log_magnitude"]] = -3.0
        shares = field.mean[field.heads.slices["directions"]].reshape(field.heads.shapes["directions"])
        shares[2, 4, 7] = 0.5  # X of the band of 2 kHz in the eighth column
    log_magnitude, directions = ExportedDirections(field, CELLS)(*places(2))
    torch.testing.assert_close(log_magnitude, torch.full((2, 7, COLUMNS), -3.0))
    assert directions[:, 2, 4, 7].tolist() == [0.5, 0.5]
    assert directions.sum().item() == pytest.approx(1.0)


def test_shares_are_none_above_one_and_levels_none_below_silence():
    field = made()
    with torch.no_grad():
        field.mean[field.heads.slices["log_magnitude"]] = -100.0
        field.mean[field.heads.slices["directions"]] = -40.0
    log_magnitude, directions = ExportedDirections(field, CELLS)(*places(4))
    assert (log_magnitude >= np.log(1e-5) - 1e-4).all()
    assert (directions == -1).all()


def test_no_feature_is_that_of_a_head():
    """Every feature changes with the places, in both rooms of the plan."""
    rng = np.random.default_rng(2)
    ends = [torch.from_numpy(rng.uniform((0.1, 0.1, 1), (5.9, 1.9, 2), (300, 3)).astype(np.float32)) for _ in range(2)]
    ends[0][:150, :2] = ends[0][:150, [1, 0]]
    features = made().encoder(*ends, told_paths(PLAN, *ends)).detach()
    assert (features.std(dim=0) > 1e-6).all()


def test_sight_is_found_among_the_features():
    field = made()
    listener = torch.tensor([[1.0, 4.5, 1.5], [1.0, 4.5, 1.5]])
    emitter = torch.tensor([[5.0, 1.0, 1.5], [1.0, 1.0, 1.5]])  # round the corner, and in sight
    path = told_paths(PLAN, listener, emitter)
    sight = field.encoder.sight(field.encoder(listener, emitter, path)).flatten().tolist()
    assert sight == pytest.approx([0.0, 1.0], abs=1e-4)
    with torch.no_grad():
        field.level_correction[0, field.heads.levels] = 0.5
    corrected, _ = ExportedDirections(field, CELLS)(listener, emitter, path)
    with torch.no_grad():
        field.level_correction.zero_()
    plain, _ = ExportedDirections(field, CELLS)(listener, emitter, path)
    torch.testing.assert_close((corrected - plain)[:, 0, 0], torch.tensor([0.5, 0.0]), rtol=0, atol=1e-4)


def test_a_correction_of_bands_raises_all_levels_of_a_band_and_no_share():
    field, at = made(), places(5)
    plain = ExportedDirections(field, CELLS)(*at)
    with torch.no_grad():
        hidden = field.hidden(field.encoder(*at))
        field.band_correction[2, 0] = 0.5
        field.band_correction[4, 1:] = 0.1
        corrected = ExportedDirections(field, CELLS)(*at)
    expected = torch.zeros(5, 7, 1)
    expected[:, 2], expected[:, 4] = 0.5, 0.1 * hidden.sum(dim=1, keepdim=True)
    raised = expected.expand_as(plain[0])
    torch.testing.assert_close(corrected[0] - plain[0], raised, rtol=0, atol=1e-4)
    torch.testing.assert_close(corrected[1], plain[1], rtol=0, atol=1e-5)


def test_a_truncated_field_loses_what_no_field_of_its_rank_could_keep():
    field, at = made(), places(200)
    with torch.no_grad():
        whole = field(*at).numpy()
        singular = np.linalg.svd(whole, compute_uv=False)
        lower = field.truncated(3, *at)
        lost = np.linalg.norm(lower(*at).numpy() - whole)
    assert isinstance(lower, DirectionalField)
    assert lost == pytest.approx(np.sqrt(np.sum(singular[3:8] ** 2)), rel=1e-3)

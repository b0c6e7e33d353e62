import numpy as np
import pytest
import torch

from training.learning.schedule import decay_to_a_tenth, one_cycle


def test_one_cycle_is_torchs():
    parameter = torch.nn.Parameter(torch.zeros(1))
    optimiser = torch.optim.AdamW([parameter], 1.0)
    steps = 1001
    reference = torch.optim.lr_scheduler.OneCycleLR(optimiser, 1.0, steps, pct_start=0.1)
    for step in range(steps):
        beta, share = one_cycle(step / (steps - 1))
        # Torch lets the warming end a step earlier.
        assert share == pytest.approx(optimiser.param_groups[0]["lr"], abs=0.02)
        assert beta == pytest.approx(optimiser.param_groups[0]["betas"][0], abs=0.003)
        optimiser.step()
        if step < steps - 1:
            reference.step()


def test_the_papers_rate_falls_to_a_tenth_exponentially():
    shares = [decay_to_a_tenth(fraction)[1] for fraction in np.linspace(0, 1, 5)]
    np.testing.assert_allclose(shares, np.geomspace(1, 0.1, 5))

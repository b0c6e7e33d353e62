"""Published numbers are quoted with their source, and none is made up."""

from server.acoustics.metrics import PARAMETER_METRICS
from training.evaluation.methods import METHODS
from training.evaluation.published import NOT_AT_HAND, PAPER_FIGURES, published_table

OTHERS = {"naf", "naf-whole", "inras", "neraf", "minaf", "avr"}


def test_errors_are_of_methods_and_metrics_that_exist():
    names = {metric.name for metric in PARAMETER_METRICS}
    for simulated in (True, False):
        table = published_table(simulated=simulated)
        assert table.errors.keys() <= METHODS.keys() | OTHERS
        assert all(errors.keys() <= names for errors in table.errors.values())
        assert table.source


def test_the_papers_gain_of_psnr_is_that_of_its_two_numbers():
    gain = PAPER_FIGURES["psnr-75-nerf-naf"].value - PAPER_FIGURES["psnr-75-nerf"].value
    assert round(gain, 2) == 0.78


def test_what_was_not_read_has_no_number():
    assert NOT_AT_HAND
    for figure in PAPER_FIGURES.values():
        assert "Luo et al." in figure.source
        assert figure.subject not in NOT_AT_HAND

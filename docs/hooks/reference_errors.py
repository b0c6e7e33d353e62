"""Reference of the errors that a benchmark scores, from their definitions."""

from training.evaluation.benchmark_report import definitions


def error_definitions() -> str:
    """Return what each error means."""
    return definitions()

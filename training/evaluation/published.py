"""Results that others have published for the methods in our tables, with the data on which they were measured, and what
Luo et al. printed of their own network.

None is for our scenes. Rooms, source-listener distances and definitions differ, so these numbers only give orientation
and are never a reference. Numbers that the authors did not print are absent, and so are those of the paper that we did
not have before us: `NOT_AT_HAND` lists them.
"""

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class PublishedTable:
    """A table of published results. errors: by method, then by metric of `server.acoustics.metrics`, in its unit."""

    data: str
    source: str
    errors: Mapping[str, Mapping[str, float]]


def _t60_c50_edt(t60: float, c50: float, edt_ms: float) -> dict[str, float]:
    return {"t60": t60, "c50": c50, "edt": edt_ms}


SOUNDSPACES = PublishedTable(
    "SoundSpaces, mean of six simulated scenes",
    "Su, Chen and Shlizerman, INRAS, NeurIPS 2022; repeated by Liang et al., AV-NeRF, NeurIPS 2023; MiNAF: Si et al., "
    "arXiv 2509.15210; NeRAF: Brunetto et al., ICLR 2025",
    {
        "opus-nearest": _t60_c50_edt(10.10, 3.58, 115.0),
        "opus-linear": _t60_c50_edt(8.64, 3.13, 97.0),
        "aac-nearest": _t60_c50_edt(9.35, 1.67, 59.0),
        "aac-linear": _t60_c50_edt(7.88, 1.68, 57.0),
        "naf": _t60_c50_edt(3.18, 1.06, 31.0),
        "naf-whole": _t60_c50_edt(3.18, 1.06, 31.0),
        "inras": _t60_c50_edt(3.14, 0.60, 19.0),
        "neraf": _t60_c50_edt(2.04, 0.39, 11.0),
        "minaf": _t60_c50_edt(1.59, 0.41, 2.2),
    },
)
MESHRIR = PublishedTable(
    "MeshRIR S1-M3969, measured, first 0.1 s",
    "Lan et al., Acoustic Volume Rendering, NeurIPS 2024, table 1",
    {
        "opus-nearest": _t60_c50_edt(5.2, 1.26, 35.7),
        "opus-linear": _t60_c50_edt(6.9, 1.83, 49.3),
        "aac-nearest": _t60_c50_edt(8.6, 2.20, 58.8),
        "aac-linear": _t60_c50_edt(8.2, 2.29, 58.9),
        "naf": _t60_c50_edt(4.2, 1.25, 39.0),
        "inras": _t60_c50_edt(3.4, 1.47, 40.7),
        "avr": _t60_c50_edt(3.9, 0.92, 35.1),
    },
)


def published_table(*, simulated: bool) -> PublishedTable:
    """The published results on data of the same kind: simulated or measured."""
    return SOUNDSPACES if simulated else MESHRIR


@dataclass(frozen=True)
class PaperFigure:
    """A number of Luo et al.: what it is of, its value, its unit, and where it stands."""

    subject: str
    value: float
    unit: str
    source: str


_PAPER = "Luo et al., Learning Neural Acoustic Fields, NeurIPS 2022"
_TABLE_UNKNOWN = f"{_PAPER}; told to us without the number of the table"
PAPER_FIGURES: Mapping[str, PaperFigure] = {
    "t60-time-domain": PaperFigure("T60 error of the network of waveforms", 49.7, "%", _TABLE_UNKNOWN),
    "preference": PaperFigure("answers for their network over AAC-nearest", 82.38, "%", _TABLE_UNKNOWN),
    "listeners": PaperFigure("people who were asked, ten places each", 21, "people", _TABLE_UNKNOWN),
    "psnr-75-nerf": PaperFigure("PSNR of NeRF alone, 75 images", 25.41, "dB", _TABLE_UNKNOWN),
    "psnr-75-nerf-naf": PaperFigure("PSNR of NeRF trained with their network, 75 images", 26.19, "dB", _TABLE_UNKNOWN),
    "psnr-150-gain": PaperFigure("gain of PSNR, 150 images", 0.05, "dB", _TABLE_UNKNOWN),
}
"""By a name that `benchmarks.paper` uses."""

NOT_AT_HAND = (
    "spectral loss and T60 error of all methods",
    "storage",
    "the ablations of the grid",
    "the explained variance of the linear probe",
    "IACC error",
    "the results on MeshRIR, with Helmholtz ridge regression",
    "the errors over fractions of the training data",
)
"""What the paper printed and we could not read. No number of these is written anywhere here."""

"""The figure of one response's log-magnitude and phase, truth beside prediction, as in the paper: rows are truth and
methods, columns are log-magnitude and instantaneous frequency of one ear."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from server.acoustics.codec import Codec
from training.evaluation.paper_metrics import HOP, LOG_FLOOR, N_FFT

_FAINTEST = 1e-5
_SHOWN_LN = 8.0


def draw_spectrograms(responses: Mapping[str, npt.NDArray[np.floating]], sample_rate: int, path: Path) -> None:
    """Write a PNG. `responses` (sample,) by name, truth first. Where a bin is too faint to have a phase, its frequency
    is left white."""
    figure = Figure(figsize=(10.5, 2.5 * len(responses) + 0.4), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    panels = figure.subplots(len(responses), 2, squeeze=False, sharex=True, sharey=True)
    loudest: float | None = None
    images: list[AxesImage] = []
    for axes_of_row, (name, response) in zip(panels, responses.items(), strict=True):
        codec = Codec(sample_rate, N_FFT, HOP, len(response), min(LOG_FLOOR, _FAINTEST))
        log_magnitude, frequency = codec.encode(response.astype(np.float64))
        loudest = float(log_magnitude.max()) if loudest is None else loudest
        frequency[log_magnitude < loudest - _SHOWN_LN] = np.nan
        times_ms = 1e3 * codec.frame_times_s
        extent = (times_ms[0], times_ms[-1], 0.0, sample_rate / 2e3)
        drawn = (
            (log_magnitude, "log-magnitude", {"vmin": loudest - _SHOWN_LN, "vmax": loudest, "cmap": "magma"}),
            (frequency, "instantaneous frequency", {"vmin": -np.pi, "vmax": np.pi, "cmap": "twilight"}),
        )
        for column, (axes, (values, what, style)) in enumerate(zip(axes_of_row, drawn, strict=True)):
            image = axes.imshow(values, origin="lower", aspect="auto", extent=extent, interpolation="none", **style)
            images[column:] = [image]
            axes.set_title(f"{name}: {what}", fontsize=10)
            axes.set(xlabel="time (ms)", ylabel="kHz")
            axes.label_outer()
    for column, (image, label) in enumerate(zip(images, ("ln", "radians a frame"), strict=True)):
        figure.colorbar(image, ax=panels[:, column], pad=0.01).set_label(label)
    figure.savefig(path, dpi=110)

"""The figure of `nafir-train fractions`: mean error over the fraction of training pairs, a line for each field, with
the standard deviation over seeds as bars."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from training.evaluation.evaluate import METRICS
from training.trials.fractions import Fractions

SHOWN = ("spectral_loss", "t60", "c50")
_STYLES = (("o", "#0b6e99"), ("^", "#d1495b"), ("v", "#edae49"), ("s", "#66a182"), ("D", "#8d6a9f"))


def spreads(fractions: Fractions, metric: str) -> Mapping[str, Mapping[float, tuple[float, float, int]]]:
    """By field and percentage: mean error, standard deviation over seeds (NaN for one), and the number of seeds."""
    found: dict[str, dict[float, list[float]]] = {}
    for each in fractions.scored:
        if metric in each.errors:
            found.setdefault(each.trial.field, {}).setdefault(each.trial.percent, []).append(each.errors[metric])
    return {
        field: {
            percent: (float(np.mean(errors)), float(np.std(errors, ddof=1)) if len(errors) > 1 else np.nan, len(errors))
            for percent, errors in sorted(by_percent.items())
        }
        for field, by_percent in found.items()
    }


def figure_of(fractions: Fractions) -> Figure:
    figure = Figure(figsize=(12.5, 4.2), layout="constrained", facecolor="white")
    labels = {metric.name: f"{metric.label} ({metric.unit})" for metric in METRICS}
    for axes, metric in zip(figure.subplots(1, len(SHOWN)), SHOWN, strict=True):
        for (field, by_percent), (marker, colour) in zip(spreads(fractions, metric).items(), _STYLES, strict=False):
            means, deviations, _ = zip(*by_percent.values(), strict=True)
            axes.errorbar(
                list(by_percent),
                means,
                yerr=np.nan_to_num(deviations),
                marker=marker,
                color=colour,
                capsize=3,
                linewidth=1.3,
                label=field,
            )
        if metric in fractions.floor:
            repeated = fractions.floor[metric]
            axes.axhline(repeated, color="#8a8a8a", linestyle="--", label="a second simulation (repeatability)")
        axes.set_xscale("log")
        percents = sorted({each.trial.percent for each in fractions.scored})
        axes.set_xticks(percents, [f"{percent:g}" for percent in percents])
        axes.minorticks_off()
        axes.set_ylim(bottom=0)
        axes.set(xlabel="training pairs used (%)", ylabel=labels[metric])
        axes.grid(alpha=0.25)
        axes.spines[["top", "right"]].set_visible(False)
    figure.axes[0].legend(frameon=False, fontsize=9, loc="lower left")
    return figure

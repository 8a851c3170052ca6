"""How the position errors are spread over the particles (the paper's Fig. "Distribution of … position MSEs")."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from sgns.evaluation.figures import (
    ACCENT,
    NETWORK,
    PICTURE_WIDTH,
    new_figure,
    plain_log_numbers,
    styled,
)
from sgns.evaluation.metrics import ParticleErrors

__all__ = ["error_bins", "histogram_figure"]

BINS_PER_DECADE = 4
# An error below a micrometre counts as one [m²]: particles that rest would fill decades with rounding.
SMALLEST = 1e-12


def error_bins(values: Sequence[np.ndarray]) -> np.ndarray:
    """Borders [m²] of bins, equally wide on a logarithmic axis, that hold all of the values."""
    everything = np.concatenate([np.maximum(v, SMALLEST) for v in values])
    low = np.floor(BINS_PER_DECADE * np.log10(everything.min())) / BINS_PER_DECADE
    high = np.floor(BINS_PER_DECADE * np.log10(everything.max()) + 1.0) / BINS_PER_DECADE
    return 10.0 ** np.linspace(low, high, round((high - low) * BINS_PER_DECADE) + 1)


@styled
def histogram_figure(runs: Sequence[ParticleErrors]) -> Figure:
    """Share of particles by the mean-square error of their position, all runs together; dotted: the medians."""
    spread = {
        "PCA (reduction)": (np.concatenate([run.reduction for run in runs]), ACCENT),
        "network": (np.concatenate([run.network for run in runs]), NETWORK),
    }
    bins = error_bins([values for values, _ in spread.values()])
    figure = new_figure(PICTURE_WIDTH, 3.6)
    axes = figure.subplots(2, 1, sharex=True, sharey=True)
    for axis, (label, (values, colour)) in zip(axes, spread.items(), strict=True):
        values = np.maximum(values, SMALLEST)
        share = np.full(len(values), 100.0 / len(values))
        axis.hist(values, bins, weights=share, color=colour, alpha=0.85, edgecolor="white", linewidth=0.4)
        median = float(np.median(values))
        axis.axvline(median, color="black", linestyle=":", linewidth=1.2)
        axis.set_title(f"{label}: median {median:.1e}, mean {values.mean():.1e} m²", fontsize=9)
        axis.set_ylabel("particles [%]")
        axis.grid(alpha=0.25, linewidth=0.6, axis="y")
    axes[0].set_xscale("log")
    plain_log_numbers(axes[0].xaxis)
    axes[1].set_xlabel("position MSE of a particle [m²]")
    return figure

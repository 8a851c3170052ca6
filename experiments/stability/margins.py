"""The figure: how far every case is from its limit."""

from __future__ import annotations

import math
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

__all__ = ["draw"]

_LEAST, _MOST = 1e-4, 1e2  # measured / limit that the axis shows


def draw(rows: list, file: Path) -> None:
    """Measured over limit of every case on a logarithmic axis, a panel for every area."""
    areas = list(dict.fromkeys(row.area for row in rows))
    counts = [sum(row.area == area for row in rows) for area in areas]
    figure, panels = plt.subplots(
        len(areas),
        1,
        figsize=(9.0, 0.2 * len(rows) + 0.9 * len(areas) + 0.5),
        gridspec_kw={"height_ratios": [count + 1 for count in counts]},
        squeeze=False,
        sharex=True,
    )
    for area, panel in zip(areas, panels[:, 0], strict=True):
        _panel(panel, area, [row for row in rows if row.area == area])
    panels[-1, 0].set_xlabel("measured / limit (1: at the limit)")
    figure.tight_layout()
    figure.savefig(file, dpi=110)
    plt.close(figure)


def _panel(panel, area: str, rows: list) -> None:
    for place, row in enumerate(rows):
        share = _share(row)
        colour = "tab:green" if row.passed else "tab:red"
        panel.barh(place, share - _LEAST, left=_LEAST, color=colour, height=0.7)
        text = f" {row.measured:.2g} {row.unit}" if math.isfinite(row.measured) else " broke down"
        panel.text(min(share, _MOST / 8.0), place, text, va="center", fontsize=6.5)
    panel.axvline(1.0, color="black", linewidth=1.0)
    panel.set_xscale("log")
    panel.set_xlim(_LEAST, _MOST)
    panel.set_yticks(range(len(rows)), [row.name for row in rows], fontsize=7)
    panel.set_ylim(len(rows) - 0.4, -0.6)
    failed = sum(not row.passed for row in rows)
    panel.set_title(f"{area}: {len(rows)} cases, {failed} fail", fontsize=9, loc="left")
    panel.grid(axis="x", linewidth=0.3)


def _share(row) -> float:
    """Measured over limit within the axis; what broke down, and anything beyond a limit of 0, is at its end."""
    if not math.isfinite(row.measured):
        return _MOST
    if row.limit == 0.0:
        return _LEAST if row.passed else _MOST
    return min(max(row.measured / row.limit, _LEAST), _MOST)

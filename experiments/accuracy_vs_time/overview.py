"""The README's figure: force error against computing time, eight points of full/points.csv.

python experiments/accuracy_vs_time/overview.py
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(1, str(Path(__file__).resolve().parents[1]))

import matplotlib.pyplot as plt
from common import read_rows

HERE = Path(__file__).resolve().parent
SOLVER, LEARNED = "#0072b2", "#d55e00"
KNOWN = 0.20
"""Band of the study: the reference's own draft is known to 20 %."""

# name in the figure, rows of the table (two where it was trained twice), place of the name beside the point
SOLVER_POINTS = [
    ("27 mm grid", ["26.7 mm, 4 per cell"], (30, 10)),
    ("20 mm: the\ntraining runs", ["20 mm, 2.37 per cell (training data)"], (0, -22)),
    ("13 mm", ["13.3 mm, 4 per cell"], (0, 10)),
    ("10 mm", ["10 mm, 4 per cell"], (0, 10)),
]
LEARNED_POINTS = [
    ("network,\ndefault", ["default", "default, seed 1"], (34, -4)),
    ("network,\nhalf width", ["fast", "fast, seed 1"], (-36, -4)),
    ("polynomial", ["polynomial"], (0, -18)),
    ("network, the\npaper's settings", ["paper's network, 40 s"], (0, 10)),
]


def main() -> None:
    rows = {row["label"]: row for row in read_rows(HERE / "full" / "points.csv") if row["scene"] == "cut"}
    figure, axes = plt.subplots(figsize=(7.2, 4.0), dpi=110, layout="constrained")
    axes.axhspan(0.0, KNOWN, color="#e6e6e6", linewidth=0)
    words = "too small to judge: the most accurate run\nis itself known to 20 %"
    axes.text(0.0013, 0.085, words, fontsize=9, va="center")
    axes.axvline(1.0, color="#666666", linestyle="--", linewidth=1.2)
    axes.text(0.9, 0.89, "faster than real time", ha="right", va="center", fontsize=9, color="#444444")
    axes.text(1.12, 0.89, "slower", ha="left", va="center", fontsize=9, color="#444444")
    learned = "learned from the training runs in 40 s or less (bar: two trainings)"
    for points, colour, marker, name in (
        (SOLVER_POINTS, SOLVER, "o", "solver, by grid spacing"),
        (LEARNED_POINTS, LEARNED, "^", learned),
    ):
        seconds, errors = [], []
        for label, names, offset in points:
            both = [float(rows[key]["force_nrmse"]) for key in names]
            time = sum(float(rows[key]["wall_s_per_simulated_s"]) for key in names) / len(names)
            seconds.append(time)
            errors.append(sum(both) / len(both))
            axes.plot([time] * 2, [min(both), max(both)], color=colour, lw=2.5, solid_capstyle="butt")
            place = {"xytext": offset, "ha": "center", "va": "bottom" if offset[1] > 0 else "center"}
            axes.annotate(label, (time, errors[-1]), textcoords="offset points", fontsize=9, **place)
        axes.plot(seconds, errors, marker, color=colour, markersize=8, label=name)
    axes.set(xscale="log", xlim=(0.001, 200.0), ylim=(0.0, 0.95), ylabel="error of the force, NRMSE [-]")
    axes.set_xticks([0.01, 0.1, 1.0, 10.0, 100.0], ["0.01", "0.1", "1", "10", "100"])
    axes.set_xlabel("computing time of one core for one simulated second [s]")
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside upper center", ncols=2, frameon=False, fontsize=9)
    figure.savefig(HERE / "overview.png", metadata={"Software": None})


if __name__ == "__main__":
    main()

"""Wheels in sand as measured, as two cheap theories have them, and as the solver has them.

    python experiments/measured/judge.py

Fixes the theories' parameters from straight rolling at slips -1, 0, 0.5, judges the rest, and writes table.csv,
conditions.csv and figure.png beside this script. Ours come from ours.csv, which campaign.py makes.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy.optimize import least_squares

sys.path.insert(1, str(Path(__file__).resolve().parents[1]))

import bekker
import resistive_force
from common import read_rows, write_rows
from conditions import QUANTITIES, Condition, Forces, cmu, ding, errors, steady

from sgns.evaluate.figures import ACCENT, BASELINE, NETWORK, TRUTH, new_figure, styled

HERE = Path(__file__).parent
Answers = dict[tuple[str, float, float], Mapping[str, float]]
Rival = Callable[[Condition, float], Forces]
LOOKS = {
    "ours": {"color": NETWORK, "marker": "s"},
    "resistive force": {"color": ACCENT},
    "resistive force, fitted": {"color": ACCENT, "linestyle": "--"},
    "bekker": {"color": BASELINE},
}


def fitted(force: Callable[..., Forces], start: Sequence[float]) -> np.ndarray:
    """Positive parameters with which pull and sinkage of the three fixing conditions come out best.

    Args:
        force: forces on the wheel for a condition, a depth and the parameters; the last is the friction of wheel and
            soil, at most the soil's own.
    """
    conditions = cmu()
    highest = np.array([math.inf] * (len(start) - 1) + [math.tan(conditions[0].soil.angle)])
    largest = {name: max(abs(c.measured[name]) for c in conditions) for name in ("fx", "sinkage")}

    def misses(logarithms: np.ndarray) -> list[float]:
        found = []
        for c in (c for c in conditions if c.fixed):
            answer = steady(lambda depth, c=c: force(c, depth, np.exp(logarithms)), c)
            found += [(answer[name] - c.measured[name]) / size for name, size in largest.items()]
        return found

    return np.exp(least_squares(misses, np.log(start), bounds=(-math.inf, np.log(highest)), diff_step=1e-3).x)


def rivals() -> dict[str, Rival]:
    """Each theory with its parameters."""

    def scaled(c: Condition, depth: float, given: Sequence[float]) -> Forces:
        return resistive_force.forces(c, depth, given[0] * resistive_force.scale_of(c.soil), given[1])

    def wheel_model(c: Condition, depth: float, given: Sequence[float]) -> Forces:
        return bekker.forces(c, depth, bekker.Parameters(*given))

    def from_soil(c: Condition, depth: float) -> Forces:
        return scaled(c, depth, (1.0, math.tan(2.0 / 3.0 * c.soil.angle)))

    force, rim = fitted(scaled, (1.0, 0.4)), fitted(wheel_model, (1.5e6, 0.3, 0.3, 0.4))
    print("resistive force, fitted: scale x {:.3g}, wheel friction {:.3g}".format(*force))
    print("bekker: k {:.3g}, growth of n {:.3g} driven, {:.3g} braked, wheel friction {:.3g}".format(*rim))
    return {
        "resistive force": from_soil,
        "resistive force, fitted": partial(scaled, given=force),
        "bekker": partial(wheel_model, given=rim),
    }


def ours(file: Path = HERE / "ours.csv") -> Answers:
    """Answers of the solver in the campaign's own settings."""
    found: Answers = {}
    for row in read_rows(file):
        if row["study"] in ("judged", "larger"):
            key = (row["source"], float(row["slip_angle"]), float(row["slip"]))
            found[key] = {name: float(row[name]) for name in QUANTITIES}
    return found


def table(conditions: list[Condition], models: Mapping[str, Answers]) -> list[dict]:
    """Errors of each model in each quantity, as shares of the largest measured value, and the trials' scatter likewise.

    Over the conditions that ours answers, where it answers any of that wheel; `median_all` over all judged.
    """
    rows = []
    for source in ("cmu", "ding"):
        wheels = [c for c in conditions if c.source == source]
        keys = {c.key for c in wheels}
        same = keys & set(models["ours"]) or keys
        for name in QUANTITIES:
            for model, answers in models.items():
                shares = errors(wheels, {key: answer for key, answer in answers.items() if key in same}).get(
                    name
                )
                if shares is not None:
                    row = {"source": source, "quantity": name, "model": model} | summary(shares)
                    rows.append(row | {"median_all": float(np.median(errors(wheels, answers)[name]))})
            trials = [c for c in wheels if name in c.scatter]
            if trials:
                largest = max(abs(c.measured[name]) for c in trials)
                shares = np.array([c.scatter[name] / largest for c in trials])
                rows.append(
                    {"source": source, "quantity": name, "model": "scatter of trials"} | summary(shares)
                )
    return rows


def summary(shares: np.ndarray) -> dict[str, float]:
    median, mean, worst = (float(of(shares)) for of in (np.median, np.mean, np.max))
    return {"conditions": len(shares), "median": median, "mean": mean, "worst": worst}


def answered(conditions: list[Condition], models: Mapping[str, Answers]) -> list[dict]:
    """All answers beside what was measured, a row for each condition."""
    rows = []
    for c in conditions:
        row = {"source": c.source, "slip_angle": c.slip_angle, "slip": c.slip, "load": c.load}
        row |= {"used": "fixes" if c.fixed else "judged"}
        for name in QUANTITIES:
            if name in c.measured:
                row[f"{name}_measured"] = c.measured[name]
            if name in c.scatter:
                row[f"{name}_scatter"] = c.scatter[name]
            for model, answers in models.items():
                if c.key in answers:
                    row[f"{name}_{model.replace(', ', '_').replace(' ', '_')}"] = answers[c.key][name]
        rows.append(row)
    return rows


@styled
def figure(conditions: list[Condition], models: Mapping[str, Answers]) -> Figure:
    """Pull, lateral force and sinkage over slip, a column for each slip angle."""
    small = [c for c in conditions if c.source == "cmu"]
    angles = sorted({c.slip_angle for c in small})
    drawn = new_figure(2.0 * len(angles) + 1.0, 7.2)
    panels = drawn.subplots(3, len(angles), sharex=True, sharey="row")
    for column, angle in zip(panels.T, angles, strict=True):
        column[0].set_title(f"slip angle {angle:.0f}°")
        column[2].set_xlabel("slip")
        group = sorted((c for c in small if c.slip_angle == angle), key=lambda c: c.slip)
        for axes, (name, unit) in zip(column, (("fx", 1.0), ("fy", 1.0), ("sinkage", 1e3)), strict=True):
            for model, answers in models.items():
                known = [c for c in group if c.key in answers]
                axes.plot(
                    [c.slip for c in known],
                    [unit * answers[c.key][name] for c in known],
                    **LOOKS[model],
                    markersize=4,
                    label=model,
                )
            for used, fill in (("judged", TRUTH), ("fixes parameters", "white")):
                dots = [c for c in group if c.fixed == (used != "judged")]
                axes.errorbar(
                    [c.slip for c in dots],
                    [unit * c.measured[name] for c in dots],
                    [unit * c.scatter[name] for c in dots],
                    fmt="o",
                    color=TRUTH,
                    markerfacecolor=fill,
                    markersize=4.5,
                    label=f"measured, {used}",
                )
            axes.axhline(0.0, color=BASELINE, linewidth=0.5)
    for axes, words in zip(panels[:, 0], ("pull [N]", "lateral force [N]", "sinkage [mm]"), strict=True):
        axes.set_ylabel(words)
    panels[2, 0].invert_yaxis()
    drawn.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=6)
    return drawn


def main() -> None:
    conditions = cmu() + ding()
    models: dict[str, Answers] = {"ours": ours()}
    for name, force in rivals().items():
        models[name] = {c.key: steady(partial(force, c), c) for c in conditions}
    rows = table(conditions, models)
    print("wheel quantity model              conditions median   mean  worst    all")
    write_rows(HERE / "table.csv", rows, 3)
    write_rows(HERE / "conditions.csv", answered(conditions, models))
    figure(conditions, models).savefig(HERE / "figure.png", dpi=90)
    for row in rows:
        words = [f"{value:.3f}" if isinstance(value, float) else str(value) for value in row.values()]
        print(f"{words[0]:6}{words[1]:9}{words[2]:25}" + "".join(f"{word:>7}" for word in words[3:]))


if __name__ == "__main__":
    main()

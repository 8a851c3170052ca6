"""`sgns advise`: which setting of the solver, or which surrogate, is good enough and fast enough."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import yaml
from omegaconf import DictConfig, OmegaConf

from sgns.command_settings import Advise
from sgns.config import UserError
from sgns.frontier.point import Point, effective_error, read_points, usable

log = logging.getLogger(__name__)

TABLE = Path(str(files("sgns.frontier").joinpath("table.csv")))  # that ships with the package
STEP = 1.0 / 60.0  # simulated time of one step: what `time` is the wall time of [s]
_FAR_ABOVE = 10.0  # an error so many times the largest of the table is likely meant in another unit
# Key of `error` → column, what one of its units is of the key's, and words. Lengths are metres in settings.
ERRORS = {
    "force": ("force_nrmse", 1.0, "force NRMSE", ""),
    "position": ("position_rmse_mm", 1e3, "displacement of the soil", " mm"),
    "surface": ("surface_rmse_mm", 1e3, "surface at the end", " mm"),
    "sinkage": ("sinkage_error_mm", 1e3, "sinkage", " mm"),
}


@dataclass(frozen=True)
class Wish:
    """What a person needs."""

    scene: str  # whose points are looked at
    limits: Mapping[str, float]  # key of `error` → largest error, in the unit of the column
    time: float | None  # longest wall time of a step of `STEP`, as a control loop calls it [s], or None
    particles: bool  # whether the positions of all particles are wanted in every step
    own: bool  # judge by the errors against the solver that made the training runs
    bands: Mapping[str, float]  # column → how wrong the reference itself may be

    def column(self, key: str) -> str:
        """The column of a key of `error`."""
        return f"own_{ERRORS[key][0]}" if self.own else ERRORS[key][0]

    def step_time(self, point: Point) -> float:
        """Wall time of a step of a point, pose by pose where that was measured, else along a path that is known
        beforehand [s]; NaN if neither is known."""
        cost = point.cost if math.isnan(point.stepped_cost) else point.stepped_cost
        return STEP * (cost + (point.decoded_cost - point.cost if self.particles else 0.0))

    def error(self, point: Point, key: str) -> float:
        """What counts: of a surrogate the larger of its error and of that against the solver that made its training
        runs, since a surrogate that is nearer to the reference than to what it learned from is so by luck."""
        found = effective_error(point, self.column(key), self.bands)
        own = getattr(point, f"own_{ERRORS[key][0]}")
        return found if math.isnan(own) else max(found, own)

    def excess(self, point: Point) -> float:
        """The largest of what a point does over what is allowed; 1 or less: it is good enough."""
        shares = [self.error(point, key) / limit for key, limit in self.limits.items()]
        if self.time is not None:
            shares.append(self.step_time(point) / self.time)
        return math.nan if any(map(math.isnan, shares)) else max(shares)


def chosen(points: Sequence[Point], wish: Wish) -> tuple[Point, bool]:
    """The point to use and whether it meets the wish.

    Of those that meet it the fastest, or with a time alone the one with the smallest error of the force; if none does,
    the one that misses it by the smallest factor. Surrogates that no command makes, such as those trained on some of
    the runs or frames, are for the study only.

    Raises:
        UserError: no point of the scene has the errors asked for.
    """
    named = [
        p for p in points if usable(p) and not (p.kind == "surrogate" and p.note)
    ]  # the note: what it leaves out
    candidates = [
        p for p in named if p.scene == wish.scene and not math.isnan(wish.excess(p) + wish.step_time(p))
    ]
    if not candidates:
        raise UserError(
            f"no operating point of task={wish.scene} has all the numbers asked for; {_kinds(named, wish)}"
        )
    good = [p for p in candidates if wish.excess(p) <= 1.0]
    if not good:
        return min(candidates, key=lambda p: (wish.excess(p), wish.step_time(p))), False
    if wish.limits:
        return min(good, key=wish.step_time), True
    with_force = [p for p in good if not math.isnan(wish.error(p, "force"))] or good
    return min(with_force, key=lambda p: (wish.error(p, "force"), wish.step_time(p))), True


def _kinds(points: Sequence[Point], wish: Wish) -> str:
    """Which kinds of error a scene's points have, and which other scenes have those asked for."""

    def having(key: str) -> list[str]:
        found = (p.scene for p in points if not math.isnan(getattr(p, wish.column(key))))
        return list(dict.fromkeys(found))

    kinds = ", ".join(f"error.{key}" for key in ERRORS if wish.scene in having(key)) or "no error"
    hints = [f"it has {kinds}"]
    for key in wish.limits:
        if wish.scene not in (scenes := having(key)):
            there = " or ".join(f"task={scene}" for scene in scenes) or "no task"
            hints.append(f"error.{key} is known of {there}")
    return "; ".join(hints)


def advice(points: Sequence[Point], wish: Wish) -> list[str]:
    """The answer in lines."""
    point, met = chosen(points, wish)
    step = wish.step_time(point)
    soil = "" if point.kind == "solver" else ", all particles decoded" if wish.particles else ", none decoded"
    lines = [
        f"{'use' if met else 'nothing meets this; closest'}: {named(point)}",
        *(f"  {line}" for line in commands(point)),
        f"  costs {1e3 * step:.3g} ms per step of 1/60 s{called(point)}{soil}, on one core of {point.machine}: up to "
        f"{float(f'{1.0 / step:.3g}'):g} steps a second",
    ]
    if point.kind == "surrogate" and math.isnan(point.stepped_cost):
        lines.append(
            "  a step with Simulator.step, pose by pose, takes longer, up to a millisecond more; this table does not "
            "have it: sgns evaluate measures it"
        )
    for key, (_, _, words, unit) in ERRORS.items():
        column = wish.column(key)
        value = effective_error(point, column, wish.bands)
        if math.isnan(value):
            continue
        limit, band = wish.limits.get(key), wish.bands.get(column, 0.0)
        low, high = (getattr(point, f"{column}{end}", math.nan) for end in ("_low", "_high"))
        said = f"  {words}: {value:.3g}{unit}"
        if value <= band:
            said += " or less (within the reference's own error)"
        elif low < high:
            said += f" ({low:.3g} to {high:.3g} from case to case)"
        lines.append(said if limit is None else f"{said}, asked for {limit:.3g}{unit}")
        if limit is not None and limit < band:
            lines.append(
                f"    the reference itself is only known to {band:g}{unit}: nothing can be shown to be better"
            )
    if point.kind == "surrogate" and not wish.own and not math.isnan(point.own_force_nrmse):
        lines.append(
            f"  against the solver that made its training runs: force NRMSE {point.own_force_nrmse:.3g}, particles "
            f"{point.own_position_rmse_mm:.3g} mm; the larger error counts"
        )
    reference = next((p for p in points if p.scene == wish.scene and p.axis == "reference"), None)
    against = f"the solver at {reference.label}" if reference else "the study's reference"
    if wish.own:
        against = "the solver that made the training runs, over its test runs"
    measured = f"version {point.version}" + (f", commit {point.commit}" if point.commit else "")
    lines.append(
        f"  rests on study {point.study}, scene {point.scene}: errors against {against}; measured with {measured}"
    )
    lines += [
        f"  the table knows task={tasks(points)} in these beds and soils only; for another scene measure your own: "
        "docs/guides/accuracy.md#measure-your-own",
        "  whatever you choose, forces depend on the grid (draft by some 20 %, a wheel's pull more): docs/limits.md",
    ]
    return lines + ([f"  note: {point.note}"] if point.note else [])


def named(point: Point) -> str:
    """A point in words."""
    what = {"solver": "solver", "surrogate": "network"}.get(point.kind, point.kind)
    if "model=polynomial" in point.settings.split():
        what = "polynomial"
    took = "" if math.isnan(point.training_s) else f"; its training took {point.training_s:.2g} s"
    return f'{what}, called "{point.label}" in the study{took}'


def tasks(points: Sequence[Point]) -> str:
    """What the table knows."""
    return ", ".join(dict.fromkeys(p.scene for p in points)) or "nothing"


def called(point: Point) -> str:
    """How a step is called whose cost is known."""
    if point.kind != "surrogate":
        return ""
    return " along a known path (sgns rollout)" if math.isnan(point.stepped_cost) else " with Simulator.step"


def commands(point: Point) -> list[str]:
    """What to type for a point."""
    if point.kind == "solver":
        return [f"sgns simulate {point.settings} output=run.h5"]
    if point.kind == "surrogate":
        return [
            f"sgns train {point.settings} output=outputs/advised",
            "sgns rollout checkpoint=outputs/advised/best.ckpt "
            f"scene={shipped(point.study, point.scene).get('scene', '...')} output=rollout.h5",
        ]
    return [point.settings] if point.settings else []


def main(cfg: DictConfig) -> float:
    """The command; returns the wall time of a step [s]."""
    points = read_points(Path(cfg.table or TABLE))
    wish = wished(OmegaConf.to_container(cfg, resolve=True), points)
    for line in advice(points, wish):
        log.info("%s", line)
    return wish.step_time(chosen(points, wish)[0])


def wished(cfg: Any, points: Sequence[Point]) -> Wish:
    """The wish in the settings of the command, as plain data.

    Raises:
        UserError: a value is not allowed, nothing is asked for, or the table has no such scene.
    """
    asked = Advise.from_dict(cfg)
    if asked.task not in {p.scene for p in points}:
        raise UserError(
            f"task is {asked.task!r}; the table has {tasks(points)}; to measure another scene see "
            "docs/guides/accuracy.md"
        )
    given = ((key, value) for key, value in asked.error.to_dict().items() if value is not None)
    limits = {key: ERRORS[key][1] * value for key, value in given}
    if not limits and asked.time is None:
        raise UserError(
            "nothing is asked for; give error.force=0.2, error.position=0.005 (m), time=0.01 (s), ..."
        )
    own = asked.against == "training"
    study = next(p.study for p in points if p.scene == asked.task)
    wish = Wish(asked.task, limits, asked.time, asked.particles, own, {} if own else bands(study, asked.task))
    for key, limit in limits.items():
        known = [error for p in points if not math.isnan(error := wish.error(p, key))]
        if ERRORS[key][3] and known and limit > _FAR_ABOVE * max(known):
            raise UserError(
                f"error.{key} is {limit / 1e3:g} m, and the largest of the table is {max(known):.3g} mm; errors are in "
                f"metres: for {limit / 1e3:g} mm give error.{key}={limit / 1e6:g}; if any error will do, leave it out"
            )
    return wish


def shipped(study: str, scene: str) -> dict[str, Any]:
    """Settings of a scene of a study that ships with the package; empty for others."""
    # Looked up among the names that there are: a table may say anything, and must not name a file to be read.
    found = (file for file in files("sgns.conf").joinpath("study").iterdir() if file.name == f"{study}.yaml")
    if (file := next(found, None)) is None:
        return {}
    return yaml.safe_load(file.read_text(encoding="utf-8"))["scenes"].get(scene, {})


def bands(study: str, scene: str) -> dict[str, float]:
    """How wrong the reference of a study may be, by column; empty where it is not known."""
    return {key: float(value) for key, value in (shipped(study, scene).get("bands") or {}).items()}

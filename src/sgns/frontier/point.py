"""One operating point: a way to get the motion of the soil, what it costs and how wrong it is. One row of a table."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from sgns.config import UserError
from sgns.data.files import read_table, whole_file

SHARED = 1.1  # wall time over processor time from which a core counts as shared
KINDS = ("solver", "reduction", "surrogate", "full space")
ERRORS = {
    "force_nrmse": "force, NRMSE [-]",
    "position_rmse_mm": "displacement of the soil, RMSE [mm]",
    "surface_rmse_mm": "surface at the end, RMSE [mm]",
    "sinkage_error_mm": "sinkage, mean absolute error [mm]",
}
"""Column → what it is, of the errors that points are compared by."""


@dataclass(frozen=True)
class Point:
    """One row of points.csv. A number that is not known, or has no meaning for this kind of point, is NaN.

    Errors are against the most accurate run of the study (row `reference`), pooled over the study's cases of the
    scene (observation.py); they are filled in when points are gathered, all other fields when a point is measured.
    """

    study: str  # quick, full or the name of a study of one's own
    scene: str  # cut, wheel, ...: points of one scene are on one figure
    kind: str  # one of `KINDS`
    # what is varied: dx, stiffness, an effect, r, width, ...; `reference` for the most accurate run
    axis: str
    label: str  # unique within scene and kind; stands in figures
    # the overrides that make it as they are written on the command line: of `sgns simulate` for the solver,
    # of `sgns train` for surrogates (dataset and length of the training among them)
    settings: str = ""
    note: str = ""  # what a reader must know, such as `left the range: not finite from frame 31 on`
    paper: bool = False  # an operating point of the paper

    # --- size ---
    particles: float = math.nan  # that are computed or decoded, the mirrored half included
    modes: float = math.nan  # r
    parameters: float = math.nan  # learned numbers

    # --- cost: medians of repeats, warm ---
    wall_s_per_simulated_s: float = math.nan
    wall_s_per_simulated_s_low: float = math.nan  # the fastest repeat
    wall_s_per_simulated_s_high: float = math.nan  # the slowest repeat
    processor_s_per_simulated_s: float = math.nan
    # with the positions of all particles in every frame, where they are not computed anyway
    decoded_wall_s_per_simulated_s: float = math.nan
    # of surrogates: pose by pose, with a call of `Simulator.step` for each; `wall_s_...` is of a whole path at once
    stepped_wall_s_per_simulated_s: float = math.nan
    repeats: float = math.nan  # how many repeats, or stretches of one run, the median is of
    # the reference workload (study.py), before and after, on the same core; processor time if that was shared
    workload_wall_s_per_simulated_s: float = math.nan
    ratio: float = math.nan  # `cost` / workload_wall_s_per_simulated_s
    includes: str = ""  # what is in the time
    processor: str = ""
    threads: float = math.nan
    device: str = ""

    # --- errors against the reference; low and high: the best and the worst case (solver) or case and seed ---
    force_nrmse: float = math.nan
    force_nrmse_low: float = math.nan
    force_nrmse_high: float = math.nan
    draft_nrmse: float = math.nan
    draft_mean_error: float = math.nan  # (mean - mean of the reference) / mean of the reference, signed
    vertical_nrmse: float = math.nan
    vertical_mean_error: float = math.nan
    torque_nrmse: float = math.nan
    position_rmse_mm: float = math.nan
    position_rmse_mm_low: float = math.nan
    position_rmse_mm_high: float = math.nan
    surface_rmse_mm: float = math.nan  # of the last frame
    surface_rmse_mm_low: float = math.nan
    surface_rmse_mm_high: float = math.nan
    sinkage_error_mm: float = math.nan  # mean absolute error of the height of a body that is free
    force_nrmse_q1: float = math.nan  # in the first quarter of the run; q2 to q4 likewise
    force_nrmse_q2: float = math.nan
    force_nrmse_q3: float = math.nan
    force_nrmse_q4: float = math.nan
    position_rmse_mm_q1: float = math.nan  # at the end of the first quarter of the run; q2 to q4 likewise
    position_rmse_mm_q2: float = math.nan
    position_rmse_mm_q3: float = math.nan
    position_rmse_mm_q4: float = math.nan

    # --- of surrogates: errors against the solver that made the training runs, over its test runs ---
    own_runs: float = math.nan
    own_force_nrmse: float = math.nan
    own_draft_mean_error: float = math.nan
    own_position_rmse_mm: float = math.nan
    own_surface_rmse_mm: float = math.nan
    own_sinkage_error_mm: float = math.nan
    frozen_rmse_mm: float = math.nan  # nothing moves: the baseline of skill_frozen
    skill_frozen: float = math.nan
    skill_constant_velocity: float = math.nan
    mean_force_nrmse: float = math.nan  # the mean force of the training runs: the baseline of own_force_nrmse
    training_s: float = math.nan  # processor seconds
    training_samples: float = math.nan  # windows seen, repetitions counted
    training_runs: float = math.nan
    energy: float = math.nan  # share of the displacement energy that the modes hold, held-out runs

    command: str = ""  # that measured it
    machine: str = ""
    version: str = ""  # of the package
    commit: str = ""  # of the code that measured it, where that was a checkout

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise UserError(f"a point is of kind {self.kind!r}; allowed: {', '.join(KINDS)}")

    @property
    def shared(self) -> bool:
        """Whether other work had the core for more than a tenth of the time while this was measured."""
        return self.wall_s_per_simulated_s > SHARED * self.processor_s_per_simulated_s

    @property
    def cost(self) -> float:
        """Seconds of one core per simulated second, see `core_time`."""
        return core_time(self.wall_s_per_simulated_s, self.processor_s_per_simulated_s)

    @property
    def decoded_cost(self) -> float:
        """As `cost`, with the positions of all particles."""
        if self.kind == "solver":
            return self.cost
        return self.decoded_wall_s_per_simulated_s * self.cost / self.wall_s_per_simulated_s

    @property
    def stepped_cost(self) -> float:
        """As `cost`, of what a control loop calls, frame by frame; NaN if it was not measured."""
        if self.kind == "solver":
            return self.cost
        return self.stepped_wall_s_per_simulated_s * self.cost / self.wall_s_per_simulated_s

    def row(self) -> dict[str, Any]:
        """Plain values by column, numbers to five digits, empty where not known."""
        return {
            key: value if not isinstance(value, float) else "" if math.isnan(value) else f"{value:.5g}"
            for key, value in asdict(self).items()
        }

    @classmethod
    def from_row(cls, row: dict[str, Any]) -> Point:
        """The point of a row of text or plain values; columns that are not known are left out.

        Raises:
            UserError: a value is not what its column holds.
        """
        values: dict[str, Any] = {}
        for field in fields(cls):
            given = row.get(field.name)
            if given is None or given == "":
                continue
            divides = field.name in _DIVISORS
            try:
                values[field.name] = value = _READERS[str(field.type)](given)
                if isinstance(value, float) and (math.isinf(value) or (divides and value <= 0.0)):
                    raise ValueError
            except (ValueError, KeyError, TypeError) as error:
                kind = "float above 0" if divides else field.type
                raise UserError(f"{field.name} is {given!r:.40}, which is not a {kind}") from error
        try:
            return cls(**values)
        except TypeError as error:
            raise UserError(f"a row of operating points lacks columns: {error}") from None


_DIVISORS = (
    "wall_s_per_simulated_s",
    "processor_s_per_simulated_s",
    "decoded_wall_s_per_simulated_s",
    "stepped_wall_s_per_simulated_s",
)
_READERS: dict[str, Callable[[Any], Any]] = {
    "str": str,
    "float": float,
    "bool": lambda v: {"True": True, "False": False}[str(v)],
}


def core_time(wall: float, processor: float) -> float:
    """Wall time, or the processor's where other work had the core for more than a tenth of the time."""
    return processor if wall > SHARED * processor else wall


def write_points(file: Path, points: Iterable[Point]) -> None:
    """A CSV file with one line per point, complete or not at all; columns that no point fills are there, too."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(file) as temporary, temporary.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, [field.name for field in fields(Point)], lineterminator="\n")
        writer.writeheader()
        writer.writerows(point.row() for point in points)


def read_points(file: Path) -> list[Point]:
    """The points of a CSV file.

    Raises:
        UserError: it cannot be read or is no such table.
    """
    rows = read_table(file, "no table of operating points", "make it: sgns frontier")
    if not rows:
        raise UserError(f"{file} is no table of operating points: it has no rows; make it: sgns frontier")
    try:
        return [Point.from_row(row) for row in rows]
    except UserError as error:
        raise UserError(f"{file} is no table of operating points: {error}") from None


# --- Which points nobody beats --------------------------------------------------------------------------


def usable(point: Point) -> bool:
    """Whether a point can stand in for a simulation: it finished, and needs no run of the solver as its input."""
    return point.kind != "reduction" and not math.isnan(point.cost)


def effective_error(point: Point, column: str, bands: Mapping[str, float]) -> float:
    """An error, but never less than what the reference itself may be wrong by; NaN if it is not known."""
    if point.axis == "reference":
        return bands.get(column, math.nan)
    error = getattr(point, column)
    return error if math.isnan(error) else max(error, bands.get(column, 0.0))


def front(points: Iterable[Point], column: str, bands: Mapping[str, float]) -> list[Point]:
    """The points that no faster point equals in an error, fastest first (Pareto)."""
    best, found = math.inf, []
    for point in sorted(filter(usable, points), key=lambda point: point.cost):
        error = effective_error(point, column, bands)
        if error < best:
            best = error
            found.append(point)
    return found

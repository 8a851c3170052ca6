"""Operating points of the reduction: what r modes leave out of runs that the basis has not seen, and what they cost.

An entry of `study.scenes.<scene>.reduction` has axis, label, `modes` (a list of r) and `centring`, and makes one point
for each r. One stream over the dataset's training runs serves all entries; held out are its other runs.
"""

from __future__ import annotations

import logging
import shlex
import statistics
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import torch

from sgns.campaign import Dataset
from sgns.claim import claimed
from sgns.clock import elapsed
from sgns.errors import UserError
from sgns.frontier.point import Point
from sgns.frontier.study import PointSettings, Study, StudyScene
from sgns.frontier.surrogate_points import training_settings
from sgns.frontier.timing import Workload, cost_fields, made_here, one_core
from sgns.reduction import CENTRINGS, Basis
from sgns.reduction.fitting import fit_runs
from sgns.reduction.reconstruction import reconstruction_curve
from sgns.runs import Run

__all__ = ["measure_reduction"]

log = logging.getLogger(__name__)

REPEATS = 5  # timed passes over some frames, after one that warms up
FRAMES = 16  # of one pass
INCLUDES = "encoding and decoding every frame; not: reading the frames, fitting the basis"


@dataclass(frozen=True, eq=False)
class Wanted:
    """One point to be measured."""

    entry: PointSettings
    centring: str
    modes: int

    @property
    def label(self) -> str:
        """Of the point."""
        return f"{self.entry.label}, r {self.modes}"


def wanted_of(scene: StudyScene) -> Iterator[Wanted]:
    """All points of a scene's entries.

    Raises:
        UserError: An entry lacks its keys, or they make no sense.
    """
    for entry in scene.points("reduction"):
        where = f"study.scenes.{scene.name}.reduction, {entry.label!r}"
        more = dict(entry.more or {})
        if more.get("centring") not in CENTRINGS:
            raise UserError(f"{where}: centring is {more.get('centring')!r}; allowed: {', '.join(CENTRINGS)}")
        modes = more.get("modes")
        if not isinstance(modes, list) or not all(type(r) is int and r >= 1 for r in modes):
            raise UserError(f"{where}: modes is {modes!r}; it must be a list of whole numbers, 1 or more")
        yield from (Wanted(entry, more["centring"], r) for r in modes)


def measure_reduction(study: Study) -> None:
    """Measure the reduction points of a study that are not there yet."""
    with one_core(last=True):
        for scene in study.scenes:
            wanted = list(wanted_of(scene))
            missing = [w for w in wanted if not study.store.has(scene.name, "reduction", w.label)]
            if not missing:
                continue
            # One process makes all of a scene's: they share the stream over the runs.
            with claimed(study.store.file(scene.name, "reduction", "all")) as ours:
                if ours:
                    measure_scene(study, scene, missing)


def measure_scene(study: Study, scene: StudyScene, missing: list[Wanted]) -> None:
    """Fit, measure and keep."""
    began = time.perf_counter()
    dataset = Dataset.open(training_settings(scene.dataset, ())["dataset"]["path"])
    training, held_out = dataset.runs("train"), [*dataset.runs("validation"), *dataset.runs("test")]
    pca = fit_runs(training, max(w.modes for w in missing))
    log.info(
        "%s, reduction: fitted on %d runs (%.0f s)",
        scene.name,
        len(training),
        elapsed(began, time.perf_counter()),
    )
    motion = held_out_motion(pca.basis("particle_axis", 1), held_out)
    workload = Workload()
    for centring in dict.fromkeys(w.centring for w in missing):
        basis = pca.basis(centring, pca.rank(centring))
        found = [w for w in missing if w.centring == centring and w.modes <= basis.num_modes]
        curve = reconstruction_curve(held_out, basis)
        before = workload.measure()
        coding = {one: coding_times(basis.sliced(one.modes), held_out[0]) for one in found}
        speed = [*before, *workload.measure()]
        for one, times in coding.items():
            mse = float(curve[one.modes])
            point = described(study, scene, one)
            study.store.save(
                replace(
                    point,
                    particles=float(len(basis.modes)),
                    own_runs=float(len(held_out)),
                    own_position_rmse_mm=1e3 * mse**0.5,
                    frozen_rmse_mm=1e3 * motion**0.5,
                    energy=1.0 - mse / motion,
                    training_runs=float(len(training)),
                    decoded_wall_s_per_simulated_s=statistics.median(times.decoding),
                    **cost_fields(times.both, speed, statistics.median(times.processor)),
                ),
                {},
            )
        if beyond := [w.modes for w in missing if w.centring == centring and w.modes > basis.num_modes]:
            log.info("%s: r %s left out, the data has %d modes", scene.name, beyond, basis.num_modes)
    log.info(
        "%s, reduction: %d points (%.0f s)", scene.name, len(missing), elapsed(began, time.perf_counter())
    )


def described(study: Study, scene: StudyScene, one: Wanted) -> Point:
    """What a point says of itself before anything is measured."""
    changes = [f"reduction.centring={one.centring}", f"reduction.num_modes={one.modes}"]
    if one.modes > 64:  # kept by default
        changes.append(f"reduction.max_modes={one.modes}")
    return Point(
        study=study.name,
        scene=scene.name,
        kind="reduction",
        axis=one.entry.axis,
        label=one.label,
        settings=shlex.join([f"dataset={scene.dataset}", *changes]),
        modes=float(one.modes),
        includes=INCLUDES,
        **made_here(),
    )


def held_out_motion(basis: Basis, paths: list[Path]) -> float:
    """Mean square of the held-out runs about each particle's mean place in the training runs [m²]: what the energy is
    a share of, for every centring."""
    return float(reconstruction_curve(paths, basis)[0])


class CodingTimes(NamedTuple):
    """Seconds per simulated second of some passes, a frame at a time.

    Attributes:
        both: wall time of encoding and decoding.
        processor: processor time of both.
        decoding: wall time of decoding.
    """

    both: list[float]
    processor: list[float]
    decoding: list[float]


def coding_times(basis: Basis, path: Path) -> CodingTimes:
    """Times of encoding and decoding the first frames of a run."""
    with Run(path) as run:
        positions, rate = torch.from_numpy(run.positions(slice(0, FRAMES))), run.frame_rate
    times = CodingTimes([], [], [])
    for repeat in range(REPEATS + 1):
        clock, began = time.process_time(), time.perf_counter()
        coded = [basis.transform(frame) for frame in positions]
        between = time.perf_counter()
        for latent in coded:
            basis.inverse(latent)
        end = time.perf_counter()
        if repeat:
            per_second = rate / len(positions)
            times.both.append(elapsed(began, end) * per_second)
            times.processor.append(elapsed(clock, time.process_time()) * per_second)
            times.decoding.append(elapsed(between, end) * per_second)
    return times

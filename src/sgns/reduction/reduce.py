"""The basis of a dataset's training runs, and every run in that basis, kept in the dataset's folder."""

from __future__ import annotations

import hashlib
import json
import logging
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from mpm_warp.settings import short_repr
from sgns.config import UserError
from sgns.data.dataset import SPLITS, Dataset
from sgns.data.files import parse_json, require_replaceable
from sgns.data.hdf5 import BROKEN, new_hdf5, open_hdf5, own_attribute, own_dataset
from sgns.data.run import Run, frame_chunks
from sgns.numbers import counted, require_shapes
from sgns.reduction.basis import Basis, reconstruction_curve
from sgns.reduction.closure import Closure, fit_closure
from sgns.reduction.pca import IncrementalPCA, checked_device
from sgns.settings import ReductionSettings

log = logging.getLogger(__name__)


# --- An incremental PCA over run files ------------------------------------------------------------------


def fit_runs(paths: Iterable[Path], max_modes: int, device: str = "cpu") -> IncrementalPCA:
    """One stream over runs; the bases of all centrings follow from it."""
    pca = IncrementalPCA(max_modes, device=device)
    for path in paths:
        with Run(path) as run:
            for frames in frame_chunks(run.particle_count, run.frame_count):
                positions = run.positions(frames)
                try:
                    pca.partial_fit(positions)
                except UserError:
                    require_positions(path, frames.start, positions)
                    raise
    return pca


def require_positions(path: Path, first: int, positions: np.ndarray) -> None:
    """Refuses positions (t, n, 3) of a run from its frame `first` on that are no numbers; the line says where."""
    bad = ~np.isfinite(positions)
    if bad.any():
        frame, particle, axis = (int(i) for i in np.argwhere(bad)[0])
        raise UserError(
            f"{path}: the position of particle {particle} along {'xyz'[axis]} is {positions[frame, particle, axis]} "
            f"at frame {first + frame}; simulate this run again, or remove it"
        )


# --- How many modes are enough: `reduction.num_modes=auto` ----------------------------------------------


def choose_modes(basis: Basis, settings: Mapping[str, Any], validation: Sequence[Path]) -> tuple[int, str]:
    """The fewest modes that are good enough, and why, as part of a sentence.

    Args:
        basis: With all its modes.
        settings: `conf/reduction`; used are choose, tolerance and share.
        validation: Run files that the basis was not fitted on, for `position`; without any, the error on
            the runs that it was fitted on counts.

    Raises:
        UserError: All modes together are not good enough; the line says what they reach.
    """
    if settings["choose"] == "position":
        curve = (
            reconstruction_curve(validation, basis)[1:] if validation else np.asarray(basis.residual_mse())
        )
        values = 1e3 * np.sqrt(curve)
        key, unit, sign, change = "tolerance", " mm", "≤", "raise"
        what = (
            f"RMSE on {counted(len(validation), 'validation run')}"
            if validation
            else "RMSE on the training runs"
        )
    else:
        values = np.asarray(getattr(basis, settings["choose"])())
        key, unit, sign, change = "share", "", "≥", "lower"
        what = f"{settings['choose'].replace('_', ' ')} of the training runs"
    limit = settings[key]
    enough = values <= limit if key == "tolerance" else values >= limit
    asked = f"{sign} reduction.{key}={limit:g}{unit}"
    if not enough.any():
        # With fewer modes than were asked for there are no more to be had.
        more = "" if basis.num_modes < settings["max_modes"] else ", or raise reduction.max_modes"
        raise UserError(
            f"reduction.num_modes=auto: {what} must be {asked} but all {basis.num_modes} modes reach "
            f"{_shown(values[-1], limit)}{unit}; {change} reduction.{key}{more}"
        )
    first = int(enough.argmax())
    return first + 1, f"{what} is {_shown(values[first], limit)}{unit}, {asked}"


def _shown(value: float, limit: float) -> str:
    """`value` with enough digits to tell it from `limit`."""
    digits = 4
    if value != limit:
        digits = max(digits, 1 + math.ceil(-math.log10(abs(value - limit) / max(abs(value), abs(limit)))))
    return f"{value:.{digits}g}"


# --- The cache in the dataset's folder ------------------------------------------------------------------
#     <dataset>/reduced/<key>/basis.h5               fitted on the training split only
#     <dataset>/reduced/<key>/<content hash>.h5      one reduced run each
#
# The key is made of the training runs' content and of the settings that the basis depends on, not of how many
# of its modes are used: a basis of `max_modes` modes is kept and its first `num_modes` are used, so that a
# sweep over them fits once. Every file appears complete or not at all, so several processes may do this at the
# same time.
#
# Letters: T frames, n particles, M body points, r modes.

_FORMAT = "sgns-reduced-run-1"
_SERIES: dict[str, tuple[int | str, ...]] = {
    "latent": ("T", "r", 3),
    "time": ("T",),
    "pose": ("T", 7),
    "body_points": ("T", "M", 3),
    "force": ("T", 3),
    "torque": ("T", 3),
}


@dataclass(frozen=True, eq=False)
class ReducedRun:
    """A run whose soil is a few modes."""

    __repr__ = short_repr

    name: str  # file name of the run without its ending
    latent: np.ndarray  # modes [m], shape (T, r, 3)
    time: np.ndarray  # [s], shape (T,)
    pose: np.ndarray  # centre of mass [m] and quaternion x, y, z, w, shape (T, 7)
    body_points: np.ndarray  # world frame [m], shape (T, M, 3)
    force: np.ndarray  # by the soil on the body [N], shape (T, 3)
    torque: np.ndarray  # about the centre of mass [N m], shape (T, 3)
    scene: dict[str, Any]  # the complete scene as plain data
    path: Path | None = None  # the run file; None where there is none with particles
    unseen: np.ndarray | None = (
        None  # without one: squares that all modes do not see, of `left_out` since frame 0, (T, 2)
    )


@dataclass(frozen=True, eq=False)
class ReducedDataset:
    """A dataset in the basis of its training split."""

    __repr__ = short_repr

    basis: Basis  # with all `max_modes` modes; `basis.sliced(r)` keeps the first r, `latent[:, :r]` likewise
    num_modes: int  # r, the modes to use: `reduction.num_modes`, or what `auto` chose
    folder: Path  # where it is cached
    frame_rate: float  # [Hz]
    start_positions: np.ndarray  # common start of the soil [m], shape (n, 3), float64
    _runs: Mapping[str, Sequence[ReducedRun]] = field(repr=False)
    closure: Closure | None = None  # of the first `num_modes` modes

    def of_modes(self, r: int) -> Basis:
        """The basis of the first r modes, with the closure if it is of that many."""
        return replace(self.basis.sliced(r), closure=self.closure if r == self.num_modes else None)

    def runs(self, split: str) -> list[ReducedRun]:
        """The runs of "train", "validation" or "test"."""
        return list(self._runs[split])


def reduce_dataset(
    dataset: Dataset, reduction: Mapping[str, Any], progress: bool = True, device: str = "cpu"
) -> ReducedDataset:
    """Fit the basis, or take the cached one, and reduce every run that is not yet.

    Args:
        dataset: With complete runs.
        reduction: Values of `conf/reduction`.
        progress: Whether to show a bar (never without a terminal).
        device: Torch device that fits and projects.

    Raises:
        UserError: No training runs, runs of different beds, more modes asked than the data has, or no
            number of modes good enough.
    """
    settings = ReductionSettings.from_dict(dict(reduction)).to_dict()
    checked_device(device)
    paths = {split: dataset.runs(split) for split in SPLITS}
    everything = [path for split in SPLITS for path in paths[split]]
    if not paths["train"]:
        raise UserError(f"{dataset.path} has no complete training runs; make them with: {dataset.command}")
    content, frame_rate = check_one_bed(everything)
    folder = dataset.path / "reduced" / cache_key([content[path] for path in paths["train"]], settings)
    bar = {"disable": None if progress else True, "unit": "run", "leave": False}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        cached = [folder / "basis.h5", *(folder / f"{one}.h5" for one in content.values())]
        require_replaceable(*(file for file in cached if not file.is_file()))
        basis = fitted_basis(folder / "basis.h5", paths["train"], settings, bar, device)
        projector = basis.to(device)
        num_modes = modes_to_use(projector, settings, paths["validation"])
        reduced = {
            path: reduced_run(folder / f"{content[path]}.h5", path, projector)
            for path in tqdm(everything, desc="reducing runs", **bar)
        }
    except OSError as error:
        raise UserError(
            f"cannot keep the reduced runs in {folder}: {error}; make the dataset's folder writable"
        ) from error
    with Run(paths["train"][0]) as run:
        start = run.positions(slice(0, 1))[0].astype(np.float64)
    runs = {split: [reduced[path] for path in paths[split]] for split in SPLITS}
    closure = fitted_closure(basis, num_modes, settings, runs)
    return ReducedDataset(basis, num_modes, folder, frame_rate, start, runs, closure)


def check_one_bed(paths: Sequence[Path]) -> tuple[dict[Path, str], float]:
    """Content hash of every run, and the frame rate they share; refuses a mixture of beds or rates."""
    content: dict[Path, str] = {}
    beds: dict[tuple[str, int, float], Path] = {}
    for path in paths:
        with Run(path) as run:
            if run.scene.get("others"):
                raise UserError(
                    f"{path} has further bodies (scene.others), and a network knows one body: train on runs without"
                )
            content[path] = run.content_hash
            beds.setdefault((run.arrangement_hash, run.particle_count, run.frame_rate), path)
    if len(beds) > 1:
        one, other = list(beds.values())[:2]
        raise UserError(
            f"the runs do not belong together: {one} and {other} differ in particle arrangement or frame "
            "rate; one basis serves one bed: keep one dataset per bed"
        )
    return content, next(iter(beds))[2]


def modes_to_use(basis: Basis, settings: Mapping[str, Any], validation: Sequence[Path]) -> int:
    """`reduction.num_modes`, or for `auto` the number that is enough, with a line that says why."""
    asked = settings["num_modes"]
    if asked == "auto":
        chosen, reason = choose_modes(basis, settings, validation)
        log.info("reduction.num_modes=auto: %s; %s", counted(chosen, "mode"), reason)
        return chosen
    if asked > basis.num_modes:
        raise UserError(
            f"reduction.num_modes is {asked} but the training runs give "
            f"{basis.num_modes} modes; ask for at most {basis.num_modes}"
        )
    return asked


def fitted_closure(
    basis: Basis, r: int, settings: Mapping[str, Any], runs: Mapping[str, Sequence[ReducedRun]]
) -> Closure | None:
    """That of the first r modes as `reduction.closure` says, with a line on what it gains."""
    if settings["closure"] == "none":
        return None
    last = min(settings["closure_modes"], basis.num_modes)
    if last <= r:
        raise UserError(
            f"reduction.closure={settings['closure']} has no modes to add to the {r} that are stepped, of "
            f"{last} in all; raise reduction.closure_modes and reduction.max_modes, or lower reduction.num_modes"
        )
    train, validation = ([run.latent for run in runs[split]] for split in ("train", "validation"))
    closure, without, error = fit_closure(settings["closure"], basis.modes[:, :last], r, train, validation)
    log.info(
        "%s closure: modes %d to %d follow from the first %d with an RMSE of %.3g mm on %s; without it %.3g mm",
        settings["closure"],
        r + 1,
        last,
        r,
        1e3 * error,
        counted(len(validation), "validation run") if validation else "every third training run",
        1e3 * without,
    )
    return closure


def cache_key(training_content: Sequence[str], settings: Mapping[str, Any]) -> str:
    """Name of the cache for a training split, in any order, and the settings that the basis depends on."""
    told = {key: settings[key] for key in ("max_modes", "centring")}
    text = json.dumps([_FORMAT, sorted(training_content), told], sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def fitted_basis(
    path: Path, runs: Sequence[Path], settings: Mapping[str, Any], bar: dict[str, Any], device: str = "cpu"
) -> Basis:
    """The cached basis, or a new one of as many modes as the data gives up to `max_modes`."""
    if path.exists():
        try:
            return Basis.load(path)
        except UserError as error:
            log.warning("%s; fitting it anew", error)
    # More modes than particles or rows cannot be had, whatever is asked.
    pca = fit_runs(tqdm(runs, desc="fitting the basis", **bar), settings["max_modes"], device)
    with Run(runs[0]) as run:
        arrangement = run.arrangement_hash
    rank = pca.rank(settings["centring"])
    if rank == 0:
        raise UserError(
            "nothing moves in the training runs: the data has rank 0 and no modes; simulate "
            "runs that move the soil"
        )
    basis = pca.basis(
        settings["centring"], rank, arrangement_hash=arrangement, fitted_on=[path.stem for path in runs]
    )
    basis.save(path)
    return basis


def reduced_run(path: Path, run_path: Path, basis: Basis) -> ReducedRun:
    """The cached reduced run, or a new one."""
    if path.exists():
        try:
            return replace(read_reduced(path, {"r": basis.num_modes}), name=run_path.stem, path=run_path)
        except BROKEN as error:
            log.warning("%s is damaged (%s); reducing %s again", path, error, run_path)
    with Run(run_path) as run:
        parts = []
        for frames in frame_chunks(run.particle_count, run.frame_count):
            positions = run.positions(frames)
            parts.append(basis.transform(positions).cpu())
            if not bool(parts[-1].isfinite().all()):
                require_positions(run_path, frames.start, positions)
        series = {name: getattr(run, name) for name in _SERIES if name != "latent"}
        reduced = ReducedRun(
            run_path.stem, torch.cat(parts).numpy(), **series, scene=run.scene, path=run_path
        )
    write_reduced(path, reduced)
    return reduced


def write_reduced(path: Path, run: ReducedRun) -> None:
    """Write a reduced run; it appears complete or not at all."""
    with new_hdf5(path) as file:
        for name in _SERIES:
            file.create_dataset(name, data=getattr(run, name))
        file.create_dataset("scene", data=json.dumps(run.scene))
        file.attrs["name"] = run.name
        file.attrs["format"] = _FORMAT


def read_reduced(path: Path, counts: Mapping[str, int] | None = None) -> ReducedRun:
    """Read a reduced run; `counts` are T, r or M where they are known.

    Raises:
        One of sgns.data.hdf5.BROKEN: Not one, or its arrays do not fit together.
    """
    with open_hdf5(path) as file:
        if own_attribute(file, "format") != _FORMAT:
            raise ValueError("not a reduced run")
        series = {name: own_dataset(file, name)[()] for name in _SERIES}
        require_shapes(series, _SERIES, counts)
        if infinite := [name for name, values in series.items() if not np.isfinite(values).all()]:
            raise ValueError(f"{infinite[0]} is not finite")
        scene = parse_json(own_dataset(file, "scene")[()])
        if not isinstance(scene, dict):
            raise ValueError("its scene is no group of keys")
        return ReducedRun(name=str(own_attribute(file, "name")), scene=scene, **series)

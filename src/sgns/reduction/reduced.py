"""The basis of a dataset's training runs, and every run in that basis, kept in the dataset's folder.

    <dataset>/reduced/<key>/basis.h5               fitted on the training split only
    <dataset>/reduced/<key>/<content hash>.h5      one reduced run each

The key is made of the training runs' content and of the settings, without `num_modes`: a basis of `max_modes`
modes is kept and its first `num_modes` are used, so that a sweep over them fits once. Every file appears
complete or not at all, so several processes may do this at the same time.

Letters: T frames, n particles, M body points, r modes.
"""

from __future__ import annotations

import hashlib
import json
import logging
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypedDict

import h5py
import numpy as np
import torch
from tqdm import tqdm

from sgns.campaign import SPLITS, Dataset
from sgns.errors import UserError
from sgns.reduction.basis import CENTRINGS, Basis
from sgns.reduction.incremental_pca import IncrementalPCA
from sgns.runs import Run, frame_chunks
from sgns.settings import check_fields
from sgns.wholefile import whole_file

__all__ = ["ReducedDataset", "ReducedRun", "reduce_dataset"]

log = logging.getLogger(__name__)

_FORMAT = "sgns-reduced-run-1"
_SERIES = ("latent", "time", "pose", "body_points", "force", "torque")


@dataclass(frozen=True, eq=False)
class ReducedRun:
    """A run whose soil is a few modes.

    Attributes:
        name: File name of the run without its ending.
        latent: Modes [m], shape (T, r, 3).
        time: [s], shape (T,).
        pose: Centre of mass [m] and quaternion x, y, z, w, shape (T, 7).
        body_points: World frame [m], shape (T, M, 3).
        force: By the soil on the body [N], shape (T, 3).
        torque: About the centre of mass [N m], shape (T, 3).
        scene: The complete scene as plain data.
    """

    name: str
    latent: np.ndarray
    time: np.ndarray
    pose: np.ndarray
    body_points: np.ndarray
    force: np.ndarray
    torque: np.ndarray
    scene: dict[str, Any]


@dataclass(frozen=True, eq=False)
class ReducedDataset:
    """A dataset in the basis of its training split.

    Attributes:
        basis: The basis with all `max_modes` modes; `basis.sliced(r)` keeps the first r, `latent[:, :r]`
            likewise.
        folder: Where it is cached.
        frame_rate: [Hz].
        start_positions: Common start of the soil [m], shape (n, 3), float64.
    """

    basis: Basis
    folder: Path
    frame_rate: float
    start_positions: np.ndarray
    _runs: Mapping[str, Sequence[ReducedRun]] = field(repr=False)

    @property
    def arrangement_hash(self) -> str:
        """Of the particle arrangement all runs share."""
        return self.basis.arrangement_hash

    def runs(self, split: str) -> list[ReducedRun]:
        """The runs of "train", "validation" or "test"."""
        if split not in self._runs:
            raise UserError(f"no split {split!r}; allowed: {', '.join(SPLITS)}")
        return list(self._runs[split])


def reduce_dataset(dataset: Dataset, reduction: Mapping[str, Any], progress: bool = True) -> ReducedDataset:
    """Fit the basis, or take the cached one, and reduce every run that is not yet.

    Args:
        dataset: With complete runs.
        reduction: `conf/reduction`: num_modes, max_modes, centring.
        progress: Whether to show a bar (never without a terminal).

    Returns:
        The reduced dataset, with all `max_modes` modes.

    Raises:
        UserError: No training runs, runs of different beds, more modes asked than the data has.
    """
    settings = check_settings(reduction)
    paths = {split: [Path(path) for path in dataset.runs(split)] for split in SPLITS}
    if not paths["train"]:
        raise UserError(
            f"{dataset.path} has no complete training runs; make them with: sgns simulate "
            f"dataset={dataset.name}"
        )
    content, frame_rate = check_one_bed([path for split in SPLITS for path in paths[split]])
    folder = Path(dataset.path) / "reduced" / cache_key([content[path] for path in paths["train"]], settings)
    bar = {"disable": not (progress and sys.stderr.isatty()), "unit": "run", "leave": False}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        basis = fitted_basis(folder / "basis.h5", paths["train"], settings, bar)
        if settings["num_modes"] > basis.num_modes:
            raise UserError(
                f"reduction.num_modes is {settings['num_modes']} but the training runs give "
                f"{basis.num_modes} modes; ask for at most {basis.num_modes}"
            )
        everything = [path for split in SPLITS for path in paths[split]]
        reduced = {
            path: reduced_run(folder / f"{content[path]}.h5", path, basis)
            for path in tqdm(everything, desc="reducing runs", **bar)
        }
    except OSError as error:
        raise UserError(
            f"cannot keep the reduced runs in {folder}: {error}; make the dataset's folder writable"
        ) from error
    with Run(paths["train"][0]) as run:
        start = run.positions(slice(0, 1))[0].astype(np.float64)
    runs = {split: [reduced[path] for path in paths[split]] for split in SPLITS}
    return ReducedDataset(basis, folder, frame_rate, start, runs)


class ReductionSettings(TypedDict):
    """What `conf/reduction` says; see there for the meaning of each key."""

    num_modes: int
    max_modes: int
    centring: str


def check_settings(reduction: Mapping[str, Any]) -> dict[str, Any]:
    """The settings as plain values, refused where they make no sense."""
    check_fields(ReductionSettings, reduction, "reduction")
    settings = dict(reduction)
    if settings["centring"] not in CENTRINGS:
        raise UserError(f"reduction.centring is {settings['centring']!r}; allowed: {', '.join(CENTRINGS)}")
    if not 1 <= settings["num_modes"] <= settings["max_modes"]:
        raise UserError(
            f"reduction.num_modes is {settings['num_modes']}; allowed: 1 to reduction.max_modes "
            f"({settings['max_modes']}); raise reduction.max_modes to keep more"
        )
    return settings


def check_one_bed(paths: Sequence[Path]) -> tuple[dict[Path, str], float]:
    """Content hash of every run, and the frame rate they share; refuses a mixture of beds or rates."""
    content: dict[Path, str] = {}
    beds: dict[tuple[str, int, float], Path] = {}
    for path in paths:
        with Run(path) as run:
            content[path] = run.content_hash
            beds.setdefault((run.arrangement_hash, run.particle_count, run.frame_rate), path)
    if len(beds) > 1:
        one, other = list(beds.values())[:2]
        raise UserError(
            f"the runs do not belong together: {one} and {other} differ in particle arrangement or frame "
            "rate; one basis serves one bed: keep one dataset per bed"
        )
    return content, next(iter(beds))[2]


def cache_key(training_content: Sequence[str], settings: Mapping[str, Any]) -> str:
    """Name of the cache for a training split and settings; `num_modes` does not matter, the order of runs
    neither."""
    told = {key: value for key, value in settings.items() if key != "num_modes"}
    text = json.dumps([_FORMAT, sorted(training_content), told], sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def fitted_basis(path: Path, runs: Sequence[Path], settings: Mapping[str, Any], bar: dict[str, Any]) -> Basis:
    """The cached basis, or a new one of as many modes as the data gives up to `max_modes`."""
    if path.exists():
        try:
            return Basis.load(path)
        except UserError as error:
            log.warning("%s; fitting it anew", error)
    # More modes than particles or rows cannot be had, whatever is asked.
    pca = IncrementalPCA(settings["max_modes"])
    names, arrangement = [], ""
    for run_path in tqdm(runs, desc="fitting the basis", **bar):
        with Run(run_path) as run:
            arrangement = run.arrangement_hash
            for frames in frame_chunks(run.particle_count, run.frame_count):
                pca.partial_fit(run.positions(frames))
        names.append(run_path.stem)
    rank = pca.rank(settings["centring"])
    if rank == 0:
        raise UserError(
            "nothing moves in the training runs: the data has rank 0 and no modes; simulate "
            "runs that move the soil"
        )
    basis = pca.basis(settings["centring"], rank, arrangement_hash=arrangement, fitted_on=names)
    basis.save(path)
    return basis


def reduced_run(path: Path, run_path: Path, basis: Basis) -> ReducedRun:
    """The cached reduced run, or a new one."""
    if path.exists():
        try:
            return replace(read_reduced(path), name=run_path.stem)
        except (OSError, KeyError, ValueError) as error:
            log.warning("%s is damaged (%s); reducing %s again", path, error, run_path)
    with Run(run_path) as run:
        latent = torch.cat(
            [
                basis.transform(run.positions(frames))
                for frames in frame_chunks(run.particle_count, run.frame_count)
            ]
        ).numpy()
        reduced = ReducedRun(
            run_path.stem, latent, run.time, run.pose, run.body_points, run.force, run.torque, run.scene
        )
    write_reduced(path, reduced)
    return reduced


def write_reduced(path: Path, run: ReducedRun) -> None:
    """Write a reduced run; it appears complete or not at all."""
    with whole_file(path) as temporary, h5py.File(temporary, "w") as file:
        for name in _SERIES:
            file.create_dataset(name, data=getattr(run, name))
        file.create_dataset("scene", data=json.dumps(run.scene))
        file.attrs["name"] = run.name
        file.attrs["format"] = _FORMAT


def read_reduced(path: Path) -> ReducedRun:
    """Read a reduced run.

    Raises:
        OSError, KeyError, ValueError: Not one.
    """
    with h5py.File(path, "r") as file:
        if file.attrs.get("format") != _FORMAT:
            raise ValueError("not a reduced run")
        series = {name: file[name][()] for name in _SERIES}
        return ReducedRun(name=str(file.attrs["name"]), scene=json.loads(file["scene"][()]), **series)

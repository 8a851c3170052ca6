"""The published reduced runs as a dataset to learn from.

The authors' basis is not published, only the modes' positions. So the basis here is the unit matrix: what is called
soil are the modes themselves, and the mean over all particles follows from how many there were.

Shapes: T frames, M body points, r modes.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sgns.campaign import SPLITS
from sgns.errors import UserError
from sgns.poses import fitted_poses, quaternions
from sgns.published import DIAMETERS, PublishedRun, published_files, read_published
from sgns.reduction.basis import Basis
from sgns.reduction.reduced import ReducedDataset, ReducedRun

__all__ = ["PARTICLES", "fingerprint", "published_dataset", "published_runs"]

log = logging.getLogger(__name__)

PARTICLES = {"excavation": 4880, "wheel": 6005}
"""Particles behind the published modes."""

_FRAME_RATE = 60.0  # [Hz]
_RIM_SPEED = 0.0195  # of the published wheels [m/s]
_RIM = 0.974  # the published rim's points lie at this share of the diameter
_SPLIT = {"train": "train", "valid": "validation", "validation": "validation", "test": "test"}


def published_dataset(settings: Mapping[str, Any], num_modes: int | str) -> ReducedDataset:
    """The runs of a folder, split for training.

    With a train.tfrecord every file is its split. Without one all runs are for training, but for one fold if there are
    `folds`; that fold is both for validation and for the test, which therefore is not blind to the choice of the
    checkpoint, unless the files say otherwise.

    Args:
        settings: The `dataset` group.
        num_modes: r, the first of the published modes.
    """
    folder, folds, fold = Path(settings["path"]), settings.get("folds"), settings.get("fold", 0)
    runs = published_runs(folder)
    split: dict[str, list[ReducedRun]] = {name: [] for name in SPLITS}
    if "train" in runs:
        if folds is not None:
            raise UserError(
                f"{folder} has a train.tfrecord and thereby a split of its own; use dataset.folds=null"
            )
        for name, found in runs.items():
            split[_SPLIT.get(name, "test")] += found
    else:
        everything = [run for found in runs.values() for run in found]
        if folds is None:
            split["train"] = everything
        else:
            _check_fold(folds, fold, len(everything))
            split["test"] = everything[fold::folds]
            split["train"] = [run for i, run in enumerate(everything) if i % folds != fold]
    first = split["train"][0]
    if {run.scene["kind"] for name in SPLITS for run in split[name]} != {first.scene["kind"]}:
        raise UserError(f"{folder} mixes blades and wheels; keep one folder for each")
    modes = first.latent.shape[1]
    if not isinstance(num_modes, int) or not 1 <= num_modes <= modes:
        raise UserError(
            f"reduction.num_modes is {num_modes}; {folder} holds {modes} modes: allowed are 1 to {modes}"
        )
    basis = Basis(
        mean=torch.zeros(modes, 3, dtype=torch.float64),
        modes=torch.eye(modes, dtype=torch.float64),
        eigenvalues=torch.zeros(modes, dtype=torch.float64),
        total_variance=0.0,
        displacement_variance=0.0,
        centring="scalar",
        arrangement_hash=f"published-{first.scene['kind']}",
        fitted_on=[f"{run.name} {fingerprint(run)}" for run in split["train"]],
    )
    start = np.mean([run.latent[0] for run in split["train"]], axis=0)
    return ReducedDataset(basis, num_modes, folder, _FRAME_RATE, start, split)


def published_runs(folder: str | Path) -> dict[str, list[ReducedRun]]:
    """All runs of a folder by the name of their file."""
    found = {}
    for split in published_files(folder):
        runs = read_published(folder, split=split)
        # The authors drew their training split with replacement: a run may be there twice.
        unique = {run.latent.tobytes(): run for run in runs}.values()
        found[split] = [_reduced(run, f"{split}_{i:03d}") for i, run in enumerate(unique)]
        if len(found[split]) < len(runs):
            log.info("%s.tfrecord: %d runs, %d of them different", split, len(runs), len(found[split]))
    return found


def fingerprint(run: ReducedRun) -> str:
    """Tells whether two runs are the same, whatever they are called."""
    return hashlib.blake2b(np.ascontiguousarray(run.latent).tobytes(), digest_size=6).hexdigest()


def _check_fold(folds: Any, fold: Any, count: int) -> None:
    if not isinstance(folds, int) or isinstance(folds, bool) or not 2 <= folds <= count:
        raise UserError(f"dataset.folds is {folds!r}; allowed: 2 to {count}, the number of runs, or null")
    if not isinstance(fold, int) or isinstance(fold, bool) or not 0 <= fold < folds:
        raise UserError(f"dataset.fold is {fold!r}; allowed: 0 to {folds - 1}")


def _reduced(run: PublishedRun, name: str) -> ReducedRun:
    # To this package's axes; where the origin of a mode's positions lies does not matter.
    latent = np.stack([-run.latent[..., 0], run.latent[..., 2], run.latent[..., 1]], axis=-1)
    time = np.arange(len(latent)) / _FRAME_RATE
    return ReducedRun(
        name=name if run.case is None else f"{run.kind}_{run.case:03d}",
        latent=latent,
        time=time,
        pose=_wheel_poses(run.body_points) if run.kind == "wheel" else _blade_poses(run.body_points),
        body_points=run.body_points,
        force=run.force,
        torque=np.zeros_like(run.force),
        scene={"kind": run.kind} | (_wheel_values(run) if run.kind == "wheel" else {}),
    )


def _wheel_values(run: PublishedRun) -> dict[str, float]:
    """What the context of the file and the wheel's points say."""
    points = run.body_points
    gravity, angle, load = (float(value) for value in run.context[0])
    across = float(np.ptp(points[0, :, 0])) / _RIM
    speed = float(points[-1, :, 0].mean() - points[0, :, 0].mean()) * _FRAME_RATE / (len(points) - 1)
    return {
        "gravity": gravity,
        "friction_angle": angle,
        "load": load,
        "diameter": min(DIAMETERS, key=lambda diameter: abs(diameter - across)),
        "slip": round(1.0 - speed / _RIM_SPEED, 4),
    }


def _wheel_poses(points: np.ndarray) -> np.ndarray:
    """Centre of the rim's points and turn since the first frame, shape (T, 7)."""
    return fitted_poses(points[0] - points[0].mean(axis=0), points)


def _blade_poses(points: np.ndarray) -> np.ndarray:
    """Middle of the lowest row of points, and the plate's directions, shape (T, 7).

    Blades with 15 and with 20 points have different middles; the lowest row is at the same place in both.
    """
    first = points[0]
    tip = first[:, 2] < first[:, 2].min() + 1e-3
    _, _, axes = np.linalg.svd(first - first.mean(axis=0))
    across = axes[0] * np.sign(axes[0, 1])
    along = axes[1] * np.sign(axes[1, 2])
    turned = quaternions(np.stack([np.cross(across, along), across, along], axis=1))
    middle = points[:, tip].mean(axis=1)
    return np.concatenate([middle, np.tile(turned, (len(points), 1))], axis=1)

"""A reduced dataset in a few small files, to share and to train from without its runs.

    <folder>/basis.npz        the basis, the bed at the start, and which runs are for what
    <folder>/runs_00.npz ...  the reduced runs, so many in a file that it stays small

Coordinates along the modes are rounded to one step for all of them, such that the decoded soil moves by 0.002 mm (RMS,
the limit `PRECISION`), and kept as second differences in time: small whole numbers, which pack well. The rest is in
single or half precision; what that costs is printed when it is written.

Letters: T frames, n particles, M body points, r modes.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mpm_warp.poses import in_body_frame, in_world_frame
from sgns.config import UserError
from sgns.data.dataset import SPLITS
from sgns.data.files import one_line, parse_json, read_arrays, write_arrays
from sgns.reduction.basis import Basis, left_out
from sgns.reduction.reduce import ReducedDataset, ReducedRun, fitted_closure
from sgns.settings import ReductionSettings

PRECISION = 2e-6
"""RMS distance along an axis by which the rounding of the modes' coordinates moves a particle [m]."""
MOST_BYTES = 2_800_000
"""Of a file of runs, about."""

_FORMAT = "sgns-packed-dataset-1"
_SERIES = {"latent": "<u4", "pose": "<f4", "force": "<f2", "torque": "<f2", "unseen": "<f4", "points": "<f4"}
_WRONG = "no part of a reduced dataset, or damaged"


# --- Writing --------------------------------------------------------------------------------------------


def pack(reduced: ReducedDataset, folder: Path) -> str:
    """Write a reduced dataset into `folder`, which is new or empty; returns a line with what it takes and costs."""
    if folder.exists() and any(folder.iterdir()):
        raise UserError(f"{folder} is not empty; name another folder, or remove what is there")
    basis = reduced.basis
    step = PRECISION * math.sqrt(12.0 * basis.num_particles / basis.num_modes)
    runs = [_with_unseen(run, basis) for split in SPLITS for run in reduced.runs(split)]
    size = _write(folder / "runs_00.npz", runs, step)
    parts = min(math.ceil(size / MOST_BYTES), len(runs))
    if parts > 1:
        for part in range(parts):
            share = runs[part * len(runs) // parts : (part + 1) * len(runs) // parts]
            _write(folder / f"runs_{part:02d}.npz", share, step)
    about = {
        "format": _FORMAT,
        "frame_rate": reduced.frame_rate,
        "parts": parts,
        "split": {name: [run.name for run in reduced.runs(name)] for name in SPLITS},
        "centring": basis.centring,
        "arrangement_hash": basis.arrangement_hash,
        "total_variance": basis.total_variance,
        "displacement_variance": basis.displacement_variance,
        "residual_variance": basis.residual_variance,
    }
    arrays = {
        "about": _text(about),
        "mean": basis.mean.numpy().astype("f4"),
        "start": reduced.start_positions.astype("f4"),
        "modes": basis.modes.numpy().astype("f2"),
        "eigenvalues": basis.eigenvalues.numpy(),
    }
    write_arrays(folder / "basis.npz", arrays)
    soil, force = _loss(reduced, packed_dataset(folder, {"num_modes": basis.num_modes}))
    total = sum(path.stat().st_size for path in folder.iterdir())
    return (
        f"{len(runs)} reduced runs of {basis.num_modes} modes in {folder}: {total / 1e6:.3g} MB; this moves "
        f"the soil by {1e3 * soil:.2g} mm and the force by {100 * force:.2g} % (RMS)"
    )


def _with_unseen(run: ReducedRun, basis: Basis) -> ReducedRun:
    """The run with what all modes do not see of it; its file is read for that."""
    if run.path is not None:
        return replace(run, unseen=np.stack(left_out(run.path, basis, 0), axis=-1))
    if run.unseen is None:
        raise UserError(f"{run.name} has no particles: it cannot be packed")
    return run


def _write(path: Path, runs: Sequence[ReducedRun], step: float) -> int:
    """Write some runs, one after the other in every array; returns the size of the file."""
    columns: dict[str, list[np.ndarray]] = {name: [] for name in _SERIES}
    for run in runs:
        whole = np.rint(run.latent / step).astype(np.int64)
        small = np.diff(whole, n=2, axis=0, prepend=np.zeros((2, *whole.shape[1:]), np.int64))
        unsigned = np.where(small < 0, -2 * small - 1, 2 * small)  # small ones have no bits above
        if unsigned.max() >= 2**32:
            raise UserError(f"{run.name} moves too far to be packed")
        columns["latent"].append(unsigned.transpose(1, 2, 0).astype("u4").ravel())
        columns["pose"].append(run.pose.astype("f4").ravel())
        columns["unseen"].append(np.asarray(run.unseen, "f4").ravel())
        columns["points"].append(in_body_frame(run.pose[0], run.body_points[0]).astype("f4").ravel())
        for name in ("force", "torque"):
            columns[name].append((getattr(run, name) / _scale(run, name)).astype("f2").ravel())
    about = [
        {
            "name": run.name,
            "frames": len(run.pose),
            "points": run.body_points.shape[1],
            "force": _scale(run, "force"),
            "torque": _scale(run, "torque"),
            "scene": run.scene,
        }
        for run in runs
    ]
    arrays = {name: _planes(np.concatenate(parts)) for name, parts in columns.items()}
    write_arrays(path, arrays | {"about": _text({"format": _FORMAT, "step": step, "runs": about})})
    return path.stat().st_size


def _planes(values: np.ndarray) -> np.ndarray:
    """The bytes of numbers (k,), all the first ones first: they are alike, and so pack better."""
    return values.view(np.uint8).reshape(-1, values.itemsize).T


def _text(content: Any) -> np.ndarray:
    return np.frombuffer(json.dumps(content).encode(), np.uint8)


def _scale(run: ReducedRun, name: str) -> float:
    """The largest component of a force or torque, so that half precision holds it."""
    return float(np.abs(getattr(run, name)).max()) or 1.0


def _loss(true: ReducedDataset, packed: ReducedDataset) -> tuple[float, float]:
    """RMS change of the decoded soil along an axis [m] and of the force as a share of its RMS."""
    soil, force, size = 0.0, 0.0, 0.0
    frames = 0
    for split in SPLITS:
        for one, other in zip(true.runs(split), packed.runs(split), strict=True):
            change = packed.basis.inverse(other.latent[::20]) - true.basis.inverse(one.latent[::20])
            soil += float(change.square().mean((1, 2)).sum())
            frames += len(change)
            force += float(np.square(other.force - one.force).sum())
            size += float(np.square(one.force).sum())
    return math.sqrt(soil / frames), math.sqrt(force / (size or 1.0))


# --- Reading --------------------------------------------------------------------------------------------


def packed_dataset(folder: Path, reduction: Mapping[str, Any]) -> ReducedDataset:
    """The reduced dataset in a folder.

    Args:
        folder: Of the files.
        reduction: Values of `conf/reduction`; a centring that is not given is that of the files.

    Raises:
        UserError: There is none, it is damaged, or it has fewer modes or another centring.
    """
    settings = ReductionSettings.from_dict(dict(reduction)).to_dict()
    num_modes, centring = settings["num_modes"], reduction.get("centring")
    if not (folder / "basis.npz").is_file():
        raise UserError(
            f"no reduced dataset in {folder}: basis.npz is missing; they come with the repository, in its folder "
            "reduced, or from `sgns reduce ... pack=<folder>`"
        )
    path, advice = folder / "basis.npz", "get it again"
    try:
        arrays = read_arrays(path, _WRONG, advice)
        about = _about(arrays)
        runs: dict[str, ReducedRun] = {}
        for part in range(int(about["parts"])):
            path = folder / f"runs_{part:02d}.npz"
            found = _read(
                read_arrays(path, _WRONG, advice), float(about["frame_rate"]), arrays["modes"].shape[1]
            )
            runs |= {run.name: run for run in found}
        path = folder / "basis.npz"
        chosen = {name: [runs[one] for one in about["split"][name]] for name in SPLITS}
        mean, modes, eigenvalues, start = (
            torch.from_numpy(arrays[name]).double() for name in ("mean", "modes", "eigenvalues", "start")
        )
        if start.shape != mean.shape or not bool(torch.cat([modes, start], dim=1).isfinite().all()):
            raise ValueError("its arrays do not fit together, or are not finite")
        # Half precision leaves modes that are nearly of length 1 and at right angles; these are, and as near as can be.
        left, _, right = torch.linalg.svd(modes, full_matrices=False)
        basis = Basis(
            mean=mean,
            modes=left @ right,
            eigenvalues=eigenvalues,
            centring=str(about["centring"]),
            arrangement_hash=str(about["arrangement_hash"]),
            fitted_on=[str(name) for name in about["split"]["train"]],
            total_variance=float(about["total_variance"]),
            displacement_variance=float(about["displacement_variance"]),
            residual_variance=float(about["residual_variance"]),
        )
    except (KeyError, ValueError, TypeError, RuntimeError, AttributeError) as error:
        if isinstance(error, UserError):
            raise
        raise UserError(f"{path} is {_WRONG} ({one_line(error)}); {advice}") from None
    if not isinstance(num_modes, int) or not 1 <= num_modes <= basis.num_modes:
        raise UserError(
            f"reduction.num_modes is {num_modes}; {folder} holds {basis.num_modes} modes: allowed are 1 to "
            f"{basis.num_modes}"
        )
    if centring not in (None, basis.centring):
        raise UserError(
            f"reduction.centring is {centring}; the modes in {folder} are of centring {basis.centring}"
        )
    closure = fitted_closure(basis, num_modes, settings, chosen)
    return ReducedDataset(
        basis, num_modes, folder, float(about["frame_rate"]), start.numpy(), chosen, closure
    )


def _about(arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """What is said in words."""
    about = parse_json(arrays["about"].tobytes())
    if not isinstance(about, dict) or about.get("format") != _FORMAT:
        raise ValueError("not written by sgns reduce")
    return about


def _read(arrays: Mapping[str, np.ndarray], frame_rate: float, num_modes: int) -> Iterator[ReducedRun]:
    about = _about(arrays)
    columns = {
        name: np.ascontiguousarray(arrays[name].T).view(kind).ravel() for name, kind in _SERIES.items()
    }
    for one in about["runs"]:
        name, frames, points = str(one["name"]), int(one["frames"]), int(one["points"])
        shapes = {
            "latent": (num_modes, 3, frames),
            "pose": (frames, 7),
            "force": (frames, 3),
            "torque": (frames, 3),
            "unseen": (frames, 2),
            "points": (points, 3),
        }
        found = {key: columns[key][: math.prod(shape)].reshape(shape) for key, shape in shapes.items()}
        columns = {key: columns[key][math.prod(shape) :] for key, shape in shapes.items()}
        unsigned = found.pop("latent").astype(np.int64).transpose(2, 0, 1)
        small = np.where(unsigned % 2, -(unsigned + 1) // 2, unsigned // 2)
        values = {key: array.astype(float) for key, array in found.items()}
        if infinite := [key for key, array in values.items() if not np.isfinite(array).all()]:
            raise ValueError(f"{infinite[0]} of {name} is not finite")
        pose = values["pose"]
        pose[:, 3:] /= np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)
        yield ReducedRun(
            name=name,
            latent=small.cumsum(axis=0).cumsum(axis=0) * float(about["step"]),
            time=np.arange(frames) / frame_rate,
            pose=pose,
            body_points=in_world_frame(pose, values["points"]),
            force=values["force"] * float(one["force"]),
            torque=values["torque"] * float(one["torque"]),
            scene=dict(one["scene"]),
            unseen=values["unseen"],
        )

"""The reduced runs published by the paper's authors: their files, and a dataset to learn from."""

from __future__ import annotations

import hashlib
import logging
import os
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from mpm_warp.poses import fitted_poses
from mpm_warp.settings import open_file
from sgns.config import UserError
from sgns.data.dataset import SPLITS
from sgns.data.files import read_json
from sgns.reduction.basis import Basis
from sgns.reduction.reduce import ReducedDataset, ReducedRun

log = logging.getLogger(__name__)


# --- Their files ----------------------------------------------------------------------------------------
# The files are TFRecords of protobuf `SequenceExample`s, the format of "Learning to Simulate" (Sanchez-Gonzalez
# et al. 2020); both are simple enough to be read here without TensorFlow. Numbers are mapped to this package's
# axes and signs: x forward, z up, forces by the soil on the body.

_SUBSPACE = 6  # the particle type of a subspace node; all others are nodes of the rigid body
_FREE = 0  # the particle type of a wheel's nodes; those of a blade, which is prescribed, are 3
_MOST_BYTES = 1 << 33  # of a .tfrecord; the authors' largest has a tenth of that
_MOST_OF_RUN = 1 << 28  # of one run in it
_LONGEST = 63  # bits before the last part of a number
_MARGIN = 0.1  # the authors' bin starts at this coordinate on each axis [m]
_BINS = {"excavation": (0.80, 0.60, 0.15), "wheel": (0.40, 0.19, 0.0583)}  # Lx, Ly, Lz [m]
DIAMETERS = (0.05, 0.15, 0.30)  # of the wheels [m]


@dataclass(frozen=True)
class PublishedRun:
    """One run. T frames at 60 Hz; the file's duplicated first frame is dropped."""

    kind: str
    """excavation or wheel."""
    body_points: np.ndarray
    """Nodes of the rigid body [m], shape (T, M, 3)."""
    latent: np.ndarray
    """Subspace nodes in the authors' basis and axes (the basis itself is not published), shape (T, r, 3)."""
    force: np.ndarray
    """By the soil on the body [N], at the end of the frame, shape (T, 3)."""
    context: np.ndarray
    """Of a wheel: gravity [m/s^2], friction angle [degrees] and load [N] in every frame, shape (T, 3); of a blade:
    shape (T, 0)."""
    case: int | None = None
    """Number of the run among all of its kind, from 1; None where metadata.json does not say."""


def read_published(folder: str | Path, split: str = "valid") -> list[PublishedRun]:
    """The runs of one folder with `<split>.tfrecord` and `metadata.json`."""
    folder = Path(folder)
    about = folder / "metadata.json"
    metadata = read_json(about, "no description of published runs", "copy the authors' files again")
    splits = metadata.get("dataset_split") if isinstance(metadata, dict) else None
    cases = splits.get(split) if isinstance(splits, dict) else ()
    if cases is not None and (
        not isinstance(cases, list) or not all(case is None or type(case) is int for case in cases)
    ):
        raise UserError(
            f"{about} does not name the {split} runs by their numbers; it needs dataset_split: {{{split}: [1, 2]}}"
        )
    try:
        with open_file(folder / f"{split}.tfrecord", _MOST_BYTES) as file:
            records = _records(file)
            if cases is not None and len(cases) != len(records):
                raise UserError(
                    f"{folder}: metadata.json names {len(cases)} {split} runs, the file holds {len(records)}"
                )
            if not records:
                raise UserError(f"{folder}/{split}.tfrecord holds no run")
            runs = []
            for start, length in records:
                file.seek(start)
                runs.append(_run(file.read(length)))
    except (OSError, ValueError, KeyError, IndexError, struct.error) as error:
        raise UserError(f"{folder}/{split}.tfrecord is not a file of published runs: {error}") from None
    return [replace(run, case=case) for run, case in zip(runs, cases or [None] * len(runs), strict=True)]


def _run(record: bytes) -> PublishedRun:
    about, frames = _sequence_example(record)
    types = np.frombuffer(about["particle_type"], dtype="<i8")
    nodes = _series(frames["position"], 3 * len(types)).reshape(-1, len(types), 3)[1:]
    force = _series(frames["force"], 3)[1:]
    given = frames.get("step_context", ())
    context = _series(given, len(given[0]) // 4)[1:] if given and given[0] else np.zeros((len(nodes), 0))
    if not len(nodes) == len(force) == len(context):
        raise ValueError("its series have different numbers of frames")
    if not (len(nodes) and np.isfinite(nodes).all() and np.isfinite(force).all()):
        raise ValueError("a run has no frames, or values that are not finite")
    soil = types == _SUBSPACE
    kind = "wheel" if bool((types == _FREE).any()) else "excavation"
    lx, _, lz = _BINS[kind]
    x, y, z = np.moveaxis(nodes[:, ~soil], -1, 0)
    body = np.stack([_MARGIN + lx - x, z - _MARGIN, y - _MARGIN - lz], axis=-1)
    return PublishedRun(kind, body, nodes[:, soil], force[:, [0, 2, 1]] * [-1.0, 1.0, 1.0], context)


def _series(frames: Sequence[bytes], values: int) -> np.ndarray:
    """Numbers of every frame, so many in each, shape (T, values)."""
    if not values or any(len(frame) != 4 * values for frame in frames):
        raise ValueError(f"a frame does not hold {values} numbers")
    return np.frombuffer(b"".join(frames), dtype="<f4").astype(float).reshape(-1, values)


def _records(file: BinaryIO) -> list[tuple[int, int]]:
    """Start and length of the runs in a TFRecord file: each is length (8), check sum (4), run, check sum (4)."""
    size, at, records = os.fstat(file.fileno()).st_size, 0, []
    while at < size:
        file.seek(at)
        (length,) = struct.unpack("<Q", file.read(8))
        if at + 16 + length > size:
            raise ValueError("the file is cut short")
        if not 0 < length <= _MOST_OF_RUN:
            raise ValueError(f"a run has {length} bytes; allowed: 1 to {_MOST_OF_RUN}")
        records.append((at + 12, length))
        at += 16 + length
    return records


def _fields(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Number and content of a protobuf message's length-delimited fields."""
    at = 0
    while at < len(data):
        key, at = _varint(data, at)
        if key & 7 != 2:
            raise ValueError(f"unexpected wire type {key & 7}")
        length, at = _varint(data, at)
        if at + length > len(data):
            raise ValueError("a field is cut short")
        yield key >> 3, data[at : at + length]
        at += length


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = data[at]
        value |= (byte & 0x7F) << shift
        if shift > _LONGEST:
            raise ValueError("a number is longer than 64 bits")
        at += 1
        shift += 7
        if byte < 0x80:
            return value, at


def _entry(data: bytes) -> tuple[str, bytes]:
    """Key and value of one entry of a protobuf map."""
    parts = dict(_fields(data))
    return parts[1].decode(), parts[2]


def _first_bytes(feature: bytes) -> bytes:
    """The first value of a Feature that holds a bytes list; empty for other kinds."""
    lists = dict(_fields(feature))
    return next((value for _, value in _fields(lists[1])), b"") if 1 in lists else b""


def _sequence_example(record: bytes) -> tuple[dict[str, bytes], dict[str, list[bytes]]]:
    """Context and per-frame features of a SequenceExample; only bytes are kept."""
    parts = dict(_fields(record))
    context = {key: _first_bytes(value) for key, value in (_entry(e) for _, e in _fields(parts[1]))}
    lists = (_entry(e) for _, e in _fields(parts[2]))
    return context, {key: [_first_bytes(f) for _, f in _fields(value)] for key, value in lists}


# --- The published reduced runs as a dataset to learn from ----------------------------------------------
# The authors' basis is not published, only the modes' positions. So the basis here is the unit matrix: what is
# called soil are the modes themselves, and the mean over all particles follows from how many there were.
#
# Shapes: T frames, M body points, r modes.

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
        split["train"] = everything = [run for found in runs.values() for run in found]
        if folds is not None:
            if folds > len(everything):
                raise UserError(
                    f"dataset.folds is {folds!r}; allowed: 2 to {len(everything)}, the number of runs, or null"
                )
            if fold >= folds:
                raise UserError(f"dataset.fold is {fold!r}; allowed: 0 to {folds - 1}")
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
    """All runs of a folder by the name of their file, <split>.tfrecord."""
    folder = Path(folder)
    splits = sorted(file.stem for file in folder.glob("*.tfrecord"))
    if not splits or not (folder / "metadata.json").is_file():
        raise UserError(
            f"{folder} does not hold published runs; it needs metadata.json and at least one <split>.tfrecord, as the "
            "paper's authors published them"
        )
    found = {}
    for split in splits:
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


def _reduced(run: PublishedRun, name: str) -> ReducedRun:
    # To this package's axes; where the origin of a mode's positions lies does not matter.
    latent = np.stack([-run.latent[..., 0], run.latent[..., 2], run.latent[..., 1]], axis=-1)
    points, wheel = run.body_points, run.kind == "wheel"
    # A wheel's pose: centre of the rim's points and turn since the first frame.
    pose = fitted_poses(points[0] - points[0].mean(axis=0), points) if wheel else _blade_poses(points)
    return ReducedRun(
        name=name if run.case is None else f"{run.kind}_{run.case:03d}",
        latent=latent,
        time=np.arange(len(latent)) / _FRAME_RATE,
        pose=pose,
        body_points=points,
        force=run.force,
        torque=np.zeros_like(run.force),
        scene={"kind": run.kind} | (_wheel_values(run) if wheel else {}),
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


def _blade_poses(points: np.ndarray) -> np.ndarray:
    """Middle of the lowest row of points, and the plate's directions, shape (T, 7).

    Blades with 15 and with 20 points have different middles; the lowest row is at the same place in both.
    """
    first = points[0]
    tip = first[:, 2] < first[:, 2].min() + 1e-3
    _, _, axes = np.linalg.svd(first - first.mean(axis=0))
    across = axes[0] * np.sign(axes[0, 1])
    along = axes[1] * np.sign(axes[1, 2])
    turned = Rotation.from_matrix(np.stack([np.cross(across, along), across, along], axis=1)).as_quat(
        canonical=True
    )
    middle = points[:, tip].mean(axis=1)
    return np.concatenate([middle, np.tile(turned, (len(points), 1))], axis=1)

"""Checking run files: `sgns check`.

Letters: T frames, n soil particles, M body points.
"""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
from scipy.spatial import cKDTree

from mpm_warp.poses import in_body_frame, rotation_matrices
from sgns.config import UserError, parse_yaml
from sgns.data.files import one_line
from sgns.data.hdf5 import BROKEN, own_dataset, own_object, own_view
from sgns.data.run import Run
from sgns.data.run_file import (
    OTHERS,
    PRODUCERS,
    SPREAD,
    STOPPED,
    VIEW_ATTRIBUTES,
    VIEWS,
    open_run,
    read_attributes,
    read_mesh,
    recorded_in,
    require_mesh_was_read,
    series,
    structure_problems,
    view_arrays,
)
from sgns.data.writer import ContentHash

if TYPE_CHECKING:
    from omegaconf import DictConfig

log = logging.getLogger(__name__)


# --- Every problem of a run file, in words --------------------------------------------------------------

RIGID_TOLERANCE = 1e-4
"""How far a body point may be from where the pose puts it [m]."""
QUATERNION_TOLERANCE = 1e-5
"""How far a quaternion's length may be from 1."""
INTERVAL_TOLERANCE = 1e-2
"""How far the time between frames may be from 1 / frame_rate, as a share of it."""
# How the reason begins of a run that was ended from outside: nothing is wrong with it.
_INTERRUPTED = ("interrupted by ", "its process ended")
_SCENE_NUMBERS = (
    "depth speed rake diameter width grouser_height slip slip_angle friction_angle gravity".split()
)
_BLADE_NUMBERS = ("thickness", "width", "length")


def check_run(path: str | os.PathLike[str]) -> list[str]:
    """Everything that is wrong with a run file, in words; an empty list means it is good. So is one that was
    interrupted and can be gone on with.

    Reads every dataset, a frame of soil at a time.
    """
    try:
        file = open_run(path)
    except UserError as error:
        return [str(error)]
    with file, np.errstate(all="ignore"):  # damaged numbers may be huge
        try:
            problems = structure_problems(file)
        except BROKEN as error:
            return [f"the file is damaged ({one_line(error)})"]
        checks = [_check_h5md, _check_attributes]
        if not problems:  # the rest relies on complete datasets of the right shapes
            checks += [
                _check_stopped,
                _check_times,
                _check_body,
                _check_others,
                _check_mesh,
                _check_view,
                _check_names,
                _check_frames,
            ]
        for check in checks:
            try:
                problems += check(file)
            except BROKEN as error:
                problems.append(f"the file is damaged ({one_line(error)})")
    return problems or _state_problems(path)


def _check_h5md(file: h5py.File) -> Iterator[str]:
    h5md = own_object(file, "h5md")
    if not isinstance(h5md, h5py.Group):
        yield "group /h5md is missing"
        return
    if tuple(np.atleast_1d(h5md.attrs.get("version", ()))) != (1, 1):
        yield "attribute version of /h5md is not (1, 1)"
    for group, key in (("author", "name"), ("creator", "name"), ("creator", "version")):
        found = own_object(h5md, group)
        if found is None or key not in found.attrs:
            yield f"attribute {key} of /h5md/{group} is missing"
    for group in ("soil", "body"):
        box = own_object(file, f"particles/{group}/box")
        if box is None or "dimension" not in box.attrs or "boundary" not in box.attrs:
            yield f"group /particles/{group}/box with dimension and boundary is missing"


def _check_attributes(file: h5py.File) -> Iterator[str]:
    values = read_attributes(file)
    for name in ("scene", "effects", "extra"):
        if not isinstance(text := values.get(name), str):
            continue  # reported with the structure
        try:
            data = parse_yaml(text)
        except ValueError as error:
            yield f"root attribute {name!r} is not YAML ({one_line(error)})"
            continue
        if not isinstance(data, dict):
            yield f"root attribute {name!r} is not a group of keys"
        elif name == "scene":
            yield from scene_problems(data)
            try:
                require_mesh_was_read(data)
            except ValueError as error:
                yield f"root attribute 'scene': {one_line(error)}"
        elif name == "effects":
            for key, effect in data.items():
                if not (isinstance(effect, dict) and type(effect.get("on")) is bool and effect.get("reason")):
                    yield f"effect {key!r} does not say whether it is on and why"
    producer = values.get("producer")
    if isinstance(producer, str) and producer not in PRODUCERS:
        yield f"producer is {producer!r}; allowed: {', '.join(PRODUCERS)}"


def scene_problems(scene: Mapping[str, Any]) -> list[str]:
    """Values of a scene that are not the numbers which others calculate with, in words; what is not there is none."""
    found = [(key, scene[key]) for key in _SCENE_NUMBERS if scene.get(key) is not None]
    load = scene.get("load")
    for row in load if isinstance(load, list) else [load]:
        found += [("load", value) for value in (row if isinstance(row, list) else [row]) if value is not None]
    blade = scene.get("blade")
    if blade is not None:
        if not isinstance(blade, Mapping):
            return [f"scene.blade is {blade!r:.40}, not a group of keys"]
        found += [(f"blade.{key}", blade.get(key)) for key in _BLADE_NUMBERS]
    if "bed" in scene:
        size = scene["bed"].get("size") if isinstance(scene["bed"], Mapping) else None
        if not isinstance(size, list) or len(size) != 3:
            return [f"scene.bed.size is {size!r:.40}, not three lengths"]
        found += [(f"bed.size[{axis}]", length) for axis, length in enumerate(size)]
    return [
        f"scene.{key} is {value!r:.40}, not a finite number"
        for key, value in found
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < math.inf
    ]


def _check_stopped(file: h5py.File) -> Iterator[str]:
    reason = read_attributes(file).get(STOPPED)
    if reason is not None and not one_line(reason).startswith(_INTERRUPTED):
        yield f"the run stopped after {len(series(file, 'position'))} good frames: {one_line(reason)}"


def _state_problems(path: str | os.PathLike[str]) -> list[str]:
    """Why an interrupted run cannot be gone on with, or the soil of one cannot be started from."""
    try:
        with Run(path) as run:
            interrupted = run.stopped is not None and run.stopped.startswith(_INTERRUPTED)
            if interrupted or (run.stopped is None and run.has_state):
                _ = run.soil
    except UserError as error:
        return [str(error)]
    return []


def _verdict(path: Path) -> str:
    """What a file without a problem is."""
    with Run(path) as run:
        if run.stopped is None:
            return "good"
        duration = run.scene.get("duration")
        length = duration * run.frame_rate if isinstance(duration, (int, float)) else math.nan
        total = f" of {round(length) + 1}" if math.isfinite(length) else ""
        return (
            f"unfinished: {run.frame_count}{total} frames, good; the same `sgns simulate` goes on (of a sweep: "
            f"continue_from={path})"
        )


def _check_times(file: h5py.File) -> Iterator[str]:
    time, step = (series(file, "position", part)[...] for part in ("time", "step"))
    for name, recorded in recorded_in(file).items():
        for part, expected in (("time", time), ("step", step)):
            if not np.array_equal(series(file, name, part)[...], expected, equal_nan=part == "time"):
                yield f"dataset /{recorded.path}/{part} differs from that of the soil positions"
    if (frame := _first(~np.isfinite(time))) is not None:
        yield f"time is not finite at frame {frame}"
        return
    if (frame := _first(np.diff(step) <= 0)) is not None:
        yield f"step does not increase at frame {frame + 1}"
    interval, rate = np.diff(time), float(file.attrs["frame_rate"])
    if (frame := _first(interval <= 0)) is not None:
        yield f"time does not increase at frame {frame + 1}"
    elif (frame := _first(~(np.abs(interval * rate - 1.0) <= INTERVAL_TOLERANCE))) is not None:
        yield (
            f"time before frame {frame + 1} advances by {interval[frame]:.6g} s, "
            f"not by 1 / frame_rate = {1.0 / rate:.6g} s"
        )


def _check_body(file: h5py.File) -> Iterator[str]:
    names = ("pose", "force", "torque", "body_points")
    pose, force, torque, points = (series(file, name)[...].astype(float) for name in names)
    good = True
    for name, values in zip(names, (pose, force, torque, points), strict=True):
        frame = _first(~np.isfinite(values).reshape(len(values), -1).all(axis=1))
        if frame is not None:
            yield f"{name} is not finite at frame {frame}"
            good = False
    if not good:
        return
    length = np.linalg.norm(pose[:, 3:], axis=1)
    if (frame := _first(~(np.abs(length - 1.0) <= QUATERNION_TOLERANCE))) is not None:
        yield f"the quaternion of frame {frame} has length {length[frame]:.6g}, not 1"
        return
    # Rows times R are R^T applied to each point.
    nodes = (points - pose[:, None, :3]) @ rotation_matrices(pose[:, 3:])
    error = np.linalg.norm(nodes - nodes[:1], axis=2)
    if (frame := _first(~(error <= RIGID_TOLERANCE).all(axis=1))) is not None:
        point = int(error[frame].argmax())
        yield (
            f"body point {point} of frame {frame} is {error[frame, point]:.3g} m from where the pose puts it "
            f"(allowed {RIGID_TOLERANCE:g} m)"
        )


def _check_others(file: h5py.File) -> Iterator[str]:
    for name in set(recorded_in(file)) & set(OTHERS | SPREAD):
        values = series(file, name)[...].astype(float)
        if (frame := _first(~np.isfinite(values).reshape(len(values), -1).all(axis=1))) is not None:
            yield f"{name} is not finite at frame {frame}"
        elif name == "other_pose":
            off = np.abs(np.linalg.norm(values[:, :, 3:], axis=2) - 1.0).max(axis=1, initial=0.0)
            if (frame := _first(off > QUATERNION_TOLERANCE)) is not None:
                yield f"a quaternion of the further bodies at frame {frame} is not of length 1"


def _check_mesh(file: h5py.File) -> Iterator[str]:
    """That the meshes are such, and that the body points are vertices of the tool's."""
    mesh, k = None, series(file, "other_pose").shape[1] if "other_pose" in recorded_in(file) else 0
    for body in range(1 + k):
        try:
            found = read_mesh(file, body)
        except BROKEN as error:
            whose = f"the mesh of scene.others[{body - 1}]" if body else "the tool's mesh"
            yield f"{whose} is damaged ({one_line(error)})"
            continue
        mesh = mesh if body else found
    if mesh is not None:
        pose, points = (series(file, name)[0].astype(float) for name in ("pose", "body_points"))
        away, _ = cKDTree(mesh[0]).query(in_body_frame(pose, points))
        if (point := _first(~(away <= RIGID_TOLERANCE))) is not None:
            yield (
                f"body point {point} is {away[point]:.3g} m from the nearest vertex of the tool's mesh (allowed "
                f"{RIGID_TOLERANCE:g} m): the mesh is of another tool"
            )


def _check_view(file: h5py.File) -> Iterator[str]:
    """Where /VTKHDF does not fit the H5MD arrays; the values behind it are compared by `_check_frames`."""
    group = own_object(file, "VTKHDF")
    if not isinstance(group, h5py.Group):
        yield "group /VTKHDF is missing: ParaView cannot open the file"
        return
    for name, value in VIEW_ATTRIBUTES.items():
        if not np.array_equal(np.asarray(group.attrs.get(name)), np.asarray(value)):
            wanted = value.decode() if isinstance(value, bytes) else tuple(value.tolist())
            yield f"attribute {name} of /VTKHDF is not {wanted}"
    frames, particles, _ = series(file, "position").shape
    times = series(file, "position", "time")[...]
    for name, values in (view_arrays(frames, particles) | {"Steps/Values": times}).items():
        try:
            stored = own_dataset(group, name)
        except KeyError:
            yield f"dataset /VTKHDF/{name} is missing"
            continue
        if stored.shape != values.shape or not np.array_equal(stored[...], values):
            yield f"dataset /VTKHDF/{name} does not fit {frames} frames of {particles} particles"
    expected = (frames * particles, 3)
    for name in VIEWS.values():
        found = own_object(group, name)
        if not isinstance(found, h5py.Dataset):
            yield f"dataset /VTKHDF/{name} is missing"
        elif found.shape != expected:
            yield f"dataset /VTKHDF/{name} has shape {found.shape}, expected {expected}"
        elif not found.is_virtual:
            yield f"dataset /VTKHDF/{name} is a copy, not a view"
        else:
            own_view(group, name)


def _check_names(file: h5py.File) -> Iterator[str]:
    """That the names at the root, which earlier files lack, are those of the same numbers."""
    for name in recorded_in(file):
        found = own_object(file, name)
        if found is not None and found != series(file, name):
            yield f"dataset /{name} is another one than {series(file, name).name}"


def _check_frames(file: h5py.File) -> Iterator[str]:
    """Finite soil, the same numbers through /VTKHDF, and the content hash; memory for a frame only."""
    small = {name: series(file, name)[...] for name in recorded_in(file) if name not in VIEWS}
    small["time"] = series(file, "position", "time")[...]
    views = {name: _view(file, f"VTKHDF/{path}") for name, path in VIEWS.items()}
    frames, particles, _ = series(file, "position").shape
    found: dict[str, str] = {}  # the first problem of each kind
    content = ContentHash()
    for frame in range(frames):
        arrays = {name: values[frame] for name, values in small.items()}
        for name, view in views.items():
            arrays[name] = soil = series(file, name)[frame]
            if (particle := _first(~np.isfinite(soil).all(axis=1))) is not None:
                words = f"{name} of particle {particle} is not finite at frame {frame}"
                found.setdefault(f"{name} finite", words)
            if view is not None and view.shape == (frames * particles, 3):
                seen = view[frame * particles : (frame + 1) * particles]
                if not np.array_equal(seen, soil, equal_nan=True):
                    found.setdefault(f"{name} view", f"/VTKHDF shows another {name} at frame {frame}")
        content.update(arrays)
    yield from found.values()
    if content.hexdigest() != read_attributes(file)["content_hash"]:
        yield "the data do not match content_hash: they were changed or damaged after the run"


def _view(file: h5py.File, path: str) -> h5py.Dataset | None:
    """A view or copy of this file's own values; what else may be there is reported with the view."""
    for reading in (own_view, own_dataset):
        try:
            return reading(file, path)
        except (KeyError, ValueError):
            continue
    return None


def _first(wrong: np.ndarray) -> int | None:
    """Index of the first True, or None."""
    return int(np.argmax(wrong)) if wrong.any() else None


# --- `sgns check`: read run files through and list what is wrong with them ------------------------------


def run_files(paths: Iterable[str | Path]) -> list[Path]:
    """Run files that the given paths stand for, in order.

    Args:
        paths: Files, and folders that hold run files themselves or, like a dataset, in a folder `runs`.

    Raises:
        UserError: A path does not exist, or a folder holds no run file.
    """
    files: list[Path] = []
    for path in map(Path, paths):
        if not os.path.isdir(path):  # unlike Path.is_dir, takes any name
            if not os.path.exists(path):
                raise UserError(f"{path}: no such file; give run files (.h5) or folders of them")
            files.append(path)
            continue
        folder = path / "runs" if (path / "runs").is_dir() else path
        # a name that begins with a dot is one that is still being written
        found = sorted(file for file in folder.glob("*.h5") if not file.name.startswith("."))
        if not found:
            raise UserError(f"{folder}: holds no run file (*.h5); `sgns simulate` writes them")
        files.extend(found)
    if not files:
        raise UserError("nothing to check; give run files: sgns check run.h5")
    return files


def main(cfg: DictConfig) -> float:
    """Check the run files `cfg.files`; returns the number of problems, which is 0.

    Raises:
        UserError: A path is missing or a file has a problem; all problems have been listed before.
    """
    paths = [cfg.files] if isinstance(cfg.files, str) else list(cfg.files)
    files: list[Path] = []
    bad = 0
    for path in paths or run_files([]):
        try:
            files += run_files([path])
        except UserError as error:
            if len(paths) == 1:
                raise
            bad += 1
            log.info("%s", error)
    checked = bad + len(files)
    for path in files:
        if problems := check_run(path):
            bad += 1
            for problem in problems:
                log.info("%s", problem if str(path) in problem else f"{path}: {problem}")
        else:
            log.info("%s: %s", path, _verdict(path))
    if bad:
        raise UserError(f"{bad} of {checked} files checked {'is' if bad == 1 else 'are'} not good; see above")
    return 0.0

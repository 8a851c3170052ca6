"""Writing a run: frame by frame into a hidden file that gets its name only when it is complete.

Letters: T frames, n soil particles, M body points.
"""

from __future__ import annotations

import hashlib
import logging
import os
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePath
from types import TracebackType
from typing import Any

import h5py
import numpy as np
import yaml

from mpm_warp import State
from sgns import __version__
from sgns.config import UserError
from sgns.data.files import require_new, require_replaceable
from sgns.data.hdf5 import BROKEN, NewFile
from sgns.data.run_file import (
    FORMAT,
    FORMAT_VERSION,
    OTHERS,
    SERIES,
    SPREAD,
    STATE,
    STOPPED,
    VIEWS,
    WHOLE,
    Recorded,
    mesh_parts,
    open_run,
    read_attributes,
    series,
    write_views,
)

log = logging.getLogger(__name__)


_MOST_IN_CHUNK = 1 << 30
"""Of an array of a state [bytes]; HDF5 takes less than 4 GB."""


# --- What is kept of a run that stopped, and what a run may replace -------------------------------------


def stopped_path(path: Path) -> Path:
    """Where the frames of a run go that was to become `path` and stopped before its end."""
    return path.with_name(f"{path.stem}.stopped{path.suffix}")


def require_new_run(path: Path, overwrite: bool) -> None:
    """Refuse a run's name that is not one of a run, is taken, unless `overwrite` is true, or as `require_run_place`.

    Raises:
        UserError: says what is there.
    """
    require_run_place(path)
    require_new(path, overwrite, "a run", ".h5")


def require_run_place(path: Path) -> None:
    """Refuse a run's name if the run, or its frames if it stops, would destroy something else than an earlier run.

    Raises:
        UserError: says what is there.
    """
    kept = stopped_path(path)
    require_replaceable(path, kept)
    if os.path.lexists(kept) and not _is_stopped(kept):
        raise UserError(
            f"{kept} is no stopped run, and the frames of {path.name} would go there if it stopped; move it, or choose "
            "another output"
        )


def _is_stopped(path: Path) -> bool:
    try:
        with open_run(path) as file:
            return STOPPED in read_attributes(file)
    except (UserError, *BROKEN):
        return False


# --- The run --------------------------------------------------------------------------------------------


class ContentHash:
    """BLAKE2b over the stored numbers, frame by frame in the order of `ORDER`, little-endian."""

    ORDER = ("time", "position", "velocity", "body_points", "pose", "force", "torque")

    def __init__(self) -> None:
        self._hash = hashlib.blake2b(digest_size=16)

    def update(self, frame: Mapping[str, np.ndarray]) -> None:
        """Add one frame: an array for every name in `ORDER`, in the file's types, and what else there is."""
        for name in (*self.ORDER, *(name for name in OTHERS | SPREAD if name in frame)):
            self._hash.update(np.ascontiguousarray(frame[name]).data)

    def hexdigest(self) -> str:
        """32 hexadecimal digits."""
        return self._hash.hexdigest()


class RunWriter:
    """Writes a run file; use it as a context manager and call `finish` at the end.

    The file appears under its name only when `finish` succeeds, or under another one with `stop`; leaving the context
    in any other way removes what was written. An existing file of that name stays untouched until then.

    Args:
        path: where the run goes, usually `*.h5`; missing folders are made.
        scene: the complete scene as plain nested data.
        effects: physics that was on or off: {name: {"on": bool, "reason": str}}.
        arrangement_hash: identifies the initial particle arrangement.
        particle_count: n.
        body_points: M.
        frame_rate: recorded frames per second [Hz].
        seed: of the run.
        producer: "mpm" or "rollout".
        extra: more provenance as plain nested data; "author" also becomes H5MD's author name.
        meshes: of the tool and of each of the k further bodies: vertices (V, 3) about its centre of mass [m] and
            triangles (F, 3) of one that is a mesh, else None.
        spread: whether every frame has a spread of the force.

    Raises:
        UserError: the folder cannot be written, the disk is full, something else than a run of before would be
            destroyed, or a frame is not finite.
        ValueError: a frame has the wrong shape or value.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        scene: Mapping[str, Any],
        effects: Mapping[str, Mapping[str, Any]],
        arrangement_hash: str,
        particle_count: int,
        body_points: int,
        frame_rate: float,
        seed: int,
        producer: str,
        extra: Mapping[str, Any] | None = None,
        meshes: Sequence[tuple[np.ndarray, np.ndarray] | None] = (None,),
        spread: bool = False,
    ) -> None:
        self.path = Path(path)
        others = len(meshes) - 1
        counts = {"n": int(particle_count), "M": int(body_points), "k": others}
        self._recorded = SERIES | (OTHERS if others else {}) | (SPREAD if spread else {})
        self._shapes = {  # of one frame
            name: tuple(counts[size] if isinstance(size, str) else size for size in recorded.tail)
            for name, recorded in self._recorded.items()
        }
        self._small: dict[str, list[np.ndarray]] = {
            name: [] for name in ("time", *self._recorded) if name not in VIEWS
        }
        self._hash = ContentHash()
        extra = extra or {}
        attributes = {  # in the order of a reader's interest
            "format": FORMAT,
            "format_version": np.int64(FORMAT_VERSION),
            "package_version": __version__,
            "producer": producer,
            "seed": np.int64(seed),
            "frame_rate": np.float64(frame_rate),
            "arrangement_hash": str(arrangement_hash),
            "scene": _yaml_text(scene),
            "effects": _yaml_text(effects),
            "extra": _yaml_text(extra),
        }
        require_run_place(self.path)
        self._disk = NewFile(self.path)
        self._file: h5py.File | None = None
        try:
            # v110 is the oldest HDF5 whose files say that they were cut short and may hold virtual datasets.
            self._file = h5py.File(self._disk, "w", libver=("v110", "v110"))
            for name, value in attributes.items():
                _set(self._file, name, value)
            _write_h5md(self._file, str(extra.get("author", "unknown")))
            self._create_soil(self._file)
            for body, mesh in enumerate(meshes):
                for part, values in zip(mesh_parts(body), mesh or (), strict=mesh is not None):
                    data = np.asarray(values, dtype=part.dtype)
                    # Checksummed: no content hash guards it.
                    dataset = self._file.create_dataset(part.path, data=data, chunks=True, fletcher32=True)
                    _describe(dataset, part)
            self._disk.check()
        except BaseException:
            self._discard()
            raise

    @property
    def frame_count(self) -> int:
        """Frames appended so far."""
        return len(self._small["time"])

    def append(
        self,
        time: float,
        position: np.ndarray,
        velocity: np.ndarray,
        body_points: np.ndarray,
        body_pose: np.ndarray,
        force: np.ndarray,
        torque: np.ndarray,
        more: tuple[np.ndarray, ...] = (),
    ) -> None:
        """Write one frame.

        Args:
            time: [s], later than the frame before.
            position: soil [m], shape (n, 3).
            velocity: soil [m/s], shape (n, 3).
            body_points: world frame [m], shape (M, 3).
            body_pose: centre of mass [m] and quaternion x y z w, shape (7,).
            force: by the soil on the body [N], world frame, mean since the frame before, shape (3,).
            torque: likewise about the centre of mass [N m], shape (3,).
            more: pose (k, 7), force and torque (k, 3) of the further bodies, if there are any; then the spread of the
                force [N], shape (3,), if it has one.
        """
        file = self._open_file()
        index = self.frame_count
        frame = {"time": np.asarray(time, dtype="<f8")}
        if frame["time"].shape != ():
            raise ValueError(f"time has shape {frame['time'].shape}; it must be one number [s]")
        given = (
            position,
            velocity,
            body_points,
            force,
            torque,
            body_pose,
            *more,
        )  # as in SERIES, OTHERS and SPREAD
        for (name, recorded), values in zip(self._recorded.items(), given, strict=True):
            # A float64 beyond float32's range becomes inf here and is reported below, so numpy need not warn.
            with np.errstate(over="ignore"):
                convert = np.asarray if name in VIEWS else np.array  # the small ones are kept: copy them
                frame[name] = convert(values, dtype=recorded.dtype, order="C")
            if frame[name].shape != (expected := self._shapes[name]):
                raise ValueError(f"frame {index}: {name} has shape {frame[name].shape}, expected {expected}")
        for name, values in frame.items():
            if not np.isfinite(values).all():
                where = np.argwhere(~np.isfinite(values))[0]
                at = f" of particle {where[0]}" if name in VIEWS else ""
                raise UserError(
                    f"{self.path}: frame {index} ({float(time):.4g} s): {name}{at} is not finite; "
                    "the run is not kept; use a smaller time step or check what drives it"
                )
        if index and not frame["time"] > self._small["time"][-1]:
            raise ValueError(f"frame {index}: time {time} s is not after {self._small['time'][-1]} s")
        for name in VIEWS:
            dataset = series(file, name)
            dataset.resize(index + 1, axis=0)
            # A frame is a chunk, so it needs neither HDF5's cache nor its conversions.
            dataset.id.write_direct_chunk((index, 0, 0), frame[name])
        self._disk.check()
        for name, kept in self._small.items():
            kept.append(frame[name])
        self._hash.update(frame)

    def finish(self, wall_time_s: float, state: State | None = None) -> None:
        """Complete the file and give it its name; `wall_time_s` is what it took to compute the run [s].

        What an earlier attempt at this run left is removed. `state` is the solver's at the last frame: other runs may
        start from it.
        """
        file = self._open_file()
        if self.frame_count == 0:
            raise ValueError("no frame was appended")
        if state is not None:
            _write_state(file, state)
        self._complete(wall_time_s, self.path)
        kept = stopped_path(self.path)
        if not kept.is_symlink() and _is_stopped(kept):
            kept.unlink(missing_ok=True)

    def stop(self, wall_time_s: float, reason: str, state: State | None = None) -> Path:
        """Complete the file with the frames so far, as a stopped run beside the one it was to be.

        Args:
            wall_time_s: time it took so far [s].
            reason: why there are no more frames.
            state: at the last of them, to go on from; a rollout has none.
        """
        file = self._open_file()
        _set(file, STOPPED, reason)
        if state is not None:
            _write_state(file, state)
        path = stopped_path(self.path)
        self._complete(wall_time_s, path)
        return path

    def _open_file(self) -> h5py.File:
        if self._file is None:
            raise ValueError("the run is already finished or discarded; make a new RunWriter")
        return self._file

    def _create_soil(self, file: h5py.File) -> None:
        # MDAnalysis reads the first group; in order of creation that is the soil.
        particles = file.create_group("particles", track_order=True)
        for name in ("soil", "body"):
            box = particles.create_group(f"{name}/box")
            box.attrs["dimension"] = np.int64(3)
            box.attrs["boundary"] = np.array([b"none"] * 3)
        for name in VIEWS:
            recorded, shape = SERIES[name], self._shapes[name]
            dataset = file.create_dataset(
                f"{recorded.path}/value",
                (0, *shape),
                recorded.dtype,
                maxshape=(None, *shape),
                chunks=(1, *shape),
            )
            _describe(dataset, recorded)

    def _complete(self, wall_time_s: float, path: Path) -> None:
        """Write the times, everything of the body, and the view for VTK; then the file gets its name."""
        file = self._open_file()
        try:
            first = file[SERIES["position"].path]
            first["step"] = np.arange(self.frame_count, dtype="<i8")
            first["time"] = np.array(self._small["time"], dtype="<f8")
            _set(first["time"], "si_unit", "s")
            for name, recorded in self._recorded.items():
                if name in self._small:
                    file[f"{recorded.path}/value"] = np.array(self._small[name], dtype=recorded.dtype)
                    _describe(series(file, name), recorded)
                if name != "position":  # hard links: H5MD's way to say "sampled at the same times"
                    file[f"{recorded.path}/step"] = first["step"]
                    file[f"{recorded.path}/time"] = first["time"]
            write_views(file)
            _set(file, "wall_time_s", np.float64(wall_time_s))
            _set(file, "content_hash", self._hash.hexdigest())
            file.close()
            self._disk.complete(path)
        except BaseException:
            self._discard()
            raise
        self._file = None

    def __enter__(self) -> RunWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._file is not None:
            if kind is None:
                log.warning("%s was left without finish(); nothing is kept", self.path)
            self._discard()

    def _discard(self) -> None:
        """Close and remove the hidden file, whatever state it is in."""
        file, self._file = self._file, None
        try:
            if file is not None:
                file.close()
        finally:
            self._disk.discard()


def _write_state(file: h5py.File, state: State) -> None:
    group = file.create_group(STATE)
    group.attrs["frame"] = np.int64(state.frame)
    arrays = state.arrays | ({} if state.whole is None else {WHOLE: state.whole})
    for name, array in arrays.items():
        # Checksummed: no content hash guards them.
        chunk = (
            min(len(array), max(1, _MOST_IN_CHUNK * len(array) // max(1, array.nbytes))),
            *array.shape[1:],
        )
        group.create_dataset(
            name, data=array, chunks=chunk if array.size else None, fletcher32=array.size > 0
        )


def _set(owner: h5py.Group | h5py.Dataset, name: str, value: Any) -> None:
    """Set an attribute, text in UTF-8 of fixed length: H5MD asks for that, and HDF5 guards it by a checksum."""
    if isinstance(value, str):
        data = value.encode("utf-8") or b" "  # HDF5 has no text of length 0
        owner.attrs.create(name, data, dtype=h5py.string_dtype("utf-8", len(data)))
    else:
        owner.attrs[name] = value


def _describe(dataset: h5py.Dataset, recorded: Recorded) -> None:
    if recorded.si_unit:
        _set(dataset, "si_unit", recorded.si_unit)
    _set(dataset, "description", recorded.description)


def _write_h5md(file: h5py.File, author: str) -> None:
    """The group that every H5MD file must have."""
    h5md = file.create_group("h5md")
    h5md.attrs["version"] = np.array([1, 1], dtype="<i8")
    _set(h5md.create_group("author"), "name", author or "unknown")
    creator = h5md.create_group("creator")
    _set(creator, "name", "sgns")
    _set(creator, "version", __version__)


def _yaml_text(data: Mapping[str, Any]) -> str:
    return yaml.dump(
        _plain(data),
        Dumper=getattr(yaml, "CSafeDumper", yaml.SafeDumper),
        sort_keys=False,
        allow_unicode=True,
        default_flow_style=None,
    )


def _plain(value: Any) -> Any:
    """The same data in the types that YAML knows without tags."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return _plain(value.tolist())
    if isinstance(value, PurePath):
        return str(value)
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise TypeError(f"{type(value).__name__} cannot be stored in a run; give numbers, text, lists and dicts")

"""A run file, whether the solver or a network made it: what is in it and where, and reading it.

Letters: T frames, n soil particles, M body points; V vertices and F triangles of a tool that is a mesh.
"""

from __future__ import annotations

import copy
import math
import os
import re
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import h5py
import numpy as np

from mpm_warp import SceneError, State
from mpm_warp.bodies import checked_mesh
from mpm_warp.inputs import MOST_BYTES, open_file
from sgns import __version__
from sgns.config import UserError, parse_yaml
from sgns.data.files import ANY_SIZE, one_line
from sgns.data.hdf5 import BROKEN, own_attribute, own_dataset, own_object

# --- What is in the file: the H5MD 1.1 tree, its units and its root attributes --------------------------

FORMAT = "sgns-run"
"""Root attribute `format`: says that the file is ours."""
FORMAT_VERSION = 1
"""Root attribute `format_version`: raised when an older program could no longer read the file."""
PRODUCERS = ("mpm", "rollout")
"""Who may have made a run: the material point solver, or a trained network."""
_WHOLE, _REAL = (int, np.integer), (float, np.floating)
ATTRIBUTES: dict[str, type | tuple[type, ...]] = {
    "format": str,
    "format_version": _WHOLE,
    "package_version": str,
    "producer": str,
    "seed": _WHOLE,
    "frame_rate": _REAL,
    "wall_time_s": _REAL,
    "arrangement_hash": str,
    "content_hash": str,
    "scene": str,
    "effects": str,
    "extra": str,
}
"""Root attributes and their types; `scene`, `effects` and `extra` are YAML text in UTF-8."""
STOPPED = "stopped"
"""Root attribute that only some files have: why a run ended before its time."""
STATE = "state"
"""Group of a run whose solver stopped: the arrays to go on from."""


@dataclass(frozen=True)
class Recorded:
    """Numbers in a run file."""

    path: str
    """Of the dataset; of a time-dependent one, an H5MD element, the group with `value`, `step` and `time`."""
    tail: tuple[int | str, ...]
    """Shape, of one frame of a time-dependent one; letters stand for the counts of this run."""
    dtype: str
    si_unit: str
    description: str


# H5MD's own attribute `unit` is left unset on purpose: MDAnalysis refuses lengths in metres.
SERIES = {
    "position": Recorded("particles/soil/position", ("n", 3), "<f4", "m", "soil particles, world frame"),
    "velocity": Recorded("particles/soil/velocity", ("n", 3), "<f4", "m/s", "soil particles, world frame"),
    "body_points": Recorded(
        "particles/body/position", ("M", 3), "<f8", "m", "fixed to the body, world frame"
    ),
    "force": Recorded(
        "observables/body/force", (3,), "<f8", "N", "by the soil on the body, world frame, mean of the frame"
    ),
    "torque": Recorded(
        "observables/body/torque",
        (3,),
        "<f8",
        "N m",
        "by the soil on the body about its centre of mass, world frame, mean over the frame",
    ),
    "pose": Recorded(
        "observables/body/pose",
        (7,),
        "<f8",
        "m, 1",
        "centre of mass x y z [m], then unit quaternion x y z w, body to world",
    ),
}
"""What is recorded in every frame."""
MESH = {
    "vertices": Recorded(
        "parameters/tool/vertices", ("V", 3), "<f8", "m", "of the tool, about its centre of mass, body frame"
    ),
    "triangles": Recorded(
        "parameters/tool/triangles", ("F", 3), "<i4", "", "vertices of each triangle, facing outwards"
    ),
}
"""What a run has besides whose tool is a mesh."""


def series(file: h5py.File, name: str, part: str = "value") -> h5py.Dataset:
    """A dataset of one of `SERIES`: its `value`, `step` or `time`."""
    return file[f"{SERIES[name].path}/{part}"]


# --- Opening a file that may be anything ----------------------------------------------------------------


def open_run(path: str | os.PathLike[str]) -> h5py.File:
    """The run file, open for reading; only that it is a run of ours is certain.

    Raises:
        UserError: missing, unreadable, not HDF5, cut short, written by something else or by a newer sgns.
    """
    path = Path(path)
    if not os.path.exists(path):  # unlike Path.exists, takes any name
        raise UserError(f"no such run file: {path}; check the path, or make one with `sgns simulate`")
    if path.is_dir():
        raise UserError(f"{path} is a folder, not a run file; give one of the .h5 files in it")
    try:
        open_file(path, ANY_SIZE).close()
    except ValueError:
        raise UserError(f"{path} is a pipe or device, not a run file") from None
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}; check its permissions") from error
    if not h5py.is_hdf5(path):
        raise UserError(f"{path} is not an HDF5 file; give a run made by `sgns simulate` or `sgns rollout`")
    try:
        file = h5py.File(path, "r")
    except BROKEN as error:
        raise UserError(
            f"{path} is cut short or damaged and cannot be opened ({_reason(error)}); "
            "copy it again or repeat the run"
        ) from error
    with ExitStack() as unless_ours:
        unless_ours.callback(file.close)
        try:
            made_as, version = own_attribute(file, "format"), own_attribute(file, "format_version")
        except BROKEN as error:
            raise UserError(
                f"{path} is damaged ({_reason(error)}); copy it again or repeat the run"
            ) from error
        if not isinstance(made_as, str) or made_as != FORMAT:
            raise UserError(
                f"{path} is HDF5 but not a run of sgns (root attribute `format` is not {FORMAT!r}); "
                "give a file made by `sgns simulate` or `sgns rollout`"
            )
        if not isinstance(version, _WHOLE):
            raise UserError(f"{path} has no whole number as root attribute `format_version`; repeat the run")
        if version > FORMAT_VERSION:
            raise UserError(
                f"{path} has run format {version}, but sgns {__version__} reads up to {FORMAT_VERSION}; "
                "upgrade sgns"
            )
        unless_ours.pop_all()
    return file


def _reason(error: Exception) -> str:
    """The part of an HDF5 message that tells a person something."""
    text = one_line(error)
    if "truncated" in text:
        return "the file is shorter than its header says"
    if "already open for" in text:
        return "its writer never closed it"
    return text


def read_attributes(file: h5py.File) -> dict[str, Any]:
    """The root attributes that are there, text as str."""
    return {name: own_attribute(file, name) for name in (*ATTRIBUTES, STOPPED) if name in file.attrs}


def read_mesh(file: h5py.File) -> tuple[np.ndarray, np.ndarray] | None:
    """Vertices (V, 3) about the centre of mass [m] and triangles (F, 3) of a run whose tool is a mesh, checked; None if
    there is none.

    Raises:
        One of sgns.data.hdf5.BROKEN: It is damaged.
    """
    if own_object(file, MESH["vertices"].path) is None:
        return None
    try:
        return checked_mesh(*(own_dataset(file, part.path)[...] for part in MESH.values()))
    except SceneError as error:
        raise ValueError(str(error)) from error


def require_mesh_was_read(scene: object) -> None:
    """Refuses a scene out of a file whose tool is a mesh without a digest: such a scene is a person's wish to read the
    file it names, and no file may have wishes.

    Raises:
        ValueError: It is one.
    """
    tool = scene.get("tool") if isinstance(scene, dict) else None
    if isinstance(tool, dict) and tool.get("shape") == "mesh":
        if not isinstance(tool.get("digest"), str) or not tool["digest"]:
            raise ValueError("its scene names a mesh file without the digest of what was read from it")


def structure_problems(file: h5py.File) -> list[str]:
    """What is missing or has the wrong shape, in words; reads no bulk data.

    A file without such problems can be read by `Run` without surprises.
    """
    counts: dict[str, int] = {}  # T, n and M, from the first that shows them
    problems = list(_attribute_problems(file))
    for recorded in SERIES.values():
        problems += _series_problems(file, recorded, counts)
    return problems + _mesh_problems(file)


def _attribute_problems(file: h5py.File) -> Iterator[str]:
    values = read_attributes(file)
    yield from (f"root attribute {name!r} is missing" for name in ATTRIBUTES if name not in values)
    for name, kind in ATTRIBUTES.items():
        if name in values and not isinstance(values[name], kind):
            yield f"root attribute {name!r} has the wrong type ({type(values[name]).__name__})"
    for name, allowed in (("frame_rate", "above 0 Hz"), ("wall_time_s", "0 s or more")):
        value = values.get(name)
        if isinstance(value, _REAL) and not (0 <= value < math.inf and (value > 0 or name == "wall_time_s")):
            yield f"{name} is {value}; it must be {allowed}"
    digest = values.get("content_hash")  # it becomes the name of a file
    if isinstance(digest, str) and not re.fullmatch("[0-9a-f]{32}", digest):
        yield f"root attribute 'content_hash' is {digest[:40]!r}, not 32 hexadecimal digits"


def _series_problems(file: h5py.File, recorded: Recorded, counts: dict[str, int]) -> Iterator[str]:
    datasets = {}
    for part in ("value", "step", "time"):
        path = f"{recorded.path}/{part}"
        try:
            found = own_dataset(file, path, by_frame=part == "value" and "n" in recorded.tail)
        except KeyError:
            yield f"dataset /{path} is missing"
            continue
        except ValueError as error:
            yield str(error)
            continue
        if found.dtype.kind in ("iu" if part == "step" else "f"):
            datasets[part] = found
        else:
            yield f"dataset /{path} has the wrong type {found.dtype}"
    for part, found in datasets.items():
        expected = ("T", *recorded.tail) if part == "value" else ("T",)
        known = [counts.get(size, size) if isinstance(size, str) else size for size in expected]
        fits = len(found.shape) == len(known) and all(
            isinstance(size, str) or size == actual for size, actual in zip(known, found.shape, strict=True)
        )
        if not fits:
            shown = ", ".join(map(str, known))  # a letter if not known yet
            yield f"dataset {found.name} has shape {found.shape}, expected ({shown})"
            continue
        if found.shape[0] == 0:
            yield f"dataset {found.name} holds no frame"
        counts |= {size: n for size, n in zip(known, found.shape, strict=True) if isinstance(size, str)}


def _mesh_problems(file: h5py.File) -> list[str]:
    missing, problems = [], []
    for part in MESH.values():
        path = part.path
        try:
            if own_object(file, path) is None:
                missing.append(f"dataset /{path} is missing")
                continue
            found = own_dataset(file, path)
        except (KeyError, ValueError) as error:
            problems.append(one_line(error).strip("'"))
            continue
        if found.ndim != 2 or found.shape[1] != 3 or not len(found):
            problems.append(f"dataset /{path} has shape {found.shape}, expected (at least 1, 3)")
        elif found.dtype != np.dtype(part.dtype):
            problems.append(f"dataset /{path} has the wrong type {found.dtype}")
        elif found.size * found.dtype.itemsize > MOST_BYTES:
            problems.append(f"dataset /{path} is larger than {MOST_BYTES / 1e6:.0f} MB")
    return problems or (missing if len(missing) == 1 else [])  # without both there is no mesh


# --- Reading a run --------------------------------------------------------------------------------------


class Run:
    """A run file, open for reading; soil is read only when asked for.

    Opening reads attributes and shapes only. Close it, or use it as a context manager.

    Raises:
        UserError: the file is missing, cut short, incomplete, written by something else or by a newer sgns.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self._file = open_run(self.path)
        self._cache: dict[str, Any] = {}
        try:
            try:
                problems = structure_problems(self._file)
                found = read_attributes(self._file)
            except BROKEN as error:
                problems = [one_line(error)]
            if problems:
                more = f" and {len(problems) - 1} more" if len(problems) > 1 else ""
                raise UserError(
                    f"{self.path} is not a complete run: {problems[0]}{more}; "
                    f"`sgns check {self.path}` lists everything; repeat the run"
                )
        except BaseException:
            self._file.close()
            raise
        self.frame_count: int
        """T."""
        self.particle_count: int
        """n."""
        self.frame_count, self.particle_count, _ = series(self._file, "position").shape
        self.body_point_count: int = series(self._file, "body_points").shape[1]
        """M."""
        self.producer: str = found["producer"]
        """Who made the run: "mpm" or "rollout"."""
        self.seed = int(found["seed"])
        """Seed of the run."""
        self.frame_rate = float(found["frame_rate"])
        """Frames per second [Hz]."""
        self.wall_time_s = float(found["wall_time_s"])
        """Time it took to compute the run [s]."""
        self.arrangement_hash: str = found["arrangement_hash"]
        """Identifies the initial particle arrangement; the same in every run of a dataset."""
        self.content_hash: str = found["content_hash"]
        """Identifies the recorded numbers, 32 hexadecimal digits."""
        self.package_version: str = found["package_version"]
        """Version of sgns that wrote the file."""
        self.stopped: str | None = str(found[STOPPED]) if found.get(STOPPED) is not None else None
        """Why the run ended before its time; None for a whole run."""
        self._text: dict[str, str] = {name: found[name] for name in ("scene", "effects", "extra")}

    @property
    def scene(self) -> dict[str, Any]:
        """The complete scene as plain nested data; a tool that is a mesh is in `mesh`."""
        return self._yaml("scene")

    @property
    def effects(self) -> dict[str, dict[str, Any]]:
        """Physics that was on or off: {name: {"on": bool, "reason": str}}."""
        return self._yaml("effects")

    @property
    def extra(self) -> dict[str, Any]:
        """More provenance, given by who wrote the run."""
        return self._yaml("extra")

    @property
    def mesh(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Of a tool that is a mesh: vertices (V, 3) about its centre of mass [m], float64, and triangles (F, 3), both
        read-only; None for other tools."""
        if "mesh" not in self._cache:
            with self._reading("the tool's mesh"):
                self._cache["mesh"] = read_mesh(self._file)
            for array in self._cache["mesh"] or ():
                array.flags.writeable = False
        return self._cache["mesh"]

    # --- what was recorded --------------------------------------------------------------------------------

    @property
    def time(self) -> np.ndarray:
        """Times of the frames [s], shape (T,), float64."""
        return self._whole("position", "time")

    @property
    def pose(self) -> np.ndarray:
        """Body: centre of mass [m] and unit quaternion x y z w, body to world, shape (T, 7), float64."""
        return self._whole("pose")

    @property
    def force(self) -> np.ndarray:
        """By the soil on the body [N], world frame, mean over the frame, shape (T, 3), float64."""
        return self._whole("force")

    @property
    def torque(self) -> np.ndarray:
        """By the soil on the body about its centre of mass [N m], world frame, shape (T, 3), float64."""
        return self._whole("torque")

    @property
    def body_points(self) -> np.ndarray:
        """Points fixed to the body [m], world frame, shape (T, M, 3), float64."""
        return self._whole("body_points")

    def positions(self, frames: slice | int | list[int] | np.ndarray = slice(None)) -> np.ndarray:
        """Soil particles [m] in the chosen frames, shape (t, n, 3), float32; one frame gives t = 1."""
        return self._frames("position", frames)

    def velocities(self, frames: slice | int | list[int] | np.ndarray = slice(None)) -> np.ndarray:
        """Velocities of the soil particles [m/s] in the chosen frames, shape (t, n, 3), float32."""
        return self._frames("velocity", frames)

    @property
    def state(self) -> State:
        """What the solver of a stopped run needs to go on.

        Raises:
            UserError: the file holds none, or it is damaged.
        """
        try:
            group = own_object(self._file, STATE)
            if not isinstance(group, h5py.Group):
                raise UserError(
                    f"{self.path} holds no state to go on from; give a *.stopped.h5, which `sgns simulate` leaves when "
                    "the solver stops"
                )
            datasets = {name: own_dataset(group, name) for name in sorted(group)}
            for name, found in datasets.items():
                if found.dtype.kind not in "if":
                    raise UserError(f"{self.path}: /{STATE}/{name} does not hold numbers; repeat the run")
            frame = int(own_attribute(group, "frame"))
            return State(frame, {name: found[...] for name, found in datasets.items()})
        except BROKEN as error:
            raise UserError(
                f"{self.path}: its state is damaged ({one_line(error)}); repeat the run"
            ) from error

    # --- the file -----------------------------------------------------------------------------------------

    def close(self) -> None:
        """Close the file; what was read stays valid."""
        self._file.close()

    def __enter__(self) -> Run:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        size = f"{self.frame_count} frames, {self.particle_count} particles"
        return f"Run({str(self.path)!r}: {self.producer}, {size})"

    def _dataset(self, name: str, part: str = "value") -> h5py.Dataset:
        if not self._file:
            raise ValueError(f"{self.path} is closed")
        return series(self._file, name, part)

    def _whole(self, name: str, part: str = "value") -> np.ndarray:
        """A small array as float64: read once, given out as a copy."""
        key = f"{name}/{part}"
        if key not in self._cache:
            with self._reading(name):
                self._cache[key] = self._dataset(name, part)[...].astype(np.float64)
        return self._cache[key].copy()

    def _frames(self, name: str, frames: slice | int | list[int] | np.ndarray) -> np.ndarray:
        index = np.atleast_1d(np.arange(self.frame_count)[frames])
        dataset = self._dataset(name)
        out = np.empty((len(index), self.particle_count, 3), dtype=np.float32)
        with self._reading(name):
            if len(index) and (np.diff(index) == 1).all():
                dataset.read_direct(out, np.s_[index[0] : index[-1] + 1])
            else:  # a frame is a chunk, so reading them one by one costs nothing extra
                for row, frame in enumerate(index):
                    dataset.read_direct(out, np.s_[frame], np.s_[row])
        return out

    def _yaml(self, name: str) -> dict[str, Any]:
        if name not in self._cache:
            with self._reading(name):
                data = parse_yaml(self._text[name])
                if not isinstance(data, dict):
                    raise ValueError("it is not a group of keys")
                if name == "scene":
                    require_mesh_was_read(data)
            self._cache[name] = data
        return copy.deepcopy(self._cache[name])

    @contextmanager
    def _reading(self, name: str) -> Iterator[None]:
        try:
            yield
        except BROKEN as error:
            raise UserError(
                f"{self.path}: {name} is damaged ({one_line(error)}); copy the file again or repeat the run"
            ) from error


CHUNK_BYTES = 32e6  # positions held at one time, float64


def frame_chunks(particle_count: int, stop: int, start: int = 0) -> Iterator[slice]:
    """Slices of at least one frame that cover start ... stop - 1, so that memory does not grow with a run's length."""
    size = max(1, int(CHUNK_BYTES / (24.0 * particle_count)))
    for first in range(start, stop, size):
        yield slice(first, min(first + size, stop))

"""Reading a run, whether the solver or a network made it."""

from __future__ import annotations

import copy
import os
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

import h5py
import numpy as np

from mpm_warp import State
from sgns.config import UserError, parse_yaml
from sgns.data.files import is_replaceable, require_replaceable
from sgns.data.layout import (
    BROKEN,
    ELEMENTS,
    one_line,
    open_run,
    own_attribute,
    own_dataset,
    own_object,
    read_attributes,
    read_mesh,
    require_mesh_was_read,
    structure_problems,
)

# --- Reading or decoding a run a few frames at a time, so that memory does not grow with its length -----

CHUNK_BYTES = 32e6  # positions held at one time, float64


def frame_chunks(particle_count: int, stop: int, start: int = 0) -> Iterator[slice]:
    """Slices of at least one frame that cover start ... stop - 1."""
    size = max(1, int(CHUNK_BYTES / (24.0 * particle_count)))
    for first in range(start, stop, size):
        yield slice(first, min(first + size, stop))


# --- A run file -----------------------------------------------------------------------------------------
# Letters: T frames, n soil particles, M body points.


class Run:
    """A run file, open for reading; soil is read only when asked for.

    Opening reads attributes and shapes only. Close it, or use it as a context manager.

    Args:
        path: the .h5 file.

    Raises:
        UserError: the file is missing, cut short, incomplete, written by something else or by a newer sgns.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self._file: h5py.File = open_run(self.path)
        self._cache: dict[str, Any] = {}
        try:
            try:
                problems = structure_problems(self._file)
                self._attributes = read_attributes(self._file)
            except BROKEN as error:
                problems = [one_line(error)]
            if problems:
                more = f" and {len(problems) - 1} more" if len(problems) > 1 else ""
                raise UserError(
                    f"{self.path} is not a complete run: {problems[0]}{more}; "
                    f"`sgns check {self.path}` lists everything; repeat the run"
                )
            self.frame_count, self.particle_count, _ = self._dataset("position").shape
            """T and n."""
            self.body_point_count: int = self._dataset("body_points").shape[1]
            """M."""
        except BaseException:
            self._file.close()
            raise

    # --- where it comes from ------------------------------------------------------------------------------

    @property
    def scene(self) -> dict[str, Any]:
        """The complete scene as plain nested data; a tool that is a mesh is in `mesh`."""
        return self._yaml("scene")

    @property
    def mesh(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Of a tool that is a mesh: vertices (V, 3) about its centre of mass [m], float64, and triangles (F, 3), both
        read-only; None for other tools."""
        if "mesh" not in self._cache:
            try:
                self._cache["mesh"] = read_mesh(self._file)
            except BROKEN as error:
                raise self._damaged("the tool's mesh", error) from error
            for array in self._cache["mesh"] or ():
                array.flags.writeable = False
        return self._cache["mesh"]

    @property
    def effects(self) -> dict[str, dict[str, Any]]:
        """Physics that was on or off: {name: {"on": bool, "reason": str}}."""
        return self._yaml("effects")

    @property
    def extra(self) -> dict[str, Any]:
        """More provenance, given by who wrote the run."""
        return self._yaml("extra")

    @property
    def producer(self) -> str:
        """Who made the run: "mpm" or "rollout"."""
        return self._attributes["producer"]

    @property
    def seed(self) -> int:
        """Seed of the run."""
        return int(self._attributes["seed"])

    @property
    def frame_rate(self) -> float:
        """Frames per second [Hz]."""
        return float(self._attributes["frame_rate"])

    @property
    def wall_time_s(self) -> float:
        """Time it took to compute the run [s]."""
        return float(self._attributes["wall_time_s"])

    @property
    def arrangement_hash(self) -> str:
        """Identifies the initial particle arrangement; the same in every run of a dataset."""
        return self._attributes["arrangement_hash"]

    @property
    def content_hash(self) -> str:
        """Identifies the recorded numbers, 32 hexadecimal digits."""
        return self._attributes["content_hash"]

    @property
    def package_version(self) -> str:
        """Version of sgns that wrote the file."""
        return self._attributes["package_version"]

    @property
    def stopped(self) -> str | None:
        """Why the run ended before its time; None for a whole run."""
        reason = self._attributes.get("stopped")
        return None if reason is None else str(reason)

    # --- what was recorded --------------------------------------------------------------------------------

    @property
    def time(self) -> np.ndarray:
        """Times of the frames [s], shape (T,), float64."""
        return self._series("position", "time")

    @property
    def pose(self) -> np.ndarray:
        """Body: centre of mass [m] and unit quaternion x y z w, body to world, shape (T, 7), float64."""
        return self._series("pose")

    @property
    def force(self) -> np.ndarray:
        """By the soil on the body [N], world frame, mean over the frame, shape (T, 3), float64."""
        return self._series("force")

    @property
    def torque(self) -> np.ndarray:
        """By the soil on the body about its centre of mass [N m], world frame, shape (T, 3), float64."""
        return self._series("torque")

    @property
    def body_points(self) -> np.ndarray:
        """Points fixed to the body [m], world frame, shape (T, M, 3), float64."""
        return self._series("body_points")

    def positions(self, frames: slice | int | list[int] | np.ndarray = slice(None)) -> np.ndarray:
        """Soil particles [m] in the chosen frames, shape (t, n, 3), float32; one frame gives t = 1."""
        return self._frames("position", frames)

    def velocities(self, frames: slice | int | list[int] | np.ndarray = slice(None)) -> np.ndarray:
        """Velocities of the soil particles [m/s] in the chosen frames, shape (t, n, 3), float32."""
        return self._frames("velocity", frames)

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
        return self._file[f"{ELEMENTS[name].path}/{part}"]

    def _series(self, name: str, part: str = "value") -> np.ndarray:
        """A small array as float64: read once, given out as a copy."""
        if (name, part) not in self._cache:
            try:
                self._cache[name, part] = self._dataset(name, part)[...].astype(np.float64)
            except BROKEN as error:
                raise self._damaged(name, error) from error
        return self._cache[name, part].copy()

    def _frames(self, name: str, frames: slice | int | list[int] | np.ndarray) -> np.ndarray:
        index = np.atleast_1d(np.arange(self.frame_count)[frames])
        dataset = self._dataset(name)
        steps = np.diff(index)
        out = np.empty((len(index), self.particle_count, 3), dtype=np.float32)
        try:
            if len(index) and (steps == 1).all():
                dataset.read_direct(out, np.s_[index[0] : index[-1] + 1])
            else:  # a frame is a chunk, so reading them one by one costs nothing extra
                for row, frame in enumerate(index):
                    dataset.read_direct(out, np.s_[frame], np.s_[row])
        except BROKEN as error:
            raise self._damaged(name, error) from error
        return out

    def _yaml(self, name: str) -> dict[str, Any]:
        if name not in self._cache:
            try:
                data = parse_yaml(self._attributes[name])
            except ValueError as error:
                raise self._damaged(name, error) from error
            if not isinstance(data, dict):
                raise self._damaged(name, "it is not a group of keys")
            if name == "scene":
                try:
                    require_mesh_was_read(data)
                except ValueError as error:
                    raise self._damaged(name, error) from error
            self._cache[name] = data
        return copy.deepcopy(self._cache[name])

    def _damaged(self, name: str, error: object) -> UserError:
        return UserError(
            f"{self.path}: {name} is damaged ({one_line(error)}); copy the file again or repeat the run"
        )


# --- What is kept of a run whose solver stopped: its frames, and the state to go on from ----------------

_GROUP = "state"


def stopped_path(path: Path) -> Path:
    """Where the frames of a run go that was to become `path` and stopped before its end."""
    return path.with_name(f"{path.stem}.stopped{path.suffix}")


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


def remove_stopped(path: Path) -> None:
    """Remove what an earlier attempt at a run left, now that the run is complete; anything else stays."""
    kept = stopped_path(path)
    if is_replaceable(kept) and _is_stopped(kept):
        kept.unlink(missing_ok=True)


def _is_stopped(path: Path) -> bool:
    try:
        with open_run(path) as file:
            return "stopped" in read_attributes(file)
    except (UserError, *BROKEN):
        return False


def write_state(file: h5py.File, state: State) -> None:
    """Store a state beside the frames."""
    group = file.create_group(_GROUP)
    group.attrs["frame"] = np.int64(state.frame)
    for name, array in state.arrays.items():
        group[name] = array


def read_state(path: str | os.PathLike[str]) -> State:
    """The state in a stopped run.

    Raises:
        UserError: the file cannot be read or holds none.
    """
    with open_run(path) as file:
        try:
            group = own_object(file, _GROUP)
            if not isinstance(group, h5py.Group):
                raise UserError(
                    f"{path} holds no state to go on from; give a *.stopped.h5, which `sgns simulate` leaves when the "
                    "solver stops"
                )
            return State(
                int(own_attribute(group, "frame")),
                {name: _numbers(group, name, path) for name in sorted(group)},
            )
        except BROKEN as error:
            raise UserError(f"{path}: its state is damaged ({one_line(error)}); repeat the run") from error


def _numbers(group: h5py.Group, name: str, path: str | os.PathLike[str]) -> np.ndarray:
    found = own_dataset(group, name)
    if found.dtype.kind not in "if":
        raise UserError(f"{path}: /{_GROUP}/{name} does not hold numbers; repeat the run")
    return found[...]

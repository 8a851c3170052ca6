"""Reading a run file, whether the solver or a network made it.

Letters: T frames, n soil particles, M body points; V vertices and F triangles of a tool that is a mesh.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np

from mpm_warp import Scene, SceneError, Soil, State
from mpm_warp.motions import Passes, along_and_across
from mpm_warp.settings import short
from sgns.config import UserError, library, parse_yaml
from sgns.data.files import one_line
from sgns.data.hdf5 import BROKEN, own_attribute, own_dataset, own_object
from sgns.data.run_file import (
    STATE,
    STOPPED,
    WHOLE,
    open_run,
    read_attributes,
    read_mesh,
    recorded_in,
    require_mesh_was_read,
    series,
    structure_problems,
)
from sgns.data.surface import Surface, soil_surface
from sgns.numbers import is_whole

if TYPE_CHECKING:
    import pandas
    import xarray

AXES = ["x", "y", "z"]
POSE = [*AXES, "qx", "qy", "qz", "qw"]
"""Names of a pose's numbers, as in a CSV file of a path."""


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
        """Who made the run: "mpm", "rollout" or "imported"."""
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
        return self._mesh(0)

    @property
    def meshes(self) -> list[tuple[np.ndarray, np.ndarray] | None]:
        """`mesh`, then that of each of the k further bodies."""
        return [self._mesh(body) for body in range(1 + self.other_pose.shape[1])]

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
    def force_spread(self) -> np.ndarray | None:
        """Half the width of the band around the force that is to hold 90 % [N], shape (T, 3), float64; None where the
        run has none: only rollouts with spread=true do."""
        there = self._file and "force_spread" in recorded_in(self._file)
        return self._whole("force_spread") if there or not self._file else None

    @property
    def torque(self) -> np.ndarray:
        """By the soil on the body about its centre of mass [N m], world frame, shape (T, 3), float64."""
        return self._whole("torque")

    @property
    def other_pose(self) -> np.ndarray:
        """Of the k further bodies (scene.others), as `pose`, shape (T, k, 7), float64."""
        return self._of_others("other_pose", 7)

    @property
    def other_force(self) -> np.ndarray:
        """By the soil on them, as `force` [N], shape (T, k, 3), float64."""
        return self._of_others("other_force", 3)

    @property
    def other_torque(self) -> np.ndarray:
        """Likewise, each about its centre of mass, as `torque` [N m], shape (T, k, 3), float64."""
        return self._of_others("other_torque", 3)

    @property
    def body_points(self) -> np.ndarray:
        """Points fixed to the body [m], world frame, shape (T, M, 3), float64."""
        return self._whole("body_points")

    def positions(self, frames: slice | int | list[int] | np.ndarray = slice(None)) -> np.ndarray:
        """Soil particles [m] in the chosen frames, shape (t, n, 3), float32; one frame gives t = 1.

        Raises:
            UserError: the run has no such frame.
        """
        return self._frames("position", frames)

    def velocities(self, frames: slice | int | list[int] | np.ndarray = slice(None)) -> np.ndarray:
        """Velocities of the soil particles [m/s] in the chosen frames, shape (t, n, 3), float32."""
        return self._frames("velocity", frames)

    def surface(self, frame: int = -1, resolution: float | None = None) -> Surface:
        """The soil's surface in a frame, the last if none is given: x (nx,), y (ny,) and heights z (nx, ny) [m]; in
        columns two particle spacings wide, or in cells with this edge [m].

        Raises:
            UserError: `frame` is no whole number or not one of the run, the resolution is no such edge, or the scene
                does not say how its bed is filled.
        """
        if not is_whole(frame):
            raise UserError(
                f"frame is {frame!r}; it must be a whole number: that of a time t is round(t * run.frame_rate)"
            )
        return soil_surface(self.positions(int(frame))[0], self.scene, resolution)

    def forces(self) -> pandas.DataFrame:
        """Force [N], torque [N m] and pose of every frame as a table: columns Fx Fy Fz, Tx Ty Tz, x y z [m] and qx qy
        qz qw, by `time` [s]; for a wheel also `pull` along its heading, `lateral` along its axle [N], and `drive`, the
        torque about its axle [N m]; of several passes `pass`, which one cuts, from 1 on (0: none). Forces in frame 0
        are 0: they are means since the frame before. Needs pandas.

        Raises:
            UserError: pandas is not installed.
        """
        pd = library("pandas", "run.forces()")
        return pd.DataFrame(self.force_columns(), index=pd.Index(self.time, name="time"))

    def force_columns(self) -> dict[str, np.ndarray]:
        """The columns of `forces`, each (T,), without pandas."""
        columns = [f"{name}{axis}" for name in "FT" for axis in AXES] + POSE
        values = np.hstack([self.force, self.torque, self.pose])
        table = dict(zip(columns, values.T, strict=True))
        scene = self.scene
        if scene.get("kind") == "wheel":
            table["pull"], table["lateral"], _ = along_and_across(scene, self.force).T
            table["drive"] = along_and_across(scene, self.torque)[:, 1]
        if scene.get("motion") == "passes":
            passes = Passes.from_dict(scene.get("passes") or {})
            table["pass"] = 1 + passes.cutting(self.time, scene["depth"], scene["speed"])
        return table

    def to_xarray(self, frames: slice | int | list[int] | np.ndarray = slice(None)) -> xarray.Dataset:
        """The chosen frames with named dimensions, in memory: `position` and `velocity` (time, particle, axis), `force`
        and `torque` (time, axis), `pose` (time, component), `body_points` (time, point, axis). Needs xarray.

        Raises:
            UserError: xarray is not installed.
        """
        xr = library("xarray", "run.to_xarray()")
        index = self._index(frames)
        parts = {
            "position": (("particle", "axis"), self.positions(index), "m"),
            "velocity": (("particle", "axis"), self.velocities(index), "m/s"),
            "force": (("axis",), self.force[index], "N"),
            "torque": (("axis",), self.torque[index], "N m"),
            "pose": (("component",), self.pose[index], "m, 1"),
            "body_points": (("point", "axis"), self.body_points[index], "m"),
        }
        return xr.Dataset(
            {
                name: (("time", *dims), values, {"units": unit})
                for name, (dims, values, unit) in parts.items()
            },
            coords={
                "time": ("time", self.time[index], {"units": "s"}),
                "axis": AXES,
                "component": POSE,
            },
            attrs={"producer": self.producer, "frame_rate": self.frame_rate, "source": str(self.path)},
        )

    @property
    def has_state(self) -> bool:
        """Whether the file holds more of the last frame than was recorded: that of a rollout does not."""
        return STATE in self._file

    @property
    def state(self) -> State:
        """What the solver has in memory after the last frame.

        Raises:
            UserError: the file holds none, or it is damaged.
        """
        try:
            group = own_object(self._file, STATE)
            if not isinstance(group, h5py.Group):
                raise UserError(
                    f"{self.path} holds no state to go on from: it is no run of `sgns simulate`, or one of an older "
                    "version; repeat the run"
                )
            datasets = {name: own_dataset(group, name) for name in sorted(group)}
            for name, found in datasets.items():
                if found.dtype.kind not in "if":
                    raise UserError(f"{self.path}: /{STATE}/{name} does not hold numbers; repeat the run")
            frame = int(own_attribute(group, "frame"))
            arrays = {name: found[...] for name, found in datasets.items()}
            return State(frame, arrays, arrays.pop(WHOLE, None))
        except BROKEN as error:
            raise UserError(
                f"{self.path}: its state is damaged ({one_line(error)}); repeat the run"
            ) from error

    @property
    def soil(self) -> Soil:
        """Soil after the last frame, for another tool and path: `mpm_warp.Solver(scene, start_from=run.soil)`.

        Raises:
            UserError: the file holds none, or it is damaged.
        """
        state = self.state
        if state.frame != self.frame_count - 1:
            raise UserError(
                f"{self.path} holds {self.frame_count} frames but the state of frame {state.frame}; repeat the run"
            )
        try:
            scene = Scene.from_dict(self.scene, *self.meshes)
            return Soil(scene, state, self.pose[-1], f"{self.path}@{state.frame}")
        except SceneError as error:
            raise UserError(f"{self.path}: {error}; repeat the run") from error

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

    def _mesh(self, body: int) -> tuple[np.ndarray, np.ndarray] | None:
        if (key := f"mesh/{body}") not in self._cache:
            with self._reading(f"the mesh of scene.others[{body - 1}]" if body else "the tool's mesh"):
                self._cache[key] = read_mesh(self._file, body)
            for array in self._cache[key] or ():
                array.flags.writeable = False
        return self._cache[key]

    def _dataset(self, name: str, part: str = "value") -> h5py.Dataset:
        if not self._file:
            raise UserError(f"{self.path} is closed; read it inside its `with`, or open it again")
        return series(self._file, name, part)

    def _whole(self, name: str, part: str = "value") -> np.ndarray:
        """A small array as float64: read once, given out as a copy."""
        key = f"{name}/{part}"
        if key not in self._cache:
            with self._reading(name):
                self._cache[key] = self._dataset(name, part)[...].astype(np.float64)
        return self._cache[key].copy()

    def _of_others(self, name: str, size: int) -> np.ndarray:
        there = self._file and name in recorded_in(self._file)
        return self._whole(name) if there or not self._file else np.zeros((self.frame_count, 0, size))

    def _index(self, frames: slice | int | list[int] | np.ndarray) -> np.ndarray:
        """Numbers of the chosen frames, shape (t,)."""
        try:
            return np.atleast_1d(np.arange(self.frame_count)[frames])
        except IndexError as error:
            raise UserError(
                f"frames is {short(frames)}: {self.path} has {self.frame_count} frames, 0 to {self.frame_count - 1} "
                "(or counted from the end, -1 the last); that of a time t is round(t * run.frame_rate)"
            ) from error

    def _frames(self, name: str, frames: slice | int | list[int] | np.ndarray) -> np.ndarray:
        index = self._index(frames)
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

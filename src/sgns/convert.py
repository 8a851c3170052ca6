"""`sgns convert`: a run as a file of other programs. The run itself stays as it is.

Letters: T frames, n soil particles, M body points; V vertices and F triangles of a body's surface.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
from omegaconf import DictConfig

from mpm_warp.poses import in_body_frame, in_world_frame
from sgns.config import UserError
from sgns.data.files import require_new, require_replaceable, whole_file
from sgns.data.hdf5 import new_hdf5
from sgns.data.run import Run
from sgns.data.run_file import VIEWS, write_steps
from sgns.evaluate.body_shape import bodies, body_triangles

log = logging.getLogger(__name__)


def main(cfg: DictConfig) -> None:
    """Write the run `cfg.run` as `cfg.output`, whose ending says what for."""
    path = Path(cfg.output)
    if path.suffix.lower() not in KINDS:
        raise UserError(f"output is {path}; it must end in one of {', '.join(KINDS)}, as output=run.vtkhdf")
    write, words = KINDS[path.suffix.lower()]
    with Run(cfg.run) as run:
        require_new(path, cfg.overwrite)
        require_replaceable(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        frames = np.arange(0, run.frame_count, cfg.every)
        write(run, frames, path)
    log.info("%s: %s; %d frames, %.3g MB", path, words, len(frames), path.stat().st_size / 1e6)


def surfaces(run: Run) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Of each body its poses (T, 7), and its surface: vertices (V, 3) in the body frame [m], triangles (F, 3)."""
    found = {}
    for number, body in enumerate(bodies(run)):
        corners = body_triangles(body, 0)
        if len(corners):
            own = in_body_frame(body.pose[0], corners.reshape(-1, 3))
            vertices, index = np.unique(own.round(9), axis=0, return_inverse=True)
            name = f"other_{number - 1}" if number else "tool"
            found[name] = body.pose, vertices, index.reshape(-1, 3)
    return found


def _vtkhdf(run: Run, frames: np.ndarray, path: Path) -> None:
    """Blocks in time (VTKHDF 2.2, MultiBlockDataSet): the soil, the tool, further bodies."""
    times = run.time[frames]
    with new_hdf5(path) as file:
        root = file.create_group(
            "VTKHDF", track_order=True
        )  # VTK reads blocks in the order of their creation
        root.attrs["Version"], root.attrs["Type"] = (
            np.array((2, 2), dtype="<i8"),
            np.bytes_("MultiBlockDataSet"),
        )
        soil, n = root.create_group("soil"), run.particle_count
        for name in VIEWS.values():
            soil.create_dataset(name, (len(frames) * n, 3), "<f4", chunks=(n, 3))
        for row, frame in enumerate(frames):
            soil[VIEWS["position"]][row * n : (row + 1) * n] = run.positions(frame)[0]
            soil[VIEWS["velocity"]][row * n : (row + 1) * n] = run.velocities(frame)[0]
        write_steps(soil, times, n)
        for name, (poses, vertices, triangles) in surfaces(run).items():
            block = root.create_group(name)
            points = in_world_frame(poses[frames], vertices).reshape(-1, 3)
            block.create_dataset("Points", data=points.astype("<f4"))
            write_steps(block, times, len(vertices), triangles)
        assembly = root.create_group("Assembly", track_order=True)
        for name in [name for name in root if name != "Assembly"]:
            assembly[name] = h5py.SoftLink(f"/VTKHDF/{name}")


def _xyz(run: Run, frames: np.ndarray, path: Path) -> None:
    """Extended XYZ: soil, then body points, with velocities; force and torque of the frame in its second line."""
    columns = "species:S:1:pos:R:3:velo:R:3"
    with whole_file(path) as hidden, hidden.open("w", encoding="ascii") as text:
        for frame in frames:
            load = [f'{name}="{_numbers(getattr(run, name)[frame])}"' for name in ("force", "torque", "pose")]
            text.write(f"{run.particle_count + run.body_point_count}\n")
            text.write(f'Properties={columns} Time={run.time[frame]:.9g} pbc="F F F" {" ".join(load)}\n')
            soil = np.hstack([run.positions(frame)[0], run.velocities(frame)[0]])
            points = run.body_points[frame]
            np.savetxt(text, soil, "soil %.7g %.7g %.7g %.7g %.7g %.7g")
            np.savetxt(text, points, "tool %.7g %.7g %.7g 0 0 0")


def _numbers(values: np.ndarray) -> str:
    return " ".join(f"{value:.9g}" for value in values)


def _csv(run: Run, frames: np.ndarray, path: Path) -> None:
    """The table of `Run.forces`."""
    table = {"time": run.time} | run.force_columns()
    with whole_file(path) as hidden:
        values = np.stack(list(table.values()), axis=1)[frames]
        np.savetxt(hidden, values, "%.9g", ",", header=",".join(table), comments="")


def _npz(run: Run, frames: np.ndarray, path: Path) -> None:
    """Arrays by the names that `sgns import` knows, and the scene as JSON."""
    names = ("time", "pose", "force", "torque", "body_points")
    arrays = {name: getattr(run, name)[frames] for name in names}
    arrays |= {"position": run.positions(frames), "velocity": run.velocities(frames)}
    if run.mesh is not None:
        arrays["vertices"], arrays["triangles"] = run.mesh
        del arrays["body_points"]  # they are vertices of the mesh
    with whole_file(path) as hidden, hidden.open("wb") as stream:
        np.savez(stream, scene=json.dumps(run.scene), **arrays)


KINDS: dict[str, tuple[Callable[[Run, np.ndarray, Path], None], str]] = {
    ".vtkhdf": (_vtkhdf, "soil and tool for ParaView and VTK"),
    ".xyz": (_xyz, "soil and body points for OVITO"),
    ".csv": (_csv, "forces, torques and poses"),
    ".npz": (_npz, "arrays for NumPy"),
}
"""Ending → what writes it, and what it is."""

"""`sgns import`: what another simulator has computed becomes a run file, or a dataset of them.

Letters: T frames, n soil particles, M body points; V vertices and F triangles of the tool.
"""

from __future__ import annotations

import hashlib
import logging
import math
import shlex
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from omegaconf import DictConfig, OmegaConf
from scipy.spatial.transform import Rotation

from mpm_warp import Bed, MeshBody, SceneError
from mpm_warp.bodies import UNITS
from mpm_warp.mesh_files import read_mesh
from mpm_warp.poses import in_world_frame, rotate
from mpm_warp.solids import closed_mesh
from sgns.command_settings import Import
from sgns.config import UserError
from sgns.data.check import check_run
from sgns.data.dataset import IMPORTED, SPLITS
from sgns.data.files import only_here, require_new, write_whole
from sgns.data.sources import ARRAYS, PAGE, found_sources, read_source
from sgns.data.surface import particle_spacing
from sgns.data.writer import RunWriter, require_new_run
from sgns.numbers import counted
from sgns.simulate.campaign import split_runs

log = logging.getLogger(__name__)


def main(cfg: DictConfig) -> None:
    """Import `cfg.source` into the run file `cfg.output`, or each of several into the dataset `cfg.output`."""
    plain: Any = OmegaConf.to_container(cfg, resolve=True)
    settings = Import.from_dict(plain)
    sources, output = found_sources(settings.source), Path(settings.output)
    if output.suffix.lower() == ".h5":
        if len(sources) > 1:
            raise UserError(
                f"output is {output}, one run, and there are {len(sources)} sources, each of them a run; give a folder "
                "as output for a dataset"
            )
        with only_here(output):
            require_new_run(output, settings.overwrite)
            _import(sources[0], output, settings, None)
        log.info("to look at it: sgns plot %s", shlex.quote(str(output)))
        return
    description = output / "dataset.yaml"
    with only_here(description):
        require_new(description, settings.overwrite)
        import_dataset(sources, output, settings)
    log.info(
        "next: sgns train dataset=imported dataset.path=%s output=outputs/imported", shlex.quote(str(output))
    )


def import_dataset(sources: Sequence[Path], folder: Path, settings: Import) -> None:
    """Every source as a run in the folder's `runs`, then `dataset.yaml` with their split."""
    names = [source.stem if source.is_file() else source.name for source in sources]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise UserError(
            f"two sources are called {twice[0]}; runs are named after them: give them other names"
        )
    first: np.ndarray | None = None
    scenes = {}
    for name, source in zip(names, sources, strict=True):
        path = folder / "runs" / f"{name}.h5"
        start, scenes[name] = _import(source, path, settings, first)
        first = start if first is None else first
    part = split_runs([names], settings.split, np.random.default_rng(settings.seed))
    split = {one: [name for name in names if part[name] == one] for one in SPLITS}
    content = {"name": IMPORTED, "seed": settings.seed, "split": split, "scenes": scenes}
    write_whole(folder / "dataset.yaml", yaml.safe_dump(content, sort_keys=False))
    shares = ", ".join(f"{len(runs)} {one}" for one, runs in split.items())
    log.info("%s: %s (%s)", folder, counted(len(names), "run"), shares)


# --- From their axes, units and order to ours -----------------------------------------------------------

NEEDED = ("position", "pose", "force")
_ALL_THERE = 1e-3
"""How far a quaternion's length may be from 1, which is then made so."""
_EVEN = 0.01
"""How far the time between frames may be from its median, as a share of it."""
_SAME_START = 0.1
"""How far two runs may be apart at the start [particle spacings]."""
_UPRIGHT = Rotation.from_matrix([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Turns their y, upwards, to our z."""


class Foreign(NamedTuple):
    """A run in our axes and units."""

    rate: float  # [Hz]
    position: np.ndarray  # (T, n, 3), float32
    velocity: np.ndarray
    pose: np.ndarray  # (T, 7)
    force: np.ndarray  # (T, 3)
    torque: np.ndarray
    points: np.ndarray  # (T, M, 3)
    mesh: tuple[np.ndarray, np.ndarray] | None
    centre: np.ndarray  # of the mesh in their body frame [m], (3,)
    values: dict[str, float]  # of the scene


def converted(arrays: Mapping[str, np.ndarray], settings: Import, source: Path) -> Foreign:
    """The run in a source's arrays.

    Raises:
        UserError: Something is missing, has the wrong shape or is not finite; the line says what.
    """
    if missing := [name for name in NEEDED if name not in arrays]:
        raise UserError(f"{source} has no {', no '.join(missing)}; it has {', '.join(arrays)}; {PAGE}")
    if np.ndim(arrays["position"]) != 3 or arrays["position"].shape[2] != 3:
        shape = np.shape(arrays["position"])
        raise UserError(
            f"{source}: position has shape {shape}; it must be (T, n, 3): frames, particles, axes"
        )
    frames, n, _ = arrays["position"].shape
    given: dict[str, Any] = {}
    for name, shape in {
        "position": (frames, n, 3),
        "velocity": (frames, n, 3),
        "pose": (frames, 7),
        "force": (frames, 3),
        "torque": (frames, 3),
        "time": (frames,),
    }.items():
        if name in arrays:
            given[name] = _checked(arrays[name], shape, name, source)
    if "id" in arrays:
        _sort(given, _checked(arrays["id"], None, "id", source), source)
    rate = _rate(given.get("time"), arrays.get("frame_rate"), settings, source)
    pose = given["pose"] if settings.quaternion == "xyzw" else given["pose"][:, [0, 1, 2, 4, 5, 6, 3]]
    length = np.linalg.norm(pose[:, 3:], axis=1)
    if (off := np.abs(length - 1.0) > _ALL_THERE).any():
        frame = int(off.argmax())
        raise UserError(
            f"{source}: the quaternion of frame {frame} has length {length[frame]:.4g}, not 1; a pose is x y z qx qy "
            "qz qw (quaternion=wxyz: qw before qx)"
        )
    turned, unit = _UPRIGHT if settings.up == "y" else Rotation.identity(), UNITS[settings.unit]

    def vectors(values: np.ndarray) -> np.ndarray:
        return turned.apply(values.reshape(-1, 3)).reshape(values.shape) if settings.up == "y" else values

    def places(values: np.ndarray) -> np.ndarray:
        return vectors(unit * (values - settings.origin))

    rotation = (turned * Rotation.from_quat(pose[:, 3:])).as_quat()
    pose = np.hstack([places(pose[:, :3]), rotation])
    position = places(given["position"]).astype("<f4")
    velocity = vectors(unit * given["velocity"]) if "velocity" in given else _differences(position, rate)
    force = vectors(given["force"])
    torque = vectors(given["torque"]) if "torque" in given else np.zeros_like(force)
    mesh, centre = _mesh(arrays, settings, unit, source)
    if mesh is not None:
        arm = rotate(pose[:, 3:], np.broadcast_to(centre, (frames, 3)))
        pose[:, :3] += arm
        torque = torque - np.cross(arm, force) if "torque" in given else torque
        points = in_world_frame(pose, MeshBody.of_mesh(*mesh).points())
    elif "body_points" not in arrays:
        raise UserError(
            f"{source} has no body_points and no mesh (tool=tool.stl, or vertices and triangles); without the network "
            f"does not know how large the tool is; {PAGE}"
        )
    elif np.ndim(arrays["body_points"]) == 2:
        points = in_world_frame(
            pose, unit * _checked(arrays["body_points"], (None, 3), "body_points", source)
        )
    else:
        points = places(_checked(arrays["body_points"], (frames, None, 3), "body_points", source))
    numbers = {
        name: float(values) for name, values in arrays.items() if name not in ARRAYS and name != "frame_rate"
    }
    return Foreign(rate, position, velocity, pose, force, torque, points, mesh, centre, numbers)


def _checked(values: Any, shape: tuple[int | None, ...] | None, name: str, source: Path) -> np.ndarray:
    """An array of finite numbers of a shape, in which None may be any."""
    found = np.asarray(values)
    if found.dtype.kind not in "iuf":
        raise UserError(f"{source}: {name} holds no numbers")
    fits = shape is None or (
        found.ndim == len(shape) and all(a in (None, b) for a, b in zip(shape, found.shape, strict=True))
    )
    if not fits or found.size == 0:
        wanted = ", ".join("any" if size is None else str(size) for size in shape or ())
        raise UserError(
            f"{source}: {name} has shape {found.shape}; expected ({wanted}), as position has T and n; {PAGE}"
        )
    bad = ~np.isfinite(found)
    if bad.any():
        raise UserError(f"{source}: {name} is not finite at index {tuple(map(int, np.argwhere(bad)[0]))}")
    return found if name in ("position", "velocity", "id") else found.astype(float)


def _sort(given: dict[str, Any], number: np.ndarray, source: Path) -> None:
    """Put the particles of every frame into the order of their numbers."""
    frames, n, _ = given["position"].shape
    number = (
        np.broadcast_to(number.squeeze(), (frames, n))
        if number.squeeze().shape in ((n,), (frames, n))
        else number
    )
    if number.shape != (frames, n):
        raise UserError(f"{source}: id has shape {number.shape}; expected ({frames}, {n}) or ({n},)")
    order = np.argsort(number, axis=1, kind="stable")
    known = np.take_along_axis(number, order, axis=1)
    if len(np.unique(known[0])) < n or (known != known[0]).any():
        frame = int((known != known[0]).any(axis=1).argmax())
        raise UserError(
            f"{source}: id of frame {frame} are not those of frame 0, each once; a run keeps its particles"
        )
    for name in {"position", "velocity"} & set(given):
        given[name] = np.take_along_axis(given[name], order[..., None], axis=1)


def _rate(times: np.ndarray | None, stated: Any, settings: Import, source: Path) -> float:
    """Frames per second, from the settings, the source's own number or its times, which must agree."""
    rate = (
        settings.frame_rate if settings.frame_rate is not None else None if stated is None else float(stated)
    )
    if rate is not None and not 0.0 < rate < math.inf:
        raise UserError(f"{source}: frame_rate is {rate:g} Hz; it must be a number above 0")
    if times is None or len(times) < 2:
        if rate is None:
            raise UserError(f"{source} has no time (T,) and no frame_rate; give frame_rate=60 [Hz]")
        return rate
    steps = np.diff(times)
    step = float(np.median(steps)) if rate is None else 1.0 / rate
    if (off := ~(np.abs(steps - step) <= _EVEN * step)).any() or not step > 0.0:
        frame = int(off.argmax())
        raise UserError(
            f"{source}: time before frame {frame + 1} advances by {steps[frame]:.6g} s and not by {step:.6g} s; frames "
            "must be equally far apart in time: interpolate them, with forces averaged over each frame"
        )
    return 1.0 / step if rate is not None else float((len(times) - 1) / (times[-1] - times[0]))


def _differences(position: np.ndarray, rate: float) -> np.ndarray:
    """Backward differences, zero in frame 0, as in rollouts."""
    return np.diff(position, axis=0, prepend=position[:1]) * np.float32(rate)


def _mesh(
    arrays: Mapping[str, np.ndarray], settings: Import, unit: float, source: Path
) -> tuple[tuple[np.ndarray, np.ndarray] | None, np.ndarray]:
    """The tool's mesh about its centre of mass, and that centre in the body frame [m]."""
    if settings.tool is not None:
        name: Any = settings.tool
        try:
            vertices, triangles, said = read_mesh(Path(name))
        except (OSError, ValueError) as error:
            raise UserError(
                f"tool: cannot read {name}: {getattr(error, 'strerror', None) or error}"
            ) from None
        unit = said or unit
    elif {"vertices", "triangles"} <= set(arrays):
        name = source
        vertices = _checked(arrays["vertices"], (None, 3), "vertices", source)
        triangles = np.asarray(arrays["triangles"])
        if triangles.dtype.kind not in "iu" or triangles.shape != (len(triangles), 3) or not len(triangles):
            raise UserError(
                f"{source}: triangles has shape {triangles.shape}; it needs three whole numbers in each row"
            )
        if triangles.min() < 0 or triangles.max() >= len(vertices):
            raise UserError(f"{source}: a triangle has a vertex that is not there; numbers count from 0")
    else:
        return None, np.zeros(3)
    try:
        solid = closed_mesh(unit * vertices, triangles.astype(np.int64), str(name))
    except SceneError as error:
        raise UserError(str(error).removeprefix("tool.file: ")) from None
    return (solid.vertices, solid.triangles), solid.centre


# --- The run file ---------------------------------------------------------------------------------------


def _import(
    source: Path, path: Path, settings: Import, first: np.ndarray | None
) -> tuple[np.ndarray, dict[str, Any]]:
    """Write one run; returns its soil at the start (n, 3) and its scene. `first` is that of the dataset's first run."""
    began = time.perf_counter()
    run = converted(read_source(source, settings.names.to_dict()), settings, source)
    start = run.position[0]
    spacing = particle_spacing(start)
    if first is not None:
        require_same_start(start, first, spacing, source)
    for line in doubts(run, spacing):
        log.warning("%s: %s", source, line)
    scene = described(run, start, spacing)
    content = hashlib.blake2b(
        np.ascontiguousarray(start if first is None else first).tobytes(), digest_size=8
    )
    with RunWriter(
        path,
        scene=scene,
        effects={},
        arrangement_hash=f"{IMPORTED}-{content.hexdigest()}",
        particle_count=len(start),
        body_points=run.points.shape[1],
        frame_rate=run.rate,
        seed=settings.seed,
        producer=IMPORTED,
        extra={"source": str(source), "centre": run.centre.tolist()},
        meshes=(run.mesh,),
    ) as writer:
        for i in range(len(run.position)):
            soil = run.position[i], run.velocity[i]
            writer.append(i / run.rate, *soil, run.points[i], run.pose[i], run.force[i], run.torque[i])
        writer.finish(time.perf_counter() - began)
    if problems := check_run(path):
        path.unlink()
        raise UserError(f"{source}: {problems[0]}; nothing is kept; {PAGE}")
    size = f"{len(run.position)} frames at {run.rate:.6g} Hz, {len(start)} particles, {run.points.shape[1]} body points"
    log.info("%s: %s", path, size)
    return start, scene


def described(run: Foreign, start: np.ndarray, spacing: float) -> dict[str, Any]:
    """The scene as plain data: of the bin what the soil at rest shows, if it lies as ours do."""
    scene: dict[str, Any] = {"name": IMPORTED, "kind": IMPORTED, "frame_rate": run.rate}
    scene["duration"] = (len(run.position) - 1) / run.rate
    if run.mesh is not None:
        content = np.ascontiguousarray(run.mesh[0]).tobytes() + np.ascontiguousarray(run.mesh[1]).tobytes()
        scene["tool"] = {"shape": "mesh", "digest": hashlib.blake2b(content, digest_size=8).hexdigest()}
    low, high = start.min(axis=0) - 0.5 * spacing, start.max(axis=0) + 0.5 * spacing
    here = np.array([low[0], low[1], high[2]])
    if (np.abs(here) <= spacing).all():
        size = (float(high[0]), float(high[1]), float(-low[2]))
        with suppress(SceneError):  # such as one layer: then it has no bin
            Bed(size=size, spacing=spacing)
            scene["bed"] = {"size": list(size), "spacing": spacing, "particles_per_cell": 1.0}
    return scene | run.values


def require_same_start(start: np.ndarray, first: np.ndarray, spacing: float, source: Path) -> None:
    """Refuse a run whose soil begins otherwise than that of the dataset's first run."""
    if len(start) != len(first):
        raise UserError(
            f"{source} has {len(start)} particles, the first run {len(first)}; all runs of a dataset need the same"
        )
    away = np.linalg.norm(start - first, axis=1)
    if away.max() > _SAME_START * spacing:
        raise UserError(
            f"{source}: particle {int(away.argmax())} begins {away.max():.3g} m from where it begins in the first run; "
            "all runs of a dataset start from the same particles, in the same order and at rest"
        )


def doubts(run: Foreign, spacing: float) -> Iterator[str]:
    """What looks like another unit, axis, order or sign than was said."""
    low, high = run.position.min(axis=(0, 1)), run.position.max(axis=(0, 1))
    gap = np.linalg.norm(np.maximum(np.maximum(low - run.points, run.points - high), 0.0), axis=-1).min()
    if gap > (size := float((high - low).max())):
        yield (
            f"the tool is never nearer to the soil than {gap:.3g} m, and the soil is {size:.3g} m long; are unit, up "
            "and origin those of both?"
        )
    step = float(np.sqrt(np.square(np.diff(run.position, axis=0)).sum(-1).mean(-1)).max(initial=0.0))
    tool = float(np.linalg.norm(np.diff(run.points, axis=0), axis=-1).max(initial=0.0))
    if step > max(spacing, 2.0 * tool):
        yield (
            f"all particles move by {step:.3g} m in one frame, the tool by {tool:.3g} m; are they in the same order in "
            "all frames? An array id (T, n) puts them in order"
        )
    if not run.force.any():
        yield "the force is 0 in all frames; a network learns no force from it"
    work = np.einsum("ti,ti->t", run.force[1:], np.diff(run.pose[:, :3], axis=0))
    if work.sum() > 0.2 * np.abs(work).sum() > 0.0:
        yield "the force drives the tool on; is it by the soil on the tool? That of the tool on the soil needs a minus"

"""How long a step may be, what a scene may ask for, and where the solver has to stop."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import warp as wp

from .bed import Bed
from .launch import find_device
from .material import Material
from .rigid_body import longest_step
from .scene import Scene
from .state import SceneError

MOST_SUBSTEPS = 1_000_000
"""Between two frames."""
MOST_STEPS = 1_000_000_000
"""Substeps of a whole run."""

# --- How long a step may be, and how many of them pass between two remaps -------------------------------


def substeps_per_frame(scene: Scene) -> int:
    """Equal steps in a frame: as many as elastic waves, the body's motion and a free body's mass ask for.

    Raises:
        SceneError: more than limits.py allows in a frame or in all.
    """
    limit = min(wave_step(scene), *map(longest_step, (scene, *scene.companions)))
    count = 1.0 / scene.frame_rate / limit - 1e-9 if limit > 0.0 else math.inf
    total = count * (scene.frame_count - 1)
    if not count <= MOST_SUBSTEPS:
        raise SceneError(
            f"a frame would take {count:.3g} substeps of {limit:.3g} s; at most {MOST_SUBSTEPS:g} are allowed: "
            f"{_way_out(scene)}"
        )
    if not total <= MOST_STEPS:
        raise SceneError(
            f"the run would take {total:.3g} substeps, {count:.3g} in each of {scene.frame_count - 1} frames; at most "
            f"{MOST_STEPS:g} are allowed: lower scene.duration ({scene.duration:g} s), or {_way_out(scene)}"
        )
    return max(1, math.ceil(count))


def wave_step(scene: Scene) -> float:
    """Longest step [s] that elastic waves and the body's motion allow."""
    step = scene.courant * scene.bed.spacing / (scene.material.wave_speed + top_body_speed(scene))
    return step * damped_share(scene)


def _way_out(scene: Scene) -> str:
    """What to change for fewer substeps: the key that asks for most of them beyond what the defaults would."""
    for one in scene.companions:
        if longest_step(one) < wave_step(scene):
            key = "density" if one.free else "load"
            return f"the mass of {one.place} is too small for contact this stiff: raise its {key}"
    if scene.axle is not None and longest_step(scene) < wave_step(scene):
        return (
            f"the body's mass of {scene.axle.mass:.3g} kg is too small for contact this stiff: raise scene.load or "
            "lower scene.gravity"
        )
    soil, usual, speed = scene.material, Material(), top_body_speed(scene)
    if speed > soil.wave_speed:
        return (
            f"the body moves at up to {speed:.3g} m/s: make its path or scene.speed, scene.rim_speed slower"
        )
    more = {  # key → by what it multiplies the number of steps
        "raise scene.bed.spacing": Bed.spacing / scene.bed.spacing,
        "raise scene.courant": Scene.courant / scene.courant,
        "raise scene.frame_rate": Scene.frame_rate / scene.frame_rate,
        "lower material.youngs_modulus": math.sqrt(soil.youngs_modulus / usual.youngs_modulus),
        "lower material.poissons_ratio": Material(poissons_ratio=soil.poissons_ratio).wave_speed
        / usual.wave_speed,
        "raise material.grain_density": math.sqrt(usual.grain_density / soil.grain_density),
        "raise material.packing": math.sqrt(usual.packing / soil.packing),
    }
    return max(more, key=lambda key: more[key])


def damped_share(scene: Scene) -> float:
    """Longest stable step of a damped oscillator over that of a free one [-]."""
    return math.sqrt(1.0 + scene.elastic_damping**2) - scene.elastic_damping


def top_body_speed(scene: Scene, step: float | None = None) -> float:
    """Fastest motion of any point of a body between frames and, with `step` [s], along its path within such a time
    [m/s]; a free height moves on top of it."""
    every = [max(_top_speed(one, step), one.top_free_speed) for one in scene.companions]
    return max(_top_speed(scene, step), *every, 0.0)


def _top_speed(scene: Scene, step: float | None) -> float:
    """Of the scene's own body."""
    if scene.body is None:
        return 0.0
    times = scene.times()
    top = float(np.max(scene.largest_displacement(times), initial=0.0) * scene.frame_rate)
    corners = scene.path_times()
    if step is None or not len(corners):
        return top
    # Where a path is fastest, such a time begins or ends at one of its rows.
    begin = np.clip(np.concatenate([corners, corners - step]), 0.0, times[-1])
    every = np.unique(np.concatenate([[0.0], begin, begin + step]))
    travelled = np.concatenate([[0.0], np.cumsum(scene.largest_displacement(every))])
    way = np.interp(begin + step, every, travelled) - np.interp(begin, every, travelled)
    return max(top, float(way.max()) / step)


def steps_to_remap(scene: Scene, time_step: float, speed: float) -> int:
    """Number of steps of `time_step` [s] until momentum is carried to a fresh grid: 2^n or 3 2^n.

    Soil of at most `speed` [m/s] must not travel far from the place that its weights belong to: at most
    `scene.remap_distance` grid spacings, free fall included, and never longer than `scene.remap_limit`.
    """
    room, limit = scene.remap_distance * scene.bed.spacing, scene.remap_limit
    if speed * limit + scene.gravity * limit**2 > room:
        limit = 2.0 * room / (speed + math.sqrt(speed**2 + 4.0 * scene.gravity * room))
    most = max(1, int(limit / time_step * (1.0 + 1e-9)))
    # Few different numbers, because on a GPU each is recorded once.
    power = 1 << (most.bit_length() - 1)
    return power + power // 2 if most >= power + power // 2 else power


# --- How much a scene is, before anything of it is there ------------------------------------------------

# Numbers in a solver's precision: positions, velocities, strains, stress and contact of a particle and what is kept of
# them from the frame before; four fields on the grid and 1 / mass; poses and speeds of the body in a substep.
_REALS_PER_PARTICLE, _REALS_PER_NODE, _REALS_PER_SUBSTEP = 75, 17, 13
# Double precision besides, while these are made, and one frame.
_BYTES_PER_PARTICLE, _BYTES_PER_SUBSTEP = 220, 400


@dataclass(frozen=True)
class SceneSize:
    """What a solver of a scene holds and does."""

    particles: int
    """About: random points and round beds are counted by their volume."""
    nodes: int
    """Of the grid."""
    substeps: int
    """Between two frames."""
    steps: int
    """Substeps of the whole run."""
    memory: int
    """About [bytes]; half of it where mirror symmetry is made use of."""


def scene_size(scene: Scene, precision: str = "float32") -> SceneSize:
    """The size of a scene in `precision`; takes no memory itself.

    Raises:
        SceneError: it is beyond limits.py; beds and numbers of frames beyond it are refused when they are made.
    """
    real = 8 if precision == "float64" else 4
    particles = round(scene.soil_volume / scene.bed.particle_volume)
    nodes, substeps = math.prod(scene.bed.node_counts), substeps_per_frame(scene)
    memory = particles * (_REALS_PER_PARTICLE * real + _BYTES_PER_PARTICLE) + nodes * _REALS_PER_NODE * real
    if scene.body is not None:
        memory += substeps * (_REALS_PER_SUBSTEP * real + _BYTES_PER_SUBSTEP)
    memory += len(scene.others) * (
        3 * particles * real + substeps * (_REALS_PER_SUBSTEP * real + _BYTES_PER_SUBSTEP)
    )
    return SceneSize(particles, nodes, substeps, substeps * (scene.frame_count - 1), memory)


def require_memory(scene: Scene, precision: str, device: str, symmetry: bool) -> None:
    """Refuse a scene that the device has no memory for; with `symmetry` only half of it is computed.

    Raises:
        SceneError: the scene is too large, or there is no such device.
    """
    size, there = scene_size(scene, precision), _memory(find_device(device))
    needed = size.memory * (0.5 if symmetry else 1.0)
    if needed > there:
        raise SceneError(
            f"the scene needs about {needed / 1e9:.3g} GB of memory and {device} has {there / 1e9:.3g} GB: "
            f"{size.particles:.3g} particles, {size.nodes:.3g} grid nodes, {size.substeps:.3g} substeps in a frame; "
            "use a larger bed.spacing, fewer bed.particles_per_cell or a lower bed.headroom"
        )


def _memory(device: wp.Device) -> float:
    """Of a device [bytes]; infinite where the system does not say."""
    return device.total_memory if device.is_cuda else usable_memory()


# --- Where a solver has to stop: values that are not finite, or that soil cannot have -------------------

LARGEST_STRAIN = 1.0
"""Of the elastic log strain: soil at 37 % of its volume. The elastic law means nothing there."""
STABLE_COURANT = 0.84
"""Longest step that was found stable, over what theory gives for waves along one axis [-]; `MOST_COURANT` of scene.py
leaves soil room to become stiffer."""


class PhysicalLimits:
    """What soil of a scene cannot do, computed in steps of `time_step` [s], and what is to blame when it does."""

    def __init__(self, scene: Scene, time_step: float) -> None:
        self._time_step = time_step
        # Compressed soil is stiffer: its waves are faster by sqrt(1 - ln J).
        stable = damped_share(scene) * scene.bed.spacing / scene.material.wave_speed
        self._most_compression = min(LARGEST_STRAIN, (STABLE_COURANT * stable / time_step) ** 2 - 1.0)
        bed = scene.bed
        start = float(np.linalg.norm(scene.initial_velocities(), axis=1).max(initial=0.0))
        height = bed.size[2] + bed.headroom + abs(math.sin(math.radians(scene.tilt))) * bed.size[0]
        fall = math.sqrt(2.0 * scene.gravity * height)
        if bed.walls.conditions[0] == "periodic" and scene.tilt:
            fall = max(fall, scene.gravity * scene.duration)
        cause = start + top_body_speed(scene, time_step) + fall
        self.top_speed = 4.0 * cause + 0.5 * scene.material.wave_speed
        """[m/s]. Four times the sum of what soil has at the start, of the fastest point of the body and of a fall
        through the whole grid (or, down an endless slope, of a fall for as long as the scene lasts), and half the
        speed of waves for what elastic strain can give back."""

    def too_fast(self, speed: float) -> str:
        """The cause for soil of this speed [m/s], above the top one."""
        return (
            f"it moves at {speed:.3g} m/s, which nothing here can cause ({self.top_speed:.3g} m/s at most): lower "
            "scene.courant"
        )

    def strayed(self, near: bool) -> str:
        """The cause for a particle that the kernels left where it was; `near` its place at the last remap or not."""
        if near:
            return "it left the grid: soil was thrown or pushed beyond it, raise scene.bed.headroom"
        return (
            "its speed is not finite or carried it further than a cell between two remaps: lower scene.courant or the "
            "body's speed"
        )

    def too_strained(self, ln_j: np.ndarray, strain: np.ndarray) -> tuple[int, str] | None:
        """The first particle whose elastic strain cannot be, and why; None if there is none. `ln_j` (n,) is the log of
        the volume, `strain` (n, 6) the deviatoric part."""
        lowest, largest = ln_j.min(), max(strain.max(), -strain.min())  # a NaN makes both comparisons false
        if lowest > -self._most_compression and largest < LARGEST_STRAIN:
            return None
        sheared = np.abs(strain).max(axis=1)
        particle = int(np.argmax(~((ln_j > -self._most_compression) & (sheared < LARGEST_STRAIN))))
        volume, shear = ln_j[particle], sheared[particle]
        if not np.isfinite(volume + shear):
            return particle, "its strain is not finite: lower scene.courant"
        left = f"{100.0 * math.exp(volume):.3g} % of its volume"
        if volume > -LARGEST_STRAIN and shear < LARGEST_STRAIN:
            return particle, (
                f"it is compressed to {left}, where waves are too fast for steps of {self._time_step:.3g} s: lower "
                "scene.courant or raise material.youngs_modulus"
            )
        return particle, (
            f"it is strained to {left} and by {shear:.2g} in shear, more than elastic soil can be: raise "
            "material.youngs_modulus or lower the body's speed"
        )

    def lost_fluidity(self, excess: np.ndarray) -> tuple[int, str] | None:
        """The first particle to which cooperative flow gave an `excess` (n,) that is no number, and why; None if there
        is none. Its stress does not show it: without a fluidity soil is elastic."""
        lost = ~np.isfinite(excess)
        if not lost.any():
            return None
        cause = "its fluidity is not finite: lower scene.courant or set effects.nonlocality=false"
        return int(np.argmax(lost)), cause


# --- The machine: cores and memory that this process may use, within a container, too -------------------


ROOT = Path("/")
"""Of the file system."""


def usable_cores() -> int:
    """Cores that this process may use at once: those it is bound to, and at most its container's quota, rounded up."""
    bound = getattr(os, "sched_getaffinity", None)  # not on macOS and Windows
    cores = (os.cpu_count() or 1) if bound is None else len(bound(0))
    for group in _control_groups("cpu"):
        quota = _numbers(group / "cpu.max")
        quota = quota or [*_numbers(group / "cpu.cfs_quota_us"), *_numbers(group / "cpu.cfs_period_us")]
        if len(quota) == 2 and 0.0 < quota[0] < math.inf and quota[1] > 0.0:
            cores = min(cores, math.ceil(quota[0] / quota[1]))
    return cores


def usable_memory() -> float:
    """Memory of the machine, and at most the limit of its container [bytes]; infinite where the system does not say."""
    try:
        memory = float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, ValueError, OSError):
        memory = math.inf
    for group in _control_groups("memory"):
        for name in ("memory.max", "memory.limit_in_bytes"):
            memory = min([memory, *_numbers(group / name)])
    return memory


def _control_groups(controller: str) -> Iterator[Path]:
    """Folders of Linux's control groups that this process is in, and of those above them; some may not be there, since
    a container sees the top of its own only. Of version 2, and of a controller's own tree of version 1."""
    try:
        lines = (ROOT / "proc/self/cgroup").read_text().splitlines()
    except (OSError, ValueError):
        return
    top = ROOT / "sys/fs/cgroup"
    for line in lines:
        number, controllers, path = line.split(":", 2)
        if number != "0" and controller not in controllers.split(","):
            continue
        tree = top if number == "0" else top / controller
        own = tree / path.lstrip("/")
        yield from (group for group in (own, *own.parents) if group.is_relative_to(tree))


def _numbers(file: Path) -> list[float]:
    """Of the first line of a control group's file; empty if there is none."""
    try:
        return [math.inf if word == "max" else float(word) for word in file.read_text().split()]
    except (OSError, ValueError):
        return []

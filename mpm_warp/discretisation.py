"""The scene on the grid: nodes and walls, mirror symmetry, the stress at the start."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from .bed import PADDING
from .bodies import MeshBody
from .kernels.grid import grid_struct, mirror_layers, periodic_layers
from .kernels.signed_distance import mesh_asymmetry
from .scene import Scene
from .state import SceneError

# --- Where the grid lies: its nodes, walls and ghost layers for a scene ---------------------------------


def lay_grid(
    scene: Scene, real: type, time_step: float, particle_volume: float, symmetric: bool
) -> tuple[Any, dict[int, np.ndarray]]:
    """The grid's struct, and for each axis that has ghost layers these and their images (kernels/ghost_nodes.py).

    Walls fall on nodes where the bin is a whole number of cells; otherwise the grid is centred in x and y, which
    keeps the scene's mirror symmetry, and the nodes just outside the bin are the walls. With `symmetric` the grid
    ends two layers beyond the plane y = Ly / 2.
    """
    bed, vec3 = scene.bed, wp.types.vector(3, real)
    h = bed.spacing
    cells = [math.ceil(s / h - 1e-6) for s in bed.size[:2]]
    origin = [0.5 * (s - c * h) - PADDING * h for s, c in zip(bed.size[:2], cells, strict=True)]
    origin.append(-bed.size[2] - PADDING * h)
    count = list(bed.node_counts)
    low = [PADDING, PADDING, PADDING]
    high = [PADDING + cells[0], PADDING + cells[1], 2**30]
    ghosts = {}
    for axis in (0, 1):
        if bed.walls.conditions[axis] == "periodic":
            ghosts[axis] = periodic_layers(PADDING, cells[axis])
            low[axis], high[axis] = -1, 2**30  # no walls
    if symmetric:
        ghosts[1] = mirror_layers(2 * PADDING + cells[1])
        left_out = ghosts[1].min()
        ghosts[1] -= left_out
        origin[1] += left_out * h
        count[1] -= left_out
        low[1], high[1] = -1, high[1] - left_out

    grid = grid_struct(real)()
    grid.origin = vec3(*origin)
    grid.spacing, grid.inverse_spacing = h, 1.0 / h
    grid.nx, grid.ny, grid.nz = (int(c) for c in count)
    grid.dt, grid.gravity = time_step, vec3(*scene.gravity_vector)
    grid.volume_averaging = scene.volume_averaging
    grid.forgetting = min(1.0, time_step * scene.material.wave_speed / h)
    grid.damping = scene.elastic_damping * h / scene.material.wave_speed / time_step
    grid.low, grid.high = wp.vec3i(*low), wp.vec3i(*(int(i) for i in high))
    grid.wall_friction = vec3(*bed.walls.friction)
    grid.particle_volume = particle_volume
    grid.particle_mass = particle_volume * scene.material.bulk_density
    grid.density_per_mass = 1.0 / (scene.material.bulk_density * h**3 * bed.filling)
    behind = [round(0.5 * (c - s / h), 6) for s, c in zip(bed.size[:2], cells, strict=True)]
    grid.beyond_walls = vec3(*(1.0 / _part_in_bin(distance) for distance in (*behind, 0.0)))
    grid.speed_limit = h / time_step
    return grid, ghosts


def _part_in_bin(distance: float) -> float:
    """How much of a node's spline lies in the bin, for a node 0 to 0.5 cells outside of it [-]."""
    return 0.5 - 0.75 * distance + distance**3 / 3.0


# --- Mirror symmetry about the vertical plane at mid-width, y = Ly / 2 ----------------------------------
# Where a scene has it, the half with y >= Ly / 2 is computed and the whole is put together from it. Ghost nodes
# across the plane are images of nodes on this side, so half and whole agree to round-off. Particles on the
# plane are their own images: they come first and count half.

_SAME = 1e-6  # positions closer than this are the same [grid spacings]
_ALIKE = 0.01  # sides of a mesh that differ by less feel the same forces [grid spacings]


@dataclass(frozen=True)
class Half:
    """The particles that are computed, and how the whole bed follows from them."""

    kept: np.ndarray
    """Indices into the whole bed of the particles that are computed, those on the plane first; shape (m,)."""
    on_plane: int
    """How many of them lie on the plane."""
    source: np.ndarray
    """Index into `kept` of each particle of the whole bed, shape (n,)."""
    mirrored: np.ndarray
    """Whether a particle of the whole bed is the image of its source, shape (n,), bool."""
    plane: float
    """y of the plane [m]."""

    @property
    def images(self) -> np.ndarray:
        """As `State.whole`."""
        return np.where(self.mirrored, -1 - self.source, self.source).astype(np.int32)

    def whole(self, position: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions and velocities (n, 3) of the whole bed from those of the particles computed (m, 3)."""
        position, velocity = position[self.source], velocity[self.source]
        position[self.mirrored, 1] = 2.0 * self.plane - position[self.mirrored, 1]
        velocity[self.mirrored, 1] *= -1.0
        return position, velocity


def asymmetry(scene: Scene) -> str | None:
    """Why a scene is not mirror symmetric about y = Ly / 2; None if it is."""
    if scene.bed.walls.y == "periodic":
        return "the bed is periodic in y (bed.walls.y)"
    for one in scene.companions:
        if one.free:
            return f"{one.place} is free to leave the plane"
        if reason := _body_asymmetry(one):
            return reason.replace("the body", one.place).replace("the tool", one.place)
    if reason := _body_asymmetry(scene):
        return reason
    if scene.soil is not None and scene.soil.state.whole is None:
        return "the soil to start from was not computed as one half and its mirror image"
    if half(scene) is None:
        return (
            "the particles are not mirror images of each other (bed.arrangement); use bed.arrangement=lattice or "
            "bed.mirrored=true"
        )
    return None


def _body_asymmetry(scene: Scene) -> str | None:
    """Why a scene's own body or its motion is not symmetric."""
    if scene.body is None:
        return None
    # A path may turn off the plane between two frames.
    times = np.concatenate([scene.times(), scene.path_times()])
    poses = scene.poses_at(times)
    off = np.abs(poses[:, 1] - 0.5 * scene.bed.size[1]) > _SAME * scene.bed.spacing
    if off.any():
        i = int(np.argmax(off))
        return f"the body is at y = {poses[i, 1]:.4f} m at {times[i]:.3f} s, not at mid-width"
    turned = np.abs(poses[:, [3, 5]]).max(axis=1) > 1e-9
    if turned.any():
        return f"at {times[int(np.argmax(turned))]:.3f} s the body is turned about another axis than y"
    if (
        isinstance(scene.body, MeshBody)
        and (off_by := mesh_asymmetry(scene.body)) > _ALIKE * scene.bed.spacing
    ):
        return f"the tool's two sides differ by {1e3 * off_by:.3g} mm"
    return None


def require_symmetry(scene: Scene) -> None:
    """Refuse a scene that is not mirror symmetric about y = Ly / 2.

    Raises:
        SceneError: with what is not symmetric.
    """
    if reason := asymmetry(scene):
        raise SceneError(
            f"effects.symmetry needs a scene that is mirror symmetric about mid-width: {reason}; or set "
            "effects.symmetry=false"
        )


def half(scene: Scene) -> Half | None:
    """The half of a scene's particles with y >= Ly / 2; None if the particles are not mirror symmetric."""
    positions = scene.initial_positions()
    plane = 0.5 * scene.bed.size[1]
    same = _SAME * scene.bed.spacing
    x, off, z = positions[:, 0], positions[:, 1] - plane, positions[:, 2]
    on = np.flatnonzero(np.abs(off) <= same)
    right, left = np.flatnonzero(off > same), np.flatnonzero(off < -same)
    if len(left) != len(right):
        return None
    # Both sides in the same order: partners agree in x and z to the bit, and differ in distance by round-off.
    by_place = [side[np.lexsort((np.abs(off[side]), z[side], x[side]))] for side in (right, left)]
    one, other = (np.stack([x[side], np.abs(off[side]), z[side]]) for side in by_place)
    if np.abs(one - other).max(initial=0.0) > same:
        return None
    kept = np.concatenate([on, right])
    source = np.empty(len(positions), dtype=np.int64)
    source[kept] = np.arange(len(kept))
    source[by_place[1]] = source[by_place[0]]
    return Half(kept, len(on), source, off < -same, plane)


# --- What soil starts with ------------------------------------------------------------------------------


def initial_particles(scene: Scene) -> dict[str, np.ndarray]:
    """The arrays of the particles at time 0 that are not zero, by the names that they have in kernels/grid.py, for the
    whole bed: shape (n, ...)."""
    if scene.soil is not None:
        every = scene.soil.particles.items()
        return {name: np.delete(values, scene.displaced, axis=0) for name, values in every}
    velocities, (ln_j, strain) = scene.initial_velocities(), initial_stress(scene)
    shear, bulk = 2.0 * scene.material.shear_modulus, scene.material.bulk_modulus
    return {
        "position": scene.initial_positions(),
        "velocity": velocities,
        "felt_velocity": np.pad(velocities, ((0, 0), (0, 1))),
        "elastic_strain": strain,
        "log_volume": ln_j,
        "stress": shear * strain + bulk * ln_j[:, None] * np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0]),
    }


def initial_stress(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """ln J, shape (n,), and the deviatoric elastic strain xx, yy, zz, xy, xz, yz, shape (n, 6), at time 0.

    Both `geostatic` and `k0` hold the vertical stress of rest at once, so nothing settles. `geostatic` is isotropic;
    `k0` has the horizontal stress nu / (1 - nu) times the vertical one, as an elastic bed filled from above has.
    In a tilted bin they hold the shear stress rho g_x d at depth d, too, that carries an endless slope. Under a surface
    that is not flat d is the depth below it, and the shear stress that carries its slope comes on top, as much of it as
    friction holds.
    """
    positions, volume = scene.filled
    material, (pull, _, fall) = scene.material, scene.gravity_vector
    ln_j, strain = np.zeros(len(positions)), np.zeros((len(positions), 6))
    if scene.bed.initial_stress != "none":
        density = material.bulk_density * len(positions) * volume / scene.soil_volume
        surface = 0.0 if scene.bed.surface is None else scene.bed.surface_at(*positions[:, :2].T)
        depth = np.maximum(surface - positions[:, 2], 0.0)
        ratio = material.lateral_stress_ratio if scene.bed.initial_stress == "k0" else 1.0
        vertical = density * fall * depth  # tension is positive
        ln_j = vertical * (1.0 + 2.0 * ratio) / 3.0 / material.bulk_modulus
        share = vertical * (1.0 - ratio) / (6.0 * material.shear_modulus)
        strain[:, :3] = share[:, None] * np.array([-1.0, -1.0, 2.0])
        strain[:, 4] = density * pull * depth / (2.0 * material.shear_modulus)
        if scene.bed.surface is not None:
            # Equilibrium of an endless slope s: sigma_xx = K v, sigma_xz = K v s_x, sigma_zz = v (1 + K |s|^2).
            slope = scene.bed.slope_at(*positions[:, :2].T)
            steep = np.linalg.norm(slope, axis=0)
            slope *= np.minimum(1.0, material.static_friction / np.maximum(steep, 1e-9))
            side = ratio * vertical
            strain[:, 4:] += (side * slope).T / (2.0 * material.shear_modulus)
            more = side * (slope**2).sum(axis=0)
            ln_j += more / 3.0 / material.bulk_modulus
            strain[:, :3] += (more / (6.0 * material.shear_modulus))[:, None] * np.array([-1.0, -1.0, 2.0])
    return np.delete(ln_j, scene.displaced), np.delete(strain, scene.displaced, axis=0)

"""How much a scene is, before anything of it is there."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass

import warp as wp

from .errors import SceneError
from .scene import Scene
from .start import find_device
from .time_step import substeps_per_frame

__all__ = ["SceneSize", "require_memory", "scene_size"]

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
    return SceneSize(particles, nodes, substeps, substeps * (scene.frame_count - 1), memory)


def require_memory(scene: Scene, precision: str, device: str, symmetry: bool) -> None:
    """Refuse a scene that the device has no memory for.

    Args:
        scene: what will be computed.
        precision: float32 or float64.
        device: cpu, cuda, cuda:0, ...
        symmetry: whether only half of it is computed.

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
    if device.is_cuda:
        return device.total_memory
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return math.inf

"""The explicit material point method, frame by frame."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from .constitutive import soil_struct
from .contact import body_struct
from .effects import Effects
from .errors import SceneError, SolverStopped
from .grid import grid_step, grid_struct
from .rotation import angular_velocity, rotate
from .scene import Scene
from .start import start_warp
from .time_step import steps_to_remap, substeps_per_frame, top_body_speed
from .transfer import transfer

__all__ = ["PRECISIONS", "Frame", "Solver"]

PRECISIONS = {"float32": wp.float32, "float64": wp.float64}
_PADDING = 3  # cells outside the bin, so that the nodes around a particle at a wall exist


@dataclass(frozen=True)
class Frame:
    """The state at one recorded time. Arrays are copies and stay valid."""

    index: int
    time: float
    """[s]"""
    position: np.ndarray
    """Soil [m], shape (n, 3), float32."""
    velocity: np.ndarray
    """Soil [m/s], shape (n, 3), float32."""
    body_pose: np.ndarray
    """Centre of mass [m] and quaternion x, y, z, w, shape (7,)."""
    body_points: np.ndarray
    """Body nodes in the world [m], shape (M, 3)."""
    force: np.ndarray
    """By the soil on the body, world frame, mean since the previous frame [N], shape (3,); frame 0: zeros."""
    torque: np.ndarray
    """About the body's centre of mass, likewise [N m], shape (3,)."""


class Solver:
    """Computes a scene.

        for frame in Solver(scene).frames():
            print(frame.time, frame.force)

    Args:
        scene: what to compute.
        effects: which physics; kernels are compiled without what is off.
        device: `cpu` (one core) or `cuda`, `cuda:0`, ...
        precision: `float32` or `float64`.
    """

    def __init__(
        self,
        scene: Scene,
        effects: Effects | None = None,
        device: str = "cpu",
        precision: str = "float32",
    ) -> None:
        if precision not in PRECISIONS:
            raise SceneError(f"precision is {precision!r}; allowed: {', '.join(PRECISIONS)}")
        start_warp()
        if device not in {str(d) for d in wp.get_devices()} | {"cuda"} or (
            device == "cuda" and not wp.is_cuda_available()
        ):
            raise SceneError(
                f"device is {device!r}; allowed here: {', '.join(str(d) for d in wp.get_devices())}"
            )
        self.scene = scene
        self.effects = effects or Effects()
        self.device = wp.get_device(device)
        self.precision = precision
        self._real = PRECISIONS[precision]

        self._top_body = top_body_speed(scene)
        self.substeps_per_frame = substeps_per_frame(scene)
        self.time_step = 1.0 / scene.frame_rate / self.substeps_per_frame
        """Substep [s]."""
        self._allocate()

    @property
    def particle_count(self) -> int:
        """n."""
        return len(self._x)

    def frames(self) -> Iterator[Frame]:
        """All frames in order, the initial state first.

        Raises:
            SolverStopped: at the end of the first frame in which a particle went wrong.
        """
        for index in range(self.scene.frame_count):
            if index > 0:
                self._load_motion(index - 1)
                self._advance(index)
            yield self._frame(index)

    # --- set-up -------------------------------------------------------------------------------------------

    def _allocate(self) -> None:
        scene, bed, material, real = self.scene, self.scene.bed, self.scene.material, self._real
        vec3, vec4 = wp.types.vector(3, real), wp.types.vector(4, real)
        positions, volume = bed.filled
        n = len(positions)

        grid = grid_struct(real)()
        h = bed.spacing
        # Walls fall on nodes where the bin is a whole number of cells; otherwise the grid is centred in x and y,
        # which keeps the scene's mirror symmetry, and the nodes just outside the bin are the walls.
        cells = [math.ceil(s / h - 1e-6) for s in bed.size[:2]]
        origin = [0.5 * (s - c * h) - _PADDING * h for s, c in zip(bed.size[:2], cells, strict=True)]
        origin.append(-bed.size[2] - _PADDING * h)
        top = math.ceil((bed.size[2] + bed.headroom) / h) + _PADDING
        grid.origin = vec3(*origin)
        grid.spacing, grid.inverse_spacing = h, 1.0 / h
        grid.nx, grid.ny, grid.nz = (
            cells[0] + 2 * _PADDING + 1,
            cells[1] + 2 * _PADDING + 1,
            top + _PADDING + 1,
        )
        grid.dt, grid.gravity = self.time_step, scene.gravity
        grid.low = wp.vec3i(_PADDING, _PADDING, _PADDING)
        grid.high = wp.vec3i(_PADDING + cells[0], _PADDING + cells[1], 2**30)
        grid.speed_limit = h / self.time_step
        grid.particle_volume, grid.particle_mass = volume, volume * material.bulk_density
        self._grid = grid

        soil = soil_struct(real)()
        soil.shear_modulus, soil.bulk_modulus = material.shear_modulus, material.bulk_modulus
        soil.static_friction, soil.limit_friction = material.static_friction, material.limit_friction
        soil.reference_rate = material.reference_inertial_number / (
            material.grain_diameter * math.sqrt(material.grain_density)
        )
        self._soil = soil

        ln_j = np.zeros(n)
        if bed.initial_stress == "geostatic":
            # Isotropic: the vertical stress of rest at once, so nothing settles.
            density = material.bulk_density * n * volume / np.prod(bed.size)
            ln_j = -density * scene.gravity * np.maximum(-positions[:, 2], 0.0) / material.bulk_modulus

        new = {"device": self.device}
        self._x = wp.array(positions, dtype=vec3, **new)
        self._v = wp.zeros(n, dtype=vec3, **new)
        self._c = wp.zeros(n, dtype=wp.types.matrix((3, 3), real), **new)
        self._e = wp.zeros(n, dtype=wp.types.vector(6, real), **new)
        self._ln_j = wp.array(ln_j, dtype=real, **new)
        self._u = wp.zeros(n, dtype=vec3, **new)  # velocity of the grid where the particle is
        self._home = wp.zeros(n, dtype=vec3, **new)
        node_count = grid.nx * grid.ny * grid.nz
        self._momentum, self._velocity, self._before, self._impulse = (
            wp.zeros(node_count + 1, dtype=vec4, **new) for _ in range(4)  # + 1: see rows.py
        )
        self._substep = wp.zeros(1, dtype=int, **new)
        self._top_speed = wp.zeros(1, dtype=real, **new)
        self._stray = wp.zeros(4, dtype=int, **new)

        body, plate, m = body_struct(real)(), scene.plate, self.substeps_per_frame
        if plate is not None:
            body.half_size, body.friction = vec3(*plate.half_size), plate.friction
            body.margin = scene.contact_margin * h
            body.reach = float(np.linalg.norm(plate.half_size + max(0.0, body.margin)))
            # The spring is as stiff as a layer of soil one particle thick; damping is critical.
            stiffness = material.wave_speed**2 * material.bulk_density * volume ** (1.0 / 3.0)
            body.stiffness, body.damping = stiffness, 2.0 * math.sqrt(stiffness * grid.particle_mass)
            body.separation_speed = 0.01 * material.wave_speed
        body.position = wp.zeros(m, dtype=vec3, **new)
        body.rotation = wp.zeros(m, dtype=wp.types.quaternion(real), **new)
        body.velocity = wp.zeros(m, dtype=vec3, **new)
        body.spin = wp.zeros(m, dtype=vec3, **new)
        body.impulse = wp.zeros(2, dtype=vec3, **new)
        self._body = body

        kernels = transfer(real, self.effects, with_body=plate is not None, atomic=self.device.is_cuda)
        nodes = grid_step(real)

        def record(kernel: wp.Kernel, count: int, *arguments: Any) -> wp.Launch:
            return wp.launch(kernel, count, arguments, device=self.device, record_cmd=True)

        x, u, v, c, home, e, ln_j = self._x, self._u, self._v, self._c, self._home, self._e, self._ln_j
        watch = (self._substep, self._stray)
        self._to_grid = record(
            kernels.to_grid, n, x, v, c, home, grid, self._momentum, self._top_speed, *watch
        )
        self._begin = record(
            nodes.begin, node_count, grid, self._momentum, self._velocity, self._before, self._impulse
        )
        self._step = [
            record(kernels.scatter, n, x, home, u, e, ln_j, grid, soil, body, self._impulse, self._substep),
            record(nodes.step, node_count, grid, self._velocity, self._impulse, self._substep),
            record(kernels.gather, n, x, home, u, c, grid, self._velocity, *watch),
            record(kernels.material, n, c, e, ln_j, grid, soil),
        ]
        self._from_grid = record(kernels.from_grid, n, home, u, v, grid, self._before, 0.0)
        self._graphs: dict[int, wp.Graph] = {}

    # --- stepping -----------------------------------------------------------------------------------------

    def _load_motion(self, frame: int) -> None:
        """The body's pose and velocity in every substep of the frame that begins at `frame`."""
        self._substep.zero_()
        self._body.impulse.zero_()
        if self.scene.plate is None:
            return
        m, dt = self.substeps_per_frame, self.time_step
        poses = self.scene.poses_at((frame * m + np.arange(m + 1)) * dt)
        velocity = np.diff(poses[:, :3], axis=0) / dt
        spin = angular_velocity(poses[:-1, 3:], poses[1:, 3:], dt)
        for array, values in (
            (self._body.position, poses[:-1, :3]),
            (self._body.rotation, poses[:-1, 3:]),
            (self._body.velocity, velocity),
            (self._body.spin, spin),
        ):
            array.assign(values)

    def _interval(self, steps: int) -> None:
        """The substeps from one remap to the next."""
        self._begin.launch()
        for _ in range(steps):
            for launch in self._step:
                launch.launch()
        keep = math.exp(-steps * self.time_step / self.scene.velocity_memory)
        self._from_grid.set_param_by_name("keep", keep)
        self._from_grid.launch()

    def _advance(self, index: int) -> None:
        left = self.substeps_per_frame
        while left:
            self._top_speed.zero_()
            self._to_grid.launch()
            speed = max(self._top_body, float(self._top_speed.numpy()[0]))
            steps = min(left, steps_to_remap(self.scene, self.time_step, speed))
            left -= steps
            if not self.device.is_cuda:
                self._interval(steps)
                continue
            if steps not in self._graphs:
                for launch in (self._begin, *self._step, self._from_grid):
                    wp.load_module(launch.kernel.module, device=self.device)
                with wp.ScopedCapture(device=self.device) as capture:
                    self._interval(steps)
                self._graphs[steps] = capture.graph
            wp.capture_launch(self._graphs[steps])
        count, particle, substep, slow = (int(i) for i in self._stray.numpy())
        if count:
            time = (index - 1) / self.scene.frame_rate + substep * self.time_step
            at = ", ".join(f"{c:.4f}" for c in self._x.numpy()[particle])
            cause = (
                "it left the grid: soil was thrown or pushed beyond it, raise scene.bed.headroom"
                if slow
                else "its speed is not finite or carried it further than a cell between two remaps: "
                "lower scene.courant or the body's speed"
            )
            raise SolverStopped(
                f"particle {particle} at ({at}) m went wrong at {time:.5f} s, substep {substep} of frame {index}: "
                f"{cause} ({count} faults in this frame; the frames before it are good)"
            )

    def _frame(self, index: int) -> Frame:
        scene = self.scene
        pose = scene.poses_at(np.array([index / scene.frame_rate]))[0]
        impulse = self._body.impulse.numpy().astype(float) * (scene.frame_rate if index else 0.0)
        return Frame(
            index=index,
            time=index / scene.frame_rate,
            position=self._x.numpy().astype(np.float32),
            velocity=self._u.numpy().astype(np.float32),
            body_pose=pose,
            body_points=rotate(pose[3:], scene.body_points()) + pose[:3],
            force=impulse[0],
            torque=impulse[1],
        )

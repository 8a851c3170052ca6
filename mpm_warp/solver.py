"""The explicit material point method, frame by frame."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import warp as wp

from .contact import body_struct
from .effects import Effects
from .errors import SceneError, SolverStopped
from .grid import grid_step, grid_struct
from .nonlocal_fluidity import NonlocalFluidity, wall_sink
from .rotation import angular_velocity, rotate
from .scene import Scene
from .soil import soil_parameters
from .start import start_warp
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

        frame_time = 1.0 / scene.frame_rate
        limit = scene.courant * scene.bed.spacing / (scene.material.wave_speed + self._top_body_speed())
        self.substeps_per_frame = max(1, math.ceil(frame_time / limit - 1e-9))
        self.time_step = frame_time / self.substeps_per_frame
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

    def _top_body_speed(self) -> float:
        """Fastest motion of the body between frames [m/s]."""
        if self.scene.plate is None:
            return 0.0
        step = np.diff(self.scene.body_poses()[:, :3], axis=0)
        return float(np.max(np.linalg.norm(step, axis=1), initial=0.0) * self.scene.frame_rate)

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
        grid.particle_volume, grid.particle_mass = volume, volume * material.bulk_density
        grid.speed_limit = h / self.time_step
        self._grid = grid

        soil = soil_parameters(real, material, max(bed.size), self.effects.fluidity)
        if self.effects.fluidity:
            soil.g = wp.zeros(n, dtype=real, device=self.device)
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
        node_count = grid.nx * grid.ny * grid.nz
        self._nodes = wp.zeros(node_count, dtype=vec4, **new)
        self._velocity = wp.zeros(node_count, dtype=vec4, **new)
        self._substep = wp.zeros(1, dtype=int, **new)
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
        particles = [self._x, self._v, self._c, self._e, self._ln_j, grid, soil]
        record = {"device": self.device, "record_cmd": True}
        self._launches = [
            wp.launch(kernels.to_grid, n, [*particles, body, self._nodes, self._substep], **record),
            wp.launch(
                grid_step(real), node_count, [grid, self._nodes, self._velocity, self._substep], **record
            ),
            wp.launch(
                kernels.to_particles, n, [*particles, self._velocity, self._substep, self._stray], **record
            ),
        ]
        if self.effects.nonlocality:
            sink = np.zeros(node_count)
            if material.fluidity_at_walls == "zero":
                sink = wall_sink((grid.nx, grid.ny, grid.nz), grid.low, grid.high)
            nonlocal_fluidity = NonlocalFluidity(
                real,
                self.effects,
                self.device,
                sink,
                [self._x, self._e, self._ln_j],
                grid,
                soil,
                self._velocity,
            )
            self._launches[2:2] = nonlocal_fluidity.launches
        self._graph: wp.Graph | None = None

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

    def _substeps(self) -> None:
        for _ in range(self.substeps_per_frame):
            for launch in self._launches:
                launch.launch()

    def _advance(self, index: int) -> None:
        if self.device.is_cuda:
            if self._graph is None:
                for launch in self._launches:
                    wp.load_module(launch.kernel.module, device=self.device)
                with wp.ScopedCapture(device=self.device) as capture:
                    self._substeps()
                self._graph = capture.graph
            wp.capture_launch(self._graph)
        else:
            self._substeps()
        count, particle, substep, slow = (int(i) for i in self._stray.numpy())
        if count:
            time = (index - 1) / self.scene.frame_rate + substep * self.time_step
            at = ", ".join(f"{c:.4f}" for c in self._x.numpy()[particle])
            cause = (
                "it left the grid: soil was thrown or pushed beyond it, raise scene.bed.headroom"
                if slow
                else "its speed is not finite or above one cell per step: lower scene.courant or the body's speed"
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
            velocity=self._v.numpy().astype(np.float32),
            body_pose=pose,
            body_points=rotate(pose[3:], scene.body_points()) + pose[:3],
            force=impulse[0],
            torque=impulse[1],
        )

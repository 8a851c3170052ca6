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
from .images import images, mirror_pairs, seam_pairs
from .initial_stress import initial_stress
from .rotation import angular_velocity, rotate
from .scene import Scene
from .start import start_warp
from .symmetry import asymmetry, half
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
    """Soil [m], shape (n, 3), float32; along a periodic axis it goes on counting beyond the bin."""
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
        if self.effects.symmetry and (reason := asymmetry(scene)):
            raise SceneError(
                f"effects.symmetry needs a scene that is mirror symmetric about mid-width: {reason}; or set "
                "effects.symmetry=false"
            )
        self._half = half(scene) if self.effects.symmetry else None

        frame_time = 1.0 / scene.frame_rate
        limit = scene.courant * scene.bed.spacing / (scene.material.wave_speed + self._top_body_speed())
        self.substeps_per_frame = max(1, math.ceil(frame_time / limit - 1e-9))
        self.time_step = frame_time / self.substeps_per_frame
        """Substep [s]."""
        self._allocate()

    @property
    def particle_count(self) -> int:
        """n, of the whole bed."""
        return len(self.scene.initial_positions())

    @property
    def computed_count(self) -> int:
        """Particles that are computed: about half of them with mirror symmetry."""
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
        scene, material, real = self.scene, self.scene.material, self._real
        vec3, vec4 = wp.types.vector(3, real), wp.types.vector(4, real)
        positions, volume = scene.filled
        velocities, (ln_j, strain) = scene.initial_velocities(), initial_stress(scene)
        if self._half is not None:
            kept = self._half.kept
            positions, velocities, ln_j, strain = positions[kept], velocities[kept], ln_j[kept], strain[kept]
        n = len(positions)
        grid, ghosts = self._lay_grid(volume)
        self._grid = grid

        soil = soil_struct(real)()
        soil.shear_modulus, soil.bulk_modulus = material.shear_modulus, material.bulk_modulus
        soil.static_friction, soil.limit_friction = material.static_friction, material.limit_friction
        soil.reference_rate = material.reference_inertial_number / (
            material.grain_diameter * math.sqrt(material.grain_density)
        )
        self._soil = soil

        new = {"device": self.device}
        self._x = wp.array(positions, dtype=vec3, **new)
        self._v = wp.array(velocities, dtype=vec3, **new)
        self._c = wp.zeros(n, dtype=wp.types.matrix((3, 3), real), **new)
        self._e = wp.array(strain, dtype=wp.types.vector(6, real), **new)
        self._ln_j = wp.array(ln_j, dtype=real, **new)
        node_count = grid.nx * grid.ny * grid.nz
        self._nodes = wp.zeros(node_count, dtype=vec4, **new)
        self._velocity = wp.zeros(node_count, dtype=vec4, **new)
        self._substep = wp.zeros(1, dtype=int, **new)
        self._stray = wp.zeros(4, dtype=int, **new)

        body, plate, m = body_struct(real)(), scene.plate, self.substeps_per_frame
        if plate is not None:
            body.half_size, body.friction = vec3(*plate.half_size), plate.friction
            body.margin = scene.contact_margin * scene.bed.spacing
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
        state = [self._x, self._v, self._c, self._e, self._ln_j]
        record = {"device": self.device, "record_cmd": True}
        on_plane = self._half.on_plane if self._half is not None else 0
        to_grid = [([a[on_plane:] for a in state], grid, body)]
        if on_plane:
            to_grid.append(([a[:on_plane] for a in state], *self._halved(grid, body)))
        before, after = self._image_launches(ghosts, record)
        self._launches = [
            *(
                wp.launch(
                    kernels.to_grid, len(part[0]), [*part, g, soil, b, self._nodes, self._substep], **record
                )
                for part, g, b in to_grid
            ),
            *before,
            wp.launch(
                grid_step(real, scene.bed.walls.kinds),
                node_count,
                [grid, self._nodes, self._velocity, self._substep],
                **record,
            ),
            *after,
            wp.launch(
                kernels.to_particles,
                n,
                [*state, grid, soil, self._velocity, self._substep, self._stray],
                **record,
            ),
            *self._wrap_launches(record),
        ]
        self._graph: wp.Graph | None = None

    def _lay_grid(self, volume: float) -> tuple[Any, dict[int, np.ndarray]]:
        """The grid, and its ghost layers with their images for each axis that has any (images.py)."""
        scene, bed, real = self.scene, self.scene.bed, self._real
        vec3, h = wp.types.vector(3, real), self.scene.bed.spacing
        # Walls fall on nodes where the bin is a whole number of cells; otherwise the grid is centred in x and y,
        # which keeps the scene's mirror symmetry, and the nodes just outside the bin are the walls.
        cells = [math.ceil(s / h - 1e-6) for s in bed.size[:2]]
        origin = [0.5 * (s - c * h) - _PADDING * h for s, c in zip(bed.size[:2], cells, strict=True)]
        origin.append(-bed.size[2] - _PADDING * h)
        count = [c + 2 * _PADDING + 1 for c in cells]
        count.append(math.ceil((bed.size[2] + bed.headroom) / h) + 2 * _PADDING + 1)
        low = [_PADDING, _PADDING, _PADDING]
        high = [_PADDING + cells[0], _PADDING + cells[1], 2**30]
        ghosts = {
            axis: seam_pairs(_PADDING, cells[axis]) for axis in (0, 1) if bed.walls.kinds[axis] == "periodic"
        }
        if self._half is not None:
            ghosts[1] = mirror_pairs(2 * _PADDING + cells[1])
            left_out = ghosts[1].min()
            ghosts[1] -= left_out
            origin[1] += left_out * h
            count[1] -= left_out
            low[1], high[1] = -1, high[1] - left_out

        grid = grid_struct(real)()
        grid.origin = vec3(*origin)
        grid.spacing, grid.inverse_spacing = h, 1.0 / h
        grid.nx, grid.ny, grid.nz = (int(c) for c in count)
        grid.dt, grid.gravity = self.time_step, vec3(*scene.gravity_vector)
        grid.low, grid.high = wp.vec3i(*low), wp.vec3i(*(int(i) for i in high))
        grid.wall_friction = vec3(*bed.walls.friction)
        grid.particle_volume = volume
        grid.particle_mass = volume * scene.material.bulk_density
        grid.speed_limit = h / self.time_step
        return grid, ghosts

    def _halved(self, grid: Any, body: Any) -> tuple[Any, Any]:
        """Grid and body for particles on the plane of symmetry: half their mass and volume, half the contact."""
        grid_half, body_half = type(grid)(), type(body)()
        grid_half.assign(grid)
        body_half.assign(body)
        grid_half.particle_mass, grid_half.particle_volume = (
            0.5 * grid.particle_mass,
            0.5 * grid.particle_volume,
        )
        body_half.stiffness, body_half.damping = 0.5 * body.stiffness, 0.5 * body.damping
        return grid_half, body_half

    def _image_launches(self, ghosts: dict[int, np.ndarray], record: dict[str, Any]) -> tuple[list, list]:
        """What comes before and after the grid step so that ghost nodes and their images agree."""
        grid, real = self._grid, self._real
        vec4, kernels = wp.types.vector(4, real), images(real)
        before, after = [], []
        for axis, pairs in ghosts.items():
            extent, stride = ((grid.nx, grid.ny * grid.nz), (grid.ny, grid.nz))[axis]
            sign = np.ones(4)
            if self._half is not None and axis == 1:
                sign[1] = -1.0
            layers = wp.array(pairs, dtype=wp.vec2i, device=self.device)
            rows = grid.nx * grid.ny * grid.nz // extent
            rest = [layers, vec4(*sign), stride, extent]
            before.append(wp.launch(kernels.fold, rows, [self._nodes, *rest], **record))
            after.insert(0, wp.launch(kernels.unfold, rows, [self._velocity, *rest], **record))
        return before, after

    def _wrap_launches(self, record: dict[str, Any]) -> list:
        """Bring particles that left a periodic bin back in."""
        self._turns: dict[int, wp.array] = {}
        launches, n = [], len(self._x)
        for axis, kind in enumerate(self.scene.bed.walls.kinds):
            if kind == "periodic":
                self._turns[axis] = wp.zeros(n, dtype=int, device=self.device)
                inputs = [self._x, self._turns[axis], axis, self.scene.bed.size[axis]]
                launches.append(wp.launch(images(self._real).wrap, n, inputs, **record))
        return launches

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
            if self._half is not None:
                particle = int(self._half.kept[particle])
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
        position, velocity = self._x.numpy(), self._v.numpy()
        for axis, turns in self._turns.items():
            position = position.copy()  # on the CPU it is the solver's own memory
            position[:, axis] += turns.numpy() * scene.bed.size[axis]
        if self._half is not None:
            position, velocity = self._half.whole(position, velocity)
            # The other half doubles force along and moment within the plane of symmetry, and cancels the rest.
            impulse *= [[2.0, 0.0, 2.0], [0.0, 2.0, 0.0]]
        return Frame(
            index=index,
            time=index / scene.frame_rate,
            position=position.astype(np.float32),
            velocity=velocity.astype(np.float32),
            body_pose=pose,
            body_points=rotate(pose[3:], scene.body_points()) + pose[:3],
            force=impulse[0],
            torque=impulse[1],
        )

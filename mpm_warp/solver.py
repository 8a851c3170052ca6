"""The explicit material point method, frame by frame."""

from __future__ import annotations

import copy
import math
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from .discretisation import half, initial_stress, lay_grid, require_symmetry
from .effects import Effects
from .kernels.contact import ContactLaw, body_struct
from .kernels.fluidity import soil_parameters
from .kernels.ghost_nodes import Images, images
from .kernels.grid import grid_step
from .kernels.nonlocal_fluidity import NonlocalFluidity, wall_sink
from .kernels.transfer import transfer
from .launch import Launch, Program, SceneKernel, Work, Worker, find_device
from .limits import Guard, require_memory, steps_to_remap, substeps_per_frame, top_body_speed
from .poses import rotate
from .rigid_body import RigidBody
from .scene import Scene
from .state import Memory, SceneError, SolverStopped, State

PRECISIONS = {"float32": wp.float32, "float64": wp.float64}


@dataclass(frozen=True)
class Frame:
    """The state at one recorded time. Arrays are copies and stay valid."""

    index: int
    time: float
    """[s]"""
    position: np.ndarray
    """Soil [m], shape (n, 3), float32; along a periodic axis it goes on counting beyond the bin."""
    velocity: np.ndarray
    """Soil, of the grid where the particle is [m/s], shape (n, 3), float32."""
    body_pose: np.ndarray
    """Centre of mass [m] and quaternion x, y, z, w, shape (7,)."""
    body_points: np.ndarray
    """Body nodes in the world [m], shape (M, 3)."""
    force: np.ndarray
    """By the soil on the body, world frame, mean since the previous frame [N], shape (3,); frame 0: zeros."""
    torque: np.ndarray
    """About the body's centre of mass, likewise [N m], shape (3,); zeros without the effect `torque`."""


class Solver:
    """Computes a scene.

        for frame in Solver(scene).frames():
            print(frame.time, frame.force)

    Args:
        scene: what to compute.
        effects: which physics; kernels are compiled without what is off.
        device: `cpu` (one core) or `cuda`, `cuda:0`, ...
        precision: `float32` or `float64`.
        start: what to go on from instead of the scene's own start; of the same scene, whose numerics may differ.
    """

    def __init__(
        self,
        scene: Scene,
        effects: Effects | None = None,
        device: str = "cpu",
        precision: str = "float32",
        start: State | None = None,
    ) -> None:
        if precision not in PRECISIONS:
            raise SceneError(f"precision is {precision!r}; allowed: {', '.join(PRECISIONS)}")
        self.scene = scene
        self.effects = effects or Effects()
        self.device = find_device(device)
        self.precision = precision
        self._real = PRECISIONS[precision]
        require_memory(scene, precision, device, self.effects.symmetry)
        if self.effects.symmetry:
            require_symmetry(scene)
        self._half = half(scene) if self.effects.symmetry else None

        self._top_body_speed = top_body_speed(scene)
        self.substeps_per_frame = substeps_per_frame(scene)
        self.time_step = 1.0 / scene.frame_rate / self.substeps_per_frame
        """Substep [s]."""
        self._guard = Guard(scene, self.time_step)
        self._start = copy.deepcopy(start)  # every beginning needs it as it is now
        self._beginnings = 0
        self._make_ready()

    @property
    def particle_count(self) -> int:
        """n, of the whole bed."""
        return len(self.scene.initial_positions())

    @property
    def computed_count(self) -> int:
        """Particles that are computed: about half of them with mirror symmetry."""
        return len(self._x)

    def frames(self) -> Iterator[Frame]:
        """All frames in order, the initial state first, or those after the one that the solver starts from.

        Each call begins anew and gives the same frames. There is one memory: the frames of an earlier call end there.

        Raises:
            SceneError: the frames were asked for again meanwhile.
            SolverStopped: in the first frame in which a particle or the body went wrong, with the state before it.
        """
        worker = Worker(self.device)
        for stage in self.stages():
            if isinstance(stage, Work):
                worker.do([stage])
            else:
                yield stage

    def stages(self) -> Generator[Frame | Work, None, None]:
        """As `frames`, with all work that the device has to do before the solver can go on: the caller has it done,
        that of other scenes with it (batch.py)."""
        if self._beginnings:
            self._make_ready()
        self._beginnings += 1
        beginning = self._beginnings
        for stage in self._computed():
            yield stage
            if self._beginnings != beginning:
                raise SceneError(
                    "the frames of this solver were asked for again, and it began anew: take them from the later call, "
                    "or make a Solver for each"
                )

    def _computed(self) -> Iterator[Frame | Work]:
        """What `stages` gives, from the solver's memory as it is."""
        for program in (self._remap, self._until_remap):
            yield Work(program, 0)
        first = 0 if self._start is None else self._start.frame + 1
        if self._start is not None:
            self._memory.keep(self._start.frame)
        for index in range(first, self.scene.frame_count):
            if index > 0:
                try:
                    yield from self._advance(index)
                except SolverStopped as stopped:
                    stopped.state = self._memory.state()
                    raise
            self._memory.keep(index)
            yield self._frame(index)

    def state(self) -> State | None:
        """What a solver of the same scene needs to go on after the last frame that `frames` gave; None before the
        first."""
        return self._memory.state()

    # --- set-up -------------------------------------------------------------------------------------------

    def _make_ready(self) -> None:
        """Arrays as they are before the first frame, or at the state to start from."""
        self._allocate()
        if self._start is not None:
            self._memory.load(self._start)

    def _allocate(self) -> None:
        scene, real, device = self.scene, self._real, self.device
        vec3, vec4 = wp.types.vector(3, real), wp.types.vector(4, real)
        positions, volume = scene.filled
        velocities, (ln_j, strain) = scene.initial_velocities(), initial_stress(scene)
        if self._half is not None:
            kept = self._half.kept
            positions, velocities, ln_j, strain = positions[kept], velocities[kept], ln_j[kept], strain[kept]
        n = len(positions)
        self._grid, ghosts = lay_grid(scene, real, self.time_step, volume, self._half is not None)
        self._soil = soil_parameters(real, scene.material, max(scene.bed.size), self.effects.fluidity)
        if self.effects.fluidity:
            self._soil.g = wp.zeros(n, dtype=real, device=device)

        self._x = wp.array(positions, dtype=vec3, device=device)
        self._home = wp.zeros(n, dtype=vec3, device=device)
        self._v = wp.array(velocities, dtype=vec3, device=device)
        self._felt = wp.array(np.pad(velocities, ((0, 0), (0, 1))), dtype=vec4, device=device)
        self._c = wp.zeros(n, dtype=wp.types.matrix((3, 3), real), device=device)
        self._e = wp.array(strain, dtype=wp.types.vector(6, real), device=device)
        self._ln_j = wp.array(ln_j, dtype=real, device=device)
        shear, bulk = 2.0 * scene.material.shear_modulus, scene.material.bulk_modulus
        stress = shear * strain + bulk * ln_j[:, None] * np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
        self._swelling = wp.zeros(n, dtype=real, device=device)
        self._stress = wp.array(stress, dtype=wp.types.vector(6, real), device=device)
        nodes = self._grid.nx * self._grid.ny * self._grid.nz
        self._momentum, self._velocity, self._before, self._impulse = (
            wp.zeros(nodes + 1, dtype=vec4, device=device)
            for _ in range(4)  # + 1: see kernels/node_rows.py
        )
        cooperative = self.effects.nonlocality
        self._cooperation = wp.zeros(nodes + 1 if cooperative else 0, dtype=vec4, device=device)
        self._excess = wp.zeros(n if cooperative else 0, dtype=real, device=device)
        self._inverse_mass = wp.zeros(nodes, dtype=real, device=device)
        self._substep = wp.zeros(1, dtype=int, device=device)
        self._top_speed = wp.zeros(1, dtype=real, device=device)
        self._keep = wp.zeros(1, dtype=real, device=device)
        self._stray = wp.zeros(4, dtype=int, device=device)

        self._body: RigidBody | None = None
        if scene.body is not None:
            share = 1.0 if self._half is None else 0.5
            self._body = RigidBody(
                scene,
                real,
                device,
                self.substeps_per_frame,
                self.time_step,
                n,
                volume,
                share,
                self.effects.torque,
            )
        self._record_launches(n, nodes, ghosts)
        self._memory = Memory(self._lasting())

    def _lasting(self) -> dict[str, wp.array]:
        """What a frame leaves to the next one; the grid is filled anew at every remap."""
        arrays = {
            "position": self._x,
            "velocity": self._v,
            "felt_velocity": self._felt,
            "velocity_gradient": self._c,
            "elastic_strain": self._e,
            "log_volume": self._ln_j,
            "stress": self._stress,
            "swelling": self._swelling,
        }
        arrays |= {f"turns_{'xyz'[axis]}": turns for axis, turns in self._turns.items()}
        if self.effects.fluidity:
            arrays["fluidity"] = self._soil.g
        if self._nonlocal is not None:
            arrays["cooperative_fluidity"] = self._nonlocal.field
        if self._body is not None:
            arrays |= self._body.lasting()
        return arrays

    def _record(self, kernel: SceneKernel, count: int, *arguments: Any) -> Launch:
        return Launch(kernel, count, arguments, self.device)

    def _record_launches(self, n: int, nodes: int, ghosts: dict[int, np.ndarray]) -> None:
        """What runs at a remap and in every step, in order."""
        real, grid, soil, body = self._real, self._grid, self._soil, self._body
        kernels = transfer(real, self.effects, body.law if body else None, atomic=self.device.is_cuda)
        node = grid_step(real, self.scene.bed.walls.conditions)
        ghost = Images(real, self.device, grid, ghosts, mirrored=self._half is not None)
        x, home, v, felt, c, e, ln_j = (
            self._x, self._home, self._v, self._felt, self._c, self._e, self._ln_j
        )  # fmt: skip
        watch = (self._substep, self._stray)

        self._to_grid = self._record_wraps(n)
        scatter = []
        for part, its_grid, its_body in self._parts(n):
            particles = [a[part] for a in (x, v, c, home)]
            self._to_grid.append(
                self._record(
                    kernels.to_grid,
                    len(particles[0]),
                    *particles,
                    its_grid,
                    self._momentum,
                    self._top_speed,
                    *watch,
                )
            )
            particles = [a[part] for a in (x, home, felt, self._stress, self._swelling)]
            rest = (its_grid, its_body, self._impulse, self._substep)
            scatter.append(self._record(kernels.scatter, len(particles[0]), *particles, *rest))
        fields = (self._momentum, self._velocity, self._before, self._inverse_mass, self._impulse)
        self._begin = [
            *ghost.fold(self._momentum),
            self._record(node.begin, nodes, grid, *fields),
            *ghost.unfold(self._before),
        ]
        self._step = [
            *scatter,
            *(body.launches if body else ()),
            *ghost.fold(self._impulse),
            self._record(
                node.step, nodes, grid, self._velocity, self._inverse_mass, self._impulse, self._substep
            ),
            *self._record_nonlocal(ghosts),
            *ghost.unfold(self._velocity),
            self._record(
                kernels.gather,
                n,
                x,
                home,
                felt,
                c,
                grid,
                self._velocity,
                self._cooperation,
                self._excess,
                *watch,
            ),
            self._record(
                kernels.material, n, felt, c, e, ln_j, self._stress, self._swelling, self._excess, grid, soil
            ),
        ]
        self._from_grid = self._record(
            kernels.from_grid, n, x, home, felt, v, grid, self._before, self._keep, ln_j
        )
        self._remap = Program(self._to_grid)
        self._until_remap = Program(self._begin, self._step, [self._from_grid])

    def _parts(self, n: int) -> Iterator[tuple[slice, Any, Any]]:
        """Particles with the grid and the body that they see. Those on the plane of symmetry count half."""
        grid = self._grid
        body = self._body.data if self._body else body_struct(self._real, ContactLaw())()
        on_plane = self._half.on_plane if self._half is not None else 0
        if not on_plane:
            yield slice(0, n), grid, body
            return
        for part, share in ((slice(0, on_plane), 0.5), (slice(on_plane, n), 1.0)):
            if part.start == part.stop:  # all lie on it
                continue
            its_grid, its_body = type(grid)(), type(body)()
            its_grid.assign(grid)
            its_body.assign(body)
            its_grid.particle_mass, its_grid.particle_volume = (
                share * grid.particle_mass,
                share * grid.particle_volume,
            )
            if self._body is not None:
                its_body.stiffness, its_body.damping = share * body.stiffness, share * body.damping
                its_body.stick = body.stick[part]
            yield part, its_grid, its_body

    def _record_nonlocal(self, ghosts: dict[int, np.ndarray]) -> list[Launch]:
        self._nonlocal: NonlocalFluidity | None = None
        if not self.effects.nonlocality:
            return []
        real, grid = self._real, self._grid
        sink = np.zeros(grid.nx * grid.ny * grid.nz)
        if self.scene.material.fluidity_at_walls == "zero":
            sink = wall_sink((grid.nx, grid.ny, grid.nz), grid.low, grid.high)
        particles = [self._home, self._e, self._ln_j]
        ghost = Images(real, self.device, grid, ghosts, mirrored=False)  # fluidity has no direction
        on_plane = self._half.on_plane if self._half is not None else 0
        self._nonlocal = NonlocalFluidity(
            real,
            self.effects,
            self.device,
            sink,
            particles,
            grid,
            self._soil,
            ghost,
            self._cooperation,
            on_plane,
        )
        return [*self._nonlocal.launches, *ghost.unfold(self._cooperation)]

    def _record_wraps(self, n: int) -> list[Launch]:
        """Bring particles that left a periodic bin back in."""
        self._turns: dict[int, wp.array] = {}
        launches = []
        for axis, kind in enumerate(self.scene.bed.walls.conditions):
            if kind == "periodic":
                self._turns[axis] = turns = wp.zeros(n, dtype=int, device=self.device)
                wrap = images(self._real).wrap
                launches.append(self._record(wrap, n, self._x, turns, axis, self.scene.bed.size[axis]))
        return launches

    # --- stepping -----------------------------------------------------------------------------------------

    def _advance(self, index: int) -> Iterator[Work]:
        """From frame index - 1 to frame `index`."""
        self._substep.zero_()
        if self._body is not None:
            self._body.start_frame(index - 1)
        left = self.substeps_per_frame
        while left:
            self._top_speed.zero_()
            yield Work(self._remap, 1)
            top = float(self._top_speed.numpy()[0])
            if not top <= self._guard.speed_bound:
                fastest = int(np.argmax(np.linalg.norm(self._v.numpy(), axis=1)))
                raise self._stopped(index, self.substeps_per_frame - left, fastest, self._guard.too_fast(top))
            speed = max(self._top_body_speed, top)
            steps = min(left, steps_to_remap(self.scene, self.time_step, speed))
            left -= steps
            self._keep.fill_(math.exp(-steps * self.time_step / self.scene.velocity_memory))
            yield Work(self._until_remap, steps)
        self._check(index)

    def _check(self, index: int) -> None:
        """At the end of frame `index`."""
        count, particle, substep, near = (int(i) for i in self._stray.numpy())
        if count:
            raise self._stopped(index, substep, particle, self._guard.strayed(bool(near)))
        found = self._guard.too_strained(self._ln_j.numpy(), self._e.numpy())
        found = found or self._guard.lost_fluidity(self._excess.numpy())
        if found is not None:
            raise self._stopped(index, self.substeps_per_frame, *found)
        if self._body is not None:
            self._body.check(index / self.scene.frame_rate, self._guard.speed_bound)

    def _stopped(self, index: int, substep: int, particle: int, cause: str) -> SolverStopped:
        time = (index - 1) / self.scene.frame_rate + substep * self.time_step
        at = ", ".join(f"{c:.4f}" for c in self._x.numpy()[particle])
        if self._half is not None:
            particle = int(self._half.kept[particle])
        return SolverStopped(
            f"particle {particle} at ({at}) m went wrong at {time:.5f} s, substep {substep} of frame {index}: {cause}; "
            "the frames before it are good"
        )

    def _frame(self, index: int) -> Frame:
        scene = self.scene
        time = index / scene.frame_rate
        pose = scene.poses_at(np.array([time]))[0]
        impulse = np.zeros((2, 3))
        if self._body is not None:
            pose, impulse = self._body.pose(time), self._body.impulse() * (scene.frame_rate if index else 0.0)
        position, velocity = self._x.numpy(), self._felt.numpy()[:, :3]
        for axis, turns in self._turns.items():
            position = position.copy()  # on the CPU it is the solver's own memory
            position[:, axis] += turns.numpy() * scene.bed.size[axis]
        if self._half is not None:
            position, velocity = self._half.whole(position, velocity)
            # The other half doubles force along and moment within the plane of symmetry, and cancels the rest.
            impulse *= [[2.0, 0.0, 2.0], [0.0, 2.0, 0.0]]
        return Frame(
            index=index,
            time=time,
            position=position.astype(np.float32),
            velocity=velocity.astype(np.float32),
            body_pose=pose,
            body_points=rotate(pose[3:], scene.body_points()) + pose[:3],
            force=impulse[0],
            torque=impulse[1],
        )

"""The explicit material point method, frame by frame; one scene or many at once."""

from __future__ import annotations

import copy
import math
from collections.abc import Generator, Iterable, Iterator
from dataclasses import dataclass, field, replace
from itertools import repeat
from typing import Any

import numpy as np
import warp as wp

from .discretisation import half, initial_particles, lay_grid, require_symmetry
from .effects import Effects
from .kernels.contact import body_struct, node_contact
from .kernels.fluidity import nonlocal_launches, soil_parameters, wall_sink
from .kernels.grid import GhostNodes, adding_up, ghost_kernels, grid_step, particle_struct
from .kernels.transfer import transfer
from .launch import Executor, Job, Launch, Program, SideBySide, Threads, find_device, run_concurrently
from .limits import PhysicalLimits, require_memory, steps_to_remap, substeps_per_frame, top_body_speed
from .poses import rotate
from .rigid_body import RigidBody
from .scene import Scene
from .settings import short_repr
from .state import Memory, SceneError, Soil, SolverStopped, State

MOST_THREADS = 256
PRECISIONS = {"float32": wp.float32, "float64": wp.float64}


@dataclass(frozen=True)
class Frame:
    """The state at one recorded time. Arrays are copies and stay valid."""

    __repr__ = short_repr

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
    other_poses: np.ndarray = field(default_factory=lambda: np.zeros((0, 7)))
    """Of the k further bodies, as `body_pose`, shape (k, 7)."""
    other_forces: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    """On them, as `force`, shape (k, 3)."""
    other_torques: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    """Likewise as `torque`, shape (k, 3)."""

    @property
    def pose(self) -> np.ndarray:
        """`body_pose`, under the name that the state of a `sgns.Simulator` has for it."""
        return self.body_pose

    def soil(self) -> np.ndarray:
        """`position`, likewise."""
        return self.position


class Solver:
    """Computes a scene.

        for frame in Solver(scene).frames():
            print(frame.time, frame.force)

    Args:
        scene: what to compute.
        effects: which physics; kernels are compiled without what is off.
        device: `cpu` or `cuda`, `cuda:0`, ...
        precision: `float32` or `float64`.
        threads: of the CPU, each with a part of the soil. Another number of them rounds sums otherwise; the same one
            always gives the same answer. It pays from some ten thousand particles on.
        start: what to go on from instead of the scene's own start; of the same scene, whose numerics may differ.
        start_from: soil as another solver left it (`soil()`, or `sgns.Run.soil`); see `Scene.starting_from`.
    """

    def __init__(
        self,
        scene: Scene,
        effects: Effects | None = None,
        device: str = "cpu",
        precision: str = "float32",
        threads: int = 1,
        start: State | None = None,
        start_from: Soil | None = None,
    ) -> None:
        if start_from is not None:
            scene = scene.starting_from(start_from)
        if precision not in PRECISIONS:
            raise SceneError(f"precision is {precision!r}; allowed: {', '.join(PRECISIONS)}")
        self.scene = scene
        self.effects = effects or Effects()
        if scene.material.cohesion == 0.0:
            self.effects = replace(self.effects, cohesion=False)
        self.device = find_device(device)
        self._real = PRECISIONS[precision]
        if not (isinstance(threads, int) and 1 <= threads <= MOST_THREADS):
            raise SceneError(f"threads is {threads!r}; allowed: 1 to {MOST_THREADS}")
        if threads > 1 and self.device.is_cuda:
            raise SceneError(
                f"threads is {threads} on {self.device}; they are a CPU's: set it to 1, or device=cpu"
            )
        self._threads = Threads(threads, self.device)
        require_memory(scene, precision, device, self.effects.symmetry)
        if self.effects.symmetry:
            require_symmetry(scene)
        self._half = half(scene) if self.effects.symmetry else None

        self._top_body_speed = top_body_speed(scene)
        self.substeps_per_frame = substeps_per_frame(scene)
        self.time_step = 1.0 / scene.frame_rate / self.substeps_per_frame
        """Substep [s]."""
        self._limits = PhysicalLimits(scene, self.time_step)
        self._start = copy.deepcopy(start)  # every beginning needs it as it is now
        self._beginnings = 0
        self._stepped: int | None = None
        """Frame to which `reset` and `step` have come."""
        self._make_ready()

    def __repr__(self) -> str:
        size = f"{self.computed_count} particles, {self.substeps_per_frame} steps per frame"
        return f"Solver({self.scene.name}: {size}, on {self.device})"

    @property
    def particle_count(self) -> int:
        """n, of the whole bed."""
        return len(self.scene.initial_positions())

    @property
    def computed_count(self) -> int:
        """Particles that are computed: about half of them with mirror symmetry."""
        return len(self.particles.position)

    def frames(self) -> Iterator[Frame]:
        """All frames in order, the initial state first, or those after the one that the solver starts from.

        Each call begins anew and gives the same frames. There is one memory: the frames of an earlier call end there.

        Raises:
            SceneError: the frames were asked for again meanwhile.
            SolverStopped: in the first frame in which a particle or the body went wrong, with the state before it.
        """
        executor = Executor(self.device)
        for stage in self.stages():
            if isinstance(stage, Job):
                executor.run([stage])
            else:
                yield stage

    def stages(self) -> Generator[Frame | Job, None, None]:
        """As `frames`, with the jobs that the device has to do before the solver can go on: the caller runs them, with
        those of other scenes (`run_concurrently`)."""
        if self._beginnings:
            self._make_ready()
        self._beginnings += 1
        self._stepped, beginning = None, self._beginnings
        for stage in self._computed():
            yield stage
            if self._beginnings != beginning:
                raise SceneError(
                    "the frames of this solver were asked for again, and it began anew: take them from the later call, "
                    "or make a Solver for each"
                )

    def _computed(self) -> Iterator[Frame | Job]:
        """What `stages` gives, from the solver's memory as it is."""
        yield from self._begin()
        first = 0 if self._start is None else self._start.frame + 1
        for index in range(first, self.scene.frame_count):
            if index > 0:
                yield from self._advance(index)
            self._memory.keep(index)
            yield self._frame(index)

    def _begin(self) -> Iterator[Job]:
        for program in (self._remap, self._steps):
            yield Job(program, 0)
        if self._start is not None:
            self._memory.keep(self._start.frame)

    def reset(self) -> Frame:
        """Begin anew, for poses that are not known beforehand (`step`); returns the state at the start."""
        if self._beginnings:
            self._make_ready()
        self._beginnings += 1
        self._stepped = 0 if self._start is None else self._start.frame
        executor = Executor(self.device)
        for job in self._begin():
            executor.run([job])
        self._memory.keep(self._stepped)
        return self._frame(self._stepped)

    def step(self, pose: np.ndarray) -> Frame:
        """Move the body to its next pose and the soil with it; returns the state then, as `frames` would for a path
        with this pose. The scene's own motion and duration do not count. The first call begins as `reset` does.

        Args:
            pose: centre of mass [m] and unit quaternion x, y, z, w one frame from now, shape (7,). On the way there
                positions go straight, rotations the shortest way. The height of a free body is computed.

        Raises:
            SceneError: the pose is no such array, is off the plane of the effect `symmetry`, or further away than a
                step allows; then the solver stays where it was.
            SolverStopped: as of `frames`.
        """
        if self.body is None:
            raise SceneError("the scene has no tool to move; take its `frames`")
        if any(one.motion == "follow" for one in self.scene.others):
            raise SceneError(
                "a body of scene.others follows the scene's own motion, and `step` has none: give it motion=path"
            )
        if self._stepped is None:
            self.reset()
        assert self._stepped is not None
        self.body.head_for(self._stepped, np.asarray(pose, dtype=float))
        executor, index = Executor(self.device), self._stepped + 1
        for job in self._advance(index):
            executor.run([job])
        self._stepped = index
        self._memory.keep(index)
        return self._frame(index)

    def state(self) -> State | None:
        """What a solver of the same scene needs to go on after the last frame that `frames` gave; None before the
        first."""
        return self._memory.state()

    def soil(self) -> Soil:
        """Soil as it is after the last frame that `frames` gave, for another tool and path.

        Raises:
            SceneError: there is no frame yet.
        """
        state = self._memory.state()
        if state is None:
            raise SceneError(
                "the solver has no frame yet, so there is no soil to start from; take its frames first"
            )
        time = state.frame / self.scene.frame_rate
        pose = self.scene.poses_at(np.array([time]))[0] if self.body is None else self.body.pose(time)
        return Soil(self.scene, state, pose)

    # --- set-up -------------------------------------------------------------------------------------------

    def _make_ready(self) -> None:
        """Arrays as they are before the first frame, or at the state to start from."""
        scene, effects, real, device = self.scene, self.effects, self._real, self.device
        vec4 = wp.types.vector(4, real)

        def zeros(dtype: Any, count: int) -> wp.array:
            return wp.zeros(count, dtype=dtype, device=device)

        soil, volume = initial_particles(scene), scene.filled[1]
        self.grid, layers = lay_grid(scene, real, self.time_step, volume, self._half is not None)
        """The struct of the grid, see kernels/grid.py."""
        if self._half is not None:
            self.grid.on_plane = self._half.on_plane
            soil = {name: values[self._half.kept] for name, values in soil.items()}
        self._soil = soil_parameters(real, scene.material, max(scene.bed.size))
        n, node_count = len(soil["position"]), self.grid.nx * self.grid.ny * self.grid.nz
        padded = node_count + 1  # see kernels/grid.py
        struct: Any = particle_struct(real)
        given: dict[str, int | np.ndarray] = {
            "home": n,
            "velocity_gradient": n,
            "swelling": n,
            "fluidity": n,
            "excess": n if effects.nonlocality else 0,
            "bond": np.full(n, scene.material.cohesive_pressure / scene.material.bulk_modulus),
        }
        given |= {name: values for name, values in soil.items() if name in struct.vars}
        for name, used in (("fluidity", effects.fluidity), ("bond", effects.can_tear)):
            if not used:
                given[name] = 0
        self.particles = _with_arrays(struct, device, **given)
        """The arrays of the particles that are computed, see kernels/grid.py."""
        self._velocity, self._before = (zeros(vec4, padded) for _ in range(2))
        own = self._threads.copies
        self._momentum, self._impulse = (own(zeros(vec4, padded)) for _ in range(2))
        self._inverse_mass = zeros(real, node_count)
        self._cooperative_field, self._cooperation = (
            zeros(vec4, padded if effects.nonlocality else 0) for _ in range(2)
        )
        if scene.soil is not None and effects.nonlocality:
            field = scene.soil.state.arrays.get("cooperative_fluidity")
            if field is not None and field.shape == (padded, 4):
                self._cooperative_field.assign(field)
        self._top_speed, self._fault = own(zeros(real, 1)), own(zeros(int, 4))
        self._keep, self.grid.substep = zeros(real, 1), zeros(int, 1)
        periodic = (axis for axis, kind in enumerate(scene.bed.walls.conditions) if kind == "periodic")
        self._turns = {axis: zeros(int, n) for axis in periodic}
        for axis, turns in self._turns.items():
            if (found := soil.get(f"turns_{'xyz'[axis]}")) is not None:
                turns.assign(found)
        given_to = effects, real, self._threads, self.substeps_per_frame, self.time_step, n
        self.body: RigidBody | None = None
        """The tool or wheel; None without one."""
        if scene.body is not None:
            self.body = RigidBody(scene, *given_to)
            if scene.goes_on and scene.soil is not None:
                self.body.go_on(scene.soil.state.arrays, soil["contact_stretch"])
        self._others = [RigidBody(one, *given_to) for one in scene.companions]
        self._remap, self._steps = self._programs(layers)
        self._memory = Memory(self._lasting(), self._half.images if self._half is not None else None)
        if self._start is not None:
            self._memory.load(self._start)

    def _lasting(self) -> dict[str, wp.array]:
        """What a frame leaves to the next one; the grid is filled anew at every remap."""
        names = ["position", "velocity", "felt_velocity", "velocity_gradient", "elastic_strain", "log_volume"]
        names += ["stress", "swelling", *(["fluidity"] if self.effects.fluidity else [])]
        names += ["bond"] if self.effects.can_tear else []
        arrays = {name: getattr(self.particles, name) for name in names}
        arrays |= {f"turns_{'xyz'[axis]}": turns for axis, turns in self._turns.items()}
        if self.effects.nonlocality:
            arrays["cooperative_fluidity"] = self._cooperative_field
        for number, other in enumerate(self._others):
            arrays |= {f"others_{number}_{name}": array for name, array in other.lasting().items()}
        return arrays | (self.body.lasting() if self.body is not None else {})

    @property
    def _bodies(self) -> list[RigidBody]:
        return [*([] if self.body is None else [self.body]), *self._others]

    def _programs(self, layers: dict[int, np.ndarray]) -> tuple[Program, Program]:
        """A remap, and the steps from there to the next one."""
        real, scene, device, body, particles = self._real, self.scene, self.device, self.body, self.particles
        momentum, velocity, before, impulse = self._momentum, self._velocity, self._before, self._impulse
        at_nodes = body is not None and body.law.at_nodes
        kernels = transfer(
            real, self.effects, body.law if body and not at_nodes else None, atomic=device.is_cuda
        )
        node_kernels, wrap = grid_step(real, scene.bed.walls.conditions), ghost_kernels(real).wrap
        ghost_nodes = GhostNodes(real, device, self.grid, layers, mirrored=self._half is not None)
        bodies = body.of_threads if body else [body_struct(real)()] * self._threads.count
        threads, soil, nodes = self._threads, self.computed_count, len(self._inverse_mass)
        given, grid, keep = [particles, self.grid], self.grid, self._keep
        remap: list[Launch | SideBySide] = [
            Launch(wrap, len(turns), [particles.position, turns, axis, scene.bed.size[axis]], device)
            for axis, turns in self._turns.items()
        ]
        remap += threads.share(soil, (kernels.to_grid, [*given, momentum, self._top_speed, self._fault]))
        moved = [momentum[0], velocity, before, self._inverse_mass, impulse[0]]
        stepped = [velocity, self._inverse_mass, impulse[0]]
        begin = [
            *threads.share(nodes, *adding_up(momentum), owned="nodes"),
            *ghost_nodes.fold(momentum[0]),
            *threads.share(nodes, (node_kernels.begin, [grid, *moved]), owned="nodes"),
            *ghost_nodes.unfold(before),
        ]
        presses = [
            (transfer(real, self.effects, one.law, device.is_cuda).press, [*given, one.of_threads, impulse])
            for one in self._others
        ]
        moving = [launch for one in self._bodies for launch in one.launches]
        stopping = []
        if body is not None and at_nodes:
            kernel = node_contact(real, body.law, self.effects.symmetry, device.is_cuda)
            stopping = [Launch(kernel, nodes, [grid, body.data, velocity, self._inverse_mass], device)]
        step = [
            *threads.share(soil, (kernels.scatter, [*given, bodies, impulse]), *presses, owned="soil"),
            *threads.share(nodes, *adding_up(impulse), owned="nodes", alone=moving),
            *ghost_nodes.fold(impulse[0]),
            *threads.share(nodes, (node_kernels.step, [grid, *stepped]), owned="nodes"),
            *stopping,
            *(self._nonlocal_launches(layers) if self.effects.nonlocality else ()),
            *ghost_nodes.unfold(velocity),
            *threads.share(
                soil,
                (kernels.gather, [*given, velocity, self._cooperation, self._fault]),
                (kernels.material, [*given, self._soil]),
                owned="soil",
            ),
        ]
        end = threads.share(soil, (kernels.from_grid, [*given, before, keep]), owned="soil")
        return Program(remap), Program(begin, step, end)

    def _nonlocal_launches(self, layers: dict[int, np.ndarray]) -> list[Launch | SideBySide]:
        grid, field, cooperation = self.grid, self._cooperative_field, self._cooperation
        sink = np.zeros(len(self._inverse_mass))
        if self.scene.material.fluidity_at_walls == "zero":
            sink = wall_sink((grid.nx, grid.ny, grid.nz), grid.low, grid.high)
        ghost_nodes = GhostNodes(self._real, self.device, grid, layers, mirrored=False)
        given = (self.particles, grid, self._soil, field, cooperation, ghost_nodes, self._threads)
        launches = nonlocal_launches(self._real, self.effects, sink, *given)
        return [*launches, *ghost_nodes.unfold(cooperation)]

    # --- stepping -----------------------------------------------------------------------------------------

    def _advance(self, index: int) -> Iterator[Job]:
        """From frame index - 1 to frame `index`.

        Raises:
            SolverStopped: with the state at frame index - 1.
        """
        try:
            yield from self._stepped_to(index)
        except SolverStopped as stopped:
            stopped.state = self._memory.state()
            raise

    def _stepped_to(self, index: int) -> Iterator[Job]:
        self.grid.substep.zero_()
        for body in self._bodies:
            body.start_frame(index - 1)
        body_speed = (
            self._top_body_speed if self.body is None else max(self._top_body_speed, self.body.given_speed)
        )
        left = self.substeps_per_frame
        while left:
            for top_speed in self._top_speed:
                top_speed.zero_()
            yield Job(self._remap, 1)
            top = float(np.max([own.numpy()[0] for own in self._top_speed]))
            if not top <= self._limits.top_speed:
                fastest = int(np.argmax(np.linalg.norm(self.particles.velocity.numpy(), axis=1)))
                substep = self.substeps_per_frame - left
                raise self._stopped(index, substep, fastest, self._limits.too_fast(top))
            steps = min(left, steps_to_remap(self.scene, self.time_step, max(body_speed, top)))
            left -= steps
            self._keep.fill_(math.exp(-steps * self.time_step / self.scene.memory_time))
            yield Job(self._steps, steps)
        self._check(index)

    def _check(self, index: int) -> None:
        """At the end of frame `index`."""
        particles, limits = self.particles, self._limits
        for fault in self._fault:
            count, particle, substep, near = (int(i) for i in fault.numpy())
            if count:
                raise self._stopped(index, substep, particle, limits.strayed(bool(near)))
        found = limits.too_strained(particles.log_volume.numpy(), particles.elastic_strain.numpy())
        found = found or limits.lost_fluidity(particles.excess.numpy())
        if found is not None:
            raise self._stopped(index, self.substeps_per_frame, *found)
        for body in self._bodies:
            body.check(index / self.scene.frame_rate, limits.top_speed)

    def _stopped(self, index: int, substep: int, particle: int, cause: str) -> SolverStopped:
        time = (index - 1) / self.scene.frame_rate + substep * self.time_step
        at = ", ".join(f"{c:.4f}" for c in self.particles.position.numpy()[particle])
        if self._half is not None:
            particle = int(self._half.kept[particle])
        return SolverStopped(
            f"particle {particle} at ({at}) m went wrong at {time:.5f} s, substep {substep} of frame {index}: {cause}; "
            "the frames before it are good"
        )

    def _frame(self, index: int) -> Frame:
        scene = self.scene
        time = index / scene.frame_rate
        pose = scene.poses_at(np.array([time]))[0] if self.body is None else self.body.pose(time)
        bodies = [self.body, *self._others]
        impulses = np.array([np.zeros((2, 3)) if one is None else one.impulse() for one in bodies])
        impulses *= scene.frame_rate if index else 0.0
        position, velocity = self.particles.position.numpy(), self.particles.felt_velocity.numpy()[:, :3]
        for axis, turns in self._turns.items():
            position = position.copy()  # on the CPU it is the solver's own memory
            position[:, axis] += turns.numpy() * scene.bed.size[axis]
        if self._half is not None:
            position, velocity = self._half.whole(position, velocity)
            # The other half doubles force along and moment within the plane of symmetry, and cancels the rest.
            impulses *= [[2.0, 0.0, 2.0], [0.0, 2.0, 0.0]]
        return Frame(
            index=index,
            time=time,
            position=position.astype(np.float32),
            velocity=velocity.astype(np.float32),
            body_pose=pose,
            body_points=rotate(pose[3:], scene.body_points()) + pose[:3],
            force=impulses[0, 0],
            torque=impulses[0, 1],
            other_poses=np.array([one.pose(time) for one in self._others]).reshape(-1, 7),
            other_forces=impulses[1:, 0],
            other_torques=impulses[1:, 1],
        )


# --- Many scenes at once ------------------------------------------------------------------------------------


def frames_together(
    scenes: Iterable[Scene],
    effects: Effects | Iterable[Effects] | None = None,
    device: str = "cpu",
    precision: str = "float32",
    at_once: int = 32,
) -> Iterator[tuple[int, Frame | SceneError | SolverStopped]]:
    """Computes scenes side by side, each as a `Solver` of its own would.

        for number, frame in frames_together(scenes, device="cuda"):
            if not isinstance(frame, Frame):
                print(f"scene {number} ended: {frame}")

    It pays on a GPU, which a scene of some ten thousand particles does not fill. Scenes may differ in anything; none
    depends on which others are computed with it. Those of the same effects, walls, contact and precision
    share every launch.

    Args:
        scenes: what to compute.
        effects: which physics, for all of them or one for each.
        device, precision: as of a `Solver`.
        at_once: scenes that are under way at the same time; the next begins when one ends.

    Yields:
        The number of a scene and its next frame. Frames of one scene come in order, those of different scenes mixed.
        In place of a frame that cannot be computed the error comes, as that scene's last; the others go on.
    """

    def frames(scene: Scene, effects: Effects | None) -> Generator[Frame | Exception | Job, None, None]:
        try:
            yield from Solver(scene, effects, device, precision).stages()
        except (SceneError, SolverStopped) as error:
            yield error

    each = repeat(effects) if effects is None or isinstance(effects, Effects) else effects
    return run_concurrently(map(frames, scenes, each), at_once, device)


def _with_arrays(struct: Any, device: wp.Device, **given: int | np.ndarray) -> Any:
    """A struct whose arrays hold what is given, or so many zeros."""
    filled = struct()
    for name, values in given.items():
        make: Any = wp.zeros if isinstance(values, int) else wp.array
        setattr(filled, name, make(values, dtype=struct.vars[name].type.dtype, device=device))
    return filled

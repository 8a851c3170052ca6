"""A body in the soil: its motion through a frame, and the impulse that the soil gives it.

Where its height is free it carries a load and rests on the soil. One thread on the device then moves it once per
substep, so nothing waits for the host and the step can be part of a captured graph. Height and speed are kept in double
precision whatever the solver's: in single precision a height of 0.15 m moves in steps of 1.5e-8 m, and a wheel that
sinks slower than one such step per substep would hang in the air. So is all of the motion of a body that is free in
all six degrees of freedom.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from .bodies import MeshBody
from .kernels.contact import (
    COUNT,
    GAINED,
    HOLDING_LAYER,
    SPEED,
    SPIN,
    TURNED,
    ContactLaw,
    axle_step,
    body_struct,
    free_step,
)
from .kernels.grid import adding_up
from .kernels.signed_distance import shape_data, thickening
from .launch import Launch, Threads
from .poses import in_world_frame, rotation_matrices, rotation_vectors, sampled_poses
from .scene import MOST_COURANT, Companion, Scene
from .settings import short
from .state import SceneError, SolverStopped

if TYPE_CHECKING:
    from .effects import Effects

LONGEST_WAY = 0.5
"""Of any point of a body in one substep [grid spacings]."""


def stable_step(mass: float, contacts: float, stiffness: float, damping: float) -> float:
    """Longest substep [s] in which a free body on springs is stable, with a margin of two.

    A body of mass M [kg] touches at most N particles, each on a spring k [N/m] with a damper c [N s/m]. A step dt
    changes its velocity by the share q = N (k dt^2 + c dt) / M of what it would take to stop it; symplectic Euler with
    a lagged damper is stable for q below 2. The step returned has q = 1.
    """
    a, b = contacts * stiffness / mass, contacts * damping / mass
    return 2.0 / (b + math.sqrt(b * b + 4.0 * a))


def contact_spring(scene: Scene, volume: float) -> tuple[float, float]:
    """Stiffness [N/m] and damping [N s/m] of the spring between the body and a particle of `volume` [m^3].

    As stiff as a layer of soil one particle thick; the damping is critical.
    """
    material = scene.material
    stiffness = material.wave_speed**2 * material.bulk_density * volume ** (1.0 / 3.0)
    return stiffness, 2.0 * math.sqrt(stiffness * material.bulk_density * volume)


def longest_step(scene: Scene) -> float:
    """The substep [s] that a free body's mass allows; infinite for a prescribed one.

    Counted as if the whole lower half of the box around the body touched a particle per (particle spacing)^2. Of a body
    that is free in all directions all of its surface counts, and half of its mass: that is what a rod or a cylinder has
    at its surface against being turned, and other shapes have more. Of a mesh all of its surface counts; what it has
    against being turned is computed.
    """
    body = scene.body
    if body is None:
        return math.inf
    volume = scene.bed.particle_volume
    hx, hy, hz = body.half_size
    if isinstance(scene, Companion) and scene.free:
        if isinstance(body, MeshBody):
            mass, (area, skin), (whole, solid) = scene.mass, body.surface_moments, body.moments
            area = max(area, whole * float(np.linalg.eigvals(np.linalg.solve(solid, skin)).real.max()))
        else:
            box = 8.0 * hx * hy * hz  # of spheres and cylinders, the same share of volume and surface
            area = 8.0 * (hx * hy + hy * hz + hz * hx) * scene.mass / (scene.settings.density * box)
            mass = 0.5 * scene.mass
    elif scene.axle is not None:
        area, mass = 4.0 * hx * hy + 4.0 * hz * (hx + hy), scene.axle.mass
        if isinstance(body, MeshBody):
            area = max(area, body.surface_moments[0])
    else:
        return math.inf
    return stable_step(mass, area / volume ** (2.0 / 3.0), *contact_spring(scene, volume))


class RigidBody:
    """Arrays and launches of one body, for frames of so many substeps of `time_step` [s].

    With the effect `symmetry` half of the soil's impulse is computed; with `torque` its moment is added up.
    """

    def __init__(
        self,
        scene: Scene,
        effects: Effects,
        real: type,
        threads: Threads,
        substeps: int,
        time_step: float,
        particles: int,
    ) -> None:
        vec3, device = wp.types.vector(3, real), threads.device
        self.scene, self.substeps, self.time_step = scene, substeps, time_step
        shape, axle, h = scene.body, scene.axle, scene.bed.spacing
        assert shape is not None
        self._shape, self._symmetric = shape, effects.symmetry
        # Soil's waves and the body together may go so far in a step.
        stable = math.sqrt(1.0 + scene.elastic_damping**2) - scene.elastic_damping
        self._fastest = MOST_COURANT * stable * h / time_step - scene.material.wave_speed
        self._name = scene.place if isinstance(scene, Companion) else "the body"
        loose = isinstance(scene, Companion) and scene.free
        torque = effects.torque or loose
        self.law = ContactLaw(
            shape.surface, scene.bilateral, axle is not None, torque, loose, scene.contact == "nodes"
        )
        struct: Any = body_struct(real)
        self.data = data = struct()
        """The struct that kernels take."""
        data.margin = scene.contact_distance
        data.layer = HOLDING_LAYER * h if scene.bilateral else 0.0
        thicker = thickening(shape, scene.contact_distance, h)
        begins = scene.contact_distance + float(data.layer)
        data.shape, self._mesh = shape_data(shape, real, begins, device, thicker)
        outermost = max(0.0, begins) + (0.0 if thicker is None else float(thicker.max()))
        data.reach = shape.reach + math.sqrt(3.0) * outermost + h
        data.friction = shape.friction
        data.stiffness, data.damping = contact_spring(scene, scene.filled[1])
        data.separation_speed = 0.01 * scene.material.wave_speed
        known = 1 if loose else substeps
        data.position, data.velocity, data.spin = (wp.zeros(known, vec3, device) for _ in range(3))
        data.rotation = wp.zeros(known, wp.types.quaternion(real), device)
        data.stick = wp.zeros(particles, vec3, device)
        data.impulse = wp.zeros(1 + torque, vec3, device)
        self.of_threads = [data]
        """The struct for each thread, whose push it adds up."""
        self._given: np.ndarray | None = None  # path rows of the frame under way, if its end was given
        self.given_speed = 0.0
        """Of its fastest point, in a frame whose end was given [m/s]."""
        self._axle: wp.array | None = None
        moving = []
        if axle is not None:
            height = scene.poses_at(np.zeros(1))[0, 2]
            self._axle = data.axle = wp.array([height, 0.0, 0.0], dtype=wp.float64, device=device)
            self._fall: wp.array = wp.array([scene.gravity], dtype=wp.float64, device=device)
            mass = axle.mass * (0.5 if effects.symmetry else 1.0)
            values = [self._axle, data.impulse, time_step, mass, self._fall, axle.damping]
            moving.append(Launch(axle_step(real), 1, values, device))
        self._motion: wp.array | None = None
        if isinstance(scene, Companion) and scene.free:
            self._inertia = scene.inertia
            self._motion = wp.array(self._at_start(scene), dtype=wp.float64, device=device)
            inverse = wp.mat33d(*np.linalg.inv(scene.inertia).ravel())
            given = [time_step, scene.mass, inverse, wp.vec3d(*scene.gravity_vector)]
            moving.append(Launch(free_step(real), 1, [data, self._motion, *given], device))
        impulses = threads.copies(data.impulse)
        for impulse in impulses[1:]:
            own = struct()
            for name in struct.vars:
                setattr(own, name, getattr(data, name))
            own.impulse = impulse
            self.of_threads.append(own)
        adding = [Launch(kernel, len(data.impulse), given, device) for kernel, given in adding_up(impulses)]
        self.launches = [*adding, *moving]
        """What has to run in every substep after the soil's push was added up."""

    def _at_start(self, scene: Companion) -> np.ndarray:
        """As of `free_step`."""
        found = np.zeros(COUNT)
        found[:SPEED], found[SPEED:SPIN] = scene.poses_at(np.zeros(1))[0], scene.settings.velocity
        turn = rotation_matrices(found[TURNED:SPEED])
        found[SPIN:GAINED] = turn @ (scene.inertia @ (np.array(scene.settings.spin) @ turn))
        return found

    def head_for(self, frame: int, pose: np.ndarray) -> None:
        """Go on from frame number `frame` to a pose (7,) one frame later, whatever the scene's motion is.

        Raises:
            SceneError: it is no pose, or one that the body cannot be in then.
        """
        h, rate = self.scene.bed.spacing, self.scene.frame_rate
        if pose.shape != (7,) or not np.isfinite(pose).all() or abs(np.linalg.norm(pose[3:]) - 1.0) > 1e-3:
            raise SceneError(
                f"the pose of frame {frame + 1} is {short(pose)}; it needs seven finite numbers, x, y, z [m] and "
                "a unit quaternion x, y, z, w"
            )
        now = self.pose(frame / rate)
        to = pose.copy()
        if self._axle is not None:
            now[2] = to[2] = 0.0
        elif self._symmetric and max(abs(to[1] - now[1]) / h, *np.abs(to[[3, 5]])) > 1e-6:
            raise SceneError(
                f"the pose of frame {frame + 1} leaves the plane at mid-width, but half of the bed is computed: set "
                "effects.symmetry=false"
            )
        # A row behind the end: there the pose is the end itself, as on a longer path.
        rows = [[(frame + after) / rate, *place] for after, place in ((0, now), (1, to), (2, to))]
        way = np.linalg.norm(to[:3] - now[:3])
        angle = np.linalg.norm(rotation_vectors(now[None, 3:], to[None, 3:]))
        speed = float(way + self._shape.reach * angle) * rate
        most = self._fastest
        if speed > most:
            raise SceneError(
                f"the pose of frame {frame + 1} is {way:.3g} m and {math.degrees(angle):.3g} degrees away, {speed:.3g} "
                f"m/s for the fastest point; allowed: {most:.3g} m/s in steps of {self.time_step:.3g} s: go there in "
                "more frames, or lower scene.courant"
            )
        self._given, self.given_speed = np.array(rows), speed

    def start_frame(self, frame: int) -> None:
        """Load the prescribed motion of the frame that begins at `frame`, and forget the impulse.

        Raises:
            SolverStopped: the body jumps.
        """
        self.data.impulse.zero_()
        if self._motion is not None:
            motion = self._motion.numpy().copy()
            motion[GAINED:] = 0.0
            self._motion.assign(motion)
            turn = rotation_matrices(motion[TURNED:SPEED])
            self.data.position.assign(motion[None, :TURNED])
            self.data.rotation.assign(motion[None, TURNED:SPEED])
            self.data.velocity.assign(motion[None, SPEED:SPIN])
            self.data.spin.assign((turn @ np.linalg.solve(self._inertia, motion[SPIN:GAINED] @ turn))[None])
            return
        times = (frame * self.substeps + np.arange(self.substeps + 1)) * self.time_step
        if self._axle is not None and self.scene.axle is not None:
            self._axle[2:].zero_()
            if self.scene.axle.load:
                self._fall.fill_(self.scene.axle.fall(times, self.scene.gravity))
        if self._given is None:
            poses, (way, angle) = self.scene.poses_at(times), self.scene.displacement(times)
        else:
            poses = sampled_poses(self._given, times)
            way = np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=1)
            angle = np.linalg.norm(rotation_vectors(poses[:-1, 3:], poses[1:, 3:]), axis=1)
        self._require_steady(frame, times, poses[:, :3], way, angle)
        self.data.position.assign(poses[:-1, :3])
        self.data.rotation.assign(poses[:-1, 3:])
        self.data.velocity.assign(np.diff(poses[:, :3], axis=0) / self.time_step)
        self.data.spin.assign(rotation_vectors(poses[:-1, 3:], poses[1:, 3:]) / self.time_step)

    def pose(self, time: float) -> np.ndarray:
        """Centre of mass [m] and quaternion now, at `time` [s], shape (7,)."""
        if self._motion is not None:
            return self._motion.numpy()[:SPEED].copy()
        if self._given is None:
            pose = self.scene.poses_at(np.array([time]))[0]
        else:
            pose = sampled_poses(self._given, np.array([time]))[0]
        if self._axle is not None:
            pose[2] = self._axle.numpy()[0]
        return pose

    def impulse(self) -> np.ndarray:
        """By the soil on the body since the frame began [N s], and its moment [N m s], shape (2, 3); a moment that is
        not added up is 0."""
        impulse = self.data.impulse.numpy().astype(float)
        return np.pad(impulse, ((0, 2 - len(impulse)), (0, 0)))

    def lasting(self) -> dict[str, wp.array]:
        """What a frame leaves to the next one, by name."""
        arrays = {"contact_stretch": self.data.stick}
        if self._axle is not None:
            arrays["axle"] = self._axle
        if self._motion is not None:
            arrays["motion"] = self._motion
        return arrays

    def go_on(self, arrays: dict[str, np.ndarray], stretch: np.ndarray) -> None:
        """Take over the height and speed of a free body from the arrays of a state, and the stretch of contacts [m]."""
        self.data.stick.assign(stretch)
        if self._axle is not None:
            self._axle.assign(arrays["axle"])

    def check(self, time: float, top_speed: float) -> None:
        """Stop at `time` [s] where the soil's push or a free body's motion means nothing any more.

        Raises:
            SolverStopped: the force is not finite; the body reached the floor or, if it is free, a wall, or is faster
                than `top_speed` [m/s].
        """
        if not np.isfinite(self.data.impulse.numpy()).all():
            raise SolverStopped(
                f"the force on {self._name} is not finite by {time:.3f} s: lower scene.courant"
            )
        if self._motion is not None:
            self._check_free(time, top_speed, self._motion.numpy())
        if self._axle is None:
            return
        height, rate, _ = self._axle.numpy()
        if not abs(rate) <= top_speed:
            raise SolverStopped(
                f"{self._name} moves up or down at {rate:.3g} m/s by {time:.3f} s, which nothing here can cause "
                f"({top_speed:.3g} m/s at most): lower scene.courant or raise scene.damping"
            )
        if not height - self._shape.half_size[2] > -self.scene.bed.size[2]:
            raise SolverStopped(
                f"{self._name} reached the floor of the bin by {time:.3f} s: make scene.bed.size deeper or the load "
                "smaller"
            )

    def _check_free(self, time: float, top_speed: float, motion: np.ndarray) -> None:
        speed = float(np.linalg.norm(motion[SPEED:SPIN]))
        if not speed <= top_speed:
            raise SolverStopped(
                f"{self._name} moves at {speed:.3g} m/s by {time:.3f} s, which nothing here can cause ({top_speed:.3g} "
                "m/s at most): lower scene.courant"
            )
        places = in_world_frame(motion[None, :SPEED], self._shape.outline())[0]
        lx, ly, lz = self.scene.bed.size
        if not places[:, 2].min() > -lz:
            raise SolverStopped(
                f"{self._name} reached the floor of the bin by {time:.3f} s, which no free body touches: make "
                "scene.bed.size deeper"
            )
        low, high = places[:, :2].min(axis=0), places[:, :2].max(axis=0)
        if (low < 0.0).any() or (high > (lx, ly)).any():
            raise SolverStopped(
                f"{self._name} reached a side of the bin by {time:.3f} s, which no free body touches: make "
                "scene.bed.size larger or end earlier"
            )

    def _require_steady(
        self, frame: int, times: np.ndarray, position: np.ndarray, way: np.ndarray, angle: np.ndarray
    ) -> None:
        """A body that is somewhere else in the next substep does not push soil: it appears in its midst."""
        farthest, most = way + self._shape.reach * angle, LONGEST_WAY * self.scene.bed.spacing
        far = ~(farthest <= most)
        if not far.any():
            return
        substep = int(np.argmax(far))
        at = ", ".join(f"{c:.4f}" for c in position[substep])
        raise SolverStopped(
            f"{self._name} jumps by {way[substep]:.3g} m from ({at}) m and turns by {math.degrees(angle[substep]):.3g} "
            f"degrees within substep {substep} of frame {frame + 1}, {self.time_step:.3g} s long, at "
            f"{times[substep]:.5f} s: its farthest point moves {farthest[substep]:.3g} m, allowed: {most:.3g} m, half "
            "a grid spacing; make its path smooth or slower there; the frames before it are good"
        )

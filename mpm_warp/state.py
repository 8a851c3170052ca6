"""The state to go on from, soil to start from, and the errors of the solver."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

if TYPE_CHECKING:
    from .scene import Scene


class SceneError(ValueError):
    """A scene that cannot be simulated: what, where, what is allowed."""


class SolverStopped(RuntimeError):
    """The solver met a non-finite or unphysical value and stopped; frames already yielded are good."""

    state: State | None = None
    """At the last good frame; `Solver(..., start=state)` goes on from there, with a smaller step if its scene has
    one."""


@dataclass(frozen=True, eq=False)
class State:
    """A solver's memory at a recorded frame. At a frame the grid is empty: momentum has just come back from it."""

    frame: int
    """Number of the frame."""
    arrays: dict[str, np.ndarray] = field(repr=False)
    """Positions, velocities, strains, what plastic flow left, contact and the body, by name, in the solver's own
    order of particles and precision."""
    whole: np.ndarray | None = field(default=None, repr=False)
    """Where half of the bed is computed, of each particle of the whole its number k in `arrays`, or -1 - k for the
    mirror image of that one, shape (n,); None: the arrays hold all."""


# Of the arrays of a state those of particles: their shape after n, and the components that a mirror at mid-width turns.
_VECTOR, _STRAIN = (1,), (3, 5)
_PARTICLES: dict[str, tuple[tuple[int, ...], tuple[int, ...]]] = {
    "position": ((3,), _VECTOR),
    "velocity": ((3,), _VECTOR),
    "felt_velocity": ((4,), _VECTOR),
    "velocity_gradient": ((3, 3), (1, 3, 5, 7)),
    "elastic_strain": ((6,), _STRAIN),
    "log_volume": ((), ()),
    "stress": ((6,), _STRAIN),
    "swelling": ((), ()),
}
_SOME: dict[str, tuple[tuple[int, ...], tuple[int, ...]]] = {
    "fluidity": ((), ()),
    "bond": ((), ()),
    "contact_stretch": ((3,), _VECTOR),
    "turns_x": ((), ()),
    "turns_y": ((), ()),
}


@dataclass(frozen=True, eq=False)
class Soil:
    """Soil as a solver left it, for another tool and path: `Solver(scene, start_from=soil)`.

    Raises:
        SceneError: the state is not one of soil in the scene's bed.
    """

    scene: Scene
    """That it was computed in: its bed, soil and tool."""
    state: State
    pose: np.ndarray
    """Of the tool at that time: centre of mass [m] and quaternion x, y, z, w, shape (7,)."""
    source: str = ""
    """Where it comes from, in words."""

    def __repr__(self) -> str:
        return f"Soil({len(self.particles['position'])} particles, {self.source or self.scene.name})"

    def __post_init__(self) -> None:
        arrays, whole, wrong = self.state.arrays, self.state.whole, "the soil to start from is not good: "
        if missing := sorted(set(_PARTICLES) - set(arrays)):
            raise SceneError(f"{wrong}it lacks {missing[0]}")
        count = len(np.atleast_1d(arrays["log_volume"]))
        for name, (tail, _) in (_PARTICLES | _SOME).items():
            if name in arrays and arrays[name].shape != (count, *tail):
                raise SceneError(f"{wrong}{name} has shape {arrays[name].shape} and not {(count, *tail)}")
            if name in arrays and not np.isfinite(arrays[name]).all():
                raise SceneError(f"{wrong}{name} is not finite")
        if whole is not None:
            known = whole.ndim == 1 and whole.dtype.kind == "i" and len(whole) >= count > 0
            if not known or (np.where(whole < 0, -1 - whole, whole) >= count).any():
                raise SceneError(f"{wrong}what it says of mirror images is of another number of particles")
        if len(arrays["position"]) == 0:
            raise SceneError(f"{wrong}it holds no particle")
        axle = arrays.get("axle", np.zeros(3))
        if axle.shape != (3,) or not np.isfinite(axle).all():
            raise SceneError(f"{wrong}the height of its wheel and its rate are not three finite numbers")
        if np.shape(self.pose) != (7,) or not np.isfinite(self.pose).all():
            raise SceneError(f"{wrong}the pose of its tool is not seven finite numbers")

    @cached_property
    def particles(self) -> dict[str, np.ndarray]:
        """The arrays of the particles of the whole bed, by name, shape (n, ...), float64 but for counts."""
        arrays, whole = self.state.arrays, self.state.whole
        found = {name: arrays[name] for name in (*_PARTICLES, *_SOME) if name in arrays}
        found = {
            name: values if values.dtype.kind == "i" else values.astype(float)
            for name, values in found.items()
        }
        if whole is None:
            return found
        image = whole < 0
        source = np.where(image, -1 - whole, whole)
        found = {name: values[source] for name, values in found.items()}
        alone = np.bincount(source)[source] == 1  # on the plane, but for round-off
        width = self.scene.bed.size[1]
        for name, values in found.items():
            _, turned = (_PARTICLES | _SOME)[name]
            flat = values.reshape(len(values), -1)
            for component in turned:
                flat[image, component] *= -1.0
        found["position"][image, 1] += width
        found["position"][alone, 1] = 0.5 * width
        return found

    @cached_property
    def digest(self) -> str:
        """A short name of it, the same for the same soil."""
        found = hashlib.blake2b(digest_size=8)
        for name in _PARTICLES:
            found.update(np.ascontiguousarray(self.particles[name]).data)
        return found.hexdigest()


class Memory:
    """The arrays that last from frame to frame, by name, and what was in them at the last good frame."""

    def __init__(self, arrays: Mapping[str, wp.array], whole: np.ndarray | None = None) -> None:
        self._arrays, self._whole = dict(arrays), whole
        self._good = {name: wp.empty_like(array) for name, array in self._arrays.items()}
        self._frame: int | None = None

    def keep(self, frame: int) -> None:
        """What is there now is good, and is what frame number `frame` shows."""
        for name, array in self._arrays.items():
            wp.copy(self._good[name], array)
        self._frame = frame

    def state(self) -> State | None:
        """The last good frame, as a copy; None before the first."""
        if self._frame is None:
            return None
        return State(
            self._frame, {name: array.numpy().copy() for name, array in self._good.items()}, self._whole
        )

    def load(self, state: State) -> None:
        """Bring back what `state` holds; SceneError if it is of a scene or of effects with other arrays."""
        if set(state.arrays) != set(self._arrays):
            odd = sorted(set(state.arrays) ^ set(self._arrays))[0]
            raise SceneError(f"the state to start from does not fit: {odd!r} is on one side only")
        for name, array in self._arrays.items():
            found, wanted = state.arrays[name], array.numpy()
            if found.shape != wanted.shape:
                raise SceneError(
                    f"the state to start from does not fit: {name} has shape {found.shape} and not {wanted.shape}"
                )
            if not np.isfinite(found).all():
                raise SceneError(f"the state to start from is not good: {name} is not finite")
            array.assign(found.astype(wanted.dtype))

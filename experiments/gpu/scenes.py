"""Small, short scenes that together use every kernel of the solver in every form: bodies, walls, effects, ghost layers,
one scene alone and several in one launch."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

sys.path.insert(1, str(Path(__file__).resolve().parents[2] / "support"))

from mpm_warp import (
    Bed,
    Body,
    Column,
    Effects,
    Frame,
    Incline,
    Material,
    Scene,
    Solver,
    Walls,
    Wheel,
    frames_together,
)
from mpm_warp.bodies import Box, MeshBody
from sgns_testing.meshes import BOX_FACES, box_corners, write_obj
from sgns_testing.scenes import UNDAMPED, cut

FARTHEST, FORCE = 1e-4, 0.01
"""Ways to compute a case agree if no particle is farther off [m] and the forces differ by no larger share: what the
tests allow between CPU and GPU."""

COARSE = Material(grain_diameter=5e-3)  # so that flow spreads over some cells of these grids
BEADS = Material(
    youngs_modulus=1.0e5,
    grain_density=2450.0,
    packing=0.6,
    grain_diameter=0.003,
    static_friction=0.3819,
    limit_friction=0.6435,
    nonlocal_amplitude=0.48,
)
BED = Bed(size=(0.48, 0.4, 0.16), spacing=0.02, headroom=0.12)
DYNAMIC = Effects(fluidity=True, nonlocality=True)


@dataclass(frozen=True)
class Case:
    """Scenes that are computed in one go, with the same effects."""

    name: str
    scenes: tuple[Scene, ...]
    effects: Effects = Effects()  # noqa: RUF009, it is frozen

    @property
    def particles(self) -> int:
        return sum(len(scene.initial_positions()) for scene in self.scenes)


@dataclass(frozen=True)
class Outcome:
    """What came of a case."""

    position: np.ndarray
    """Of all scenes' particles in their last frame [m], shape (n, 3)."""
    force: np.ndarray
    """Of all frames and scenes [N], shape (m, 3)."""
    size: float
    """Of all forces, root mean square over the frames [N]; 0 without a body."""

    def moved_apart(self, other: Outcome) -> tuple[float, float]:
        """Distance of the particles in two outcomes of one case [m]: the largest and the root mean square."""
        distance = np.linalg.norm(self.position - other.position, axis=1)
        return float(distance.max()), float(np.sqrt(np.mean(distance**2)))

    def pushed_apart(self, other: Outcome) -> float:
        """Root mean square difference of the forces over that of the forces."""
        if self.size == 0.0:
            return 0.0
        return float(np.sqrt(np.mean(np.sum((self.force - other.force) ** 2, axis=1)))) / self.size


def outcome(case: Case, device: str = "cpu", precision: str = "float32") -> Outcome:
    """Compute a case: a scene alone by its solver, several in one launch."""
    frames: dict[int, list[Frame]] = {number: [] for number in range(len(case.scenes))}
    if len(case.scenes) == 1:
        computed = ((0, frame) for frame in Solver(case.scenes[0], case.effects, device, precision).frames())
    else:
        computed = frames_together(case.scenes, case.effects, device, precision)
    for number, frame in computed:
        if not isinstance(frame, Frame):
            raise frame
        frames[number].append(frame)
    force = np.array([frame.force for found in frames.values() for frame in found], dtype=float)
    position = np.concatenate([found[-1].position for found in frames.values()]).astype(float)
    return Outcome(position, force, float(np.sqrt(np.mean(np.sum(force**2, axis=1)))))


def cases(folder: Path) -> list[Case]:
    """All of them; `folder` takes the file of a mesh."""
    return [*_cuts(), *_other_bodies(folder), *_flows(), *_together()]


def _early(**kw) -> Scene:
    """A cut whose blade touches the soil from the first frame on."""
    return cut(**({"clearance": 0.0, "duration": 0.1} | kw))


def _wide(width: float) -> Bed:
    return Bed(size=(0.5, width, 0.16), spacing=0.025, headroom=0.12)


def _cuts() -> list[Case]:
    elastic = Effects(yielding=False, rate_dependence=False, separation=False, torque=False)
    walls = Walls(x="slip", y=0.3, floor=0.5)
    return [
        Case("cut", (_early(),)),
        Case("cut, elastic soil", (_early(),), elastic),
        Case("cut, friction at the walls", (_early(bed=replace(BED, walls=walls)),)),
        Case("cut, fluidity", (_early(material=COARSE),), Effects(fluidity=True)),
        Case("cut, nonlocality", (_early(material=COARSE),), Effects(nonlocality=True)),
        Case(
            "cut, fluidity and nonlocality, walls free of flow",
            (_early(material=replace(COARSE, fluidity_at_walls="free")),),
            DYNAMIC,
        ),
        Case("half a cut, particles on its plane", (_early(bed=_wide(0.375)),), Effects(symmetry=True)),
        Case("half a cut, none on its plane", (_early(bed=_wide(0.4)),), Effects(symmetry=True)),
        Case(
            "half a cut, fluidity and nonlocality",
            (_early(bed=_wide(0.375), material=COARSE),),
            replace(DYNAMIC, symmetry=True),
        ),
    ]


def _other_bodies(folder: Path) -> list[Case]:
    wheel = Wheel(bed=BED, duration=0.1, settle=0.03, load=60.0, **UNDAMPED)
    bars = {"grousers": 12, "grouser_height": 0.02, "grouser_thickness": 0.01}
    rows = [(0.0, 0.2, 0.03), (0.05, 0.21, -0.01), (0.1, 0.23, -0.02)]
    path = tuple((t, x, 0.2, z, 0.0, 0.0, 0.0, 1.0) for t, x, z in rows)
    size = (0.062, 0.104, 0.1)
    file = write_obj(folder / "box.obj", box_corners(size, (1.0, 2.0, 3.0)), BOX_FACES)
    pushed = Body(bed=BED, tool=Box(size=size), path=path, duration=0.1)
    return [
        Case("wheel", (wheel,)),
        Case("wheel with grousers that hold the soil", (replace(wheel, bilateral=True, **bars),)),
        Case("half a wheel", (wheel,), Effects(symmetry=True)),
        Case(
            "turned wheel, load over time",
            (replace(wheel, slip_angle=30.0, load=((0.0, 60.0), (0.1, 90.0))),),
        ),
        Case("pushed box", (pushed,)),
        Case("pushed mesh", (replace(pushed, tool=MeshBody(file=str(file))),)),
    ]


def _flows() -> list[Case]:
    endless = Walls("periodic", "periodic")
    column = Bed(size=(0.2, 0.2, 0.06), spacing=0.01, headroom=0.03)
    slope = Bed(size=(0.012, 0.012, 0.03), spacing=0.003, headroom=0.006, walls=endless)
    layer = Bed(size=(0.003, 0.003, 0.009), spacing=0.00075, headroom=0.003, walls=endless)
    trough = Bed(size=(0.03, 0.036, 0.03), spacing=0.003, headroom=0.006, walls=Walls("periodic", "slip"))
    flow = Incline(bed=slope, material=BEADS, tilt=26.0, duration=0.1, frame_rate=20.0)
    resting = {"flowing": False, "tilt": 24.0}
    return [
        Case("column", (Column(bed=column, radius=0.05, duration=0.1),)),
        Case("half a column", (Column(bed=column, radius=0.05, duration=0.1),), Effects(symmetry=True)),
        Case("incline", (flow,)),
        Case("incline, fluidity", (flow,), Effects(fluidity=True)),
        Case("thin layer", (replace(flow, bed=layer, duration=0.05, **resting),), Effects(nonlocality=True)),
        Case(
            "thin layer, fluidity and nonlocality",
            (replace(flow, bed=layer, duration=0.05, **resting),),
            DYNAMIC,
        ),
        Case(
            "half a trough, periodic along it",
            (replace(flow, bed=trough, duration=0.05),),
            replace(DYNAMIC, symmetry=True),
        ),
    ]


def _together() -> list[Case]:
    layers = [
        Bed(size=(length, 0.06, 0.05), spacing=0.01, headroom=0.02, walls=Walls("periodic", "periodic"))
        for length in (0.06, 0.1)
    ]
    slopes = tuple(Incline(bed=bed, material=Material(), tilt=40.0, duration=0.1) for bed in layers)
    halves = tuple(_early(bed=_wide(width), material=COARSE, duration=0.05) for width in (0.375, 0.4))
    return [
        Case(
            "three cuts together",
            (
                _early(),
                _early(duration=0.12, rake=30.0, gravity=1.62, material=Material(youngs_modulus=2.0e6)),
                _early(duration=0.08, bed=Bed(size=(0.5, 0.3, 0.1), spacing=0.025, headroom=0.12)),
            ),
        ),
        Case(
            "two wheels together",
            tuple(
                Wheel(bed=BED, duration=0.08, settle=0.02, load=load, **UNDAMPED) for load in (60.0, 100.0)
            ),
        ),
        Case(
            "half cuts together, fluidity and nonlocality",
            (*halves, replace(halves[0], depth=0.04, rake=20.0)),
            replace(DYNAMIC, symmetry=True),
        ),
        Case("inclines together", slopes),
    ]

"""Thin, loose, thrown, shaken and squeezed soil."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from leakage import leakage

from mpm_warp import (
    Bed,
    Body,
    Box,
    Column,
    Effects,
    Excavation,
    Frame,
    Incline,
    Material,
    Scene,
    Solver,
    Walls,
)
from sgns_testing.scenes import BlockBed, block, cut

from .measures import energies, frames_of, shares, stopped_with, top_speed, volume_gain, work_on_soil


@dataclass(frozen=True)
class OneLayer(Bed):
    """Only the particles of the lowest layer."""

    @property
    def filled(self):
        positions, volume = Bed.filled.func(self)
        return positions[positions[:, 2] < positions[:, 2].min() + 1e-6], volume


@dataclass(frozen=True)
class Grains(Bed):
    """Single particles, four cells from each other, in the air."""

    @property
    def filled(self):
        h = self.spacing
        axes = [np.arange(4.0 * h, s - 4.0 * h, 4.3 * h) for s in self.size[:2]]
        heights = np.arange(2.0 * h, self.headroom - 6.0 * h, 4.3 * h)
        places = np.stack(np.meshgrid(*axes, heights, indexing="ij"), axis=-1).reshape(-1, 3)
        return places, Bed.filled.func(self)[1]


@dataclass(frozen=True)
class Thrown(Scene):
    """Soil that starts with velocities."""

    kind: str = "thrown"
    upwards: float = 0.0
    """[m/s]"""
    spread: float = 0.0
    """Largest component of a random velocity besides [m/s]."""

    def initial_velocities(self) -> np.ndarray:
        random = np.random.default_rng(0).uniform(-1.0, 1.0, self.filled[0].shape)
        return self.spread * random + [0.0, 0.0, self.upwards]


@dataclass(frozen=True)
class Shifted(Bed):
    """A lattice whose particles lie on the grid's nodes, walls, floor, edges and corners of the bin included."""

    @property
    def filled(self):
        axes = [np.arange(round(s / self.spacing) + 1) * self.spacing for s in self.size]
        axes[2] = axes[2] - self.size[2]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3), self.spacing**3


def one_layer_at_rest() -> float:
    bed = OneLayer(size=(0.2, 0.2, 0.08), spacing=0.02, initial_stress="none")
    scene = Scene(bed=bed, duration=1.0)
    last = frames_of(scene, every=10**6)[-1]
    return 1000.0 * float(np.abs(last.position - scene.initial_positions()).max())


def energy_gain(scene: Scene) -> tuple[float, str]:
    """Energy that appears in a scene without a body, over what there was [%]."""
    energy = energies(scene, frames_of(scene))
    gain = max(0.0, float(energy.max() / energy[0] - 1.0))
    return 100.0 * gain, f"at the end {100 * energy[-1] / energy[0]:.0f} %"


def beyond_walls(scene: Scene, frames: list[Frame]) -> float:
    """How far soil is beyond the bin's walls or floor in any frame [mm]."""
    lx, ly, lz = scene.bed.size
    outside = [np.max(np.maximum(-f.position, f.position - [lx, ly, 1e3])[:, :2]) for f in frames]
    below = [np.max(-lz - f.position[:, 2]) for f in frames]
    return 1000.0 * max(0.0, float(np.max([outside, below])))


@dataclass(frozen=True)
class Strip(OneLayer):
    """The same, with bare floor up to a place along x."""

    bare: float = 0.0
    """[m]"""

    @property
    def filled(self):
        positions, volume = OneLayer.filled.fget(self)
        return positions[positions[:, 0] > self.bare], volume


def one_layer_scraped() -> tuple[float, str]:
    bed = Strip(size=(0.48, 0.4, 0.08), spacing=0.02, headroom=0.2, initial_stress="none", bare=0.14)
    scene = cut(bed=bed, motion="path", path=along(0.104, 0.304, 0.1, 0.021, 1.0), duration=1.0)
    frames = frames_of(scene)
    return shares(
        {
            "leakage": (100.0 * leakage(frames, scene.body), 1.0, "%"),
            "speed": (top_speed(frames), 2.0, "m/s"),
            "force": (max(float(np.linalg.norm(f.force)) for f in frames), 200.0, "N"),
        }
    )


def along(x0: float, x1: float, start: float, z: float, end: float, y: float = 0.2):
    """A path at rest until `start`, then along x at one height."""
    rows = [(0.0, x0), (start, x0), (end, x1)]
    return tuple((t, x, y, z, 0.0, 0.0, 0.0, 1.0) for t, x in rows)


def flight() -> float:
    bed = Grains(size=(0.4, 0.4, 0.1), spacing=0.01, headroom=0.4, initial_stress="none")
    scene = Thrown(bed=bed, upwards=0.5, spread=0.02, duration=0.1, frame_rate=20.0)
    solver = Solver(scene)
    *_, last = solver.frames()
    count = (scene.frame_count - 1) * solver.substeps_per_frame
    fall = 0.5 * scene.gravity * solver.time_step**2 * count * (count + 1)
    exact = scene.initial_positions() + scene.duration * scene.initial_velocities() - [0.0, 0.0, fall]
    return 1000.0 * float(np.abs(last.position - exact).max())


LOOSE = {"spacing": 0.02, "initial_stress": "none", "walls": Walls("slip", "slip")}


def thrown_and_settled(per_cell: float) -> tuple[float, str]:
    bed = Bed(size=(0.32, 0.32, 0.16), particles_per_cell=per_cell, headroom=0.6, **LOOSE)
    scene = Thrown(bed=bed, upwards=1.0, spread=0.5, duration=2.0)
    last = frames_of(scene, every=10**6)[-1]
    gain = 100.0 * volume_gain(scene, last.position)
    return abs(gain), f"{gain:+.2f} %"


def grains_and_settled(per_cell: float) -> tuple[float, str]:
    side = 0.32 / math.sqrt(
        per_cell
    )  # as many grains for any number per cell: so few that chance counts for 1.4 %
    bed = Rain(size=(side, side, 0.08), particles_per_cell=per_cell, headroom=3.0, **LOOSE)
    scene = Thrown(bed=bed, spread=0.3, duration=2.0)
    last = frames_of(scene, every=10**6)[-1]
    layer = np.sort(last.position[:, 2] + bed.size[2])
    # All of them together fill the bin to its surface; half of them lie below half of the height.
    gain = 100.0 * (float(np.median(layer)) / (0.5 * bed.size[2]) - 1.0)
    return abs(gain), f"median height {gain:+.2f} % off that of the full bed"


@dataclass(frozen=True)
class Rain(Bed):
    """The full bed's particles, drawn apart upwards by a factor of twelve."""

    @property
    def filled(self):
        positions, volume = Bed.filled.func(self)
        raised = np.add(positions, [0.0, 0.0, self.size[2]])
        return raised * [1.0, 1.0, 12.0], volume


def dropped_block(speed: float, cohesion: float = 0.0) -> tuple[float, str]:
    size, ends = (0.3, 0.3, 0.3), {"low": (0.1, 0.1, -0.28), "high": (0.2, 0.2, -0.18)}
    bed = BlockBed(size=size, spacing=0.01, initial_stress="none", headroom=0.2, **ends)
    soil = Material(cohesion=cohesion)
    scene = Thrown(bed=bed, material=soil, upwards=-speed, duration=0.2, frame_rate=400.0)
    return energy_gain(scene)


def impact(speed: float) -> tuple[float, str]:
    """A box hits the bed at `speed` and stops 3 cm deep: energy of the soil over the work done on it [-]."""
    bed = Bed(size=(0.4, 0.4, 0.16), spacing=0.02, headroom=1.0)
    start, stop = 0.03 + 0.02, 0.03 - 0.03
    end = (start - stop) / speed
    rows = ((0.0, start), (end, stop), (0.2, stop))
    path = tuple((t, 0.2, 0.2, z, 0.0, 0.0, 0.0, 1.0) for t, z in rows)
    scene = Body(bed=bed, tool=Box(size=(0.1, 0.1, 0.06)), path=path, duration=0.1, frame_rate=1000.0)
    frames = frames_of(scene)
    gained, work = energies(scene, frames) - energies(scene, frames)[0], work_on_soil(frames)
    moving = slice(round(end * 1000.0), None)
    ratio = float(np.max(gained[moving] / work[moving]))
    peak = max(float(np.linalg.norm(f.force)) for f in frames)
    return ratio, f"work {work[-1]:.3g} J, peak force {peak:.3g} N, top speed {top_speed(frames):.3g} m/s"


def push_without_gravity() -> tuple[float, str]:
    free = block()
    path = ((0.0, 0.08, 0.15, -0.15, 0, 0, 0, 1), (1.0, 1.08, 0.15, -0.15, 0, 0, 0, 1))
    scene = cut(bed=free.bed, gravity=0.0, motion="path", path=path, duration=0.05, frame_rate=200.0)
    solver = Solver(scene)
    impulse = sum(f.force for f in solver.frames()) / scene.frame_rate
    gained = solver.grid.particle_mass * solver.particles.velocity.numpy().astype(float).sum(axis=0)
    return float(np.linalg.norm(impulse + gained) / np.linalg.norm(gained)), f"{gained[0]:.3g} N s given"


def free_block_in_nothing() -> float:
    scene = block(gravity=0.0, duration=0.5, frame_rate=20.0)
    *_, last = Solver(scene).frames()
    return 1000.0 * float(np.abs(last.position - scene.initial_positions()).max())


def on_nodes() -> tuple[float, str]:
    bed = Shifted(size=(0.2, 0.2, 0.1), spacing=0.02, initial_stress="none")
    scene = Scene(bed=bed, duration=1.0)
    frames = frames_of(scene, every=10)
    moved = float(np.abs(frames[-1].position - scene.initial_positions()).max())
    return shares(
        {
            "displacement": (1000.0 * moved, 2.0, "mm"),
            "beyond walls and floor": (beyond_walls(scene, frames), 1.0, "mm"),
            "speed at the end": (top_speed(frames[-1:]), 0.01, "m/s"),
        }
    )


def against_the_wall() -> tuple[float, str]:
    """A plate as wide as the bin pushes its soil against the end wall, down to two cells from it."""
    bed = Bed(size=(0.32, 0.16, 0.12), spacing=0.02, headroom=0.6)
    path = along(0.06, 0.25, 0.05, 0.0, 1.0, y=0.08)
    tool = Box(size=(0.06, 0.158, 0.22))
    scene = Body(bed=bed, tool=tool, path=path, duration=1.2, frame_rate=100.0)
    frames = frames_of(scene)
    beyond = max(float(np.max(f.position[:, 0] - 0.32)) for f in frames)
    # What soil under the peak pressure has as its speed when the pressure is let go, 2 sigma / (rho c), and never more
    # than half the speed of its waves.
    wave = scene.material.wave_speed
    pressure = max(float(np.linalg.norm(f.force)) for f in frames) / (0.158 * 0.12)
    release = min(2.0 * pressure / (scene.material.bulk_density * wave), 0.5 * wave)
    return shares(
        {
            "beyond the wall": (1000.0 * max(beyond, 0.0), 1.0, "mm"),
            "speed": (top_speed(frames), 0.2 + release, "m/s"),
            "leakage": (100.0 * leakage(frames, scene.body, edge=0.02), 5.0, "%"),
        }
    )


def walls_hold(kind: str | float) -> float:
    walls = Walls(kind, kind, kind)
    bed = Bed(size=(0.2, 0.2, 0.1), spacing=0.02, headroom=0.5, initial_stress="none", walls=walls)
    scene = Thrown(bed=bed, spread=2.0, duration=0.5)
    return beyond_walls(scene, frames_of(scene))


def cohesive_block_bursts() -> tuple[float, str]:
    """A block whose particles fly apart at up to 2 m/s: energy that appears, and momentum that does."""
    scene = Thrown(
        bed=block().bed, material=Material(cohesion=2000.0), gravity=0.0, spread=2.0, duration=0.03
    )
    solver = Solver(scene)
    before = scene.initial_velocities().mean(axis=0)
    *_, _ = solver.frames()
    gained = np.linalg.norm(solver.particles.velocity.numpy().astype(float).mean(axis=0) - before)
    torn = float((solver.particles.bond.numpy() == 0.0).mean())
    energy, note = energy_gain(scene)
    return shares({"energy": (energy, 1.0, "%"), "momentum": (1e3 * gained, 1e-3, "mm/s")})[0], (
        f"{note}; {100.0 * torn:.0f} % torn"
    )


def column_falls(cohesion: float = 0.0) -> tuple[float, str]:
    bed = Bed(size=(0.8, 0.12, 0.32), spacing=0.02, headroom=0.05, walls=Walls(y="slip"))
    scene = Column(bed=bed, material=Material(cohesion=cohesion), radius=0.04, shape="slab", duration=0.8)
    return energy_gain(scene)


def steep_slope() -> tuple[float, str]:
    """A layer on an endless slope of 60 degrees slides off as a block: error of its speed after 0.5 s [%].

    Its base cannot hold it: friction there is at most mu_2, at least mu_s.
    """
    bed = Bed(size=(0.08, 0.08, 0.08), spacing=0.02, headroom=0.08, walls=Walls("periodic", "periodic"))
    scene = Incline(bed=bed, material=Material(), flowing=False, tilt=60.0, duration=0.5, gravity=9.81)
    last = frames_of(scene, every=10**6)[-1]
    speed = float(last.velocity[:, 0].mean())
    low, high = (
        scene.gravity * scene.duration * (np.sin(np.radians(60.0)) - mu * np.cos(np.radians(60.0)))
        for mu in (scene.material.limit_friction, scene.material.static_friction)
    )
    off = max(0.0, low - speed, speed - high)
    return 100.0 * off / high, f"{speed:.3g} m/s, between {low:.3g} and {high:.3g} m/s by theory"


def volume_after_a_deep_cut(per_cell: float) -> tuple[float, str]:
    bed = Bed(spacing=0.02, particles_per_cell=per_cell)
    scene = Excavation(bed=bed, depth=0.10, speed=0.15, rake=0.0, motion="curved", duration=4.0)
    last = frames_of(scene, every=10**6, effects=Effects(symmetry=True))[-1]
    change = 100.0 * volume_gain(scene, last.position)
    return abs(change), f"{change:+.2f} %"


def out_of_the_grid() -> tuple[float, str]:
    scene = Thrown(bed=replace(block().bed, headroom=0.05), upwards=3.0, duration=0.3)
    return stopped_with(scene, "raise scene.bed.headroom")


def cone(slope: float, duration: float) -> Scene:
    """A cone 8 cm high with sides of a slope [degrees], on 4 cm of soil."""
    fall = math.tan(math.radians(slope))
    bed = Bed(size=(0.32, 0.32, 0.08), spacing=0.01, particles_per_cell=8.0, headroom=0.2)
    steep = replace(bed, surface=lambda x, y: np.maximum(-0.04, 0.04 - fall * np.hypot(x - 0.16, y - 0.16)))
    return Scene(bed=steep, duration=duration)


def heap_at_repose() -> tuple[float, str]:
    """As steep as the friction angle tells: how far particles move in 2 s, but one in a thousand [mm]."""
    scene = cone(math.degrees(math.atan(Material().static_friction)), 2.0)
    first, *_, last = frames_of(scene, every=60)
    moved = 1e3 * np.linalg.norm(last.position - first.position, axis=1)
    words = f"mean {moved.mean():.3g} mm; the furthest, at the tip, {moved.max():.3g} mm"
    return float(np.quantile(moved, 0.999)), words


def steep_heap() -> tuple[float, str]:
    scene = cone(70.0, 1.0)
    frames = frames_of(scene, every=5)
    energy = energies(scene, frames)
    return shares(
        {
            "speed": (top_speed(frames), math.sqrt(2.0 * 9.81 * 0.08), "m/s"),
            "speed at the end": (top_speed(frames[-1:]), 0.05, "m/s"),
            "volume gain": (100.0 * volume_gain(scene, frames[-1].position), 3.0, "%"),
            "energy gained": (100.0 * float(energy.max() / energy[0] - 1.0), 0.1, "%"),
            "beyond walls and floor": (beyond_walls(scene, frames), 1.0, "mm"),
        }
    )


MEASURES = {
    "heap as steep as its friction angle": heap_at_repose,
    "cone of 70 degrees slumps": steep_heap,
    "one layer of particles at rest": one_layer_at_rest,
    "one layer of particles scraped off": one_layer_scraped,
    "single grains in flight": flight,
    **{f"bed thrown up and settled ({n} per cell)": partial(thrown_and_settled, n) for n in (1, 4, 8)},
    **{f"rain of grains becomes a layer ({n} per cell)": partial(grains_and_settled, n) for n in (1, 4)},
    "block hits the floor at 5 m/s": partial(dropped_block, 5.0),
    "tool hits the bed at 5 m/s": partial(impact, 5.0),
    "zero gravity, nothing touches": free_block_in_nothing,
    "zero gravity, a plate pushes": push_without_gravity,
    "particles on every node, walls and corners included": on_nodes,
    "soil pushed against a wall": against_the_wall,
    **{f"soil thrown against walls ({kind})": partial(walls_hold, kind) for kind in ("no_slip", "slip", 0.3)},
    "column four times as high as wide": column_falls,
    "cohesive column (300 Pa) falls": partial(column_falls, 300.0),
    "cohesive block (2 kPa) hits the floor at 5 m/s": partial(dropped_block, 5.0, 2000.0),
    "cohesive block (2 kPa) bursts": cohesive_block_bursts,
    "endless slope of 60 degrees": steep_slope,
    **{
        f"volume after the deepest, fastest cut ({n} per cell)": partial(volume_after_a_deep_cut, n)
        for n in (1, 4)
    },
    "soil thrown out of the grid": out_of_the_grid,
}

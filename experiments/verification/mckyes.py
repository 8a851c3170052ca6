"""A rough blade is pushed through deep soil: the earth-moving equation with the wedge of McKyes and Ali (1977)."""

from __future__ import annotations

import math
import tempfile
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from mpm_warp import Bed, Effects, Material, MeshBody, Scene, Solver, Walls
from mpm_warp.bodies import WEDGE

ANGLE = math.degrees(math.atan(0.76))  # of friction, of the paper's sand [degrees]
WALL_ANGLE = math.atan(0.3)  # of friction between soil and blade [rad]
WIDTH = 0.457  # of the blade of the excavations [m]
THICKNESS = 0.028  # of that blade [m]
HEIGHT = 0.25  # of the blade here [m]
LENGTH = 0.7  # of the bin [m]
FACE = 0.15  # about where the lower front edge starts [m]
MEASURED = (0.012, 0.032)  # travel over which forces are averaged: one cell of the coarsest grid [m]
MAPS = ("sin", "tan")
RAKES = (0.0, 10.0, 30.8)
SPACINGS = (0.02, 0.08 / 6, 0.01)


@dataclass(frozen=True)
class BuriedBlade(Scene):
    """A raked blade whose lower front edge is at `depth`, with an open trench behind it, moves along x."""

    kind: str = "buried_blade"
    blade: MeshBody = field(kw_only=True)
    rake: float = 0.0
    """Of the front from vertical, tip leading [degrees]."""
    depth: float = 0.08
    """[m]"""
    speed: float = 0.05
    """[m/s]"""

    @property
    def body(self) -> MeshBody:
        return self.blade

    @property
    def filled(self) -> tuple[np.ndarray, float]:
        positions, volume = self.bed.filled
        x, y, z = positions.T
        lean = math.radians(self.rake)
        front = FACE - (z + self.depth) * math.tan(lean) + self.contact_distance / math.cos(lean)
        trench = (
            (x < front) & (z > -self.depth) & (np.abs(y - 0.5 * self.bed.size[1]) < self.blade.half_size[1])
        )
        return positions[~trench], volume

    @cached_property
    def gap(self) -> float:
        """How far the front stands from the soil in front of it at FACE, along x [m]."""
        x, y, z = self.filled[0].T
        facing = (z > -self.depth) & (np.abs(y - 0.5 * self.bed.size[1]) < self.blade.half_size[1])
        lean = math.radians(self.rake)
        off = x[facing] - FACE + (z[facing] + self.depth) * math.tan(lean)
        return float(np.min(off)) - self.contact_distance / math.cos(lean)

    @property
    def soil_volume(self) -> float:
        positions, volume = self.filled
        return len(positions) * volume

    def poses_at(self, time: np.ndarray) -> np.ndarray:
        poses = super().poses_at(time)
        corners = self.blade.mesh[0]
        edge = np.array([np.max(corners[:, 0]), 0.0, np.min(corners[:, 2])])  # the lower front one
        poses[:, :3] = [FACE, 0.5 * self.bed.size[1], -self.depth] - edge
        poses[:, 0] += self.gap + self.speed * np.atleast_1d(time)
        return poses


def level_blade(rake: float, width: float, end: str = "level") -> MeshBody:
    """A blade like the plate of the excavations but cut off level below, so that only its front meets soil.

    Args:
        rake: of the front from vertical, tip leading [degrees].
        width: [m].
        end: level, or bevel: that of a plate with such an edge.
    """
    c, s, t = (f(math.radians(rake)) for f in (math.cos, math.sin, math.tan))
    back, lean = THICKNESS / c, HEIGHT * t
    section = [(0.0, 0.0), (-lean, HEIGHT), (-lean - back, HEIGHT), (-back, 0.0)]
    if end == "bevel":
        up = THICKNESS * (c / math.tan(math.radians(WEDGE)) - s)
        section[3] = (-back - up * t, up)
    vertices = [(x, y, z) for y in (-0.5 * width, 0.5 * width) for x, z in section]
    faces = ["4 3 2 1", "5 6 7 8", "1 2 6 5", "2 3 7 6", "3 4 8 7", "4 1 5 8"]
    lines = [f"v {x} {y} {z}" for x, y, z in vertices] + [f"f {face}" for face in faces]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "blade.obj"
        file.write_text("\n".join(lines) + "\n")
        return MeshBody(file=str(file), friction=math.tan(WALL_ANGLE))


def buried_blade(
    friction_map: str,
    rake: float = 0.0,
    depth: float = 0.08,
    spacing: float = 0.02,
    bin_width: float = 0.0,
    end: str = "level",
) -> BuriedBlade:
    """A blade in soil with the numerics of `scene=excavation`; endless in y if `bin_width` is 0."""
    bed = Bed(
        size=(LENGTH, bin_width or 4.0 * spacing, 0.16),
        spacing=spacing,
        particles_per_cell=4.0,
        headroom=0.12,
        walls=Walls("no_slip", "no_slip" if bin_width else "periodic", "no_slip"),
    )
    return BuriedBlade(
        bed=bed,
        material=Material(friction_angle=ANGLE, friction_map=friction_map),
        blade=level_blade(rake, WIDTH if bin_width else 1.0, end),
        rake=rake,
        depth=depth,
        duration=MEASURED[1] / BuriedBlade.speed,
        frame_rate=200.0,
    )


def force_per_width(scene: BuriedBlade) -> tuple[float, float]:
    """Against the motion and downwards, per metre of blade, mean over the MEASURED travel [N/m]."""
    endless = scene.bed.walls.y == "periodic"
    frames = Solver(scene, Effects(symmetry=not endless)).frames()
    force = np.array([f.force for f in frames])[scene.times() * scene.speed >= MEASURED[0]]
    width = scene.bed.size[1] if endless else WIDTH
    return -force[:, 0].mean() / width, -force[:, 2].mean() / width


def wedge(
    angle: float,
    rake: float,
    depth: float,
    width: float = math.inf,
    swept: float | None = None,
    cohesion: float = 0.0,
) -> tuple[float, float]:
    """Force on the blade per metre, against the motion and downwards [N/m], by McKyes and Ali (1977).

    A wedge in front of the blade and a piece of a cone at each side rest on the blade and slide on a plane through the
    tip: that plane which needs the least force. Their surcharge is the soil swept up before.

    Args:
        angle: of friction in the soil [degrees].
        rake: of the blade from vertical [degrees].
        depth: [m].
        width: of the blade [m]; infinite: the wedge alone.
        swept: soil swept up per metre of blade [m^2]; None: that of the travel before the force is measured.
        cohesion: of the soil, on the wedge's plane only: for an infinite width [Pa].
    """
    swept = depth * float(np.mean(MEASURED)) if swept is None else swept
    soil = Material()
    phi, lean = math.radians(angle), math.radians(90.0 - rake)
    turned = lean + WALL_ANGLE  # of the blade's force from the vertical
    plane = np.radians(np.linspace(3.0, 80.0, 2000))
    plane = plane[turned + plane + phi < math.pi - 0.05]
    ahead = 1.0 / math.tan(lean) + 1.0 / np.tan(plane)  # length of the wedge at the surface, in depths
    aside = np.sqrt(ahead**2 - 1.0 / math.tan(lean) ** 2)  # reach of the cones to the side, in depths
    weight = 0.5 * ahead * (1.0 + 2.0 * aside * depth / (3.0 * width)) + swept / depth**2
    unit = soil.bulk_density * Scene().gravity
    weight = weight + cohesion / (unit * depth) * math.cos(phi) / (np.sin(plane) * np.sin(plane + phi))
    least = np.min(weight / (math.cos(turned) + math.sin(turned) / np.tan(plane + phi)))
    force = unit * depth**2 * least
    return force * math.sin(turned), force * math.cos(turned)


def cases() -> list[dict]:
    """Arguments of `buried_blade` of every run."""
    plane = [
        {"friction_map": m, "rake": rake, "spacing": h} for h in SPACINGS for m in MAPS for rake in RAKES
    ]
    plane += [plane[0] | {"rake": rake, "spacing": SPACINGS[1], "end": "bevel"} for rake in RAKES]
    bins = [(0.04, 0.02, 1.2), (0.06, 0.02, 1.2), *((0.08, h, w) for w in (1.2, 0.6) for h in (0.02, 0.01))]
    return plane + [
        {"friction_map": m, "depth": depth, "spacing": h, "bin_width": width}
        for m in MAPS
        for depth, h, width in bins
    ]


def measure() -> list[dict]:
    rows = []
    for case in cases():
        scene = buried_blade(**case)
        along, down = force_per_width(scene)
        width = WIDTH if case.get("bin_width") else math.inf
        own = math.degrees(math.asin(scene.material.static_friction))
        row = {
            "friction_map": case["friction_map"],
            "rake": scene.rake,
            "depth": scene.depth,
            "spacing": scene.bed.spacing,
            "end": case.get("end", "level"),
            "bin_width": case.get("bin_width", math.inf),
            "draft": along,
            "down": down,
        }
        for name, angle in (("own", own), ("nominal", ANGLE)):
            row[f"angle_{name}"] = angle
            row[f"draft_{name}"], row[f"down_{name}"] = wedge(angle, scene.rake, scene.depth, width)
        rows.append(row)
    return rows

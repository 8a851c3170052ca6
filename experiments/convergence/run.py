"""Why the second half of the reference cut grows with every refinement: the cut in bins and with laws that say so.

    python experiments/convergence/run.py [--only slice,bevel ...] [--finest 5]

`slice` is the cut in plane strain: a bin two cells wide with smooth sides, forces per metre of width. `bin` is the
reference cut itself, in newtons. Every finished run is kept as a line of table.csv and is not made again.
"""

from __future__ import annotations

import argparse
import logging
import math
import sys
import time
from dataclasses import replace
from pathlib import Path

sys.path.insert(1, str(Path(__file__).resolve().parents[1]))
sys.path.insert(2, str(Path(__file__).resolve().parents[1] / "verification"))

import mckyes
import numpy as np
from common import read_rows, write_rows

from mpm_warp import Bed, Effects, Excavation, Material, Plate, Solver, Walls
from mpm_warp.poses import in_world_frame

HERE = Path(__file__).parent
SPACINGS = {20.0: 0.02, 13.3: 0.8 / 60, 10.0: 0.01, 6.7: 0.8 / 120, 5.0: 0.005, 3.3: 0.01 / 3}
"""Name [mm] → grid spacing [m]."""
HEAP = 0.99  # of the columns of soil along x, the share below the heap's height
COLUMN = 0.02  # their width [m]

VARIANTS: dict[str, dict] = {
    "slice": {},
    "slice, level": {"edge": "level"},
    "slice, bevel": {"edge": "bevel"},
    "slice, margin 0": {"margin": 0.0},
    "slice, contact 2.5 mm inside": {"inside": 0.0025},
    "slice, walls further away": {"length": 1.2, "depth_of_bed": 0.30},
    "slice, length 10 mm": {"length_scale": 0.010},
    "slice, length 20 mm": {"length_scale": 0.020},
    "slice, length 40 mm": {"length_scale": 0.040},
    "slice, bevel, margin -0.375": {"edge": "bevel", "margin": -0.375},
    "slice, bevel, margin -0.5": {"edge": "bevel", "margin": -0.5},
    "slice, bevel, margin -0.75": {"edge": "bevel", "margin": -0.75},
    "slice, bevel, length 10 mm": {"edge": "bevel", "length_scale": 0.010},
    "slice, bevel, length 20 mm": {"edge": "bevel", "length_scale": 0.020},
    "slice, bevel, friction map sin": {"edge": "bevel", "friction_map": "sin"},
    "bin": {"wide": True},
    "bin, level": {"wide": True, "edge": "level"},
    "bin, bevel": {"wide": True, "edge": "bevel"},
    "bin, bevel, margin -0.375": {"wide": True, "edge": "bevel", "margin": -0.375},
    "bin, bevel, margin -0.5": {"wide": True, "edge": "bevel", "margin": -0.5},
}


def cut(
    h: float,
    *,
    wide: bool = False,
    edge: str = "square",
    margin: float = -0.25,
    inside: float | None = None,
    length: float = 0.8,
    depth_of_bed: float = 0.15,
    length_scale: float = 0.0,
    friction_map: str = "",
) -> tuple[Excavation, Effects]:
    """The first 2 s of the reference cut, 80 mm deep.

    Args:
        h: grid spacing [m].
        wide: the reference bin with 4 particles per cell; else a slice with 8.
        edge: of the plate.
        margin: where the soil's edge, half a particle spacing from a particle's centre, is when contact begins [grid
            spacings]; with -1/4 and 8 particles per cell the centre is then at the surface on every grid.
        inside: how far inside the plate's surface the centre is instead [m].
        length, depth_of_bed: of the bin [m]; the cut keeps its distance from the wall behind it.
        length_scale: A d of the nonlocal law [m]; grains and rate law stay as they are.
        friction_map: of the paper's friction angle; empty: its friction coefficient.
    """
    bed = Bed(
        size=(length, 0.60 if wide else 2.0 * h, depth_of_bed),
        spacing=h,
        particles_per_cell=4.0 if wide else 8.0,
        walls=Walls() if wide else Walls("no_slip", "slip", "no_slip"),
    )
    soil = Material(friction_angle=37.2348, friction_map=friction_map) if friction_map else Material()
    soil = replace(soil, nonlocal_amplitude=length_scale / soil.grain_diameter)
    scene = Excavation(
        bed=bed,
        blade=Plate(width=0.457 if wide else 1.0, edge=edge),
        material=soil,
        depth=0.08,
        duration=2.0,
        start=0.08 / length,
        contact_margin=margin if inside is None else -(inside + 0.5 * bed.particle_spacing) / h,
    )
    return scene, Effects(symmetry=True, rate_dependence=length_scale > 0.0, nonlocality=length_scale > 0.0)


def heap(scene: Excavation, positions: np.ndarray) -> tuple[float, float]:
    """Soil above the surface per metre of width [m^2], and the height of the highest column of it along the middle of
    the bin [m], as if it were dense."""
    x, y = positions[positions[:, 2] > 0.0, :2].T
    volume, (length, width, _) = scene.filled[1], scene.bed.size
    strip = min(width, 0.1)
    middle = np.abs(y - 0.5 * width) < 0.5 * strip
    columns = np.histogram(x[middle], round(length / COLUMN), (0.0, length))[0] * volume / (COLUMN * strip)
    return len(x) * volume / (scene.blade.width if scene.blade.width < width else width), float(columns.max())


def measure(h: float, **variant) -> dict[str, float]:
    """Forces of one run, [N] or [N/m] of a slice; of the second half, too."""
    scene, effects = cut(h, **variant)
    start = time.process_time()
    forces = []
    for frame in Solver(scene, effects).frames():
        forces.append(frame.force)
    per_width = np.array(forces[1:]) / (1.0 if variant.get("wide") else scene.bed.size[1])
    draft, vertical, half = -per_width[:, 0], per_width[:, 2], len(per_width) // 2
    area, height = heap(scene, frame.position)
    return {
        "particles": len(frame.position),
        "draft": float(draft.mean()),
        "draft_second_half": float(draft[half:].mean()),
        "vertical": float(vertical.mean()),
        "vertical_second_half": float(vertical[half:].mean()),
        "swing": float(np.diff(draft[half:]).std()),
        "heap_cm2": 1e4 * area,
        "heap_height_mm": 1e3 * height,
        "cpu_s": time.process_time() - start,
    }


def theory() -> list[dict]:
    """The earth-moving equation along the same cut, with all the soil swept up as surcharge: for the friction angle and
    for that of the cone in plane strain."""
    scene, _ = cut(0.01)
    poses = scene.poses_at(scene.times())
    tip = in_world_frame(poses, scene.body.tip[None])[:, 0]
    depth, way = np.maximum(-tip[:, 2], 0.0), tip[:, 0] - tip[0, 0]
    swept = np.concatenate([[0.0], np.cumsum(0.5 * (depth[1:] + depth[:-1]) * np.diff(way))])
    rows = []
    for angle in (mckyes.ANGLE, math.degrees(math.asin(scene.material.static_friction))):
        for name, width in (("slice", math.inf), ("bin", mckyes.WIDTH)):
            force = np.zeros((len(depth), 2))
            for i in np.flatnonzero(depth > 1e-3):
                force[i] = mckyes.wedge(angle, scene.rake, depth[i], width, swept=swept[i])
            draft, down = force[1:].T * (1.0 if width == math.inf else width)
            half = len(draft) // 2
            row = {
                "case": name,
                "angle": angle,
                "draft": draft.mean(),
                "draft_second_half": draft[half:].mean(),
            }
            rows.append(row | {"vertical": -down.mean(), "vertical_second_half": -down[half:].mean()})
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="*", default=list(VARIANTS), help="variants (default: all)")
    parser.add_argument("--finest", type=float, default=6.7, help="grid spacing [mm] (default: 6.7)")
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    table = HERE / "table.csv"
    write_rows(HERE / "theory.csv", theory())
    for spacing, h in SPACINGS.items():
        for name in options.only:
            rows = read_rows(table)
            if spacing < options.finest or (name, str(spacing)) in {
                (r["variant"], r["spacing_mm"]) for r in rows
            }:
                continue
            row = {"variant": name, "spacing_mm": str(spacing), **measure(h, **VARIANTS[name])}
            order = [(one, str(at)) for one in VARIANTS for at in SPACINGS]
            rows = sorted(
                [*read_rows(table), row], key=lambda r: order.index((r["variant"], r["spacing_mm"]))
            )
            write_rows(table, rows)
            logging.info("%s", row)


if __name__ == "__main__":
    main()

"""The corners of the parameter grids, on coarse beds."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from mpm_warp import Bed, Effects, Excavation, Material, Plate, Solver, SolverStopped, Wheel

from .measures import blade_shares, frames_of, shares, top_speed, volume_gain

CUT_BED = Bed(spacing=0.02)
WHEEL_BED = Bed(size=(0.40, 0.19, 0.0583), spacing=0.04 / 3.0, particles_per_cell=4.0, headroom=0.10)
LONG_BED = replace(WHEEL_BED, size=(0.48, 0.32, 0.08))
K0_ANGLE = float(np.degrees(np.arctan(np.sqrt(3.0) * (1.0 - 0.6) / 1.3)))
"""Friction angle at which soil of Poisson's ratio 0.3 just bears its K0 state [degrees]."""


def excavation(
    depth: float, speed: float, rake: float, motion: str, cohesion: float = 0.0
) -> tuple[float, str]:
    scene = Excavation(
        bed=CUT_BED,
        material=Material(cohesion=cohesion),
        blade=Plate(thickness=0.04),
        depth=depth,
        speed=speed,
        rake=rake,
        motion=motion,
    )
    return blade_shares(scene, frames_of(scene, effects=Effects(symmetry=True)))


def wheel(
    duration: float = 3.0, bed: Bed = WHEEL_BED, bulldozing: float = 0.0, **values
) -> tuple[float, str]:
    """A run of the wheel campaign, with 1 s of settling: what must hold of any wheel. One that pushes soil before it
    may have so many loads more of horizontal force."""
    scene = Wheel(**({"bed": bed, "duration": duration, "damping": 5.0, "friction_angle": 37.0} | values))
    frames = frames_of(scene, effects=Effects(symmetry=scene.slip_angle == 0.0))
    settled = frames[round(0.5 * scene.frame_rate) :]
    carried = float(np.mean([f.force[2] for f in settled])) / values["load"]
    sinkage = float(scene.sinkage(np.array([f.body_pose for f in frames])).max())
    pull = float(np.mean([np.hypot(*f.force[:2]) for f in settled])) / values["load"]
    fall = np.sqrt(2.0 * scene.gravity * scene.bed.size[2])
    return shares(
        {
            "load not carried": (100.0 * abs(carried - 1.0), 5.0, "%"),
            "sinkage": (sinkage, scene.bed.size[2], "m"),
            "horizontal force": (pull, scene.material.limit_friction + scene.friction + bulldozing, "loads"),
            "speed": (top_speed(frames), 2.0 * max(scene.rim_speed, scene.speed) + fall, "m/s"),
            "volume gain": (100.0 * volume_gain(scene, frames[-1].position), 3.0, "%"),
        }
    )


def too_heavy() -> tuple[float, str]:
    try:
        return wheel(diameter=0.05, load=225.0, gravity=1.62, slip=0.7, width=0.0833)
    except SolverStopped as stopped:
        return float("reached the floor" not in str(stopped)), str(stopped)


def raised_limit() -> tuple[float, str]:
    """Soil of 45 degrees (mu_s = 1) with mu_2 = 0.9616: mu_2 is raised, the user told, the wheel runs."""
    soil = Material(friction_angle=45.0)
    said = any("the limit is raised to 1.2016" in words for words in soil.warnings())
    value, note = wheel(friction_angle=45.0, load=100.0, duration=2.0)
    return (value if said else np.inf), note


def light_wheel() -> tuple[float, str]:
    bed = replace(WHEEL_BED, particles_per_cell=1.0)
    scene = Wheel(
        bed=bed,
        load=0.1,
        diameter=0.05,
        clearance=0.003,
        duration=0.7,
        settle=0.69,
        damping=5.0,
        slip=0.0,
        friction_angle=None,
    )
    solver = Solver(scene, Effects(symmetry=True))
    frames = list(solver.frames())
    height = np.array([f.body_pose[2] for f in frames])
    bounce = float(np.ptp(height[round(0.5 * scene.frame_rate) :]))
    return 1000.0 * bounce, f"{solver.substeps_per_frame} substeps per frame"


MEASURES = {
    **{
        f"blade {depth} cm, {speed} cm/s, {rake}°, {motion}": partial(
            excavation, depth / 100, speed / 100, rake, motion
        )
        for depth, speed, rake, motion in (
            (10, 15, 45, "curved"),
            (10, 15, 45, "ramp"),
            (10, 15, 0, "curved"),
            (10, 1, 45, "ramp"),
            (2, 15, 45, "ramp"),
            (2, 1, 0, "curved"),
        )
    },
    "blade 10 cm, 15 cm/s, 45°, curved, 2 kPa of cohesion": partial(
        excavation, 0.10, 0.15, 45.0, "curved", cohesion=2000.0
    ),
    "wheel 5 cm, 70 %, Moon, 25 N": partial(
        wheel, diameter=0.05, slip=0.7, gravity=1.62, load=25.0, width=0.0833
    ),
    "wheel 30 cm, 70 %, Moon, 225 N": partial(
        wheel, diameter=0.30, slip=0.7, gravity=1.62, load=225.0, width=0.125
    ),
    "wheel 30 cm, 20 %, Earth, 225 N, 43°": partial(
        wheel, diameter=0.30, slip=0.2, load=225.0, width=0.125, friction_angle=43.0
    ),
    "wheel 5 cm, 70 %, Earth, 25 N, 30°": partial(
        wheel, diameter=0.05, slip=0.7, load=25.0, width=0.0833, friction_angle=30.0
    ),
    "wheel locked": partial(wheel, load=40.0, travel_speed=0.05, rim_speed=0.0, bulldozing=1.0, bed=LONG_BED),
    "wheel pushed sideways, 90°": partial(
        wheel, load=40.0, slip_angle=90.0, travel_speed=0.05, rim_speed=0.0, bulldozing=1.0, bed=LONG_BED
    ),
    "wheel turned by 45°, rim ten times as fast": partial(
        wheel, load=40.0, slip_angle=45.0, travel_speed=0.02, rim_speed=0.2, bed=LONG_BED
    ),
    "wheel on soil at the K0 limit": partial(wheel, load=60.0, friction_angle=K0_ANGLE, duration=2.0),
    "wheel on soil with mu_s at 1, above mu_2": raised_limit,
    "wheel 5 cm, 70 %, Moon, 225 N": too_heavy,
    "wheel of 10 g": light_wheel,
}

"""Tools that jump, turn back, shake, spin, leave and come back; thin ones and odd meshes."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from leakage import leakage

from mpm_warp import Body, Box, Effects, Excavation, MeshBody, Other, Plate, Solver
from mpm_warp.motions import Passes
from sgns_testing.meshes import box_corners, box_triangles, write_obj
from sgns_testing.scenes import cut

from .measures import blade_shares, frames_of, refused, shares, stopped_with, top_speed, volume_gain
from .networks import new_folder

IN_SOIL = 0.06
"""Height of the centre of the plate of `cut` when its tip is 4 cm deep [m]."""
ABOVE = 0.11
"""Likewise above the surface."""


def driven(rows, duration: float, frame_rate: float = 60.0, **changes) -> Excavation:
    """A plate that follows rows t, x, z."""
    path = tuple((t, x, 0.2, z, 0.0, 0.0, 0.0, 1.0) for t, x, z in rows)
    return cut(motion="path", path=path, duration=duration, frame_rate=frame_rate, **changes)


def down(x: float = 0.104):
    """The first rows of a path: down to `IN_SOIL` within 0.2 s."""
    return [(0.0, x, ABOVE), (0.2, x, IN_SOIL)]


def jumps_between_frames() -> tuple[float, str]:
    """The plate is 10 cm further on a frame later; between them it moves at 6 m/s. Soil flies for up to 1.4 s."""
    scene = driven([*down(), (0.4, 0.104, IN_SOIL), (0.4 + 1 / 60, 0.204, IN_SOIL)], 2.2)
    scene = replace(scene, bed=replace(scene.bed, headroom=2.0))
    frames = frames_of(scene)
    return shares(
        {
            "speed": (top_speed(frames), 12.0 + 2.0, "m/s"),
            "leakage": (100.0 * leakage(frames, scene.body), 1.0, "%"),
            "volume gain": (100.0 * volume_gain(scene, frames[-1].position), 3.0, "%"),
            "speed at the end": (top_speed(frames[-1:]), 0.3, "m/s"),
        }
    )


def jumps_within_a_substep() -> tuple[float, str]:
    rows = [*down(), (0.3, 0.104, IN_SOIL), (0.3001, 0.204, IN_SOIL)]
    return stopped_with(driven(rows, 0.5), "the body jumps by")


def appears_in_soil() -> tuple[float, str]:
    """The plate is in the soil from the start; what is in its way is pushed out at once."""
    scene = driven([(0.0, 0.2, IN_SOIL)], 1.0)
    scene = replace(scene, bed=replace(scene.bed, headroom=1.0))
    frames = frames_of(scene)
    return shares(
        {
            "speed": (top_speed(frames), 0.5 * scene.material.wave_speed, "m/s"),
            "speed at the end": (top_speed(frames[-1:]), 0.1, "m/s"),
            "volume gain": (100.0 * volume_gain(scene, frames[-1].position), 3.0, "%"),
        }
    )


def turns_back() -> tuple[float, str]:
    rows = [*down(), (0.7, 0.204, IN_SOIL), (1.2, 0.104, IN_SOIL), (1.7, 0.204, IN_SOIL)]
    scene = driven(rows, 1.7)
    return blade_shares(scene, frames_of(scene))


def creep() -> tuple[float, str]:
    """Of the soil around a tool that goes down, 3 cm forward and rests: from 1 s to 60 s after it stopped [mm]."""
    scene = driven([*down(), (0.5, 0.134, IN_SOIL)], 61.0)
    scene = replace(scene, bed=replace(scene.bed, spacing=0.04 / 1.5))
    frames = frames_of(scene, every=60, effects=Effects(symmetry=True))
    moved = np.linalg.norm(frames[-1].position - frames[2].position, axis=1)
    force = [float(np.linalg.norm(f.force)) for f in frames]
    words = (
        f"mean {1e3 * moved.mean():.3g} mm, {np.sum(moved > 1e-3)} of {len(moved)} particles beyond 1 mm; "
    )
    words += f"force {force[2]:.3g} N after 1 s, {force[-1]:.3g} N at the end"
    return 1000.0 * float(moved.max()), words


def shakes(amplitude: float = 1e-3, frequency: float = 50.0) -> tuple[float, str]:
    times = np.arange(0.0, 1.0, 1.0 / (frequency * 24.0))
    swing = 0.104 + amplitude * np.sin(2.0 * np.pi * frequency * times)
    rows = [*down(), *((0.2 + t, x, IN_SOIL) for t, x in zip(times[1:], swing[1:], strict=True))]
    scene = driven(rows, 1.2, frame_rate=600.0)
    return blade_shares(scene, frames_of(scene, every=10))


def leaves_and_comes_back() -> tuple[float, str]:
    """Cuts, is lifted out, and goes down in another place; while it is out nothing may touch it."""
    rows = [*down(), (0.7, 0.204, IN_SOIL), (0.9, 0.204, 0.18), (1.1, 0.16, 0.18), (1.4, 0.16, IN_SOIL)]
    scene = driven([*rows, (1.9, 0.26, IN_SOIL)], 1.9)
    frames = frames_of(scene)
    share, words = blade_shares(scene, frames)
    out = [f for f in frames if 0.95 < f.time < 1.05]
    touch = max(float(np.linalg.norm(f.force)) for f in out)
    return max(share, touch), f"{words}; force in the air {touch:.3g} N (limit 1)"


def second_pass(deepening: float) -> tuple[float, str]:
    """Cuts, is lifted, goes back and cuts again, in the same place or deeper."""
    passes = Passes(number=2, length=0.08, deepening=deepening, lift=0.06, return_speed=0.4)
    scene = cut(motion="passes", depth=0.05, duration=2.4, start=0.15, clearance=0.01, passes=passes)
    frames = frames_of(scene)
    cutting = passes.cutting(scene.times(), scene.depth, scene.speed)
    first, second = (
        float(np.mean([-frames[i].force[0] for i in np.flatnonzero(cutting == k)])) for k in (0, 1)
    )
    share, words = blade_shares(scene, frames)
    return share, f"{words}; mean draft {first:.3g} N, then {second:.3g} N"


def another_tool() -> tuple[float, str]:
    """A cut, then a run that starts from its soil with another plate, which begins in the heap."""
    first = Solver(cut(duration=0.8))
    *_, _ = first.frames()
    wide = replace(cut().blade, width=0.3)
    scene = cut(blade=wide, start=0.5, rake=30.0, clearance=-0.01, duration=0.6).starting_from(first.soil())
    share, words = blade_shares(scene, frames_of(scene))
    return share, f"{words}; {len(scene.displaced)} particles left out"


def stone_and_blade() -> tuple[float, str]:
    """The plate pushes soil against a stone that lies in its way; both touch soil only."""
    stone = Other(tool=Box(size=(0.06, 0.06, 0.05)), position=(0.25, 0.2, 0.0))
    scene = cut(duration=1.0, others=(stone,))
    frames = frames_of(scene)
    stones = np.array([frame.other_poses[0, :3] for frame in frames])
    speed = np.linalg.norm(np.diff(stones, axis=0), axis=1).max() * scene.frame_rate
    share, words = blade_shares(scene, frames)
    most = 5.0 * scene.speed
    moved = 1e3 * np.linalg.norm(stones[-1] - stones[0])
    words += f"; the stone at {speed:.3g} m/s (limit {most:g}), by {moved:.3g} mm in all"
    return max(share, speed / most), words


def spins() -> tuple[float, str]:
    times = np.arange(0.0, 0.8, 0.01)
    angle = np.maximum(times - 0.25, 0.0) * 6.0 * np.pi
    height = np.interp(times, [0.0, 0.2], [ABOVE, IN_SOIL])
    path = tuple(
        (float(t), 0.24, 0.2, float(z), 0.0, 0.0, math.sin(0.5 * a), math.cos(0.5 * a))
        for t, a, z in zip(times, angle, height, strict=True)
    )
    scene = cut(motion="path", path=path, duration=0.8, frame_rate=120.0)
    scene = replace(scene, bed=replace(scene.bed, headroom=1.0))
    frames = frames_of(scene)
    edge = 6.0 * np.pi * 0.5 * scene.blade.width
    return shares(
        {
            "speed": (top_speed(frames), 2.0 * edge + 2.0, "m/s"),
            "leakage": (100.0 * leakage(frames, scene.body), 1.0, "%"),
        }
    )


def thin(cells: float, speed: float) -> tuple[float, str]:
    rows = [*down(), (0.2 + 0.1 / speed, 0.204, IN_SOIL)]
    blade = Plate(length=0.2, width=0.193, thickness=0.02 * cells)
    scene = driven(rows, 0.2 + 0.1 / speed, frame_rate=max(100.0, 500.0 * speed), blade=blade)
    frames = frames_of(scene)
    force = float(np.mean([f.force[0] for f in frames[len(frames) // 2 :]]))
    return 100.0 * leakage(frames, scene.body), f"draft {-force:.3g} N"


def mesh_scene(folder: Path, triangles: np.ndarray) -> Body:
    """A box of triangles goes down and forward."""
    file = write_obj(folder / "box.obj", box_corners((0.044, 0.193, 0.2)), triangles)
    rows = [(0.0, 0.104, ABOVE), (0.1, 0.104, IN_SOIL), (0.3, 0.144, IN_SOIL)]
    path = tuple((t, x, 0.2, z, 0.0, 0.0, 0.0, 1.0) for t, x, z in rows)
    return Body(bed=cut().bed, tool=MeshBody(file=str(file)), path=path, duration=0.3)


def turned_round(triangles: np.ndarray) -> float:
    """Largest change of the force by triangles of the box that face inwards [%]."""
    force = []
    for given in (box_triangles(), triangles):
        frames = frames_of(mesh_scene(new_folder(), given))
        force.append(np.array([f.force for f in frames]))
    return 100.0 * float(np.abs(force[1] - force[0]).max() / np.abs(force[0]).max())


def flipped_mesh() -> float:
    return turned_round(box_triangles()[:, ::-1])


def one_flipped_triangle() -> float:
    triangles = box_triangles()
    triangles[3] = triangles[3][::-1]
    return turned_round(triangles)


def open_mesh() -> tuple[float, str]:
    folder = new_folder()
    accepted, words = refused(lambda: mesh_scene(folder, box_triangles()[:-1]), "is not closed")
    return accepted, words.replace(f"{folder}/", "")


def too_thin() -> tuple[float, str]:
    blade = Plate(length=0.2, width=0.193, thickness=0.002)
    bed = replace(cut().bed, particles_per_cell=8.0)
    return refused(lambda: Solver(cut(blade=blade, bed=bed)), "too thin")


def through_the_floor() -> tuple[float, str]:
    return refused(lambda: driven([*down(), (0.4, 0.104, -0.1)], 0.5), "leaves the bin")


MEASURES = {
    "tool 10 cm further within a frame": jumps_between_frames,
    "tool 10 cm further within a substep": jumps_within_a_substep,
    "tool appears in the soil": appears_in_soil,
    "tool turns back at once": turns_back,
    "tool at rest for 60 s": creep,
    "tool shakes at 50 Hz": shakes,
    "tool leaves and comes back": leaves_and_comes_back,
    "two bodies: a stone in the way of a blade": stone_and_blade,
    "tool spins at 3 turns per second": spins,
    "second pass in the same place": partial(second_pass, 0.0),
    "second pass 2 cm deeper": partial(second_pass, 0.02),
    "another tool on the soil of a cut": another_tool,
    **{
        f"plate {cells:g} spacings thick at {speed:g} m/s": partial(thin, cells, speed)
        for cells, speed in ((2.0, 1.0), (0.5, 0.2), (0.5, 1.0))
    },
    "plate a tenth of a spacing thick": too_thin,
    "tool through the floor": through_the_floor,
    "mesh with flipped normals": flipped_mesh,
    "mesh with one flipped triangle": one_flipped_triangle,
    "mesh with a hole": open_mesh,
}

"""Small plausible runs for tests: a plate cuts a bed, the soil near it is carried along.

The initial positions depend on `n` only, so runs with the same `n` belong together as in a dataset; `seed`
varies depth, speed and rake of the cut.
"""

import copy
from pathlib import Path
from typing import Any

import numpy as np

from sgns.data.writer import RunWriter

BED = np.array([0.80, 0.60, 0.15])
"""Lx, Ly, Lz [m]."""
PLATE = np.array([0.028, 0.457, 0.305])
"""Thickness, width and length of the plate [m]."""


def start_positions(n: int) -> np.ndarray:
    """Initial soil [m], shape (n, 3), float64: random in the bin, the same for every run of n particles."""
    return np.random.default_rng(n).uniform(0.0, 1.0, (n, 3)) * BED - [0.0, 0.0, BED[2]]


def body_grid(m: int) -> np.ndarray:
    """m points on the plate's front face [m], body frame, shape (m, 3)."""
    columns = max(1, m // 3)
    index = np.arange(m)
    y = (index % columns + 0.5) / columns - 0.5
    z = (index // columns + 0.5) / max(1, -(-m // columns)) - 0.5
    return np.stack([np.full(m, PLATE[0] / 2), y * PLATE[1], z * PLATE[2]], axis=1)


def make_run(path: str | Path, frames: int = 12, n: int = 50, m: int = 15, seed: int = 0, **kw: Any) -> Path:
    """Write a run of T = `frames` frames, `n` particles and `m` body points; returns its path.

    Keyword arguments: `scene` (a dict merged over the default scene; depth [m], speed [m/s], rake [degrees]
    also shape the motion), `producer` ("mpm"), `frame_rate` (60.0 Hz), `wall_time_s` (1.0 s),
    `arrangement_hash`, `effects`, `extra`.
    """
    path = Path(path)
    rng = np.random.default_rng(seed)
    frame_rate = float(kw.pop("frame_rate", 60.0))
    scene: dict[str, Any] = {
        "name": "excavation",
        "kind": "excavation",
        "bed": {"size": BED.tolist(), "spacing": 0.02, "arrangement": "lattice", "seed": 0},
        "blade": {
            "thickness": float(PLATE[0]),
            "width": float(PLATE[1]),
            "length": float(PLATE[2]),
            "edge": "square",
        },
        "gravity": 9.81,
        "duration": (frames - 1) / frame_rate,
        "frame_rate": frame_rate,
        "depth": round(float(rng.uniform(0.03, 0.09)), 4),
        "speed": round(float(rng.uniform(0.05, 0.20)), 4),
        "rake": round(float(rng.uniform(0.0, 30.0)), 2),
        "motion": ["curved", "ramp"][int(rng.integers(2))],
    }
    scene.update(copy.deepcopy(kw.pop("scene", {})))
    effects = kw.pop("effects", {"yielding": {"on": True, "reason": "shear exceeds friction"}})
    arrangement_hash = kw.pop("arrangement_hash", f"synthetic-{n}")
    producer = kw.pop("producer", "mpm")
    extra = kw.pop("extra", None)
    wall_time = kw.pop("wall_time_s", 1.0)
    if kw:
        raise TypeError(f"make_run has no {', '.join(kw)}")

    time = np.arange(frames) / frame_rate
    pose = _poses(time, scene)
    points = (body_grid(m) @ _about_y(-np.radians(scene["rake"])).T)[None] + pose[:, None, :3]
    position, velocity = _carried(start_positions(n), _tip(pose, scene), frame_rate)
    force, torque = _reaction(pose, _tip(pose, scene), scene)
    with RunWriter(
        path,
        scene=scene,
        effects=effects,
        arrangement_hash=arrangement_hash,
        particle_count=n,
        body_points=m,
        frame_rate=frame_rate,
        seed=seed,
        producer=producer,
        extra=extra,
    ) as writer:
        for i in range(frames):
            writer.append(time[i], position[i], velocity[i], points[i], pose[i], force[i], torque[i])
        writer.finish(wall_time)
    return path


def make_writer(path: Path, n: int = 4, m: int = 2, **kw: Any) -> RunWriter:
    """An open writer of small runs; keyword arguments replace those of RunWriter."""
    settings = {
        "scene": {},
        "effects": {},
        "arrangement_hash": "abc",
        "particle_count": n,
        "body_points": m,
        "frame_rate": 60.0,
        "seed": 0,
        "producer": "mpm",
    }
    return RunWriter(path, **{**settings, **kw})


def random_frame(i: int, n: int = 4, m: int = 2) -> dict[str, Any]:
    """Arguments of RunWriter.append for frame i: random, but valid."""
    rng = np.random.default_rng(i)
    return {
        "time": i / 60.0,
        "position": rng.random((n, 3)),
        "velocity": rng.random((n, 3)),
        "body_points": rng.random((m, 3)),
        "body_pose": np.array([*rng.random(3), 0.0, 0.0, 0.0, 1.0]),
        "force": rng.random(3),
        "torque": rng.random(3),
    }


def random_poses(count: int = 6) -> np.ndarray:
    """Random places [m] and moderate random turns, shape (count, 7)."""
    rng = np.random.default_rng(0)
    place, turn = rng.normal(size=(count, 3)), 0.3 * rng.normal(size=(count, 4)) + [0.0, 0.0, 0.0, 1.0]
    return np.hstack([place, turn / np.linalg.norm(turn, axis=1, keepdims=True)])


def _about_y(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def _poses(time: np.ndarray, scene: dict[str, Any]) -> np.ndarray:
    """Down along a sine while the plate advances, (T, 7); the rake is constant."""
    angle = -np.radians(scene["rake"])
    pose = np.zeros((len(time), 7))
    pose[:, :3] = [0.15, BED[1] / 2, PLATE[2] / 2]
    pose[:, 0] += scene["speed"] * time
    pose[:, 2] -= scene["depth"] * np.sin(0.5 * np.pi * np.minimum(time / 0.5, 1.0))
    pose[:, 4], pose[:, 6] = np.sin(angle / 2), np.cos(angle / 2)
    return pose


def _tip(pose: np.ndarray, scene: dict[str, Any]) -> np.ndarray:
    return pose[:, :3] + _about_y(-np.radians(scene["rake"])) @ [0.0, 0.0, -PLATE[2] / 2]


def _carried(start: np.ndarray, tip: np.ndarray, frame_rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Soil follows the tip with a weight that falls off over 10 cm; positions and velocities (T, n, 3)."""
    position = np.empty((len(tip), *start.shape))
    velocity = np.zeros_like(position)
    position[0] = start
    for i in range(1, len(tip)):
        gap = position[i - 1] - tip[i - 1]
        weight = np.exp(-0.5 * ((gap[:, 0] / 0.10) ** 2 + (gap[:, 1] / 0.25) ** 2 + (gap[:, 2] / 0.10) ** 2))
        velocity[i] = weight[:, None] * ((tip[i] - tip[i - 1]) * frame_rate) * [1.0, 1.0, 0.2]
        position[i] = position[i - 1] + velocity[i] / frame_rate
    return position, velocity


def _reaction(pose: np.ndarray, tip: np.ndarray, scene: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Resistance [N] that grows with depth and surcharge, at two thirds of the depth; (T, 3) each."""
    depth = np.maximum(0.0, -tip[:, 2])
    force = np.zeros((len(pose), 3))
    force[:, 0] = -3e4 * depth**2 * (1.0 + 2.0 * (pose[:, 0] - pose[0, 0])) - 50.0 * depth * scene["speed"]
    force[:, 2] = -0.4 * force[:, 0] * np.sin(np.radians(scene["rake"]))
    force[0] = 0.0
    arm = tip + np.array([0.0, 0.0, 1.0]) * depth[:, None] / 3.0 - pose[:, :3]
    return force, np.cross(arm, force)

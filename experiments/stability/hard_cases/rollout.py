"""Hard cases of rollouts: paths that nobody trained the network for.

Names of networks as `simulator_of` takes them; "quick" is of the solver's own runs, the others of synthetic ones.
Letters: T frames, r modes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np

from sgns.data.check import check_run
from sgns.data.run import Run
from sgns.model.training_range import NOTEWORTHY
from sgns.reduction.reduce import ReducedDataset, ReducedRun
from sgns.rollout import write_rollout
from sgns.simulator import Simulator
from sgns.state import Rollout

from .measures import unsaid
from .networks import new_folder, quick_data, quick_network, simulator_of, synthetic_data, synthetic_network

Change = Callable[[np.ndarray], np.ndarray]


def data_of(kind: str) -> ReducedDataset:
    """The runs that a network was trained on."""
    return quick_data() if kind == "quick" else synthetic_data()


def a_run(kind: str) -> ReducedRun:
    """Its first test run."""
    return data_of(kind).runs("test")[0]


def moved(simulator: Simulator, latent: np.ndarray) -> np.ndarray:
    """RMS displacement of the particles since frame 0 [mm], shape (T,)."""
    squares = np.square(latent - latent[0]).sum((1, 2)) / simulator.basis.num_particles
    return 1e3 * np.sqrt(squares)


def largest_movement(kind: str, simulator: Simulator) -> float:
    """Of all training runs [mm]."""
    r = simulator.num_modes
    return max(float(moved(simulator, run.latent[:, :r]).max()) for run in data_of(kind).runs("train"))


def to_and_fro(path: np.ndarray, times: int) -> np.ndarray:
    """The path there and back again until it is so many times as long."""
    cycle = np.concatenate([path, path[-2:0:-1]])
    return np.tile(cycle, (math.ceil(times * len(path) / len(cycle)), 1))[: times * len(path)]


def long_path(kind: str, times: int) -> tuple[float, str]:
    simulator, run = simulator_of(kind), a_run(kind)
    rollout = simulator.rollout(to_and_fro(run.pose, times), values=run.scene)
    share = float(moved(simulator, rollout.latent).max()) / largest_movement(kind, simulator)
    return share, rollout.excess.words()


def slowed(path: np.ndarray, times: int) -> np.ndarray:
    """The path so many times as slow."""
    frames = np.arange(times * (len(path) - 1) + 1) / times
    path = np.stack([np.interp(frames, np.arange(len(path)), part) for part in path.T], axis=1)
    path[:, 3:] /= np.linalg.norm(path[:, 3:], axis=1, keepdims=True)
    return path


def slowly(kind: str, times: int) -> tuple[float, str]:
    """The cut so many times as slow, which takes as many more steps and leaves the same soil behind, as slow soil does
    not know how fast it is driven: difference of the end from the run's own [share of its movement]."""
    simulator, worst = simulator_of(kind), 0.0
    for run in quick_data().runs("test"):
        found = simulator.rollout(slowed(run.pose, times), values=run.scene)
        truth = run.latent[:, : simulator.num_modes]
        error = moved(simulator, np.stack([truth[-1], found.latent[-1]]))[1]
        worst = max(worst, float(error / moved(simulator, truth)[-1]))
    return worst, found.excess.words()


def rest(start: str, seconds: float = 60.0) -> tuple[float, str]:
    run = a_run("quick")
    drifts = []
    for hold in (True, False):
        simulator = Simulator.load(quick_network(), rate_independent=hold)
        d, r = simulator.history, simulator.num_modes
        frames = round(seconds * simulator.frame_rate) + 1
        if start == "untouched":
            found = simulator.rollout(run.pose[:1].repeat(frames, axis=0), values=run.scene)
        else:
            path = run.pose[-1:].repeat(frames, axis=0)
            found = simulator.rollout(path, latent_history=run.latent[-d:, :r], values=run.scene)
        drifts.append(float(moved(simulator, found.latent).max()))
    return drifts[0], f"without rate_independent {drifts[1]:.3g} mm"


def creeping(kind: str) -> tuple[float, str]:
    simulator, run = simulator_of(kind), a_run(kind)
    path = run.pose[:1].repeat(3601, axis=0)
    path[:, 0] += 1e-6 * np.arange(len(path))
    drift = moved(simulator, simulator.rollout(path, values=run.scene).latent)
    return float(drift.max()), f"the tool moves by {1e3 * (path[-1, 0] - path[0, 0]):.1f} mm"


def vibrating(kind: str) -> tuple[float, str]:
    simulator, run = simulator_of(kind), a_run(kind)
    path = run.pose[:1].repeat(3601, axis=0)
    path[:, 0] += 1e-4 * np.sin(2 * np.pi * 15.0 * np.arange(len(path)) / simulator.frame_rate)
    found = simulator.rollout(path, values=run.scene)
    return float(moved(simulator, found.latent).max()), found.excess.words()


def shifted(path: np.ndarray, since: float = 0.0, **by: float) -> np.ndarray:
    """The tool moved [m] along axes, from a share of its way on."""
    path = path.copy()
    for axis, distance in by.items():
        path[int(since * len(path)) :, "xyz".index(axis)] += distance
    return path


teleported = partial(shifted, since=0.5)


def stretched(path: np.ndarray, axis: str, factor: float) -> np.ndarray:
    """The tool's way along one axis, longer or shorter."""
    path, i = path.copy(), "xyz".index(axis)
    path[:, i] = path[0, i] + factor * (path[:, i] - path[0, i])
    return path


def turned(path: np.ndarray, axis: str, degrees: float) -> np.ndarray:
    """The tool in another orientation, the same all the way."""
    path, half = path.copy(), math.radians(degrees) / 2
    path[:, 3:] = 0.0
    path[:, 3 + "xyz".index(axis)], path[:, 6] = math.sin(half), math.cos(half)
    return path


def backwards(path: np.ndarray) -> np.ndarray:
    """The way back, driven as a way there."""
    return path[::-1].copy()


def unlike(kind: str, change: Change) -> tuple[float, str]:
    simulator = simulator_of(kind)
    runs = data_of(kind).runs("test")
    failures, least, most, words = 0, math.inf, 0.0, ""
    for run in runs:
        found = simulator.rollout(change(run.pose), values=run.scene)
        failures += not (found.excess.largest > NOTEWORTHY) or not sound(found)
        least = min(least, found.excess.largest)
        most = max(most, float(moved(simulator, found.latent).max()))
        words = found.excess.words() or words
    share = most / largest_movement(kind, simulator)
    return (
        failures,
        f"excess at least {least:.2g}, soil moves {share:.1f} times as far as in training; {words}",
    )


def sound(found: Rollout) -> bool:
    """Whether all numbers of a rollout are finite."""
    parts = found.latent, found.force, found.torque, found.poses
    return all(bool(np.isfinite(part).all()) for part in parts)


def held_out() -> tuple[float, str]:
    simulator = simulator_of("quick")
    runs = [run for split in ("validation", "test") for run in quick_data().runs(split)]
    found = [simulator.rollout(run.pose, values=run.scene).excess.largest for run in runs]
    return max(found), f"{len(found)} runs"


def far_away(kind: str) -> tuple[float, str]:
    simulator, run = simulator_of(kind), a_run(kind)
    path = run.pose[:1].repeat(1000, axis=0)
    path[10:, :3] += 1e6 * np.sin(np.arange(990))[:, None]
    found = simulator.rollout(path, values=run.scene)
    if not sound(found):
        return math.nan, "not finite"
    low, high = (bound.numpy() for bound in simulator.dynamics.reach())
    beyond = np.maximum(np.maximum(low - found.latent, found.latent - high), 0.0)
    return float(beyond.max()), f"the force reaches {np.abs(found.force).max():.1e} N"


def breakdown() -> tuple[float, str]:
    """A pose of 1e300 m: the step is refused, the state before is kept and the same path goes on as if nothing was."""
    simulator, path = simulator_of("pose"), a_run("pose").pose
    expected = simulator.rollout(path)
    simulator.reset(path)
    for pose in path[1:6]:
        simulator.step(pose)
    far = path[6].copy()
    far[0] = 1e300
    lacking, note = unsaid(lambda: simulator.step(far), "not finite at frame 6", "frame 5 is kept")
    for t in range(6, len(path)):
        state = simulator.step(path[t])
    return lacking + float(np.abs(state.latent - expected.latent[-1]).max()), note


def broken_path() -> tuple[float, str]:
    simulator, run = simulator_of("pose"), a_run("pose")
    path = run.pose.copy()
    path[9, 0] = 1e300
    folder = new_folder()
    target = folder / "r.h5"
    found = simulator.rollout(path)
    lacking, note = unsaid(
        lambda: write_rollout(target, simulator, run.scene, found),
        "not finite from frame 9",
        "r.stopped.h5",
    )
    kept = folder / "r.stopped.h5"
    problems = [line for line in check_run(kept) if "stopped after 9 good frames" not in line]
    with Run(kept) as stopped:
        return lacking + len(problems) + abs(stopped.frame_count - 9) + target.exists(), note


def body_points(count: int) -> tuple[float, str]:
    """Another number of points on the tool than the 15 it was trained with: 0 if flagged and finite."""
    simulator, run = simulator_of("points"), a_run("points")
    low, high = simulator.body_points.min(0), simulator.body_points.max(0)
    points = np.random.default_rng(0).uniform(low, high, (count, 3))
    known, found = simulator.rollout(run.pose), simulator.rollout(run.pose, points)
    share = moved(simulator, found.latent).max() / largest_movement("points", simulator)
    force = np.abs(found.force).max() / np.abs(known.force).max()
    note = f"soil moves {share:.2g} times as far as in training; force {force:.2g} times that with 15 points"
    flagged = found.excess.largest > NOTEWORTHY and any("number" in name for name in found.excess.quantity)
    return (not flagged) + (not sound(found)), note


def fewer_modes(kind: str) -> tuple[float, str]:
    run, shares = a_run(kind), []
    path = quick_network() if kind == "quick" else synthetic_network(kind)
    whole = Simulator.load(path)
    for r in range(1, whole.num_modes):
        simulator = Simulator.load(path, num_modes=r)
        found = simulator.rollout(run.pose, values=run.scene)
        shares.append(moved(simulator, found.latent).max() / largest_movement(kind, whole))
    return float(max(shares)), ", ".join(f"{r + 1}: {share:.2f}" for r, share in enumerate(shares))


def quaternion_signs() -> float:
    simulator, run = simulator_of("pose"), a_run("pose")
    other = run.pose.copy()
    other[::2, 3:] *= -1
    a, b = simulator.rollout(run.pose), simulator.rollout(other)
    return 1e3 * float(np.abs(a.latent - b.latent).max())


def shortest_paths() -> float:
    simulator, run = simulator_of("pose"), a_run("pose")
    return sum(abs(len(simulator.rollout(run.pose[:count]).latent) - count) for count in (1, 2))


def side_by_side() -> float:
    simulator, run = simulator_of("pose"), a_run("pose")
    paths = run.pose, teleported(run.pose, x=3.0), shifted(run.pose, y=50.0), backwards(run.pose)
    many = simulator.rollouts(np.stack(paths))
    difference = [
        np.abs(many.latent[i] - simulator.rollout(path).latent).max() for i, path in enumerate(paths)
    ]
    return 1e3 * float(max(difference))


def bad_pose(row: list[float], *words: str) -> tuple[float, str]:
    simulator, run = simulator_of("pose"), a_run("pose")
    path = run.pose.copy()
    path[4] = row
    return unsaid(lambda: simulator.rollout(path), "frame 4", *words)


MEASURES = {
    "ten times the training horizon, slowly": partial(slowly, "quick", 10),
    "ten times the training horizon, to and fro": partial(long_path, "quick", 10),
    "ten times the horizon, small network": partial(long_path, "pose", 10),
    "ten times the horizon, polynomials": partial(long_path, "polynomial", 10),
    "60 s at rest in an untouched bed": partial(rest, "untouched"),
    "60 s at rest after a cut": partial(rest, "cut"),
    "tool creeps by 1 um a frame for 60 s": partial(creeping, "quick"),
    "tool shakes by 0.1 mm for 60 s before it cuts": partial(vibrating, "quick"),
    "held-out runs": held_out,
    "five times as deep": partial(unlike, "quick", partial(stretched, axis="z", factor=5.0)),
    "five times as fast": partial(unlike, "quick", partial(stretched, axis="x", factor=5.0)),
    "backwards": partial(unlike, "quick", backwards),
    "10 cm to the side": partial(unlike, "quick", partial(shifted, y=0.1)),
    "40 cm further on": partial(unlike, "quick", partial(shifted, x=0.4)),
    "raked by 80 degrees": partial(unlike, "quick", partial(turned, axis="y", degrees=-80.0)),
    "turned by 30 degrees about the vertical": partial(
        unlike, "quick", partial(turned, axis="z", degrees=30.0)
    ),
    "teleported by 10 cm": partial(unlike, "quick", partial(teleported, x=0.1)),
    "teleported by 10 m": partial(unlike, "quick", partial(teleported, x=10.0)),
    "teleported, small network": partial(unlike, "pose", partial(teleported, x=3.0)),
    "teleported, polynomials": partial(unlike, "polynomial", partial(teleported, x=3.0)),
    "1000 km to and fro": partial(far_away, "quick"),
    "1000 km to and fro, small network": partial(far_away, "pose"),
    "1000 km to and fro, polynomials": partial(far_away, "polynomial"),
    "a step that breaks down": breakdown,
    "a path that breaks down": broken_path,
    "1 body particle": partial(body_points, 1),
    "100 body particles": partial(body_points, 100),
    "fewer modes than trained": partial(fewer_modes, "quick"),
    "fewer modes, polynomials": partial(fewer_modes, "polynomial"),
    "quaternions of either sign": quaternion_signs,
    "paths of one and two frames": shortest_paths,
    "far away paths side by side": side_by_side,
    "a pose that is not finite": partial(bad_pose, [math.nan, 0, 0, 0, 0, 0, 1.0], "nan", "finite"),
    "a quaternion of length 0": partial(bad_pose, [0.1, 0.3, 0.1, 0, 0, 0, 0], "quaternion of length 0"),
}

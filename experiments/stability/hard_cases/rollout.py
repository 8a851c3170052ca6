"""Hard cases of rollouts: paths that nobody trained the network for.

Names of networks as `simulator_of` takes them; "quick" is of the solver's own runs, the others of synthetic ones.
Letters: T frames, r modes.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from sgns.data.check import check_run
from sgns.data.run import Run
from sgns.model.training_range import NOTEWORTHY
from sgns.reduction.reduce import ReducedDataset, ReducedRun
from sgns.rollout import write_rollout
from sgns.simulator import Rollout, Simulator

from .case import Case
from .measures import unsaid
from .networks import quick_data, quick_network, simulator_of, synthetic_data, synthetic_network

__all__ = ["CASES"]

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


def long_path(kind: str, times: int) -> Callable[[], tuple[float, str]]:
    """Movement of the soil at its largest, in share of the largest of a training run."""

    def measure() -> tuple[float, str]:
        simulator, run = simulator_of(kind), a_run(kind)
        rollout = simulator.rollout(to_and_fro(run.pose, times), values=run.scene)
        share = float(moved(simulator, rollout.latent).max()) / largest_movement(kind, simulator)
        return share, rollout.excess.words()

    return measure


def slowed(path: np.ndarray, times: int) -> np.ndarray:
    """The path so many times as slow."""
    frames = np.arange(times * (len(path) - 1) + 1) / times
    path = np.stack([np.interp(frames, np.arange(len(path)), part) for part in path.T], axis=1)
    path[:, 3:] /= np.linalg.norm(path[:, 3:], axis=1, keepdims=True)
    return path


def slowly(kind: str, times: int) -> Callable[[], tuple[float, str]]:
    """The cut so many times as slow, which takes as many more steps and leaves the same soil behind, as slow soil does
    not know how fast it is driven: difference of the end from the run's own [share of its movement]."""

    def measure() -> tuple[float, str]:
        simulator, worst = simulator_of(kind), 0.0
        for run in quick_data().runs("test"):
            found = simulator.rollout(slowed(run.pose, times), values=run.scene)
            truth = run.latent[:, : simulator.num_modes]
            error = moved(simulator, np.stack([truth[-1], found.latent[-1]]))[1]
            worst = max(worst, float(error / moved(simulator, truth)[-1]))
        return worst, found.excess.words()

    return measure


def rest(start: str, seconds: float = 60.0) -> Callable[[], tuple[float, str]]:
    """Drift under a tool at rest [mm]: in a bed that was never touched, or after a cut."""

    def measure() -> tuple[float, str]:
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

    return measure


def creeping(kind: str) -> Callable[[], tuple[float, str]]:
    """Movement of the soil under a tool that advances by a micrometre in every frame, for a minute [mm]."""

    def measure() -> tuple[float, str]:
        simulator, run = simulator_of(kind), a_run(kind)
        path = run.pose[:1].repeat(3601, axis=0)
        path[:, 0] += 1e-6 * np.arange(len(path))
        drift = moved(simulator, simulator.rollout(path, values=run.scene).latent)
        return float(drift.max()), f"the tool moves by {1e3 * (path[-1, 0] - path[0, 0]):.1f} mm"

    return measure


def vibrating(kind: str) -> Callable[[], tuple[float, str]]:
    """Movement of the soil under a tool that shakes by 0.1 mm to and fro at 15 Hz for a minute, before it cuts [mm]."""

    def measure() -> tuple[float, str]:
        simulator, run = simulator_of(kind), a_run(kind)
        path = run.pose[:1].repeat(3601, axis=0)
        path[:, 0] += 1e-4 * np.sin(2 * np.pi * 15.0 * np.arange(len(path)) / simulator.frame_rate)
        found = simulator.rollout(path, values=run.scene)
        return float(moved(simulator, found.latent).max()), found.excess.words()

    return measure


def shifted(**by: float) -> Change:
    """The tool moved [m] along axes."""

    def change(path: np.ndarray) -> np.ndarray:
        path = path.copy()
        for axis, distance in by.items():
            path[:, "xyz".index(axis)] += distance
        return path

    return change


def stretched(axis: str, factor: float) -> Change:
    """The tool's way along one axis, longer or shorter."""

    def change(path: np.ndarray) -> np.ndarray:
        path, i = path.copy(), "xyz".index(axis)
        path[:, i] = path[0, i] + factor * (path[:, i] - path[0, i])
        return path

    return change


def turned(axis: str, degrees: float) -> Change:
    """The tool in another orientation, the same all the way."""

    def change(path: np.ndarray) -> np.ndarray:
        path, half = path.copy(), math.radians(degrees) / 2
        path[:, 3:] = 0.0
        path[:, 3 + "xyz".index(axis)], path[:, 6] = math.sin(half), math.cos(half)
        return path

    return change


def teleported(distance: float) -> Change:
    """The tool somewhere else from the middle of its way on."""

    def change(path: np.ndarray) -> np.ndarray:
        path = path.copy()
        path[len(path) // 2 :, 0] += distance
        return path

    return change


def backwards(path: np.ndarray) -> np.ndarray:
    """The way back, driven as a way there."""
    return path[::-1].copy()


def unlike(kind: str, change: Change) -> Callable[[], tuple[float, str]]:
    """How often a path that is unlike the training runs is not flagged, or its rollout not finite or beyond bounds."""

    def measure() -> tuple[float, str]:
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

    return measure


def sound(found: Rollout) -> bool:
    """Whether all numbers of a rollout are finite."""
    return all(
        bool(np.isfinite(part).all()) for part in (found.latent, found.force, found.torque, found.poses)
    )


def held_out() -> tuple[float, str]:
    """Excess of runs of the same kind as the training's, at its largest."""
    simulator = simulator_of("quick")
    runs = [run for split in ("validation", "test") for run in quick_data().runs(split)]
    found = [simulator.rollout(run.pose, values=run.scene).excess.largest for run in runs]
    return max(found), f"{len(found)} runs"


def far_away(kind: str) -> Callable[[], tuple[float, str]]:
    """How far modes go beyond their bound when the tool jumps about by 1000 km for 1000 frames [m]."""

    def measure() -> tuple[float, str]:
        simulator, run = simulator_of(kind), a_run(kind)
        path = run.pose[:1].repeat(1000, axis=0)
        path[10:, :3] += 1e6 * np.sin(np.arange(990))[:, None]
        found = simulator.rollout(path, values=run.scene)
        if not sound(found):
            return math.nan, "not finite"
        low, high = (bound.numpy() for bound in simulator._dynamics.reach())
        beyond = np.maximum(np.maximum(low - found.latent, found.latent - high), 0.0)
        return float(beyond.max()), f"the force reaches {np.abs(found.force).max():.1e} N"

    return measure


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
    """Frames lost of a rollout that is not finite from frame 9 on."""
    simulator, run = simulator_of("pose"), a_run("pose")
    path = run.pose.copy()
    path[9, 0] = 1e300
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "r.h5"
        found = simulator.rollout(path)
        lacking, note = unsaid(
            lambda: write_rollout(target, simulator, run.scene, found),
            "not finite from frame 9",
            "r.stopped.h5",
        )
        kept = Path(folder) / "r.stopped.h5"
        problems = [line for line in check_run(kept) if "stopped after 9 good frames" not in line]
        with Run(kept) as stopped:
            return lacking + len(problems) + abs(stopped.frame_count - 9) + target.exists(), note


def body_points(count: int) -> Callable[[], tuple[float, str]]:
    """Another number of points on the tool than the 15 it was trained with: 0 if flagged and finite."""

    def measure() -> tuple[float, str]:
        simulator, run = simulator_of("points"), a_run("points")
        low, high = simulator.body_points.min(0), simulator.body_points.max(0)
        points = np.random.default_rng(0).uniform(low, high, (count, 3))
        known, found = simulator.rollout(run.pose), simulator.rollout(run.pose, points)
        share = moved(simulator, found.latent).max() / largest_movement("points", simulator)
        force = np.abs(found.force).max() / np.abs(known.force).max()
        note = (
            f"soil moves {share:.2g} times as far as in training; force {force:.2g} times that with 15 points"
        )
        flagged = found.excess.largest > NOTEWORTHY and any(
            "number" in name for name in found.excess.quantity
        )
        return (not flagged) + (not sound(found)), note

    return measure


def fewer_modes(kind: str) -> Callable[[], tuple[float, str]]:
    """Movement with 1 to all modes but one, in share of the largest of a training run."""

    def measure() -> tuple[float, str]:
        run, shares = a_run(kind), []
        path = quick_network() if kind == "quick" else synthetic_network(kind)
        whole = Simulator.load(path)
        for r in range(1, whole.num_modes):
            simulator = Simulator.load(path, num_modes=r)
            found = simulator.rollout(run.pose, values=run.scene)
            shares.append(moved(simulator, found.latent).max() / largest_movement(kind, whole))
        return float(max(shares)), ", ".join(f"{r + 1}: {share:.2f}" for r, share in enumerate(shares))

    return measure


def quaternion_signs() -> float:
    """Difference when every other quaternion has the other sign, which is the same rotation."""
    simulator, run = simulator_of("pose"), a_run("pose")
    other = run.pose.copy()
    other[::2, 3:] *= -1
    a, b = simulator.rollout(run.pose), simulator.rollout(other)
    return 1e3 * float(np.abs(a.latent - b.latent).max())


def shortest_paths() -> float:
    """Frames too many or too few along paths of one and two frames."""
    simulator, run = simulator_of("pose"), a_run("pose")
    return sum(abs(len(simulator.rollout(run.pose[:count]).latent) - count) for count in (1, 2))


def side_by_side() -> float:
    """Difference [mm] of rollouts one by one and side by side, among them paths that leave everything."""
    simulator, run = simulator_of("pose"), a_run("pose")
    changes = (lambda path: path, teleported(3.0), shifted(y=50.0), backwards)
    paths = np.stack([change(run.pose) for change in changes])
    many = simulator.rollouts(paths)
    difference = [
        np.abs(many.latent[i] - simulator.rollout(path).latent).max() for i, path in enumerate(paths)
    ]
    return 1e3 * float(max(difference))


def bad_pose(row: list[float], *words: str) -> Callable[[], tuple[float, str]]:
    """A pose that is none."""

    def measure() -> tuple[float, str]:
        simulator, run = simulator_of("pose"), a_run("pose")
        path = run.pose.copy()
        path[4] = row
        return unsaid(lambda: simulator.rollout(path), "frame 4", *words)

    return measure


FLAGGED = "flagged as unlike the training runs, and finite"
UNFLAGGED = "test runs not flagged or not finite"
BOUNDED = "the soil moves no further than twice the largest training run"
SHARE = "largest RMS movement / largest in training"
BOUND = "finite, and modes within their bounds"
STAYS = "soil at rest stays at rest"
NAMED = "refused in one line that says what and where"

CASES = [
    Case("ten times the training horizon, slowly", "errors add up over 2401 steps",
         "slow soil ends where it would have ended faster", "RMS difference of the end / movement", 1, "",
         slowly("quick", 10)),
    Case("ten times the training horizon, to and fro", "2410 steps, half of them backwards", BOUNDED, SHARE, 2, "",
         long_path("quick", 10)),
    Case("ten times the horizon, small network", "errors add up", BOUNDED, SHARE, 2, "", long_path("pose", 10),
         quick=True),
    Case("ten times the horizon, polynomials", "products of inputs grow without end", BOUNDED, SHARE, 2, "",
         long_path("polynomial", 10)),
    Case("60 s at rest in an untouched bed", "small errors of 3600 steps add up", STAYS, "largest RMS drift", 1, "mm",
         rest("untouched")),
    Case("60 s at rest after a cut", "the soil was moving until the tool stopped", STAYS, "largest RMS drift", 1, "mm",
         rest("cut")),
    Case("tool creeps by 1 um a frame for 60 s", "slower than anything trained, but not at rest",
         "soil moves no further than the tool", "RMS movement", 3.6, "mm", creeping("quick")),
    Case("tool shakes by 0.1 mm for 60 s before it cuts", "motion that no training run has", STAYS, "RMS movement", 1,
         "mm", vibrating("quick")),
    Case("held-out runs", "a false alarm would teach people to ignore it", "not flagged", "largest excess", NOTEWORTHY,
         "", held_out),
    Case("five times as deep", "deeper than the training runs", FLAGGED, UNFLAGGED, 0, "runs",
         unlike("quick", stretched("z", 5.0))),
    Case("five times as fast", "faster than the training runs", FLAGGED, UNFLAGGED, 0, "runs",
         unlike("quick", stretched("x", 5.0))),
    Case("backwards", "the tool goes the other way", FLAGGED, UNFLAGGED, 0, "runs", unlike("quick", backwards)),
    Case("10 cm to the side", "where no tool has been", FLAGGED, UNFLAGGED, 0, "runs", unlike("quick", shifted(y=0.1))),
    Case("40 cm further on", "beyond the end of every cut", FLAGGED, UNFLAGGED, 0, "runs",
         unlike("quick", shifted(x=0.4))),
    Case("raked by 80 degrees", "steeper than the training runs", FLAGGED, UNFLAGGED, 0, "runs",
         unlike("quick", turned("y", -80.0))),
    Case("turned by 30 degrees about the vertical", "never seen", FLAGGED, UNFLAGGED, 0, "runs",
         unlike("quick", turned("z", 30.0))),
    Case("teleported by 10 cm", "60 times the largest motion of a frame", FLAGGED, UNFLAGGED, 0, "runs",
         unlike("quick", teleported(0.1))),
    Case("teleported by 10 m", "the tool leaves the bin", FLAGGED, UNFLAGGED, 0, "runs",
         unlike("quick", teleported(10.0))),
    Case("teleported, small network", "motion a thousand times too large", FLAGGED, UNFLAGGED, 0, "runs",
         unlike("pose", teleported(3.0)), quick=True),
    Case("teleported, polynomials", "squares of a motion a thousand times too large", FLAGGED, UNFLAGGED, 0, "runs",
         unlike("polynomial", teleported(3.0)), quick=True),
    Case("1000 km to and fro", "features of 1e7", BOUND, "modes beyond their bound", 0, "m", far_away("quick")),
    Case("1000 km to and fro, small network", "features of 1e7", BOUND, "modes beyond their bound", 0, "m",
         far_away("pose"), quick=True),
    Case("1000 km to and fro, polynomials", "products of 1e14", BOUND, "modes beyond their bound", 0, "m",
         far_away("polynomial"), quick=True),
    Case("a step that breaks down", "the pose overflows", "refused, and the next pose goes on from the state before",
         "words lacking and difference after", 0, "", breakdown, quick=True),
    Case("a path that breaks down", "frame 9 of 14 overflows", "the frames before are kept in a file that says so",
         "words lacking and frames lost", 0, "", broken_path, quick=True),
    Case("1 body particle", "trained with 15", FLAGGED, "0 if flagged and finite", 0, "", body_points(1), quick=True),
    Case("100 body particles", "trained with 15, whose forces are summed", FLAGGED, "0 if flagged and finite", 0, "",
         body_points(100), quick=True),
    Case("fewer modes than trained", "the network never did without", BOUNDED, SHARE, 2, "", fewer_modes("quick")),
    Case("fewer modes, polynomials", "the others are put at their mean", BOUNDED, SHARE, 2, "",
         fewer_modes("polynomial"), quick=True),
    Case("quaternions of either sign", "q and -q are one rotation", "the same rollout", "largest difference", 1e-6,
         "mm", quaternion_signs, quick=True),
    Case("paths of one and two frames", "shorter than the history", "as many frames as poses",
         "frames too many or too few", 0, "frames", shortest_paths, quick=True),
    Case("far away paths side by side", "one path's rubbish beside another", "the same as one by one",
         "largest difference", 1e-3, "mm", side_by_side, quick=True),
    Case("a pose that is not finite", "NaN in a path", NAMED, "words lacking", 0, "words",
         bad_pose([math.nan, 0, 0, 0, 0, 0, 1.0], "nan", "finite"), quick=True),
    Case("a quaternion of length 0", "no orientation", NAMED, "words lacking", 0, "words",
         bad_pose([0.1, 0.3, 0.1, 0, 0, 0, 0], "quaternion of length 0"), quick=True),
]  # fmt: skip

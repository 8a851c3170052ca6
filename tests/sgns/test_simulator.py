"""The simulator a person holds: stepping, rolling out, copying, refusing."""

from __future__ import annotations

import copy
import multiprocessing
import pickle
import sys
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from sgns.config import UserError
from sgns.data.surface import soil_surface
from sgns.model.checkpoint import load_surrogate
from sgns.simulator import Simulator
from sgns.train.command import train
from sgns_testing.commands import python
from sgns_testing.stepping import assert_same, stepped
from sgns_testing.tiny import BRIEF, MODEL, POLYNOMIAL
from sgns_testing.trained import TrainedKinds

MODELS = {"pose": MODEL, "points": MODEL | {"body_nodes": "points"}, "polynomial": POLYNOMIAL}
KINDS = list(MODELS)


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> TrainedKinds:
    return TrainedKinds.of(tmp_path_factory.mktemp("tiny"), MODELS)


@pytest.fixture(scope="module")
def told(trained, tmp_path_factory) -> Simulator:
    """A network that is told the depth."""
    folder = tmp_path_factory.mktemp("told")
    train(trained.data, num_modes=4, model=MODEL | {"context": ["depth"]}, training=BRIEF, output=folder)
    return Simulator.load(folder / "best.ckpt")


def along_x(trained: TrainedKinds, steps: list[float]) -> np.ndarray:
    """Poses on along x from the test run's first; steps are in travels of the slowest training run in a frame."""
    path = trained.run.pose[:1].repeat(len(steps) + 1, axis=0)
    path[1:, 0] += trained.surrogate("pose").slowest_travel * np.cumsum(steps)
    return path


# --- Steps and rollouts ---------------------------------------------------------------------------------

# At the pace of the training, at rest, slowly, at pace, back, shaking.
CHANGING = [1.5] * 5 + [0.0] * 35 + [0.3] * 12 + [1.2] * 3 + [-0.4] * 40 + [0.2, -0.2] * 5


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("given", [False, True])
def test_stepping_is_the_rollout_at_any_pace(trained, kind, given) -> None:
    simulator, path = trained.simulator(kind), along_x(trained, CHANGING)
    history = trained.run.latent[:3, :4] if given else None
    rollout = simulator.rollout(path, latent_history=history)
    assert rollout.latent.shape == (len(path), 4, 3) and rollout.latent.dtype == np.float64
    moved = (np.diff(rollout.latent, axis=0) != 0).any(axis=(1, 2))
    assert moved[5:34].all() and not moved[34:40].any() and moved[40:52].sum() == 3 and not moved[-10:].any()
    first = 3 if given else 1
    state = simulator.reset(None if given else path, history=(history, path[:3]) if given else None)
    assert_same(state, rollout, first - 1)
    for t in range(first, len(path)):
        state = simulator.step(path[t])
        assert_same(state, rollout, t)
        np.testing.assert_array_equal(state.pose, path[t])
        assert state.outside == pytest.approx(rollout.excess.amount[t], rel=1e-12)
    assert state.frame == len(path) - first
    # From the same file the same comes again.
    assert_same(trained.simulator(kind).rollout(path, latent_history=history), rollout)


@pytest.mark.parametrize("kind", ["pose", "points"])
def test_many_paths_are_the_paths_one_by_one(trained, kind) -> None:
    simulator, count = trained.simulator(kind), len(CHANGING)
    paces = (CHANGING, [0.0] * count, [0.1] * count, [1.3] * count)
    paths = np.stack([along_x(trained, list(pace)) for pace in paces])
    many = simulator.rollouts(paths, paths_at_once=3)
    assert many.latent.shape == (4, count + 1, 4, 3) and many.wall_time_s > 0
    np.testing.assert_array_equal(many.poses, paths)
    for i, path in enumerate(paths):
        one = simulator.rollout(path)
        for name in ("latent", "force", "torque"):
            found, expected = getattr(many, name)[i], getattr(one, name)
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5 * max(np.abs(expected).max(), 1.0))
    assert not np.diff(many.latent[1], axis=0).any() and not many.force[1].any()


@pytest.mark.parametrize("kind", KINDS)
def test_a_path_goes_on_from_anywhere_as_steps_do(trained, kind) -> None:
    """At any pace, at its beginning, at rest, while the tool creeps, and after it."""
    simulator, path = trained.simulator(kind), along_x(trained, CHANGING)
    states = stepped(simulator, path)
    for here in (0, 38, 46, 57):
        stepped(simulator, path[: here + 1])
        start, first = simulator.save(), simulator.rollout(path[: here + 1])
        for begin in (start, first.end):
            rest = simulator.rollout(path[here:], start=begin)
            for frame, state in enumerate(states[here:]):
                if kind != "points" or begin is start:
                    assert_same(state, rest, frame)
                else:  # what is kept of the edges within a body is not in a rollout's end
                    np.testing.assert_allclose(state.latent, rest.latent[frame], rtol=0, atol=1e-5)
        stepped(simulator, trained.data.runs("train")[0].pose[:3])
        simulator.restore(start)
        for pose, state in zip(path[here + 1 :], states[here + 1 :], strict=True):
            assert_same(simulator.step(pose), state)


def test_each_path_has_its_own_start_and_values(trained, told) -> None:
    simulator, path = told, trained.run.pose
    scene = simulator.scene
    deeper = scene | {"depth": 1.5 * scene["depth"]}
    simulator.reset(path, values=deeper)
    for pose in path[1:4]:
        simulator.step(pose)
    here = simulator.save()
    stepped(simulator, path[:4])
    there = simulator.save()
    starts, values = [here, there, here, there], [None, None, scene, deeper]
    paths = np.stack([path[3:]] * 4)
    many = simulator.rollouts(paths, start=starts, values=values)
    each = [simulator.rollout(path[3:], start=s, values=v) for s, v in zip(starts, values, strict=True)]
    for i, one in enumerate(each):
        np.testing.assert_allclose(many.force[i], one.force, rtol=0, atol=1e-5 * np.abs(one.force).max())
        assert many.outside[i] == pytest.approx(one.outside, rel=1e-3, abs=1e-6)
    # Without values a path goes on with those of its start.
    assert np.abs(each[0].force - each[2].force).max() > 1e-6
    simulator.restore(here)
    assert_same(simulator.step(path[4]), each[0], 1)
    for depths in (values[2:], [deeper, scene]):
        both = simulator.rollouts(paths[:2], values=depths)
        for i, told_of in enumerate(depths):
            one = simulator.rollout(path[3:], values=told_of)
            np.testing.assert_allclose(both.latent[i], one.latent, rtol=0, atol=1e-5)


def test_what_is_given_stays(trained) -> None:
    """Also after it, until a step is taken."""
    run, simulator = trained.run, trained.simulator("pose")
    history = run.latent[:3, :4]
    loads = {"force_history": run.force[:3], "torque_history": run.torque[:3]}
    rollout = simulator.rollout(along_x(trained, [0.0] * 9), latent_history=history, **loads)
    for found, expected in ((rollout.force, run.force), (rollout.torque, run.torque)):
        np.testing.assert_array_equal(found, expected[[0, 1] + [2] * 8])
    rollout = simulator.rollout(run.pose, latent_history=history)
    np.testing.assert_array_equal(rollout.latent[:3], history)
    assert not rollout.force[:3].any()


@pytest.mark.parametrize("kind", KINDS)
def test_at_the_pace_of_the_training_every_frame_is_a_step(trained, kind) -> None:
    surrogate = trained.surrogate(kind)
    following, plain = Simulator(surrogate), Simulator(surrogate, rate_independent=False)
    for run in trained.data.runs("train") + trained.data.runs("test"):
        for history in (None, run.latent[:3, :4]):
            found, expected = (s.rollout(run.pose, latent_history=history) for s in (following, plain))
            assert_same(found, expected)
            assert (np.diff(found.latent[2:], axis=0) != 0).any(axis=(1, 2)).all()


@pytest.mark.parametrize("kind", KINDS)
def test_a_path_driven_slowly_leaves_the_same_soil(trained, kind) -> None:
    simulator, fast = trained.simulator(kind), along_x(trained, [1.1] * 12)
    slow = along_x(trained, [1.1 / 4] * 48)
    slow[::4] = fast
    known, found = simulator.rollout(fast), simulator.rollout(slow)
    assert_same(found, known, np.arange(49) // 4)  # in between nothing happens
    own = trained.simulator(kind, rate_independent=False).rollout(slow)
    assert (own.latent[-1] != found.latent[-1]).any()


@pytest.mark.parametrize("kind", KINDS)
def test_soil_settles_and_is_held_while_the_tool_rests(trained, kind) -> None:
    path, surrogate = trained.run.pose, trained.surrogate(kind)
    pause = np.concatenate([path[:7], path[6:7].repeat(60, axis=0), path[7:]])
    found, own = (Simulator(surrogate, rate_independent=follows).rollout(pause) for follows in (True, False))
    # It follows the clock for half a second more.
    np.testing.assert_array_equal(found.latent[:36], own.latent[:36])
    held = found.latent[35:67]
    np.testing.assert_array_equal(held, held[:1].repeat(len(held), axis=0))
    assert (found.latent[34] != held[0]).any() and (found.latent[67] != held[0]).any()
    assert (np.diff(own.latent[35:67], axis=0) != 0).any()


def test_soil_is_decoded_from_the_modes(trained) -> None:
    data, simulator = trained.data, trained.simulator("pose")
    state = simulator.reset(trained.run.pose[0])
    np.testing.assert_array_equal(state.soil(), simulator.basis.inverse(state.latent).numpy())
    np.testing.assert_array_equal(simulator.start_positions, data.start_positions)
    surface = state.surface()
    np.testing.assert_array_equal(surface.z, soil_surface(state.soil(), simulator.scene).z)
    # At rest the soil is the common start, as far as four modes can say it.
    error = np.abs(state.soil() - data.start_positions).max()
    assert error <= np.abs(data.start_positions - data.basis.mean.numpy()).max() + 1e-9


def test_it_knows_where_it_comes_from(trained) -> None:
    data, simulator = trained.data, trained.simulator("pose")
    assert simulator.arrangement_hash == data.basis.arrangement_hash
    assert simulator.scene == data.runs("train")[0].scene
    assert (simulator.num_modes, simulator.history, simulator.frame_rate) == (4, 3, 60.0)
    assert simulator.basis.fitted_on == ["a", "b", "c", "d"]
    points = simulator.rollout(data.runs("train")[0].pose).body_points
    np.testing.assert_allclose(points, data.runs("train")[0].body_points, atol=1e-6)


def test_another_number_of_body_points_can_be_rolled_out(trained) -> None:
    simulator = trained.simulator("points")
    rollout = simulator.rollout(trained.run.pose, simulator.body_points[:6])
    assert rollout.body_points.shape == (14, 6, 3) and np.isfinite(rollout.latent).all()
    simulator.reset(trained.run.pose[0], body_points=simulator.body_points[:6])
    for pose in trained.run.pose[1:]:
        state = simulator.step(pose)
    np.testing.assert_allclose(state.latent, rollout.latent[-1], atol=1e-6)
    # From where another tool has stepped to, too.
    stepped(simulator, trained.run.pose[:6])
    on = trained.run.pose[5:], simulator.body_points[:6]
    one, many = (
        simulator.rollout(*on, start=simulator.save()),
        simulator.rollouts(on[0][None], on[1], start=simulator.save()),
    )
    np.testing.assert_allclose(one.latent, many.latent[0], atol=1e-6)


def test_fewer_modes_than_it_was_trained_with(trained) -> None:
    run, simulator = trained.run, trained.simulator("pose", num_modes=2)
    rollout = simulator.rollout(run.pose, latent_history=run.latent[:3, :2])
    assert rollout.latent.shape == (14, 2, 3) and np.isfinite(rollout.latent).all()
    assert simulator.basis.num_modes == simulator.num_modes == 2
    simulator.reset(history=(run.latent[:3, :2], run.pose[:3]))
    np.testing.assert_array_equal(simulator.step(run.pose[3]).latent, rollout.latent[3])


# --- Far from the training runs -------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["pose", "polynomial"])
def test_modes_stay_near_their_training_range(trained, kind) -> None:
    for num_modes in (4, 2):
        simulator = trained.simulator(kind, num_modes=num_modes)
        runs = np.concatenate([run.latent[:, :num_modes] for run in trained.data.runs("train")])
        low, high = (bound.numpy() for bound in simulator.dynamics.reach())
        width = runs.max(axis=0) - runs.min(axis=0)
        beyond = np.maximum(runs.min(axis=0) - low, high - runs.max(axis=0))
        # A mode that varies little is given a tenth of the widest one's range.
        assert (beyond <= 0.75 * np.maximum(width, 0.1 * width.max()) + 1e-12).all()
        assert (low <= runs.min(axis=0)).all() and (high >= runs.max(axis=0)).all()


@pytest.mark.parametrize("kind", ["pose", "polynomial"])
def test_it_says_how_far_a_path_is_outside(trained, kind) -> None:
    simulator, path = trained.simulator(kind), trained.data.runs("train")[0].pose.copy()
    assert np.isnan(simulator.reset().outside)
    path[9:, 1] += 1.0
    with pytest.warns(
        UserWarning, match=r"at frame 9 the tool's displacement per frame \(y\) is .* times its train"
    ):
        rollout = simulator.rollout(path)
    excess = rollout.excess
    assert repr(rollout).endswith(f"outside={excess.largest:.3g})")
    # The network has hardly been trained: its soil leaves the range as well, but not as far.
    assert excess.amount[:9].max() < 1 < excess.amount[9:].min()
    assert excess.quantity[9] == "the tool's displacement per frame (y)"
    told = [0.0] + [state.outside for state in stepped(simulator, path)[1:]]  # without a second warning
    np.testing.assert_allclose(told, excess.amount, rtol=1e-12)


@pytest.mark.parametrize("kind", ["pose", "polynomial"])
def test_many_paths_say_how_far_each_is_outside(trained, kind) -> None:
    """With one warning, also where their first frames are far from the last of the path before."""
    path = trained.data.runs("train")[0].pose
    aside, far = path.copy(), path.copy()
    aside[:, 1] += 1.0
    far[:, :3] *= 1e3
    paths = np.stack([path, aside, path, far, path])
    trained.simulator(kind).rollouts(paths[[0, 2, 4]], paths_at_once=2)  # without a warning
    for at_once in (2, 256):
        simulator = trained.simulator(kind)
        words = r"far outside .*: 2 of 5 paths, worst of all path 3; there, at frame \d+ the tool's .*; positions look"
        with pytest.warns(UserWarning, match=words) as caught:
            many = simulator.rollouts(paths, paths_at_once=at_once)
        simulator.rollouts(paths)
        assert len(caught) == 1
        each = [simulator.rollout(one) for one in paths]
        assert many.outside.shape == (5,)
        np.testing.assert_allclose(many.outside, [one.outside for one in each], rtol=1e-3, atol=1e-6)
        np.testing.assert_array_equal(many.outside > 0.5, [False, True, False, True, False])


def test_soil_and_surface_of_paths(trained) -> None:
    simulator, path = trained.simulator("pose"), trained.run.pose
    many = simulator.rollouts(np.stack([path[:6], path[4:10]]))
    first, *_, last = stepped(simulator, path[4:10])
    soil = many.soil(1)
    np.testing.assert_allclose(soil, last.soil(), rtol=0, atol=1e-6)
    np.testing.assert_array_equal(soil, many.soil(-1, frame=5))
    np.testing.assert_array_equal(many.surface(1).z, soil_surface(soil, simulator.scene).z)
    np.testing.assert_array_equal(many.soil(0, 0), first.soil())
    one = simulator.rollout(path[4:10])
    np.testing.assert_allclose(one.soil(), last.soil(), rtol=0, atol=1e-6)
    np.testing.assert_array_equal(one.surface().z, soil_surface(one.soil(), simulator.scene).z)
    np.testing.assert_array_equal(one.soil(0), first.soil())
    with pytest.raises(UserError, match=r"frame is 6; there are 6 frames: 0 to 5"):
        one.soil(6)
    with pytest.raises(UserError, match=r"path is 2; there are 2 paths: 0 to 1"):
        many.soil(2)
    with pytest.raises(UserError, match=r"frame is 0.5; there are 6 frames: 0 to 5"):
        many.surface(0, frame=0.5)


def test_a_step_far_outside_is_told_once(trained) -> None:
    simulator, pose = trained.simulator("pose"), trained.run.pose[0].copy()
    simulator.reset(pose)
    pose[2] += 5.0
    with pytest.warns(UserWarning, match=r"at frame 1 the tool's .* \(`outside` of"):
        state = simulator.step(pose)
    assert state.outside > 0.5 and f"outside={state.outside:.3g})" in repr(state)
    simulator.reset()
    for _ in range(2):
        simulator.step(pose)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda place: place + np.eye(3)[1], r"displacement per frame \(y\) is \S+ times"),
        (
            lambda place: 1e3 * place,
            "outside of it; positions look like millimetres and are taken as metres: ",
        ),
    ],
    ids=["aside", "millimetres"],
)
def test_a_step_far_outside_is_told_when_it_comes(trained, change, words) -> None:
    simulator, path = trained.simulator("pose"), trained.run.pose[:8].copy()
    path[6, :3] = change(path[6, :3])
    stepped(simulator, path[:6])
    with pytest.warns(UserWarning, match=f"at frame 6 .*{words}") as caught:
        simulator.step(path[6])
    simulator.step(path[7])
    assert len(caught) == 1 and ("millimetres" in str(caught[0].message)) == ("millimetres" in words)


def test_a_tool_that_turns_far_outside_is_told_when_it_does(trained) -> None:
    """In its middle, so that neither place nor displacement say so."""
    simulator, path = trained.simulator("pose"), trained.run.pose[:7].copy()
    path[6, 3:] = (Rotation.from_euler("z", 90, degrees=True) * Rotation.from_quat(path[6, 3:])).as_quat()
    stepped(simulator, path[:6])
    with pytest.warns(UserWarning, match=r"at frame 6 the tool's (rotation per frame|orientation)"):
        simulator.step(path[6])


@pytest.mark.parametrize("kind", ["pose", "points"])
def test_nothing_runs_away_far_from_everything(trained, kind) -> None:
    simulator, path = trained.simulator(kind), trained.run.pose.repeat(50, axis=0)
    path[100:, :3] += 1e6 * np.sin(np.arange(len(path) - 100))[:, None]
    rollout = simulator.rollout(path)
    low, high = (bound.numpy() for bound in simulator.dynamics.reach())
    assert (rollout.latent >= low).all() and (rollout.latent <= high).all()
    assert np.isfinite(rollout.force).all()


def test_an_answer_that_is_not_finite_stops_and_keeps_the_frame_before(trained) -> None:
    simulator, path = trained.simulator("pose"), trained.run.pose
    expected = simulator.rollout(path[:4])
    stepped(simulator, path[:3])
    far = path[3].copy()
    far[0] = 1e300
    with pytest.raises(UserError, match="not finite at frame 3"):
        simulator.step(far)
    state = simulator.step(path[3])
    assert state.frame == 3
    assert_same(state, expected, 3)


def test_a_first_pose_that_is_refused_is_forgotten(trained) -> None:
    simulator, pose = trained.simulator("pose", rate_independent=False), trained.run.pose[0]
    far = pose.copy()
    far[0] = 1e300
    with pytest.raises(UserError, match="not finite at frame 1"):
        simulator.step(far)
    state = simulator.step(pose)
    simulator.reset()
    expected = simulator.step(pose)
    assert state.frame == 1 and state.outside == expected.outside
    assert_same(state, expected)


# --- Copies, processes, threads; what is shared with whom -----------------------------------------------


def reloaded(something):
    return pickle.loads(pickle.dumps(something))


@pytest.mark.parametrize("num_modes", [None, 2])
@pytest.mark.parametrize("kind", KINDS)
def test_copies_go_on_to_the_bit_and_on_their_own(trained, kind, num_modes) -> None:
    path, away = trained.run.pose, trained.data.runs("train")[0].pose[::-1]
    simulator = trained.simulator(kind, num_modes=num_modes)
    for first in (None, path):  # as it was loaded; put on its place
        for taken in (0, 5):
            simulator.reset(first)
            expected = [simulator.step(pose) for pose in path[1:9]]
            simulator.reset(first)
            for pose in path[1 : 1 + taken]:
                simulator.step(pose)
            ways = copy.copy, copy.deepcopy, reloaded
            others = [simulator, *(way(simulator) for way in ways)]
            strays = [way(simulator) for way in ways]
            for t in range(taken, 8):
                for stray in strays:
                    stray.step(away[t])
                for each in others:
                    state = each.step(path[1 + t])
                    assert_same(state, expected[t])
                    assert (state.frame, state.outside) == (expected[t].frame, expected[t].outside)


def test_a_copy_is_pickled_without_what_is_computed_again(trained) -> None:
    simulator = trained.simulator("points")
    size = len(pickle.dumps(trained.surrogate("points")))
    state = simulator.reset(trained.run.pose)
    assert len(pickle.dumps(simulator)) < size + 30_000 and len(pickle.dumps(state)) < 20_000


@pytest.mark.filterwarnings("ignore:.*multi-threaded.*:DeprecationWarning")
@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="no fork")
@pytest.mark.parametrize("method", ["fork", pytest.param("spawn", marks=pytest.mark.long)])
def test_other_processes_answer_the_same(trained, method) -> None:
    path = trained.run.pose
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context(method)) as pool:
        for kind in ("points", "polynomial"):
            simulator = trained.simulator(kind)
            kept = simulator.body_points, simulator.start_positions, simulator.mean_force
            known = [array.copy() for array in kept]
            simulator.reset(path)
            for pose in path[1:7]:
                # A step from here there, then here: what was sent away has not moved what stayed.
                there = pool.submit(copy.copy(simulator).step, pose).result(timeout=100)
                here = simulator.step(pose)
                assert_same(there, here)
                assert there.outside == here.outside
                np.testing.assert_array_equal(there.soil(), here.soil())
            rollout = simulator.rollout(path)
            assert_same(pool.submit(simulator.rollout, path).result(timeout=100), rollout)
            away = copy.copy(simulator)
            away.reset()
            assert_same(pool.submit(away.restore, simulator.save()).result(timeout=100), here)
            np.testing.assert_array_equal(here.latent, rollout.latent[6])
            for array, expected in zip(kept, known, strict=True):
                np.testing.assert_array_equal(array, expected)


def test_threads_with_a_simulator_each_do_not_meet(trained) -> None:
    path, surrogate = trained.run.pose, trained.surrogate("points")
    whole, fewer = Simulator(surrogate), Simulator(surrogate, num_modes=2)
    both = np.stack([path, path[::-1]])

    def answers(simulator: Simulator) -> list[np.ndarray]:
        latent = [state.latent for state in stepped(simulator, path)]
        return [np.stack(latent), simulator.rollout(path).latent, simulator.rollouts(both).latent]

    simulators = [whole, fewer, copy.copy(whole), copy.copy(fewer)]
    expected = [answers(each) for each in simulators]
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    try:
        with ThreadPoolExecutor(4) as pool:
            for _ in range(3):
                for found, known in zip(pool.map(answers, simulators), expected, strict=True):
                    for part, known_part in zip(found, known, strict=True):
                        np.testing.assert_array_equal(part, known_part)
    finally:
        sys.setswitchinterval(interval)


@pytest.mark.parametrize("kind", ["points", "polynomial"])
def test_what_was_given_and_what_was_answered_may_be_written_to(trained, kind) -> None:
    path, simulator = trained.run.pose, trained.simulator(kind)
    expected = simulator.rollout(path)
    given, points, values = path.copy(), simulator.body_points.copy(), simulator.scene
    rollout = simulator.rollout(given, points, values=values)
    state = simulator.reset(given, values=values)
    kept = reloaded(state)
    states = [state]
    for t in range(1, 14):
        row = given[t].copy()
        states.append(simulator.step(row))
        row[:] = np.nan
        for part in (states[-1].latent, states[-1].force, states[-1].torque, states[-1].pose):
            part += 1.0
            part -= 1.0
        assert states[-1].outside == pytest.approx(expected.excess.amount[t], rel=1e-9)
    given[:], points[:] = np.nan, np.nan
    values.clear()
    simulator.scene.clear()
    np.testing.assert_allclose(np.stack([s.latent for s in states]), expected.latent, rtol=0, atol=1e-12)
    assert_same(state, kept)
    np.testing.assert_array_equal(state.pose, path[0])
    assert state.outside == kept.outside
    assert_same(rollout, expected)
    for each in (reloaded(rollout), rollout):
        np.testing.assert_array_equal(each.excess.amount, expected.excess.amount)
    assert_same(simulator.rollout(path), expected)


# --- Refusals -------------------------------------------------------------------------------------------


class Other:
    """A scene of the bed that the simulator knows, or of another one, with points and poses of its own."""

    def __init__(self, simulator: Simulator, points: object, poses: object, bed: str = "") -> None:
        self.arrangement_hash = bed or simulator.arrangement_hash
        self.to_dict = lambda: simulator.scene
        self.body_points = lambda: points
        self.body_poses = lambda: poses


@pytest.mark.parametrize("kind", ["points", "polynomial"])
def test_a_refusal_changes_nothing(trained, kind) -> None:
    path, z, simulator = trained.run.pose, trained.run.latent[:3, :4], trained.simulator(kind)
    points = simulator.body_points
    stepped(simulator, path[:5])
    refused = {
        "first pose": lambda: simulator.reset(np.full(7, np.nan)),
        "first pose is not numeric": lambda: simulator.reset({"kind": "excavation"}),
        "particles": lambda: simulator.reset(Other(simulator, points, path, "another")),
        "body points holds": lambda: simulator.reset(Other(simulator, points * np.nan, path)),
        r"body points has shape \(0, 3\)": lambda: simulator.reset(Other(simulator, points[:0], path)),
        "first pose has shape": lambda: simulator.reset(Other(simulator, points, path[:, :6])),
        "must be a pair": lambda: simulator.reset(history=(z,)),
        "pair": lambda: simulator.reset(history=5),
        "history holds": lambda: simulator.reset(history=(z * np.nan, path[:3])),
        "history is not numeric": lambda: simulator.reset(history=(z.astype(str), path[:3])),
        "has 2 poses": lambda: simulator.reset(history=(z, path[:2])),
        "history of poses": lambda: simulator.reset(history=(z, path[:3] * np.nan)),
        "values is a str": lambda: simulator.reset(path, values="scene"),
        r"has shape \(3, 7\); it needs .* shape \(7,\)": lambda: simulator.step(path[5:8]),
        r"has shape \(1, 7\)": lambda: simulator.step(path[5:6]),
        "frame 5": lambda: simulator.step(np.full(7, np.inf)),
        "bool": lambda: simulator.step(np.ones(7, dtype=bool)),
        "complex": lambda: simulator.step(path[5] + 0j),
    }
    for match, attempt in refused.items():
        plain = copy.copy(simulator)
        with pytest.raises(UserError, match=match):
            attempt()
        # The next frame is taken by a copy, so that every attempt is made at the same one.
        found, expected = copy.copy(simulator).step(path[5]), plain.step(path[5])
        assert (found.frame, found.outside) == (expected.frame, expected.outside)
        assert_same(found, expected)


def test_an_interrupted_step_is_as_if_not_tried(trained, monkeypatch) -> None:
    simulator, path = trained.simulator("points"), along_x(trained, [1.5, 1.7, 1.9, 2.1])
    stepped(simulator, path[:2])
    plain, memory = copy.copy(simulator), simulator._steppers[0].memory
    turned = path[2].copy()
    turned[3:] = [0.0, 1.0, 0.0, 0.0]

    def interrupted(step: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(simulator, "_require_finite", interrupted)
    with pytest.raises(KeyboardInterrupt):
        simulator.step(turned)
    monkeypatch.undo()
    # What is kept of the edges within the body is that of the step before, too: it differs by rounding only.
    assert all(now is then for now, then in zip(simulator._steppers[0].memory, memory, strict=True))
    for pose in path[2:]:
        assert_same(simulator.step(pose), plain.step(pose))


def test_what_rollouts_are_given_is_looked_at(trained) -> None:
    path, z, simulator = trained.run.pose, trained.run.latent[:3, :4], trained.simulator("pose")
    points, force, broken = simulator.body_points, np.zeros((3, 3)), path.copy()
    broken[7, 2] = np.nan
    for match, bad in {
        "body points holds": np.full((4, 3), np.nan),
        r"\(0, 3\); it needs shape \(M, 3\)": points[:0],
        r"\(3,\); it needs": points[0],
        "not numeric": "points",
    }.items():
        for attempt in (lambda p: simulator.rollout(path, p), lambda p: simulator.rollouts(path[None], p)):
            with pytest.raises(UserError, match=match):
                attempt(bad)
    for match, given in {
        "frame 7": {"poses": broken},
        r"history has shape \(2, 4, 3\)": {"poses": path[:5], "latent_history": z[:2]},
        "at least 3": {"poses": path[:2], "latent_history": z},
        "force history holds": {"latent_history": z, "force_history": force * np.nan},
        r"force history has shape \(3,\); it needs shape \(3, 3\)": {
            "latent_history": z,
            "force_history": force[0],
        },
        "torque history is not numeric": {"latent_history": z, "torque_history": force.astype(bool)},
        "needs the latent history": {"force_history": force},
        "latent history is not numeric": {"latent_history": z.astype(complex)},
        "latent history holds": {"latent_history": np.full_like(z, np.inf)},
        "values is a list": {"values": []},
    }.items():
        with pytest.raises(UserError, match=match):
            simulator.rollout(**({"poses": path} | given))
    with pytest.raises(UserError, match="paths, frames, 7"):
        simulator.rollouts(path)
    with pytest.raises(UserError, match="path 1"):
        simulator.rollouts(np.stack([path, broken]))
    for count in (0, "a", 1.5, True, None):
        with pytest.raises(UserError, match="paths_at_once"):
            simulator.rollouts(path[None], paths_at_once=count)
    expected = simulator.rollout(path, latent_history=z)
    fixed = z.copy()
    fixed.flags.writeable = False
    for same in (z.tolist(), torch.tensor(z), torch.tensor(z).requires_grad_(), fixed):
        assert_same(simulator.rollout(path.tolist(), latent_history=same), expected)


def test_what_a_simulator_is_made_of_is_looked_at(trained) -> None:
    surrogate = trained.surrogate("pose")
    for device in ("meta", "mps", 5000, "nonsense", None, 1.5):
        with pytest.raises(UserError, match=r"cannot be used: .*; use device=cpu"):
            Simulator(surrogate, device)
    for num_modes in (0, 1.5, True, 5, "2"):
        with pytest.raises(UserError, match=r"num_modes is .*; allowed: 1 to 4, with which"):
            Simulator(surrogate, num_modes=num_modes)
    for rate_independent in (None, 1, "yes"):
        with pytest.raises(UserError, match="rate_independent"):
            Simulator(surrogate, rate_independent=rate_independent)
    # None of this has harmed what was given.
    assert Simulator(surrogate, num_modes=np.int64(3), rate_independent=np.True_).num_modes == 3


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="has no fork")
def test_a_forked_pool_works_with_one_thread_each() -> None:
    """As docs/faq.md says; without the initializer it hangs, since the parent has used several threads."""
    code = """
import multiprocessing, torch

def work(size):
    return float((torch.ones(size, size) @ torch.ones(size, size))[0, 0])

torch.set_num_threads(2)
work(2000)
with multiprocessing.get_context("fork").Pool(2, initializer=torch.set_num_threads, initargs=(1,)) as pool:
    print(pool.map(work, [1500, 1500]))
"""
    assert python(code).stdout == "[1500.0, 1500.0]\n"


# --- several members ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def ensemble(trained, tmp_path_factory):
    """Checkpoint of two members."""
    folder = tmp_path_factory.mktemp("ensemble")
    train(trained.data, num_modes=4, model=MODEL, training=BRIEF | {"members": 2}, output=folder)
    return folder / "best.ckpt"


def test_without_a_spread_the_first_member_answers(trained, ensemble) -> None:
    surrogate, path = load_surrogate(ensemble), trained.run.pose
    each = []
    for index in range(2):
        alone = load_surrogate(ensemble)
        alone.dynamics = alone.dynamics.member(index)
        each.append(Simulator(alone).rollout(path))
    first, both = Simulator(surrogate).rollout(path), Simulator(surrogate, spread=True).rollout(path)
    assert_same(first, each[0])
    assert first.force_spread is None and first.latent_spread is None
    forces = np.stack([one.force for one in each])
    np.testing.assert_array_equal(both.force, forces.mean(axis=0))
    factor = surrogate.dynamics.band[:3].numpy()
    assert both.force_spread == pytest.approx(factor * forces.std(axis=0, ddof=1))
    assert both.latent_spread.shape == both.latent.shape and both.latent_spread[1:].all()
    assert not both.force_spread[0].any() and not both.latent_spread[0].any()  # the bed at rest is known


def test_steps_of_several_members_are_their_rollout(trained, ensemble) -> None:
    simulator, path = Simulator.load(ensemble, spread=True), along_x(trained, CHANGING)
    states, found = stepped(simulator, path), simulator.rollout(path)
    many = simulator.rollouts(np.stack([path, path]), paths_at_once=1)
    copied = copy.deepcopy(simulator)
    for frame, state in enumerate(states):
        assert_same(state, found, frame)
        np.testing.assert_array_equal(state.force_spread, found.force_spread[frame])
        np.testing.assert_array_equal(state.latent_spread, found.latent_spread[frame])
    np.testing.assert_array_equal(many.force_spread[1], found.force_spread)
    start = simulator.save()
    more = path[-1:].repeat(3, axis=0)
    rest = simulator.rollout(more, start=start)
    for frame in (1, 2):
        assert_same(copied.step(more[frame]), rest, frame)
        state = simulator.step(more[frame])
        assert_same(state, rest, frame)
        np.testing.assert_array_equal(state.force_spread, rest.force_spread[frame])
    np.testing.assert_array_equal(simulator.restore(rest.end).latent_spread, rest.latent_spread[-1])
    assert np.isfinite(states[-1].outside)


def test_equal_members_have_no_spread(trained, ensemble) -> None:
    surrogate = load_surrogate(ensemble)
    (other,) = surrogate.dynamics.others
    for name, part in other.items():
        part.load_state_dict(getattr(surrogate.dynamics, name).state_dict())
    found = Simulator(surrogate, spread=True).rollout(trained.run.pose)
    assert found.force.any() and not found.force_spread.any() and not found.latent_spread.any()


def test_a_step_that_one_member_cannot_take_changes_nothing(trained, ensemble) -> None:
    surrogate, path = load_surrogate(ensemble), trained.run.pose
    simulator, network = Simulator(surrogate, spread=True), surrogate.dynamics.others[0]["network"]
    good = copy.deepcopy(network.state_dict())
    network.decode.linears[-1].bias.fill_(torch.nan)
    simulator.reset(path)  # which copies the weights
    with pytest.raises(UserError, match="not finite at frame 1"):
        simulator.step(path[1])
    assert "at frame 0" in repr(simulator)
    network.load_state_dict(good)
    assert_same(copy.copy(simulator).step(path[1]), stepped(Simulator(surrogate, spread=True), path[:2])[1])


@pytest.mark.parametrize("kind", KINDS)
def test_one_network_has_no_spread(trained, kind) -> None:
    with pytest.raises(UserError, match=r"spread is true, and this \w+ has one member; train with training"):
        trained.simulator(kind, spread=True)
    with pytest.raises(UserError, match="spread is 'yes'; it must be True or False"):
        trained.simulator(kind, spread="yes")

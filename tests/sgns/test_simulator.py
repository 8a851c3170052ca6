"""The simulator a person holds: stepping, rolling out, loading, refusing."""

from __future__ import annotations

import copy
import multiprocessing
import pickle
import sys
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor

import numpy as np
import pytest
import torch

from sgns.config import UserError
from sgns.model.checkpoint import load_surrogate
from sgns.simulator import Simulator
from sgns.train.command import train
from sgns_testing.tiny import FIT, MODEL, POLYNOMIAL, TRAINING, reduced


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Reduced data and checkpoints: networks with each kind of body node, and polynomials."""
    folder = tmp_path_factory.mktemp("tiny")
    data = reduced(folder)
    for kind in ("pose", "points"):
        model = MODEL | {"body_nodes": kind}
        train(data, num_modes=4, model=model, training=TRAINING, output=folder / kind)
    train(data, num_modes=4, model=POLYNOMIAL, training=FIT, output=folder / "polynomial")
    return data, folder


@pytest.mark.parametrize("kind", ["pose", "points", "polynomial"])
def test_rollout_is_stepping(trained, kind) -> None:
    data, folder = trained
    run = data.runs("test")[0]
    simulator = Simulator.load(folder / kind / "best.ckpt")
    rollout = simulator.rollout(run.pose)
    assert rollout.latent.shape == (14, 4, 3) and rollout.latent.dtype == np.float64
    state = simulator.reset(run.pose)
    np.testing.assert_array_equal(state.latent, rollout.latent[0])
    for t in range(1, 14):
        state = simulator.step(run.pose[t])
        np.testing.assert_array_equal(state.latent, rollout.latent[t])
        np.testing.assert_array_equal(state.force, rollout.force[t])
        np.testing.assert_array_equal(state.torque, rollout.torque[t])
    assert simulator.step_count == 13


@pytest.mark.parametrize("kind", ["pose", "points"])
def test_many_paths_are_the_paths_one_by_one(trained, kind) -> None:
    data, folder = trained
    simulator = Simulator.load(folder / kind / "best.ckpt")
    paths = np.stack([run.pose for run in data.runs("train")[:3]])
    many = simulator.rollouts(paths, paths_at_once=2)
    assert many.latent.shape == (3, 14, 4, 3) and many.wall_time_s > 0
    np.testing.assert_array_equal(many.poses, paths)
    for i, path in enumerate(paths):
        one = simulator.rollout(path)
        for name in ("latent", "force", "torque"):
            found, expected = getattr(many, name)[i], getattr(one, name)
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5 * np.abs(expected).max())


def test_bad_paths_are_named(trained) -> None:
    data, folder = trained
    simulator = Simulator.load(folder / "pose" / "best.ckpt")
    paths = np.stack([run.pose for run in data.runs("train")[:2]])
    with pytest.raises(UserError, match="paths, frames, 7"):
        simulator.rollouts(paths[0])
    with pytest.raises(UserError, match="paths_at_once"):
        simulator.rollouts(paths, paths_at_once=0)
    paths[1, 3, 0] = np.nan
    with pytest.raises(UserError, match="path 1"):
        simulator.rollouts(paths)


def test_rollout_from_true_frames_is_stepping_from_them(trained) -> None:
    data, folder = trained
    run = data.runs("test")[0]
    simulator = Simulator.load(folder / "pose" / "best.ckpt")
    history = run.latent[:3, :4]
    rollout = simulator.rollout(run.pose, latent_history=history, force_history=run.force[:3])
    np.testing.assert_array_equal(rollout.latent[:3], history)
    np.testing.assert_array_equal(rollout.force[:3], run.force[:3])
    simulator.reset(history=(history, run.pose[:3]))
    for t in range(3, 14):
        state = simulator.step(run.pose[t])
        np.testing.assert_array_equal(state.latent, rollout.latent[t])
        np.testing.assert_array_equal(state.force, rollout.force[t])
    again = simulator.rollout(run.pose, latent_history=history)
    np.testing.assert_array_equal(again.latent, rollout.latent)
    assert not again.force[:3].any()


def test_soil_is_decoded_from_the_modes(trained) -> None:
    data, folder = trained
    simulator = Simulator.load(folder / "pose" / "best.ckpt")
    state = simulator.reset(data.runs("test")[0].pose[0])
    np.testing.assert_array_equal(state.soil(), simulator.basis.inverse(state.latent).numpy())
    np.testing.assert_array_equal(simulator.start_positions, data.start_positions)
    # At rest the soil is the common start, as far as four modes can say it.
    error = np.abs(state.soil() - data.start_positions).max()
    assert error <= np.abs(data.start_positions - data.basis.mean.numpy()).max() + 1e-9


@pytest.mark.parametrize("kind", ["pose", "polynomial"])
def test_reloading_gives_the_same_rollout_to_the_bit(trained, kind) -> None:
    data, folder = trained
    run = data.runs("test")[0]
    first, second = (Simulator.load(folder / kind / "best.ckpt").rollout(run.pose) for _ in range(2))
    np.testing.assert_array_equal(first.latent, second.latent)
    np.testing.assert_array_equal(first.force, second.force)


def test_it_knows_where_it_comes_from(trained) -> None:
    data, folder = trained
    simulator = Simulator.load(folder / "pose" / "best.ckpt")
    assert simulator.arrangement_hash == data.arrangement_hash
    assert simulator.scene == data.runs("train")[0].scene
    assert (simulator.num_modes, simulator.history, simulator.frame_rate) == (4, 3, 60.0)
    assert simulator.basis.fitted_on == ["a", "b", "c", "d"]
    points = simulator.rollout(data.runs("train")[0].pose).body_points
    np.testing.assert_allclose(points, data.runs("train")[0].body_points, atol=1e-6)


def test_another_number_of_body_points_can_be_rolled_out(trained) -> None:
    data, folder = trained
    simulator = Simulator.load(folder / "points" / "best.ckpt")
    rollout = simulator.rollout(data.runs("test")[0].pose, simulator.body_points[:6])
    assert rollout.body_points.shape == (14, 6, 3) and np.isfinite(rollout.latent).all()


class OtherBed:
    """A scene of another bed."""

    arrangement_hash = "another"

    def body_poses(self) -> np.ndarray:
        return np.zeros((3, 7))


def test_bad_input_is_named(trained) -> None:
    data, folder = trained
    simulator = Simulator.load(folder / "pose" / "best.ckpt")
    poses = data.runs("test")[0].pose.copy()
    poses[7, 2] = np.nan
    with pytest.raises(UserError, match="frame 7"):
        simulator.rollout(poses)
    simulator.reset(poses)
    simulator.step(poses[1])
    with pytest.raises(UserError, match="frame 2"):
        simulator.step(np.full(7, np.inf))
    with pytest.raises(UserError, match="particles"):
        simulator.reset(OtherBed())
    with pytest.raises(UserError, match="history"):
        simulator.rollout(poses[:5], latent_history=np.zeros((2, 4, 3)))
    with pytest.raises(UserError, match="at least 3"):
        simulator.rollout(poses[:2], latent_history=np.zeros((3, 4, 3)))


def test_bad_checkpoints_are_named(trained, tmp_path) -> None:
    _, folder = trained
    whole = (folder / "pose" / "best.ckpt").read_bytes()
    for name, content in (("truncated", whole[: len(whole) // 2]), ("empty", b""), ("text", b"hello")):
        path = tmp_path / f"{name}.ckpt"
        path.write_bytes(content)
        with pytest.raises(UserError, match=f"{name}.ckpt"):
            Simulator.load(path)
    torch.save({"state_dict": {}, "hyper_parameters": {"lr": 1.0}}, tmp_path / "foreign.ckpt")
    with pytest.raises(UserError, match="not a checkpoint of sgns"):
        Simulator.load(tmp_path / "foreign.ckpt")
    with pytest.raises(UserError, match="no checkpoint"):
        Simulator.load(tmp_path / "absent.ckpt")

    content = torch.load(folder / "pose" / "best.ckpt", weights_only=True)
    content["hyper_parameters"]["format_version"] = 99
    torch.save(content, tmp_path / "future.ckpt")
    with pytest.raises(UserError, match="newer"):
        Simulator.load(tmp_path / "future.ckpt")
    content["hyper_parameters"]["format_version"] = 1
    card = content["hyper_parameters"]
    mesh = card | {"scene": card["scene"] | {"tool": {"shape": "mesh", "file": "/etc/passwd"}}}
    torch.save(content | {"hyper_parameters": mesh}, tmp_path / "asking.ckpt")
    with pytest.raises(UserError, match="names a mesh file without the digest"):
        Simulator.load(tmp_path / "asking.ckpt")
    del content["state_dict"]["surrogate.basis_modes"]
    torch.save(content, tmp_path / "incomplete.ckpt")
    with pytest.raises(UserError, match="fit together"):
        Simulator.load(tmp_path / "incomplete.ckpt")


def test_fewer_modes_than_it_was_trained_with(trained) -> None:
    data, folder = trained
    run = data.runs("test")[0]
    simulator = Simulator.load(folder / "pose" / "best.ckpt", num_modes=2)
    rollout = simulator.rollout(run.pose, latent_history=run.latent[:3, :2])
    assert rollout.latent.shape == (14, 2, 3) and np.isfinite(rollout.latent).all()
    assert simulator.basis.num_modes == simulator.num_modes == 2
    simulator.reset(history=(run.latent[:3, :2], run.pose[:3]))
    np.testing.assert_array_equal(simulator.step(run.pose[3]).latent, rollout.latent[3])
    with pytest.raises(UserError, match="trained with 4 modes and cannot have 5; allowed: 1 to 4"):
        Simulator.load(folder / "pose" / "best.ckpt", num_modes=5)


def along_x(simulator: Simulator, pose: np.ndarray, steps: list[float]) -> np.ndarray:
    """Poses from a first one on along x; steps are in travels of the slowest training run in a frame."""
    path = pose[None].repeat(len(steps) + 1, axis=0)
    path[1:, 0] += simulator._surrogate.slowest_travel * np.cumsum(steps)
    return path


# At the pace of the training, at rest, slowly, at pace, back, shaking.
CHANGING = [1.5] * 5 + [0.0] * 35 + [0.3] * 12 + [1.2] * 3 + [-0.4] * 40 + [0.2, -0.2] * 5


@pytest.mark.parametrize("kind", ["pose", "points", "polynomial"])
def test_at_the_pace_of_the_training_every_frame_is_a_step(trained, kind) -> None:
    data, folder = trained
    surrogate = load_surrogate(folder / kind / "best.ckpt")
    following, plain = Simulator(surrogate), Simulator(surrogate, rate_independent=False)
    for run in data.runs("train") + data.runs("test"):
        for history in (None, run.latent[:3, :4]):
            found, expected = (s.rollout(run.pose, latent_history=history) for s in (following, plain))
            np.testing.assert_array_equal(found.latent, expected.latent)
            np.testing.assert_array_equal(found.force, expected.force)
            assert (np.diff(found.latent[2:], axis=0) != 0).any(axis=(1, 2)).all()


@pytest.mark.parametrize("kind", ["pose", "points", "polynomial"])
def test_a_path_driven_slowly_leaves_the_same_soil(trained, kind) -> None:
    data, folder = trained
    simulator = Simulator.load(folder / kind / "best.ckpt")
    start = data.runs("test")[0].pose[0]
    known = simulator.rollout(along_x(simulator, start, [1.1] * 12))
    slow = along_x(simulator, start, [1.1 / 4] * 48)
    slow[::4] = along_x(simulator, start, [1.1] * 12)
    found = simulator.rollout(slow)
    for name in ("latent", "force", "torque"):
        # In between nothing happens.
        np.testing.assert_array_equal(getattr(found, name)[:-1], getattr(known, name)[:-1].repeat(4, axis=0))
        np.testing.assert_array_equal(getattr(found, name)[-1], getattr(known, name)[-1])
    own = Simulator.load(folder / kind / "best.ckpt", rate_independent=False).rollout(slow)
    assert (own.latent[-1] != found.latent[-1]).any()


@pytest.mark.parametrize("kind", ["pose", "points", "polynomial"])
def test_soil_settles_and_is_held_while_the_tool_rests(trained, kind) -> None:
    data, folder = trained
    path = data.runs("test")[0].pose
    pause = np.concatenate([path[:7], path[6:7].repeat(60, axis=0), path[7:]])
    surrogate = load_surrogate(folder / kind / "best.ckpt")
    found, own = (Simulator(surrogate, rate_independent=follows).rollout(pause) for follows in (True, False))
    # It follows the clock for half a second more.
    np.testing.assert_array_equal(found.latent[:36], own.latent[:36])
    held = found.latent[35:67]
    np.testing.assert_array_equal(held, held[:1].repeat(len(held), axis=0))
    assert (found.latent[34] != held[0]).any() and (found.latent[67] != held[0]).any()
    assert (np.diff(own.latent[35:67], axis=0) != 0).any()


@pytest.mark.parametrize("kind", ["pose", "points", "polynomial"])
@pytest.mark.parametrize("given", [False, True])
def test_stepping_is_the_rollout_at_any_pace(trained, kind, given) -> None:
    data, folder = trained
    run = data.runs("test")[0]
    simulator = Simulator.load(folder / kind / "best.ckpt")
    path = along_x(simulator, run.pose[0], CHANGING)
    history = run.latent[:3, :4] if given else None
    rollout = simulator.rollout(path, latent_history=history)
    moved = (np.diff(rollout.latent, axis=0) != 0).any(axis=(1, 2))
    assert moved[5:34].all() and not moved[34:40].any() and moved[40:52].sum() == 3 and not moved[-10:].any()
    first = 3 if given else 1
    state = simulator.reset(None if given else path, history=(history, path[:3]) if given else None)
    for t in range(first, len(path)):
        state = simulator.step(path[t])
        np.testing.assert_array_equal(state.latent, rollout.latent[t])
        np.testing.assert_array_equal(state.force, rollout.force[t])
        np.testing.assert_array_equal(state.pose, path[t])
        assert state.outside == pytest.approx(rollout.excess.amount[t], rel=1e-12)


def test_paths_of_different_paces_side_by_side(trained) -> None:
    data, folder = trained
    simulator = Simulator.load(folder / "pose" / "best.ckpt")
    pose, count = data.runs("test")[0].pose[0], len(CHANGING)
    steps = (CHANGING, [0.0] * count, [0.1] * count, [1.3] * count)
    paths = np.stack([along_x(simulator, pose, list(each)) for each in steps])
    many = simulator.rollouts(paths)
    for i, path in enumerate(paths):
        one = simulator.rollout(path)
        for name in ("latent", "force", "torque"):
            found, expected = getattr(many, name)[i], getattr(one, name)
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5 * max(np.abs(expected).max(), 1.0))
    assert not np.diff(many.latent[1], axis=0).any() and not many.force[1].any()


def test_the_given_force_stays_until_a_step_is_taken(trained) -> None:
    data, folder = trained
    run = data.runs("test")[0]
    simulator = Simulator.load(folder / "pose" / "best.ckpt")
    path = along_x(simulator, run.pose[0], [0.0] * 9)
    rollout = simulator.rollout(path, latent_history=run.latent[:3, :4], force_history=run.force[:3])
    np.testing.assert_array_equal(rollout.force[2:], run.force[2:3].repeat(8, axis=0))


@pytest.mark.parametrize(
    ("key", "value", "line"),
    [
        ("slowest_travel", float("nan"), "the slowest travel is nan"),
        ("slowest_travel", None, "fit together"),
        ("training_range", None, "fit together"),
        ("training_range", {"low": {}, "high": {}}, "fit together"),
    ],
)
def test_a_card_that_does_not_say_what_was_trained_is_refused(trained, tmp_path, key, value, line) -> None:
    content = torch.load(trained[1] / "pose" / "best.ckpt", weights_only=True)
    content["hyper_parameters"][key] = value
    torch.save(content, tmp_path / "bad.ckpt")
    with pytest.raises(UserError, match=line):
        Simulator.load(tmp_path / "bad.ckpt")


@pytest.mark.parametrize("kind", ["pose", "polynomial"])
def test_modes_stay_near_their_training_range(trained, kind) -> None:
    data, folder = trained
    for num_modes in (4, 2):
        simulator = Simulator.load(folder / kind / "best.ckpt", num_modes=num_modes)
        runs = np.concatenate([run.latent[:, :num_modes] for run in data.runs("train")])
        low, high = (bound.numpy() for bound in simulator._dynamics.reach())
        width = runs.max(axis=0) - runs.min(axis=0)
        beyond = np.maximum(runs.min(axis=0) - low, high - runs.max(axis=0))
        # A mode that varies little is given a tenth of the widest one's range.
        assert (beyond <= 0.75 * np.maximum(width, 0.1 * width.max()) + 1e-12).all()
        assert (low <= runs.min(axis=0)).all() and (high >= runs.max(axis=0)).all()


@pytest.mark.parametrize("kind", ["pose", "polynomial"])
def test_it_says_how_far_a_path_is_outside(trained, kind) -> None:
    data, folder = trained
    simulator = Simulator.load(folder / kind / "best.ckpt")
    run = data.runs("train")[0]
    assert np.isnan(simulator.reset().outside)
    path = run.pose.copy()
    path[9:, 1] += 1.0
    rollout = simulator.rollout(path)
    # The network has hardly been trained: its soil leaves the range as well, but not as far.
    assert rollout.excess.amount[:9].max() < 1 < rollout.excess.amount[9:].min()
    assert rollout.excess.quantity[9] == "the tool's displacement per frame (y)"
    simulator.reset(path)
    told = [0.0] + [simulator.step(pose).outside for pose in path[1:]]
    np.testing.assert_allclose(told, rollout.excess.amount, rtol=1e-12)


def test_a_checkpoint_that_is_not_finite_is_refused(trained, tmp_path) -> None:
    _, folder = trained
    content = torch.load(folder / "pose" / "best.ckpt", weights_only=True)
    name = next(name for name in content["state_dict"] if name.endswith("weight"))
    content["state_dict"][name][0] = float("nan")
    torch.save(content, tmp_path / "bad.ckpt")
    with pytest.raises(UserError, match="not finite"):
        Simulator.load(tmp_path / "bad.ckpt")


@pytest.mark.parametrize("rate", [float("inf"), float("nan"), 0.0, -60.0])
def test_a_checkpoint_without_a_frame_rate_is_refused(trained, tmp_path, rate) -> None:
    _, folder = trained
    content = torch.load(folder / "pose" / "best.ckpt", weights_only=True)
    content["hyper_parameters"]["frame_rate"] = rate
    torch.save(content, tmp_path / "bad.ckpt")
    with pytest.raises(UserError, match="frame rate is"):
        Simulator.load(tmp_path / "bad.ckpt")


@pytest.mark.parametrize("kind", ["pose", "points"])
def test_nothing_runs_away_far_from_everything(trained, kind) -> None:
    data, folder = trained
    simulator = Simulator.load(folder / kind / "best.ckpt")
    path = data.runs("test")[0].pose.repeat(50, axis=0)
    path[100:, :3] += 1e6 * np.sin(np.arange(len(path) - 100))[:, None]
    rollout = simulator.rollout(path)
    low, high = (bound.numpy() for bound in simulator._dynamics.reach())
    assert (rollout.latent >= low).all() and (rollout.latent <= high).all()
    assert np.isfinite(rollout.force).all()


def test_an_answer_that_is_not_finite_stops_and_keeps_the_frame_before(trained) -> None:
    data, folder = trained
    simulator = Simulator.load(folder / "pose" / "best.ckpt")
    path = data.runs("test")[0].pose
    expected = simulator.rollout(path[:4])
    simulator.reset(path)
    for pose in path[1:3]:
        simulator.step(pose)
    far = path[3].copy()
    far[0] = 1e300
    with pytest.raises(UserError, match="not finite at frame 3"):
        simulator.step(far)
    state = simulator.step(path[3])
    assert state.frame == 3
    np.testing.assert_array_equal(state.latent, expected.latent[3])


def test_a_first_pose_that_is_refused_is_forgotten(trained) -> None:
    data, folder = trained
    simulator = Simulator.load(folder / "pose" / "best.ckpt", rate_independent=False)
    pose = data.runs("test")[0].pose[0]
    far = pose.copy()
    far[0] = 1e300
    with pytest.raises(UserError, match="not finite at frame 1"):
        simulator.step(far)
    state = simulator.step(pose)
    simulator.reset()
    expected = simulator.step(pose)
    assert state.frame == 1 and state.outside == expected.outside
    np.testing.assert_array_equal(state.latent, expected.latent)


def assert_same(found, expected) -> None:
    """Two states or rollouts, to the bit."""
    for name in ("latent", "force", "torque"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


def reloaded(something):
    return pickle.loads(pickle.dumps(something))


@pytest.mark.parametrize("num_modes", [None, 2])
@pytest.mark.parametrize("kind", ["pose", "points", "polynomial"])
def test_copies_go_on_to_the_bit_and_on_their_own(trained, kind, num_modes) -> None:
    data, folder = trained
    path = data.runs("test")[0].pose
    away = data.runs("train")[0].pose[::-1]
    simulator = Simulator.load(folder / kind / "best.ckpt", num_modes=num_modes)
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
    data, folder = trained
    simulator = Simulator.load(folder / "points" / "best.ckpt")
    size = len(pickle.dumps(simulator._surrogate))
    state = simulator.reset(data.runs("test")[0].pose)
    assert len(pickle.dumps(simulator)) < size + 30_000 and len(pickle.dumps(state)) < 20_000


@pytest.mark.filterwarnings("ignore:.*multi-threaded.*:DeprecationWarning")
@pytest.mark.parametrize(
    "method", [m for m in ("fork", "spawn") if m in multiprocessing.get_all_start_methods()]
)
def test_other_processes_answer_the_same(trained, method) -> None:
    data, folder = trained
    path = data.runs("test")[0].pose
    context = multiprocessing.get_context(method)
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        for kind in ("points", "polynomial"):
            simulator = Simulator.load(folder / kind / "best.ckpt")
            known = simulator.body_points.copy(), simulator.start_positions.copy(), simulator.mean_force
            mean_force = known[2].copy()
            simulator.reset(path)
            for pose in path[1:7]:
                # A step from here there, then here: what was sent away has not moved what stayed.
                there = pool.submit(copy.copy(simulator).step, pose).result(timeout=100)
                here = simulator.step(pose)
                assert_same(there, here)
                assert there.outside == here.outside
                np.testing.assert_array_equal(there.soil(), here.soil())
            assert_same(pool.submit(simulator.rollout, path).result(timeout=100), simulator.rollout(path))
            np.testing.assert_array_equal(here.latent, simulator.rollout(path).latent[6])
            np.testing.assert_array_equal(simulator.body_points, known[0])
            np.testing.assert_array_equal(simulator.start_positions, known[1])
            np.testing.assert_array_equal(known[2], mean_force)


def test_threads_with_a_simulator_each_do_not_meet(trained) -> None:
    data, folder = trained
    path = data.runs("test")[0].pose
    surrogate = load_surrogate(folder / "points" / "best.ckpt")
    whole, fewer = Simulator(surrogate), Simulator(surrogate, num_modes=2)
    both = np.stack([path, path[::-1]])

    def stepped(simulator: Simulator) -> list[np.ndarray]:
        simulator.reset(path)
        latent = [simulator.step(pose).latent for pose in path[1:]]
        return [np.stack(latent), simulator.rollout(path).latent, simulator.rollouts(both).latent]

    simulators = [whole, fewer, copy.copy(whole), copy.copy(fewer)]
    expected = [stepped(each) for each in simulators]
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    try:
        with ThreadPoolExecutor(4) as pool:
            for _ in range(3):
                for found, known in zip(pool.map(stepped, simulators), expected, strict=True):
                    for part, known_part in zip(found, known, strict=True):
                        np.testing.assert_array_equal(part, known_part)
    finally:
        sys.setswitchinterval(interval)


@pytest.mark.parametrize("kind", ["points", "polynomial"])
def test_what_was_given_and_what_was_answered_may_be_written_to(trained, kind) -> None:
    data, folder = trained
    path = data.runs("test")[0].pose
    simulator = Simulator.load(folder / kind / "best.ckpt")
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
    np.testing.assert_array_equal(reloaded(rollout).excess.amount, expected.excess.amount)
    np.testing.assert_array_equal(rollout.excess.amount, expected.excess.amount)
    assert_same(simulator.rollout(path), expected)


class Other:
    """A scene of the bed that the simulator knows, with points and poses of its own."""

    def __init__(self, simulator: Simulator, points: object, poses: object) -> None:
        self.arrangement_hash = simulator.arrangement_hash
        self.to_dict = lambda: simulator.scene
        self.body_points = lambda: points
        self.body_poses = lambda: poses


@pytest.mark.parametrize("kind", ["points", "polynomial"])
def test_a_refusal_changes_nothing(trained, kind) -> None:
    data, folder = trained
    path, z = data.runs("test")[0].pose, data.runs("test")[0].latent[:3, :4]
    simulator = Simulator.load(folder / kind / "best.ckpt")
    points = simulator.body_points
    simulator.reset(path)
    for pose in path[1:5]:
        simulator.step(pose)
    refused = {
        "first pose": lambda: simulator.reset(np.full(7, np.nan)),
        "first pose is not numeric": lambda: simulator.reset({"kind": "excavation"}),
        "particles": lambda: simulator.reset(OtherBed()),
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
        "bool": lambda: simulator.step(np.ones(7, dtype=bool)),
        "complex": lambda: simulator.step(path[5] + 0j),
    }
    for match, attempt in refused.items():
        plain = copy.copy(simulator)
        with pytest.raises(UserError, match=match):
            attempt()
        found, expected = simulator.step(path[5]), plain.step(path[5])
        assert (found.frame, found.outside) == (expected.frame, expected.outside)
        assert_same(found, expected)


def test_an_interrupted_step_is_as_if_not_tried(trained, monkeypatch) -> None:
    data, folder = trained
    simulator = Simulator.load(folder / "points" / "best.ckpt")
    path = along_x(simulator, data.runs("test")[0].pose[0], [1.5, 1.7, 1.9, 2.1])
    simulator.reset(path)
    simulator.step(path[1])
    plain, memory = copy.copy(simulator), simulator._stepper.memory
    turned = path[2].copy()
    turned[3:] = [0.0, 1.0, 0.0, 0.0]

    def interrupted(step: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(simulator, "_require_finite", interrupted)
    with pytest.raises(KeyboardInterrupt):
        simulator.step(turned)
    monkeypatch.undo()
    # What is kept of the edges within the body is that of the step before, too: it differs by rounding only.
    assert all(now is then for now, then in zip(simulator._stepper.memory, memory, strict=True))
    for pose in path[2:]:
        assert_same(simulator.step(pose), plain.step(pose))


def test_what_rollouts_are_given_is_looked_at(trained) -> None:
    data, folder = trained
    path, z = data.runs("test")[0].pose, data.runs("test")[0].latent[:3, :4]
    simulator = Simulator.load(folder / "pose" / "best.ckpt")
    points, force = simulator.body_points, np.zeros((3, 3))
    for match, bad in {
        "body points holds": np.full((4, 3), np.nan),
        r"\(0, 3\); it needs shape \(M, 3\)": points[:0],
        r"\(3,\); it needs": points[0],
        "not numeric": "points",
    }.items():
        with pytest.raises(UserError, match=match):
            simulator.rollout(path, bad)
        with pytest.raises(UserError, match=match):
            simulator.rollouts(path[None], bad)
    for match, given in {
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
            simulator.rollout(path, **given)
    for count in ("a", 1.5, True, None):
        with pytest.raises(UserError, match="paths_at_once"):
            simulator.rollouts(path[None], paths_at_once=count)
    expected = simulator.rollout(path, latent_history=z)
    fixed = z.copy()
    fixed.flags.writeable = False
    for same in (z.tolist(), torch.tensor(z), torch.tensor(z).requires_grad_(), fixed):
        assert_same(simulator.rollout(path.tolist(), latent_history=same), expected)


def test_what_a_simulator_is_made_of_is_looked_at(trained) -> None:
    _, folder = trained
    surrogate = load_surrogate(folder / "pose" / "best.ckpt")
    for device in ("meta", "mps", 5000, "nonsense", None, 1.5):
        with pytest.raises(UserError, match=r"cannot be used: .*; use device=cpu"):
            Simulator(surrogate, device)
    for num_modes in (0, 1.5, True, 5, "2"):
        with pytest.raises(UserError, match="allowed: 1 to 4"):
            Simulator(surrogate, num_modes=num_modes)
    for rate_independent in (None, 1, "yes"):
        with pytest.raises(UserError, match="rate_independent"):
            Simulator(surrogate, rate_independent=rate_independent)
    # None of this has harmed what was given.
    assert Simulator(surrogate, num_modes=np.int64(3), rate_independent=np.True_).num_modes == 3

"""What a simulator answers, and where it may start from: snapshots, surfaces, named dimensions."""

from __future__ import annotations

import pickle
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from mpm_warp import Scene
from sgns import Simulator
from sgns.config import UserError
from sgns.state import Snapshot
from sgns_testing.stepping import assert_same, stepped


@pytest.fixture(scope="module")
def loaded() -> Simulator:
    return Simulator.pretrained("excavation")


@pytest.fixture
def simulator(loaded) -> Simulator:
    return pickle.loads(pickle.dumps(loaded))


@pytest.fixture(scope="module")
def path(loaded) -> np.ndarray:
    return Scene.from_dict(loaded.scene).body_poses()[:60]


# --- Snapshots ------------------------------------------------------------------------------------------


def test_a_restored_simulator_goes_on_to_the_bit(simulator, path) -> None:
    stepped(simulator, path[:31])
    saved = simulator.save()
    assert isinstance(saved, Snapshot) and saved.frame == 30
    kept = pickle.dumps(saved)
    assert len(kept) < 10_000
    expected = [simulator.step(pose) for pose in path[31:]]
    for other in (simulator, Simulator.pretrained("excavation")):
        here = other.restore(pickle.loads(kept))
        assert here.frame == 30 and here.outside == other.restore(saved).outside
        np.testing.assert_array_equal(here.latent, saved.latent)
        np.testing.assert_array_equal(here.pose, saved.pose)
        for pose, state in zip(path[31:], expected, strict=True):
            found = other.step(pose)
            assert_same(found, state)
            assert (found.frame, found.outside) == (state.frame, state.outside)


def test_a_snapshot_may_be_written_to(simulator, path) -> None:
    """It changes neither the simulator nor what is restored."""
    stepped(simulator, path[:10])
    saved = simulator.save()
    expected = simulator.restore(saved)
    for part in (saved.latent, saved.pose, expected.latent, expected.force):
        part += 1.0
    found = simulator.restore(saved)
    np.testing.assert_allclose(found.latent, expected.latent - 1.0, atol=1e-9)
    np.testing.assert_array_equal(found.pose, path[9])


def test_a_snapshot_of_a_tool_that_is_nowhere_yet(simulator, path) -> None:
    simulator.reset()
    saved, expected = simulator.save(), simulator.rollout(path)
    assert np.isnan(saved.pose).all()
    assert_same(simulator.rollout(path, start=saved), expected)
    simulator.restore(saved)
    simulator.step(path[0])
    assert_same(simulator.step(path[1]), expected, 1)


def test_a_path_goes_on_where_another_ends(simulator, path) -> None:
    whole, first = simulator.rollout(path), simulator.rollout(path[:21])
    rest = simulator.rollout(path[20:], start=first.end)
    assert first.end.frame == 20 and rest.end.frame == len(path) - 1
    assert_same(rest, whole, slice(20, None))
    np.testing.assert_allclose(rest.excess.amount[1:], whole.excess.amount[21:], rtol=1e-12)
    many = simulator.rollouts(np.stack([path[:21], path[:21]]))
    again = simulator.rollouts(np.stack([path[20:]] * 2), start=many.ends, paths_at_once=1)
    for i in range(2):
        np.testing.assert_allclose(again.latent[i], rest.latent, rtol=0, atol=1e-5)
    state = simulator.restore(first.end)
    assert_same(state, whole, 20)
    assert state.outside == pytest.approx(whole.excess.amount[20], rel=1e-9)
    assert_same(simulator.step(path[21]), whole, 21)


def test_paths_from_where_it_is_leave_it_there(simulator, path) -> None:
    stepped(simulator, path[:31])
    here = simulator.save()
    deeper = path[30:].copy()
    deeper[:, 2] -= np.linspace(0.0, 0.01, len(deeper))
    many = simulator.rollouts(np.stack([path[30:], deeper]), start=here)
    assert many.latent.shape[:2] == many.force.shape[:2] == (2, len(path) - 30)
    np.testing.assert_array_equal(many.latent[:, 0], [here.latent] * 2)
    assert (many.outside[1] > 0) and np.isfinite(many.outside).all()
    for i, poses in enumerate((path[30:], deeper)):
        one = simulator.rollout(poses, start=here)
        for name in ("latent", "force", "torque"):
            found, expected = getattr(many, name)[i], getattr(one, name)
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5 * max(np.abs(expected).max(), 1.0))
        assert many.outside[i] == pytest.approx(one.outside, rel=1e-3, abs=1e-6)
    assert_same(simulator.step(path[31]), simulator.rollout(path[:32]), 31)


def test_a_start_that_is_none_is_refused(simulator, path) -> None:
    stepped(simulator, path[:5])
    here, other = simulator.save(), Simulator.pretrained("excavation", num_modes=4)
    aside = path[4:9].copy()
    aside[:, 1] += 0.01
    both = np.stack([path[4:9]] * 2)
    refused = {
        r"snapshot was saved by another simulator \(network \w{8}, 8 modes.*, 4 modes": lambda: other.restore(
            here
        ),
        "snapshot is a State; it must be what `Simulator.save` gives": lambda: simulator.restore(
            simulator.reset(path)
        ),
        "another simulator": lambda: other.rollouts(both, start=here),
        "path 0 begins at .*, and the tool of its start is at": lambda: simulator.rollout(aside, start=here),
        "start is <3 items>; it must be one for all paths, or a list of 2": lambda: simulator.rollouts(
            both, start=[here] * 3
        ),
        "snapshot is a str": lambda: simulator.rollouts(both, start=["here", here]),
        "values is .*; it must be one for all paths, or a list of 2": lambda: simulator.rollouts(
            both, values=[simulator.scene]
        ),
        "values is a str": lambda: simulator.rollouts(both, values=["scene", "scene"]),
        "begins with a start or with a latent history": lambda: simulator.rollout(
            path[4:9], latent_history=np.stack([here.latent] * simulator.history), start=here
        ),
    }
    for match, attempt in refused.items():
        with pytest.raises(UserError, match=match):
            attempt()


def test_rollouts_of_one_simulator_in_several_threads(simulator, path) -> None:
    """As one after the other, also while it is stepped elsewhere."""
    stepped(simulator, path[:31])
    here = simulator.save()
    paths = [path[30 : 34 + i] for i in range(6)]
    expected = [simulator.rollout(one, start=here) for one in paths]
    after = [simulator.step(pose) for pose in path[31:]]
    simulator.restore(here)
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    try:
        with ThreadPoolExecutor(3) as pool:
            answers = pool.map(lambda one: simulator.rollout(one, start=here), paths)
            for pose, state in zip(path[31:], after, strict=True):
                assert_same(simulator.step(pose), state)
            for found, known in zip(answers, expected, strict=True):
                assert_same(found, known)
    finally:
        sys.setswitchinterval(interval)


@pytest.mark.long  # times say little while other tests run
def test_a_step_takes_about_the_time_of_a_frame_of_a_rollout(simulator, path) -> None:
    ratios = []
    for _ in range(15):
        simulator.reset(path)
        begin = time.process_time()
        for pose in path[1:]:
            simulator.step(pose)
        middle = time.process_time()
        simulator.rollout(path)
        ratios.append((middle - begin) / (time.process_time() - middle))
    assert np.median(ratios) < 2.0  # it was 3.0


# --- Surfaces and named dimensions ----------------------------------------------------------------------


def test_a_surface_has_the_cells_that_are_asked_for(simulator, path) -> None:
    rollout = simulator.rollout(path)
    state, (lx, ly, _) = stepped(simulator, path)[-1], simulator.scene["bed"]["size"]
    columns = state.surface()
    for edge in (0.02, 0.003):
        x, y, z = state.surface(edge)
        assert (x[1] - x[0], y[1] - y[0]) == pytest.approx((edge, edge), rel=0.1)
        assert z.shape == (round(lx / edge), round(ly / edge)) == (len(x), len(y))
        # The volume above the plane z = 0 is that of the columns.
        assert z.mean() == pytest.approx(columns.z.mean(), abs=1e-12)
        np.testing.assert_array_equal(rollout.surface(resolution=edge).z, z)
    assert columns.to_xarray().sel(x=0.1, method="nearest").sizes == {"y": len(columns.y)}


@pytest.mark.parametrize("edge", [0.0, -1.0, 1e-5, 5.0, np.nan, "fine"])
def test_cells_of_no_size_are_refused(simulator, edge) -> None:
    with pytest.raises(
        UserError, match=r"resolution is .*; allowed: the edge of a cell in metres, 0\.\d+ to"
    ):
        simulator.reset().surface(edge)


def test_answers_have_named_dimensions(simulator, path) -> None:
    rollout = simulator.rollout(path)
    state = stepped(simulator, path)[-1]
    found = state.to_xarray()
    np.testing.assert_array_equal(found.position.sel(axis="z"), state.soil()[:, 2])
    assert float(found.time) == pytest.approx(59 / 60) and found.force.units == "N"
    along = rollout.to_xarray()
    assert dict(along.sizes) == {"time": 60, "mode": 8, "axis": 3, "component": 7, "point": 15}
    assert float(along.pose.sel(component="qw")[3]) == path[3, 6] and along.time.units == "s"
    np.testing.assert_array_equal(along.force.sel(axis="x"), rollout.force[:, 0])
    many = simulator.rollouts(np.stack([path, path]))
    each = many.to_xarray()
    assert each.latent.dims == ("path", "time", "mode", "axis")
    np.testing.assert_array_equal(each.outside, many.outside)


def test_without_xarray_it_is_named(simulator, path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "xarray", None)
    state = simulator.reset(path)
    for ask, who in (
        (state.to_xarray, "state"),
        (state.surface().to_xarray, "surface"),
        (simulator.rollout(path).to_xarray, "rollout"),
    ):
        with pytest.raises(UserError, match=rf"{who}\.to_xarray\(\) needs xarray, .*; pip install xarray"):
            ask()

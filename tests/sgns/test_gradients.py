"""The differentiable simulator: it says what the simulator says, and its gradients are right."""

from __future__ import annotations

import weakref
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from sgns import Simulator, TorchSimulator, UserError
from sgns.gradients import TorchPath, tool_poses
from sgns_testing.tiny import MODEL, POLYNOMIAL
from sgns_testing.trained import TrainedKinds

TOLD = {"context": ["depth", "speed"]}
MODELS = {
    "pose": MODEL | TOLD | {"predicts": "velocity"},
    "points": MODEL | TOLD | {"body_nodes": "points", "edge_scale": 0.1, "next_motion": False},
    "polynomial": POLYNOMIAL | TOLD,
}
WHEELS = {"pose": MODEL | TOLD, "polynomial": POLYNOMIAL | TOLD}
KINDS = [*MODELS, "wheel pose", "wheel polynomial"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> dict[str, TrainedKinds]:
    """Of blades and, by "wheel", of bodies whose height is free."""
    blades = TrainedKinds.of(tmp_path_factory.mktemp("blade"), MODELS)
    wheels = TrainedKinds.of(tmp_path_factory.mktemp("wheel"), WHEELS, scene={"kind": "wheel"})
    return {"blade": blades, "wheel": wheels}


def simulator_of(trained, kind: str, **kw) -> tuple[Simulator, TorchSimulator, np.ndarray, np.ndarray]:
    """Both simulators, poses of the test run, and its first three latent positions."""
    body, _, model = kind.rpartition(" ")
    found = trained[body or "blade"]
    simulator = found.simulator(model, **kw)
    return simulator, TorchSimulator(simulator), found.run.pose, found.run.latent[:3, :4]


def assert_near(found, expected, share: float = 1e-5) -> None:
    """To single precision of the largest."""
    expected = np.asarray(expected)
    np.testing.assert_allclose(found, expected, rtol=0, atol=share * max(np.abs(expected).max(), 1e-3))


# --- Values -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("given", [False, True])
def test_it_says_what_the_simulator_says(trained, kind, given) -> None:
    simulator, differentiable, poses, history = simulator_of(trained, kind)
    start = history if given else None
    expected = simulator.rollout(poses, latent_history=start)
    with torch.no_grad():
        path = differentiable.rollout(poses, latent_history=start)
    for name in ("latent", "force", "torque", "poses"):
        assert_near(getattr(path, name), getattr(expected, name))
    assert_near(differentiable.outside(path), expected.excess.amount, 1e-4)
    assert_near(differentiable.soil(path.latent[-1]), expected.soil())
    state = differentiable.start(poses[:3] if given else poses[:1], latent_history=start)
    for t in range(3 if given else 1, len(poses)):
        state = differentiable.step(state, poses[t])
        torch.testing.assert_close(state.latent[0, -1], path.latent[t], rtol=0, atol=1e-10)
        torch.testing.assert_close(state.force[0], path.force[t], rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(state.torque[0], path.torque[t], rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(state.poses[0, -1], path.poses[t], rtol=0, atol=1e-10)


@pytest.mark.parametrize("kind", MODELS)
def test_under_a_slow_tool_the_soil_rests_as_in_the_simulator(trained, kind) -> None:
    simulator, differentiable, poses, _ = simulator_of(trained, kind)
    least = trained["blade"].surrogate(kind).slowest_travel
    paths = poses[:1].repeat(60, axis=0)[None].repeat(2, axis=0)
    paths[0, 1:, 0] += least * np.cumsum([1.5] * 5 + [0.0] * 35 + [0.3] * 19)
    paths[1, 1:, 0] += least * np.cumsum([1.1] * 59)
    path = differentiable.rollout(paths)
    state = differentiable.start(paths[:, :1])
    for t in range(60):
        if t > 0:
            state = differentiable.step(state, paths[:, t])
        torch.testing.assert_close(state.latent[:, -1], path.latent[:, t], rtol=0, atol=1e-10)
    for i, one in enumerate(paths):
        expected = simulator.rollout(one)
        assert_near(path.latent[i], expected.latent)
        assert_near(path.force[i], expected.force)


def test_context_and_start_are_taken(trained) -> None:
    simulator, differentiable, poses, history = simulator_of(trained, "pose")
    scene = simulator.scene
    told = differentiable.rollout(
        np.stack([poses, poses]), {"depth": torch.tensor([scene["depth"], 0.3])}, np.stack([history, history])
    )
    for i, depth in enumerate((scene["depth"], 0.3)):
        expected = simulator.rollout(poses, latent_history=history, values=scene | {"depth": depth})
        assert_near(told.latent[i], expected.latent)
        assert_near(told.force[i], expected.force)


def test_work_surface_and_volume_are_those_of_the_rollout() -> None:
    simulator = Simulator.pretrained("excavation")
    differentiable = TorchSimulator(simulator)
    poses = np.tile([-0.02, 0.3, 0.15, 0.0, 0.0, 0.0, 1.0], (90, 1))
    poses[:, 0] += 0.0025 * np.arange(90)
    poses[:, 2] -= 0.05 * np.sin(np.pi * np.arange(90) / 90)
    expected = simulator.rollout(poses)
    with torch.no_grad():
        path = differentiable.rollout(poses)
        work, height = differentiable.work(path), differentiable.surface(path.latent[[0, -1]])
        volume = differentiable.moved_volume(path.latent)
    given = -(expected.force[1:] * np.diff(poses[:, :3], axis=0)).sum(1)
    assert_near(work[1:], given)
    assert work[0] == 0
    here, there = expected.soil(0), expected.soil()
    squares = ((there - here) ** 2).sum(1)
    cell = 0.8 * 0.6 * 0.15 / len(here)
    assert float(volume) == pytest.approx((squares / (squares + 0.05**2)).sum() * cell, rel=1e-3)
    still, surface = simulator.reset().surface().z, expected.surface().z
    np.testing.assert_allclose(height[0], still, atol=1e-12)
    apart, moved = (np.sqrt(np.square(surface - z).mean()) for z in (height[-1].numpy(), still))
    assert apart < 0.4 * moved


def test_work_of_a_turning_tool_counts_its_torque(trained) -> None:
    _, differentiable, _, _ = simulator_of(trained, "pose")
    poses = tool_poses(torch.zeros(3, 3), torch.tensor([[0.0, 0.1 * t, 0.0] for t in range(3)])).double()
    load = torch.zeros(3, 3).double()
    path = TorchPath(torch.zeros(3, 4, 3), load, load + torch.tensor([0.0, -5.0, 0.0]), poses, load[0, :2])
    torch.testing.assert_close(
        differentiable.work(path), torch.tensor([0.0, 0.5, 0.5]).double(), atol=1e-6, rtol=0
    )


def test_tool_poses_turn_by_the_vector() -> None:
    vectors = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.4, 0.0], [1.0, -2.0, 0.5]], dtype=torch.float64)
    vectors.requires_grad_()
    poses = tool_poses(torch.arange(9.0).reshape(3, 3).double(), vectors)
    expected = Rotation.from_rotvec(vectors.detach().numpy()).as_quat()
    np.testing.assert_allclose(poses[:, 3:].detach(), expected, atol=1e-12)
    (gradient,) = torch.autograd.grad(poses[0, 3:].sum(), vectors)
    np.testing.assert_allclose(gradient[0], [0.5, 0.5, 0.5])


# --- Gradients --------------------------------------------------------------------------------------------


def objectives(differentiable: TorchSimulator, path: TorchPath) -> torch.Tensor:
    """One number of each of the answers, shape (6,)."""
    return torch.stack(
        [
            differentiable.work(path).sum(),
            path.force.square().mean().sqrt(),
            path.torque[..., -1, 1],
            path.poses[..., 2].sum(),
            differentiable.surface(path.latent[-1]).nansum(),
            1e4 * differentiable.moved_volume(path.latent),
        ]
    )


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("of", ["path", "context", "start"])
def test_gradients_are_central_differences(trained, kind, of) -> None:
    _, differentiable, poses, history = simulator_of(trained, kind, rate_independent=False)
    rng = np.random.default_rng(0)
    inputs = {
        "path": torch.tensor(poses[:8]),
        "context": torch.tensor([0.06, 0.1], dtype=torch.float64),
        "start": torch.tensor(history, dtype=torch.float64),
    }
    directions = {
        "path": torch.tensor(np.cumsum(rng.normal(size=(8, 7)) * [1, 0, 1, 0, 1, 0, 0], axis=0)),
        "context": torch.tensor([1.0, -2.0], dtype=torch.float64),
        "start": torch.tensor(rng.normal(size=history.shape)),
    }

    def answer(**changed: torch.Tensor) -> torch.Tensor:
        given = inputs | changed
        told = dict(zip(TOLD["context"], given["context"], strict=True))
        return objectives(differentiable, differentiable.rollout(given["path"], told, given["start"]))

    here, way = inputs[of].clone().requires_grad_(), directions[of]
    found = [
        float((torch.autograd.grad(one, here, retain_graph=True, allow_unused=True)[0] * way).sum())
        if one.requires_grad
        else 0.0
        for one in answer(**{of: here})
    ]
    step = 1e-9  # nearer than the kinks of the network
    with torch.no_grad():
        before, after = (answer(**{of: inputs[of] + sign * step * way}) for sign in (-1, 1))
    expected = ((after - before) / (2 * step)).numpy()
    assert np.abs(expected).max() > 0
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-6)


def test_a_gradient_of_steps_is_that_of_the_rollout(trained) -> None:
    _, differentiable, poses, _ = simulator_of(trained, "wheel pose")
    gradients = []
    for stepped in (False, True):
        path = torch.tensor(poses, requires_grad=True)
        if stepped:
            state = differentiable.start(path[:1])
            for pose in path[1:]:
                state = differentiable.step(state, pose)
            loss = state.latent[0, -1].sum() + state.force.sum() + state.poses[0, -1, 2]
        else:
            found = differentiable.rollout(path)
            loss = found.latent[-1].sum() + found.force[-1].sum() + found.poses[-1, 2]
        gradients += torch.autograd.grad(loss, path)
    torch.testing.assert_close(*gradients)
    assert gradients[0].abs().max() > 0


class LiveMemory(TorchDispatchMode):
    """Largest sum of bytes that tensors made within it hold at one time."""

    def __init__(self) -> None:
        super().__init__()
        self.now = self.largest = 0
        self.known: set[int] = set()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        made = func(*args, **(kwargs or {}))
        for tensor in tree_leaves(made):
            if isinstance(tensor, torch.Tensor):
                storage = tensor.untyped_storage()
                if (key := storage._cdata) not in self.known:
                    self.known.add(key)
                    self.now += storage.nbytes()
                    weakref.finalize(storage, self.freed, key, storage.nbytes())
        self.largest = max(self.largest, self.now)
        return made

    def freed(self, key: int, size: int) -> None:
        self.known.discard(key)
        self.now -= size


def test_memory_of_a_long_path_is_bounded(trained) -> None:
    _, differentiable, poses, _ = simulator_of(trained, "pose", rate_independent=False)
    gradients, largest = {}, {}
    for frames in (9, 36):
        for segment in (None, frames):
            path = torch.tensor(poses[:1].repeat(frames, axis=0))
            path[:, 0] += 0.001 * torch.arange(frames)
            path.requires_grad_()
            with LiveMemory() as memory:
                found = differentiable.rollout(path, segment=segment)
                (gradient,) = torch.autograd.grad(differentiable.work(found).sum(), path)
            gradients[segment is None, frames] = gradient
            largest[segment is None, frames] = memory.largest
    for frames in (9, 36):
        torch.testing.assert_close(gradients[True, frames], gradients[False, frames], rtol=1e-12, atol=1e-12)
    assert largest[False, 36] > 3.5 * largest[False, 9]
    assert largest[True, 36] < 2.5 * largest[True, 9]
    assert largest[True, 36] < 0.35 * largest[False, 36]


# --- What is refused --------------------------------------------------------------------------------------


def test_what_does_not_fit_is_refused_in_a_line(trained) -> None:
    _, differentiable, poses, history = simulator_of(trained, "pose")
    with pytest.raises(UserError, match="not told load; the numbers that it is told: depth, speed"):
        differentiable.rollout(poses, {"load": 3.0})
    with pytest.raises(UserError, match=r"depth has shape \(2,\); it needs \(\) or \(1,\)"):
        differentiable.rollout(poses, {"depth": [1.0, 2.0]})
    with pytest.raises(UserError, match=r"shape \(14, 6\); it needs \(T, 7\) or \(B, T, 7\)"):
        differentiable.rollout(poses[:, :6])
    with pytest.raises(UserError, match=r"latent history has shape \(2, 4, 3\)"):
        differentiable.rollout(poses, latent_history=history[:2])
    with pytest.raises(UserError, match="has 2 frames; with a given history it needs at least 3"):
        differentiable.rollout(poses[:2], latent_history=history)
    with pytest.raises(UserError, match="start has 2 poses; this start needs 1"):
        differentiable.start(poses[:2])
    with pytest.raises(UserError, match="segment is 0"):
        differentiable.rollout(poses, segment=0)
    with pytest.raises(UserError, match="not finite"):
        differentiable.rollout(np.full((3, 7), np.nan))
    with pytest.raises(UserError, match="cannot be read as numbers"):
        differentiable.rollout("path")
    two = differentiable.start(np.stack([poses[:1]] * 2))
    for wrong in (poses[:3], poses[:2, :6], poses[0, :6]):
        with pytest.raises(UserError, match=r"pose has shape .*; it needs \(7,\) or \(2, 7\)"):
            differentiable.step(two, wrong)
    one = differentiable.step(two, poses[1])  # one for all paths
    np.testing.assert_array_equal(one.force, differentiable.step(two, poses[[1, 1]]).force)
    simulator = trained["wheel"].simulator("pose")
    simulator.dynamics.settings = replace(simulator.dynamics.settings, body_nodes="points")
    with pytest.raises(UserError, match="train with model"):
        TorchSimulator(simulator)

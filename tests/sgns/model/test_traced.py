"""The simulator's step as one module: for every kind of dynamics it says what the simulator says."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from mpm_warp.poses import fitted_poses, in_world_frame
from sgns.export import driven_path
from sgns.model.features import context_of
from sgns.model.traced import Decode, Step
from sgns.simulator import Simulator
from sgns_testing.tiny import MODEL, POLYNOMIAL
from sgns_testing.trained import TrainedKinds

ODD = {"layer_norm": True, "residual": True, "message_passing_steps": 2, "edges": "star", "torque": False}
CUT = {"polynomial": POLYNOMIAL, "odd": MODEL | ODD | {"context": ["depth", "rake"]}}
WHEEL = {"pose": MODEL, "points": MODEL | {"body_nodes": "points"}}


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> dict[str, TrainedKinds]:
    cut = TrainedKinds.of(tmp_path_factory.mktemp("cut"), CUT)
    wheel = TrainedKinds.of(tmp_path_factory.mktemp("wheel"), WHEEL, scene={"kind": "wheel"})
    return dict.fromkeys(CUT, cut) | dict.fromkeys(WHEEL, wheel)


def module_of(simulator: Simulator) -> Step:
    start = simulator.basis.transform(simulator.start_positions)
    return Step(simulator.dynamics, simulator.body_points, start, simulator.pace)


def driven(simulator: Simulator, paths: np.ndarray, context: Any = None) -> list[tuple[torch.Tensor, ...]]:
    """What the module says of all frames of paths (B, T, 7), side by side."""
    step = module_of(simulator)
    state = torch.zeros(len(paths), sum(step.layout.values()), dtype=torch.float64)
    told = [] if context is None else [torch.from_numpy(context).expand(len(paths), -1)]
    found = []
    with torch.no_grad():
        for poses in torch.from_numpy(paths).unbind(1):
            state, *answer = step(state, poses, *told)
            found.append(tuple(answer))
    return found


def assert_says_the_same(
    simulator: Simulator, path: np.ndarray, found: list[Any], row: int, atol: float
) -> None:
    simulator = copy.copy(simulator)
    state = simulator.reset(path[0])
    for pose, (latent, force, torque, *placed) in zip(path, found, strict=True):
        if pose is not path[0]:
            state = simulator.step(pose)
        wanted = (state.latent, state.force, state.torque, *([state.pose] if placed else []))
        for one, other in zip((latent, force, torque, *placed), wanted, strict=True):
            np.testing.assert_allclose(one[row], other, rtol=atol, atol=atol)


@pytest.mark.parametrize("kind", [*CUT, *WHEEL])
def test_it_steps_as_the_simulator_does(trained, kind) -> None:
    simulator = trained[kind].simulator(kind)
    path = list(driven_path(simulator))
    faster = [*path[::2], *path[-1:] * 15]  # comes to rest
    context = None
    if simulator.context_keys:
        context = context_of(simulator.scene, simulator.context_keys)
    found = driven(simulator, np.stack([path, faster]), context)
    for row, one in enumerate((path, faster)):
        assert_says_the_same(simulator, one, found, row, 1e-5)
    assert (len(found[0]) == 4) == (kind in WHEEL)


@pytest.mark.parametrize("rate_independent", [True, False])
def test_under_a_tool_at_rest_soil_is_as_in_the_simulator(rate_independent) -> None:
    simulator = Simulator.pretrained("excavation", rate_independent=rate_independent)
    moving = driven_path(simulator, 12)
    slow = np.repeat(moving[-1:], 60, axis=0)
    slow[:, 2] += 1e-5 * np.arange(60)
    path = list(np.concatenate([moving, slow]))
    found = driven(simulator, np.stack([path]))
    assert_says_the_same(simulator, path, found, 0, 1e-4)
    rests = torch.equal(found[-1][0], found[-2][0])
    assert rests == rate_independent


def test_a_body_turned_any_way_is_fitted(trained) -> None:
    step, points = (
        module_of(trained["points"].simulator("points")),
        np.random.default_rng(0).normal(size=(6, 3)),
    )
    for flat in (points, points * [1.0, 0.0, 1.0]):
        step.points = torch.from_numpy(flat)
        turns = Rotation.random(50, random_state=1)
        poses = np.concatenate([np.random.default_rng(2).normal(size=(50, 3)), turns.as_quat()], axis=1)
        world = in_world_frame(poses, flat) + 1e-3 * np.random.default_rng(3).normal(size=(50, 6, 3))
        near = (Rotation.from_rotvec([0.3, -0.5, 0.2]) * turns).as_quat()
        found = step.fitted(torch.from_numpy(world), torch.from_numpy(near)).numpy()
        np.testing.assert_allclose(found, fitted_poses(flat, world), rtol=0, atol=1e-12)


def test_it_decodes_as_the_basis_does() -> None:
    simulator = Simulator.pretrained("excavation")
    latent = simulator.reset().latent
    soil = Decode(simulator.basis)(torch.from_numpy(latent)[None])
    np.testing.assert_allclose(soil[0], simulator.reset().soil(), rtol=0, atol=1e-6)

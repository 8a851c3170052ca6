"""The graph: which edges, and what is written on nodes and edges."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from mpm_warp.poses import in_world_frame, rotation_matrices
from sgns.config import UserError
from sgns.model.features import (
    Pace,
    ToolMotion,
    body_track,
    build_graph,
    context_of,
    edge_indices,
    markers,
    pose_step,
    slowest_travel,
    step_frames,
    varying_context,
)
from sgns_testing.runs import random_poses

# --- The graph: which edges, and what is written on nodes and edges -------------------------------------


@pytest.mark.parametrize("self_loops", [False, True])
@pytest.mark.parametrize("modes", [1, 3])
@pytest.mark.parametrize("nodes", [0, 2])
def test_edges_join_every_ordered_pair_that_they_should(nodes, modes, self_loops) -> None:
    """All nodes in a complete graph, in a star one mode and one body node; receivers ascend."""
    count = modes + nodes
    pairs = [(s, r) for r in range(count) for s in range(count) if s != r or self_loops]
    star = [(s, r) for s, r in pairs if (s < modes) != (r < modes) or s == r]
    for edges, expected in (("complete", pairs), ("star", star)):
        found = edge_indices(modes, nodes, edges, self_loops)
        assert found.shape == (2, len(expected)) and found.T.tolist() == [list(pair) for pair in expected]


def test_features_are_where_they_belong() -> None:
    torch.manual_seed(0)
    shapes = (2, 3, 15), (2, 1, 20), (2, 4, 3)
    mode_features, body_features, position = (torch.randn(*shape) for shape in shapes)
    edge_index = edge_indices(3, 1)
    nodes, edges = build_graph(mode_features, body_features, position, edge_index)
    assert nodes.shape == (2, 4, 20)
    assert torch.equal(nodes[:, :3, :15], mode_features)
    assert torch.equal(nodes[:, :3, 15:], torch.zeros(2, 3, 5))
    assert torch.equal(nodes[:, 3:], body_features)
    for e, (sender, receiver) in enumerate(edge_index.T.tolist()):
        difference = position[:, sender] - position[:, receiver]
        torch.testing.assert_close(edges[:, e, :3], difference)
        torch.testing.assert_close(edges[:, e, 3], difference.norm(dim=-1))
    _, bare = build_graph(mode_features, body_features, position, edge_index, edge_length=False)
    assert torch.equal(bare, edges[..., :3])


# --- The tool as the network sees it --------------------------------------------------------------------


def test_pose_track() -> None:
    poses = random_poses()
    track = body_track(poses, None, "pose")
    assert [tuple(part.shape) for part in track] == [(6, 1, 3), (6, 1, 6), (6, 1, 6)]
    np.testing.assert_allclose(track.motion[1:, 0, :3], np.diff(poses[:, :3], axis=0))
    assert not track.motion[0].any()
    matrices = rotation_matrices(poses[:, 3:])
    np.testing.assert_allclose(track.orientation[:, 0, :3], matrices[:, :, 0])
    np.testing.assert_allclose(track.orientation[:, 0, 3:], matrices[:, :, 1])


def test_points_track() -> None:
    points = np.random.default_rng(2).normal(size=(6, 4, 3))
    track = body_track(random_poses(), points, "points")
    assert [tuple(part.shape) for part in track] == [(6, 4, 3), (6, 4, 0), (6, 4, 3)]
    np.testing.assert_allclose(track.motion[1:], np.diff(points, axis=0))


# --- Numbers of a scene that the dynamics are told ------------------------------------------------------


@pytest.mark.parametrize("number", [100, 100.0, np.float32(100.0), np.int64(100)])
def test_a_number_is_told_whatever_its_type(number) -> None:
    found = context_of(
        {"load": number, "material": {"friction_angle": 30.0}}, ["load", "material.friction_angle"]
    )
    assert found.dtype == np.float64 and found.tolist() == [100.0, 30.0]


@pytest.mark.parametrize("bad", [np.nan, np.inf, True, "100", None])
def test_what_is_no_finite_number_is_named(bad) -> None:
    with pytest.raises(UserError, match=r"load .*(must be finite|needs)|no number load"):
        context_of({"load": bad}, ["load"])


def test_different_loads_over_time_are_refused_in_words() -> None:
    """A model can be told a number only; the same load over time in every run tells nothing."""
    rows = [[0.0, 10.0], [1.0, 20.0]]
    same, other = (SimpleNamespace(scene={"load": load, "slip": 0.2}) for load in (rows, 10.0))
    assert varying_context([same, same], ["load", "slip"]) == []
    with pytest.raises(
        UserError, match=r"different scene.load over time.*give each run a constant scene.load"
    ):
        varying_context([same, other], ["load"])


# --- When soil takes a step: with the tool, with the clock, not at all ------------------------------------


def line(*steps: float) -> np.ndarray:
    """One marker along x by these steps [m], shape (T, 1, 3)."""
    path = np.zeros((len(steps) + 1, 1, 3))
    path[1:, 0, 0] = np.cumsum(steps)
    return path


def frames_of(path: np.ndarray, given: int, pace: Pace) -> np.ndarray:
    """Given frames, and those after them that the soil takes a step into."""
    slow = pace.slow_after(path[:given])
    frames, _ = step_frames(path[given - 1 :], path[given - 1], slow, pace)
    return np.concatenate([np.arange(given), frames + given - 1])


@pytest.mark.parametrize(
    ("why", "steps", "given", "least", "settling", "expected"),
    [
        ("under a slow tool by the way it goes", [0.3] * 10, 1, 1.0, 5, [0, 4, 8]),
        *[("every frame of a fast tool", [1.0] * 10, given, 1.0, 5, range(11)) for given in (1, 3, 11)],
        ("settling after a fast tool", [0, 0, 2] + [0] * 9 + [0.5, 0.5], 1, 1.0, 4, [0, 3, 4, 5, 6, 14]),
        ("shaking is no motion", [0.9, -0.9] * 10, 1, 1.0, 5, [0]),
        ("unless it is far", [0.5, 0.5, -0.5, -0.5] * 5, 1, 1.0, 5, range(0, 21, 2)),
        ("given frames are all seen and say how the tool moves", [0.1, 2] + [0] * 8, 3, 1.0, 4, range(6)),
        ("given frames of a slow tool", [0.4] * 8, 3, 1.0, 4, [0, 1, 2, 5, 8]),
        ("without a known pace only a tool at rest is slow", [1e-6] * 3 + [0] * 6, 1, 0.0, 2, range(5)),
    ],
)
def test_when_soil_takes_a_step(why, steps, given, least, settling, expected) -> None:
    np.testing.assert_array_equal(frames_of(line(*steps), given, Pace.of(least, settling)), list(expected))


def test_turning_is_motion_of_the_points() -> None:
    angle = np.radians(1.0) * np.arange(20)
    poses = np.zeros((20, 7))
    poses[:, 5], poses[:, 6] = np.sin(angle / 2), np.cos(angle / 2)
    points = 0.2 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)[:, None]
    frames = frames_of(markers(poses, points), 1, Pace.of(0.2 * np.radians(2.5), 5))
    np.testing.assert_array_equal(frames, np.arange(0, 20, 3))
    # A body without points shows its centre of mass only.
    assert len(frames_of(markers(poses, points[:, :0]), 1, Pace.of(0.01, 5))) == 1


def test_any_turn_of_a_tool_in_its_place_is_seen() -> None:
    """Of half a degree, a quarter, half and three quarters of a turn between two frames, about each axis."""
    points = np.random.default_rng(0).normal(size=(5, 3)) * 0.1
    for axis in range(3):
        for angle in np.radians([0.5, 90.0, 180.0, 270.0]):
            turns = angle * np.arange(4)
            poses = np.zeros((4, 7))
            poses[:, 3 + axis], poses[:, 6] = np.sin(turns / 2), np.cos(turns / 2)
            path = markers(poses, in_world_frame(poses, points))
            np.testing.assert_array_equal(frames_of(path, 1, Pace.of(1e-4, 1)), np.arange(4))
            assert all(Pace.of(1e-4, 1).moved(points, *pair) for pair in zip(poses[1:], poses, strict=False))


def test_motion_is_not_changed_by_looking_ahead() -> None:
    here = ToolMotion.along(line(0.5), Pace.of(1.0, 5))
    assert here.moved(line(1.5)[1]).steps and not here.moved(line(0.75)[1]).steps
    np.testing.assert_array_equal(here.stepped, line(0.5)[1])


def test_a_path_may_go_on_anywhere() -> None:
    """From what is known of it there: where the soil took its last step, and how long the tool has been slow."""
    path, pace = line(*[2.0] * 3, *[0.0] * 4, *[0.3] * 9, *[2.0] * 2, *[0.4] * 7), Pace.of(1.0, 3)
    whole, last = step_frames(path, path[0], pace.settling, pace)
    for here in range(1, len(path)):
        before, slow = step_frames(path[: here + 1], path[0], pace.settling, pace)
        after, end = step_frames(path[here:], path[before[-1]], slow, pace)
        np.testing.assert_array_equal([*before, *(after + here)], whole)
        assert end == last


def test_one_step_of_a_pose_is_that_of_a_track_to_the_bit() -> None:
    rng = np.random.default_rng(0)
    for size in (0.0, 1e-9, 1e-4, 1e-2, 1.0):
        poses = np.cumsum(size * rng.normal(size=(200, 7)), axis=0) + rng.normal(size=7)
        poses[:, 3:] *= rng.choice([-1.0, 1.0], size=(200, 1))  # the same rotations
        poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
        track = torch.cat(body_track(poses, None, "pose"), dim=-1)[1:, 0].numpy()
        steps = [pose_step(*pair) for pair in zip(poses.tolist(), poses[1:].tolist(), strict=False)]
        np.testing.assert_array_equal(steps, track)
    assert np.isnan(pose_step([0.0] * 7, poses[0].tolist())[-3:]).all()


def test_the_slowest_travel_is_a_pace_not_a_stop(data) -> None:
    runs = data.runs("train")
    moved = np.concatenate([np.linalg.norm(np.diff(run.pose[:, :3], axis=0), axis=1) for run in runs])
    known = slowest_travel(runs)
    assert known == pytest.approx(moved.min(), rel=0.02)
    # Frames at rest do not count, and the one in which the tool stops is one among many.
    first = runs[0]
    fast, end = first.pose.repeat(1, axis=0), first.pose[-1:].copy()
    end[:, 0] += 1e-5
    shift = end[:, None, :3] - first.pose[-1:, None, :3]
    stopping = dataclasses.replace(
        first,
        pose=np.concatenate([fast, end.repeat(30, axis=0)]),
        body_points=np.concatenate([first.body_points, (first.body_points[-1:] + shift).repeat(30, axis=0)]),
    )
    many = [first] * 20
    assert slowest_travel([stopping, *many]) == pytest.approx(slowest_travel(many), rel=0.05)
    still = dataclasses.replace(
        first, pose=first.pose[:1].repeat(14, axis=0), body_points=first.body_points[:1].repeat(14, axis=0)
    )
    assert slowest_travel([still]) == 0.0

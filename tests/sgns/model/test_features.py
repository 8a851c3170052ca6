"""The graph: which edges, and what is written on nodes and edges."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from mpm_warp.poses import in_world_frame, rotation_matrices
from sgns.config import UserError
from sgns.model.features import (
    ToolMotion,
    body_track,
    build_graph,
    context_of,
    edge_indices,
    markers,
    slowest_travel,
    step_frames,
)
from sgns_testing.runs import random_poses
from sgns_testing.tiny import reduced

# --- The graph: which edges, and what is written on nodes and edges -------------------------------------


def test_every_ordered_pair_of_different_nodes_is_an_edge_once() -> None:
    edges = edge_indices(4, 1).T.tolist()
    assert len(edges) == 20
    assert {(s, r) for s, r in edges} == {(s, r) for s in range(5) for r in range(5) if s != r}


def test_a_star_joins_modes_and_body_only() -> None:
    edges = edge_indices(3, 2, "star").T.tolist()
    assert len(edges) == 12
    assert all((s < 3) != (r < 3) for s, r in edges)


@pytest.mark.parametrize("edges", ["complete", "star"])
def test_self_loops_are_added_and_receivers_ascend(edges) -> None:
    without, loops = edge_indices(3, 2, edges), edge_indices(3, 2, edges, self_loops=True)
    assert loops.shape[1] == without.shape[1] + 5
    assert {(s, r) for s, r in loops.T.tolist() if s == r} == {(v, v) for v in range(5)}
    assert loops[1].diff().min() >= 0


def test_one_node_has_no_edges() -> None:
    assert edge_indices(1, 0).shape == (2, 0)


def test_features_are_where_they_belong() -> None:
    torch.manual_seed(0)
    mode_features, body_features, position = (
        torch.randn(2, 3, 15),
        torch.randn(2, 1, 20),
        torch.randn(2, 4, 3),
    )
    graph = build_graph(mode_features, body_features, position, edge_indices(3, 1))
    assert graph.nodes.shape == (2, 4, 20)
    assert torch.equal(graph.nodes[:, :3, :15], mode_features)
    assert torch.equal(graph.nodes[:, :3, 15:], torch.zeros(2, 3, 5))
    assert torch.equal(graph.nodes[:, 3:], body_features)
    for e, (sender, receiver) in enumerate(graph.edge_index.T.tolist()):
        difference = position[:, sender] - position[:, receiver]
        torch.testing.assert_close(graph.edges[:, e, :3], difference)
        torch.testing.assert_close(graph.edges[:, e, 3], difference.norm(dim=-1))
    bare = build_graph(mode_features, body_features, position, edge_indices(3, 1), edge_length=False)
    assert torch.equal(bare.edges, graph.edges[..., :3])


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


# --- When soil takes a step: with the tool, with the clock, not at all ------------------------------------


def line(*steps: float) -> np.ndarray:
    """One marker along x by these steps [m], shape (T, 1, 3)."""
    path = np.zeros((len(steps) + 1, 1, 3))
    path[1:, 0, 0] = np.cumsum(steps)
    return path


def test_soil_under_a_slow_tool_steps_by_the_way_it_goes() -> None:
    frames = step_frames(line(*[0.3] * 10), 1, 1.0, 5)
    np.testing.assert_array_equal(frames, [0, 4, 8])


@pytest.mark.parametrize("given", [1, 3, 11])
def test_a_fast_tool_steps_in_every_frame(given) -> None:
    np.testing.assert_array_equal(step_frames(line(*[1.0] * 10), given, 1.0, 5), np.arange(11))


def test_soil_settles_after_a_fast_tool() -> None:
    frames = step_frames(line(0.0, 0.0, 2.0, *[0.0] * 9, 0.5, 0.5), 1, 1.0, 4)
    np.testing.assert_array_equal(frames, [0, 3, 4, 5, 6, 14])


def test_shaking_is_no_motion_unless_it_is_far() -> None:
    assert len(step_frames(line(*[0.9, -0.9] * 10), 1, 1.0, 5)) == 1
    assert len(step_frames(line(*[0.5, 0.5, -0.5, -0.5] * 5), 1, 1.0, 5)) == 11


def test_given_frames_are_all_seen_and_say_how_the_tool_moves() -> None:
    path = line(0.1, 2.0, *[0.0] * 8)
    np.testing.assert_array_equal(step_frames(path, 3, 1.0, 4), [0, 1, 2, 3, 4, 5])
    np.testing.assert_array_equal(step_frames(line(*[0.4] * 8), 3, 1.0, 4), [0, 1, 2, 5, 8])


def test_nothing_is_slower_than_rest() -> None:
    """Without a known pace only a tool at rest is slow."""
    frames = step_frames(line(*[1e-6] * 3, *[0.0] * 6), 1, 0.0, 2)
    np.testing.assert_array_equal(frames, [0, 1, 2, 3, 4])


def test_turning_is_motion_of_the_points() -> None:
    angle = np.radians(1.0) * np.arange(20)
    poses = np.zeros((20, 7))
    poses[:, 5], poses[:, 6] = np.sin(angle / 2), np.cos(angle / 2)
    points = 0.2 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)[:, None]
    frames = step_frames(markers(poses, points), 1, 0.2 * np.radians(2.5), 5)
    np.testing.assert_array_equal(frames, np.arange(0, 20, 3))
    # A body without points shows its centre of mass only.
    assert len(step_frames(markers(poses, points[:, :0]), 1, 0.01, 5)) == 1


def test_any_turn_of_a_tool_in_its_place_is_seen() -> None:
    """Of half a degree, a quarter, half and three quarters of a turn between two frames, about each axis."""
    points = np.random.default_rng(0).normal(size=(5, 3)) * 0.1
    for axis in range(3):
        for angle in np.radians([0.5, 90.0, 180.0, 270.0]):
            turns = angle * np.arange(4)
            poses = np.zeros((4, 7))
            poses[:, 3 + axis], poses[:, 6] = np.sin(turns / 2), np.cos(turns / 2)
            path = markers(poses, in_world_frame(poses, points))
            np.testing.assert_array_equal(step_frames(path, 1, 1e-4, 1), np.arange(4))


def test_motion_is_not_changed_by_looking_ahead() -> None:
    here = ToolMotion.along(line(0.5), 1.0, 5)
    assert here.moved(line(1.5)[1]).steps and not here.moved(line(0.75)[1]).steps
    np.testing.assert_array_equal(here.stepped, line(0.5)[1])


def test_the_slowest_travel_is_a_pace_not_a_stop(tmp_path) -> None:
    runs = reduced(tmp_path).runs("train")
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

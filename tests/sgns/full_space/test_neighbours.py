"""The hash grid finds exactly what comparing every pair finds."""

from __future__ import annotations

import pytest
import torch

from sgns.errors import UserError
from sgns.full_space.neighbours import radius_graph

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]


def every_pair(points: torch.Tensor, radius: float) -> set[tuple[int, int]]:
    near = (points[:, None] - points[None]).square().sum(-1) <= radius**2
    near.fill_diagonal_(False)
    return set(map(tuple, near.nonzero().tolist()))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(("size", "radius"), [(1.0, 0.15), (1.0, 0.9), (100.0, 1.3), (0.01, 0.002)])
def test_equals_brute_force(device, size, radius) -> None:
    # From before the origin to behind it, and (100 / 1.3 cells) further than the hash grid is wide.
    points = (torch.rand((400, 3), generator=torch.Generator().manual_seed(1)) - 0.5) * size
    points[:50] = points[50:100] + 0.5 * radius  # some pairs even where points are few
    edges = radius_graph(points.to(device), radius).cpu()
    found = list(map(tuple, edges.T.tolist()))
    assert len(found) == len(set(found))
    assert set(found) == every_pair(points, radius)
    assert edges.dtype == torch.int64 and bool((edges[1].diff() >= 0).all())


def test_points_in_one_place_are_neighbours_and_none_is_its_own() -> None:
    edges = radius_graph(torch.zeros(3, 3), 0.1)
    assert set(map(tuple, edges.T.tolist())) == {(a, b) for a in range(3) for b in range(3) if a != b}


@pytest.mark.parametrize("count", [0, 1, 5])
def test_lonely_points_have_no_edges(count) -> None:
    points = torch.arange(count)[:, None].double().expand(-1, 3)
    assert radius_graph(points, 0.5).shape == (2, 0)


@pytest.mark.parametrize(
    ("points", "radius"), [(torch.full((4, 3), torch.nan), 1.0), (torch.zeros(4, 3), 0.0)]
)
def test_bad_input_is_one_line(points, radius) -> None:
    with pytest.raises(UserError, match=r"finite|above 0") as refused:
        radius_graph(points, radius)
    assert "\n" not in str(refused.value)

"""The solid that a closed triangle mesh bounds: its parts, its cavities, and its centre of mass."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .mesh_files import without_idle
from .state import SceneError

_FARTHEST = 1e6  # vertex of a body [m]
_JOINED = (1e-7, 1e-6, 1e-5, 1e-4)  # corners so close are one, as a share of the mesh's diagonal
_MOST_SHELLS, _MOST_SHARED = 1000, 20_000  # parts; edges along which parts touch
_REPAIR = "close it with a mesh editor's repair (in Python: trimesh.load_mesh(file), then fill_holes()) and try again"


class Solid(NamedTuple):
    """What a mesh bounds, all faces outwards."""

    vertices: np.ndarray  # (k, 3), about the centre of mass
    triangles: np.ndarray  # (t, 3)
    centre: np.ndarray  # (3,), the centre of mass where the mesh came from
    notes: tuple[str, ...]  # what had to be changed for that


def closed_mesh(vertices: np.ndarray, triangles: np.ndarray, name: str) -> Solid:
    """The solid that a mesh bounds: vertices (k, 3) and triangles (t, 3) from the file `name`.

    Corners that differ by rounding become one. Triangles and parts that face inwards are turned. A part inside
    another one is a cavity if it faces the other way than that one, else it adds nothing. Parts that overlap are
    united.

    Raises:
        SceneError: the mesh is open, encloses no volume, or is larger than anything.
    """
    notes: list[str] = []
    if not np.abs(vertices).max(initial=0.0) <= _FARTHEST:
        raise SceneError(f"tool.file: a corner of the mesh in {name} is not finite or beyond {_FARTHEST:g} m")
    if not len(triangles):
        raise SceneError(f"tool.file: no triangle of the mesh in {name} has an area")
    vertices, triangles = _joined(vertices, triangles, name, notes)
    triangles, shell = _shells(vertices, triangles, name, notes)
    count = int(shell.max()) + 1
    triangles, kept = _facing(vertices, triangles, shell, count, notes)
    if not kept.all():
        triangles, shell = triangles[kept[shell]], shell[kept[shell]]
    if count > 1 and len(triangles):
        vertices, triangles = _united(*without_idle(vertices, triangles), shell, notes)
    volume, centre = _moments(vertices, triangles) if len(triangles) else (0.0, np.zeros(3))
    if not volume > 1e-9 * float(np.prod(np.ptp(vertices, axis=0))):
        raise SceneError(f"tool.file: the mesh in {name} encloses no volume")
    return Solid(vertices - centre, triangles, centre, tuple(notes))


def checked_mesh(vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A mesh that `closed_mesh` made before and that was kept since, its vertices (k, 3) [m] to the bit.

    Raises:
        SceneError: it is none.
    """
    vertices, triangles = np.asarray(vertices, dtype=np.float64), np.asarray(triangles)
    if vertices.ndim != 2 or triangles.ndim != 2 or vertices.shape[1] != 3 or triangles.shape[1] != 3:
        raise SceneError(f"the mesh has vertices {vertices.shape} and triangles {triangles.shape}")
    if triangles.dtype.kind not in "iu" or len(triangles) == 0:
        raise SceneError("the mesh has no triangles of whole numbers")
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise SceneError("the mesh has a triangle with a vertex that is not there")
    if not np.isfinite(vertices).all() or np.abs(vertices).max() > _FARTHEST:
        raise SceneError(f"the mesh has a vertex that is not finite or beyond {_FARTHEST:g} m")
    triangles = triangles.astype(np.int64)
    edge, forward, _ = _edges(triangles)
    if np.any(np.bincount(edge, np.where(forward, 1, -1))):
        raise SceneError("the mesh of the scene is not closed, or its triangles do not face the same way")
    volume, centre = _moments(vertices, triangles)
    if abs(volume) < 1e-9 * float(np.prod(np.ptp(vertices, axis=0))) or volume == 0.0:
        raise SceneError("the mesh of the scene encloses no volume")
    if volume < 0.0 or np.abs(centre).max() > 1e-6 * np.abs(vertices).max():
        raise SceneError("the mesh faces inwards or is not about its centre of mass")
    return vertices, triangles


def _moments(vertices: np.ndarray, triangles: np.ndarray) -> tuple[float, np.ndarray]:
    """Volume and centre of mass (3,) of what a closed mesh bounds."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    parts = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0  # volumes of the tetrahedra with the origin
    volume = float(parts.sum())
    return volume, (parts[:, None] * (a + b + c)).sum(axis=0) / (4.0 * volume or 1.0)


def solid_and_surface(vertices: np.ndarray, triangles: np.ndarray) -> list[tuple[float, np.ndarray]]:
    """Volume [m^3] of what a closed mesh bounds and its inertia about the origin per density [m^5], shape (3, 3); area
    [m^2] of the mesh itself, likewise [m^4]."""
    corners = vertices[triangles]
    a, b, c = corners.swapaxes(0, 1)
    total = corners.sum(axis=1)
    squares = np.einsum("tki,tkj->tij", corners, corners) + np.einsum("ti,tj->tij", total, total)
    volumes = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0  # of the tetrahedra with the origin
    areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    found = []
    for parts, share in ((volumes, 20.0), (areas, 12.0)):
        second = np.tensordot(parts, squares, 1) / share
        found.append((float(parts.sum()), np.trace(second) * np.eye(3) - second))
    return found


def _edges(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each side of each triangle, first all first sides: its edge's number, whether it goes from the edge's lower to
    its higher vertex, all (3 t,); and the vertices of each edge (e, 2)."""
    sides = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    low, high = sides.min(axis=1), sides.max(axis=1)
    base = int(triangles.max()) + 1
    keys, edge = np.unique(low * base + high, return_inverse=True)
    return edge.reshape(-1), sides[:, 0] == low, np.stack([keys // base, keys % base], axis=-1)


def _joined(
    vertices: np.ndarray, triangles: np.ndarray, name: str, notes: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """The mesh closed: vertices of open edges that differ by rounding become one."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    edge, _, ends = _edges(triangles)
    bad = np.bincount(edge) % 2 == 1
    if not bad.any():
        return vertices, triangles
    rim = np.unique(ends[bad])
    tree, diagonal = KDTree(vertices[rim]), float(np.linalg.norm(np.ptp(vertices, axis=0)))
    for share in _JOINED:
        if tree.count_neighbors(tree, share * diagonal) > 100 * len(rim):
            break  # the mesh itself is that fine
        pairs = rim[tree.query_pairs(share * diagonal, output_type="ndarray")]
        graph = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(vertices),) * 2)
        label = connected_components(graph, directed=False)[1]
        first = np.unique(label, return_index=True)[1]
        found = without_idle(vertices[first], label[triangles])
        if len(found[1]) and not np.any(np.bincount(_edges(found[1])[0]) % 2):
            gap = np.linalg.norm(vertices - vertices[first][label], axis=1).max() / diagonal
            notes.append(f"corners up to {gap:.1g} of the tool's size apart were joined")
            return found
    middle = vertices[ends[bad][0]].mean(axis=0)
    raise SceneError(
        f"tool.file: the mesh in {name} is not closed: {bad.sum()} of {len(bad)} edges do not belong to exactly two "
        f"triangles, the first at ({', '.join(f'{1e3 * x + 0.0:.4g}' for x in middle)}) mm; {_REPAIR}"
    )


def _shells(
    vertices: np.ndarray, triangles: np.ndarray, name: str, notes: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Triangles that face the same way as their neighbours, and the number of the closed shell of each (t,)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    edge, forward, ends = _edges(triangles)
    count, uses = len(triangles), np.bincount(edge)
    order = np.argsort(edge, kind="stable")
    two = order[uses[edge[order]] == 2].reshape(-1, 2)
    starts = np.cumsum(uses) - uses
    shared = np.flatnonzero(uses > 2)
    if len(shared) > _MOST_SHARED:
        raise SceneError(
            f"tool.file: {len(shared)} edges of {name} belong to more than two triangles; {_REPAIR}"
        )
    more = [
        _across(vertices, triangles, order[starts[e] : starts[e] + uses[e]], forward, ends[e]) for e in shared
    ]
    pairs = np.concatenate([two, *more])
    same = (forward[pairs[:, 0]] == forward[pairs[:, 1]]).astype(int)  # the two triangles face different ways
    one, other = (pairs % count).T
    # Two nodes for each triangle: as it is, and turned.
    rows, columns = (
        np.concatenate([2 * one, 2 * one + 1]),
        np.concatenate([2 * other + same, 2 * other + 1 - same]),
    )
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(2 * count, 2 * count))
    label = connected_components(graph, directed=False)[1].reshape(-1, 2)
    _, shell = np.unique(label.min(axis=1), return_inverse=True)
    shell = shell.reshape(-1)
    turned = label[:, 0] > label[:, 1]
    most = np.bincount(shell, turned) > 0.5 * np.bincount(shell)
    turned ^= most[shell]
    owner = np.unique(edge * (shell.max() + 1) + np.tile(shell, 3), return_counts=True)[1]
    if np.any(label[:, 0] == label[:, 1]) or np.any(owner % 2):
        raise SceneError(
            f"tool.file: the triangles of {name} do not all face the same way, and no way of turning them makes them; "
            "make its normals consistent in a mesh editor (in Python: trimesh's fix_normals()) and try again"
        )
    if shell.max() >= _MOST_SHELLS:
        raise SceneError(
            f"tool.file: {name} has {shell.max() + 1} separate parts; at most {_MOST_SHELLS}: "
            "unite them in a mesh editor"
        )
    if turned.any():
        notes.append(
            f"{turned.sum()} triangles faced the other way than their neighbours; they were turned round"
        )
        triangles = np.where(turned[:, None], triangles[:, ::-1], triangles)
    return triangles, shell


def _across(
    vertices: np.ndarray, triangles: np.ndarray, sides: np.ndarray, forward: np.ndarray, ends: np.ndarray
) -> np.ndarray:
    """Pairs (p, 2) of the sides at an edge of four triangles or more: two with the same matter between them."""
    low, high = vertices[ends]
    along = (high - low) / np.linalg.norm(high - low)
    corners = triangles[sides % len(triangles)]
    third = corners[(corners != ends[0]) & (corners != ends[1])]
    out = vertices[third] - low
    out -= (out @ along)[:, None] * along
    angle = np.arctan2(np.cross(out[0], out) @ along, out @ out[0]) % (2.0 * np.pi)
    angle[angle > 2.0 * np.pi - 1e-6] = 0.0
    # Matter lies behind a triangle that runs forward along the edge, and before one that runs back.
    ordered = sides[np.lexsort([~forward[sides], angle.round(6)])]
    ordered = np.roll(ordered, -int(np.argmax(~forward[ordered])))
    if np.array_equal(forward[ordered], np.arange(len(ordered)) % 2 == 1):
        return ordered.reshape(-1, 2)
    return np.zeros((0, 2), dtype=np.int64)


def _facing(
    vertices: np.ndarray, triangles: np.ndarray, shell: np.ndarray, count: int, notes: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of solids outwards and of cavities inwards, and which shells count (s,)."""
    about = vertices - vertices.mean(axis=0)
    a, b, c = (about[triangles[:, k]] for k in range(3))
    volume = np.bincount(shell, np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0)
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    for corner in (a, b, c):
        np.minimum.at(low, shell, corner)
        np.maximum.at(high, shell, corner)
    kept = np.abs(volume) > 1e-9 * np.prod(high - low, axis=1)
    if not kept.all() and kept.any():
        notes.append(f"{(~kept).sum()} parts enclose no volume; they were left out")
    solid, idle = np.ones(count, dtype=bool), 0
    by_size = np.argsort(-np.abs(volume), kind="stable")
    for place, inner in enumerate(by_size if count > 1 else ()):
        if not kept[inner]:
            continue
        points = np.unique(triangles[shell == inner])
        sample = about[points[:: max(1, len(points) // 8)]]
        for outer in by_size[:place][::-1]:
            if not kept[outer] or np.any(low[inner] < low[outer]) or np.any(high[inner] > high[outer]):
                continue
            if np.all(_winding(sample, about[triangles[shell == outer]]) > 0.5):
                if volume[inner] * volume[outer] > 0.0:
                    kept[inner], idle = False, idle + 1
                solid[inner] = not solid[outer]
                break
    if idle:
        notes.append(
            f"{idle} parts lie wholly inside another and face as it does; they were left out: turn a part's triangles "
            "round if it is a cavity"
        )
    turn = kept & ((volume > 0.0) != solid)
    if turn.any():
        which = "" if turn.sum() == count else f" of {turn.sum()} of {count} parts"
        notes.append(f"the triangles{which} faced inwards; they were turned round")
    return np.where(turn[shell][:, None], triangles[:, ::-1], triangles), kept


def _winding(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """How often a closed mesh (t, 3, 3) goes around points (p, 3), without sign: 1 inside, 0 outside, 0.5 on it."""
    found = np.empty(len(points))
    for k, point in enumerate(points):
        a, b, c = (corners - point).transpose(1, 0, 2)
        la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
        above = np.einsum("ij,ij->i", a, np.cross(b, c))
        below = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
        found[k] = abs(np.arctan2(above, below).sum()) / (2.0 * np.pi)
    return found


def _united(
    vertices: np.ndarray, triangles: np.ndarray, shell: np.ndarray, notes: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """One surface around solids that overlap; the same mesh if none do."""
    import manifold3d

    found, parts = manifold3d.Manifold(), []
    for number in np.unique(shell):
        points, local = without_idle(vertices, triangles[shell == number])
        volume, _ = _moments(points - points.mean(axis=0), local)
        outwards = local if volume > 0.0 else local[:, ::-1]
        part = manifold3d.Manifold(manifold3d.Mesh64(points.copy(), outwards.astype(np.uint64)))
        if part.status() != manifold3d.Error.NoError:
            notes.append("its parts may overlap: what they share counts twice in its mass and centre")
            return vertices, triangles
        parts.append((volume, part))
    for volume, part in sorted(parts, key=lambda one: -abs(one[0])):  # a cavity after what it is in
        found = found + part if volume > 0.0 else found - part
    shared = 1.0 - found.volume() / sum(volume for volume, _ in parts)
    if shared < 1e-6:
        return vertices, triangles
    mesh = found.to_mesh64()
    notes.append(f"its parts overlap; they are one body, and what they share ({shared:.0%}) counts once")
    return np.asarray(mesh.vert_properties)[:, :3].copy(), np.asarray(mesh.tri_verts).astype(np.int64)

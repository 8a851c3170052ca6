"""Mesh files as people have them."""

import io
import time
import zipfile

import numpy as np
import pytest

from mpm_warp import MeshBody, SceneError
from mpm_warp.mesh_files import MOST_TRIANGLES, read_mesh
from sgns_testing.meshes import BOX_FACES, box_corners, box_triangles, write_obj, write_stl, write_text_stl

CORNERS = box_corners((1.0, 2.0, 3.0))
FACES = [list(face) for face in BOX_FACES]


def volume(file):
    vertices, triangles = MeshBody(file=str(file)).mesh
    return np.linalg.det(vertices[triangles]).sum() / 6.0


def ply(form, faces, extra=False):
    """A PLY file of the box, with or without more properties than one needs."""
    more = "property uchar red\n" if extra else ""
    head = (
        f"ply\nformat {form} 1.0\ncomment a box\nelement vertex 8\nproperty double x\nproperty double y\n"
        f"property double z\n{more}element face {len(faces)}\nproperty list uchar int vertex_indices\n"
        f"{more}end_header\n"
    ).encode()
    if form == "ascii":
        tail = " 7" if extra else ""
        rows = [" ".join(map(str, c)) + tail for c in CORNERS] + [
            f"{len(f)} " + " ".join(map(str, f)) + tail for f in faces
        ]
        return head + "\n".join(rows).encode() + b"\n"
    order, tail = "<>"["big" in form], b"\7" if extra else b""
    rows = [c.astype(order + "f8").tobytes() + tail for c in CORNERS]
    rows += [bytes([len(f)]) + np.array(f, order + "i4").tobytes() + tail for f in faces]
    return head + b"".join(rows)


def off(faces):
    rows = ["OFF # a box", f"8 {len(faces)} 0", ""] + [" ".join(map(str, c)) for c in CORNERS]
    return "\n".join(rows + [f"{len(f)} " + " ".join(map(str, f)) + " 255 0 0" for f in faces]).encode()


@pytest.mark.parametrize("extra", [False, True])
@pytest.mark.parametrize("faces", [FACES, box_triangles().tolist(), [*FACES[1:], FACES[0][:3], [0, 3, 1]]])
@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply(tmp_path, form, faces, extra):
    (tmp_path / "a.ply").write_bytes(ply(form, faces, extra))
    assert volume(tmp_path / "a.ply") == pytest.approx(6.0)


def test_off(tmp_path):
    (tmp_path / "a.off").write_bytes(off(FACES))
    assert volume(tmp_path / "a.off") == pytest.approx(6.0)


@pytest.mark.parametrize(("kind", "box"), [("glb", (1.0, 3.0, 2.0)), ("3mf", (1.0, 2.0, 3.0))])
def test_the_library_reads_the_rest(tmp_path, kind, box):
    """The y of a GLB is upwards, in metres; a 3MF says that it is in millimetres."""
    trimesh = pytest.importorskip("trimesh")
    made = trimesh.Trimesh(box_corners(box), box_triangles(), process=False)
    (tmp_path / f"a.{kind}").write_bytes(made.export(file_type=kind))
    body = MeshBody(file=str(tmp_path / f"a.{kind}"))
    unit = 1.0 if kind == "glb" else 1e-3
    np.testing.assert_allclose(2.0 * body.half_size, np.array([1.0, 2.0, 3.0]) * unit, rtol=1e-6)
    wide = MeshBody(file=str(tmp_path / f"a.{kind}"), unit="m")
    np.testing.assert_allclose(2.0 * wide.half_size, [1.0, 2.0, 3.0], rtol=1e-6)


def test_a_library_that_is_not_there_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "trimesh", None)
    (tmp_path / "a.3mf").write_bytes(archive(b"<model/>"))
    with pytest.raises(SceneError, match=r"needs the library trimesh: pip install 'sgns\[meshes\]'"):
        read_mesh(tmp_path / "a.3mf")


def archive(model):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as parts:
        parts.writestr("3D/3dmodel.model", model)
    return file.getvalue()


@pytest.mark.parametrize(
    ("unit", "metres"), [("mm", 1e-3), ("cm", 1e-2), ("m", 1.0), ("in", 0.0254), ("file", 1.0)]
)
def test_units(tmp_path, unit, metres):
    file = write_obj(tmp_path / "a.obj", CORNERS, FACES)
    body = MeshBody(file=str(file), unit=unit, scale=2.0)
    np.testing.assert_allclose(body.half_size, np.array([1.0, 2.0, 3.0]) * metres, rtol=1e-9)


# --- as other programs write them ---------------------------------------------------------------------------

TEXT = {
    "byte order mark": lambda text: b"\xef\xbb\xbf" + text,
    "utf-16": lambda text: text.decode().encode("utf-16"),
    "latin-1": lambda text: "o Schürfkübel\ng Größe".encode("latin-1") + b"\n" + text,
    "comments": lambda text: text.replace(b"\n", b" # a comment\n"),
    "windows": lambda text: text.replace(b"\n", b"\r\n"),
    "old mac": lambda text: text.replace(b"\n", b"\r"),
    "continued": lambda text: text.replace(b"//1 3//1", b"//1 \\\n3//1"),
    "no more": lambda text: text.rstrip(b"\n"),
    "colours": lambda text: text.replace(b".0\nv", b".0 1 0.5 0.2\nv"),
}


@pytest.mark.parametrize("change", TEXT.values(), ids=TEXT)
def test_texts(tmp_path, change):
    file = write_obj(tmp_path / "a.obj", CORNERS, FACES)
    text = file.read_bytes()
    file.write_bytes(change(text))
    assert file.read_bytes() != text
    assert volume(file) == pytest.approx(6.0)
    if change not in (TEXT["latin-1"], TEXT["continued"], TEXT["colours"]):
        stl = write_text_stl(tmp_path / "a.stl", CORNERS, box_triangles())
        stl.write_bytes(change(stl.read_bytes()))
        assert volume(stl) == pytest.approx(6.0)


def test_a_latin_1_name_in_a_text_stl(tmp_path):
    file = write_text_stl(tmp_path / "a.stl", CORNERS, box_triangles())
    file.write_bytes(file.read_bytes().replace(b"solid box", "solid Kübel".encode("latin-1")))
    assert volume(file) == pytest.approx(6.0)


def test_indices_may_count_back(tmp_path):
    file = tmp_path / "a.obj"
    lines = [f"v {x} {y} {z}" for x, y, z in CORNERS] + [
        "f " + " ".join(str(i - 8) for i in f) for f in FACES
    ]
    file.write_text("\n".join(lines))
    assert volume(file) == pytest.approx(6.0)


def test_a_binary_stl_may_be_padded(tmp_path):
    file = write_stl(tmp_path / "a.stl", CORNERS, box_triangles())
    file.write_bytes(b"\0" * 80 + file.read_bytes()[80:] + b"\0\0\0")
    assert volume(file) == pytest.approx(6.0)


def test_vertices_of_no_face_do_not_count(tmp_path):
    file = write_obj(tmp_path / "a.obj", np.concatenate([CORNERS, [[99.0, 0, 0]]]), FACES)
    assert MeshBody(file=str(file)).half_size[0] == pytest.approx(0.5)


# --- faces of many corners ----------------------------------------------------------------------------------


def prism(outline, height=1.0):
    """Vertices and faces of a prism: two caps of all corners, and quads."""
    n = len(outline)
    vertices = np.concatenate([np.insert(outline, 2, z, axis=1) for z in (0.0, height)])
    sides = [[k, (k + 1) % n, n + (k + 1) % n, n + k] for k in range(n)]
    return vertices, [list(range(n))[::-1], list(range(n, 2 * n)), *sides]


def area_and_centre(outline):
    x, y = outline.T
    cross = x * np.roll(y, -1) - np.roll(x, -1) * y
    area = cross.sum() / 2
    return area, ((outline + np.roll(outline, -1, axis=0)) * cross[:, None]).sum(axis=0) / (6 * area)


C_SHAPE = np.array([(0, 0), (3, 0), (3, 1), (1, 1), (1, 2), (3, 2), (3, 3), (0, 3)], float)
ANGLE = np.linspace(0, 2 * np.pi, 10_000, endpoint=False)
STAR = (1 + 0.4 * np.sin(40 * ANGLE))[:, None] * np.stack([np.cos(ANGLE), np.sin(ANGLE)], axis=-1)
MIDPOINTS = np.array([(0, 0), (1, 0), (2, 0), (3, 0), (4, 0), (4, 1), (4, 2), (2, 1), (0, 2), (0, 1)], float)


@pytest.mark.parametrize("first", range(8))
def test_a_concave_face_keeps_its_opening(tmp_path, first):
    check_prism(tmp_path, np.roll(C_SHAPE, first, axis=0))


@pytest.mark.parametrize("outline", [STAR, MIDPOINTS], ids=["10 000 corners", "corners in a line"])
def test_faces_of_many_corners(tmp_path, outline):
    begin = time.process_time()
    check_prism(tmp_path, outline)
    assert time.process_time() - begin < 5.0


def check_prism(tmp_path, outline):
    """Every face is filled: the sum of the triangles' areas is the face's."""
    vertices, faces = prism(outline)
    file = write_obj(tmp_path / "a.obj", vertices, faces)
    vertices, triangles, _ = read_mesh(file)
    corners = vertices[triangles]
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] / 2
    area, centre = area_and_centre(outline)
    assert np.abs(areas).sum() == pytest.approx(2 * area)
    assert areas[areas > 0].sum() == pytest.approx(area)
    body = MeshBody(file=str(file), origin="file")
    assert volume(file) == pytest.approx(area)
    np.testing.assert_allclose(body.centre, [*centre, 0.5], atol=1e-9)


def test_a_face_that_crosses_itself_is_refused(tmp_path):
    vertices, faces = prism(np.array([(0, 0), (2, 2), (2, 0), (0, 1)], float))
    with pytest.raises(SceneError, match=r"face 1 of 4 corners crosses itself.*cut the faces into triangles"):
        read_mesh(write_obj(tmp_path / "a.obj", vertices, faces))


# --- what is refused ----------------------------------------------------------------------------------------

BAD = {
    "a.obj": [
        (b"v 0 0 0\nf 1 2 3", "a face names a vertex that is not there"),
        (b"v 0 0\nv 0 0 1\nv 1 0 0\nf 1 2 3", "less than three numbers"),
        (b"v 0,5 0 0\nv 0 0 1\nv 1 0 0\nf 1 2 3", "'0,5', which is no number"),
        (b"v nan 0 0\nv 0 0 1\nv 1 0 0\nf 1 2 3", "not finite"),
        (b"cstype bspline\nsurf 0 1 0 1 1 2 3", "holds no triangles"),
    ],
    "a.stl": [
        (b"solid a\nfacet\nouter loop\nvertex 0 0 0\n", "cut short: export it again"),
        (b"solid a\n" + b"vertex 0 0 0\n" * 3, "endsolid is missing"),
        (b"\0" * 80 + (9).to_bytes(4, "little") + b"\0" * 100, "9 triangles, but there are 2"),
    ],
    "a.ply": [
        (b"nothing", "does not begin with ply"),
        (ply("ascii", FACES)[:-30], "fewer lines than it says|names a vertex|fewer numbers"),
        (ply("binary_little_endian", FACES)[:-3], "not a good PLY file"),
        (ply("ascii", FACES).replace(b"vertex 8", b"vertex 999999999"), "decimate"),
        (
            ply("ascii", FACES).replace(b"element vertex", b"element corner"),
            "no element vertex with x, y and z",
        ),
        (ply("ascii", FACES).replace(b"double z", b"double w"), "no element vertex with x, y and z"),
        (ply("middle_endian", FACES), "format is 'middle_endian'; allowed: ascii, binary_little_endian"),
        (ply("ascii", FACES).replace(b"double x", b"half x"), "of the type 'half'"),
        (
            b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
            b"element face 1\nproperty int vertex_index\nend_header\n0 0 0\n0\n",
            "no lists of vertices",
        ),
    ],
    "a.off": [(b"8 6 0", "does not begin with OFF"), (off(FACES)[:-60], "cut short")],
    "a.glb": [
        (b"glTF" + b"\0" * 30, "not a good GLB file"),
        (b"nothing", "does not begin with glTF"),
        (b"glTF" + b"\0" * 8 + b"\2\0\0\0JSON[]", "not a good GLB file: AttributeError"),
    ],
    "a.3mf": [
        (b"nothing", "not a good 3MF file: File is not a zip file"),
        (archive(b"<model/>"), "3MF"),
        (archive(b" " * (300 << 20)), "unfolds to more than 268 MB"),
        (archive(b"<component />" * 30), "more than 24 components"),
    ],
}


@pytest.mark.parametrize(
    ("name", "content", "words"), [(name, *case) for name, cases in BAD.items() for case in cases]
)
def test_what_is_refused(tmp_path, name, content, words):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(SceneError, match=words) as found:
        read_mesh(tmp_path / name)
    assert "\n" not in str(found.value)


def test_a_mesh_of_too_many_triangles_says_to_decimate(tmp_path):
    file = tmp_path / "a.stl"
    with open(file, "wb") as stl:
        stl.write(b"\0" * 80 + (MOST_TRIANGLES + 1).to_bytes(4, "little"))
        stl.truncate(84 + 50 * (MOST_TRIANGLES + 1))
    with pytest.raises(SceneError, match=r"has 1000001 triangles; .* decimate it"):
        read_mesh(file)
    with open(file, "wb") as stl:
        stl.truncate(1 << 29)
    with pytest.raises(SceneError, match=r"larger than 268 MB; .* decimate it"):
        read_mesh(file)

"""Good files of every type that commands read, and wrong ones made of them."""

from __future__ import annotations

import json
import os
import shutil
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
import torch
import trimesh
import yaml

from sgns_testing.commands import SHORT, SMALL, TRAIN, call, small_dataset
from sgns_testing.meshes import box_corners, box_triangles, write_obj, write_stl, write_text_stl
from sgns_testing.published import record


class Case(NamedTuple):
    """A command that is to be refused."""

    kind: str
    command: str
    base: tuple[str, ...]
    """Arguments with which it does its work."""
    wrong: tuple[str, ...]
    """And with which it must not."""
    names: str = ""
    """What its line has to name."""
    make: Callable[[Path, Path], None] | None = None
    """Writes the wrong file: into a folder, from the folder of the good files."""
    file: str = ""
    """What is wrong about that."""

    @property
    def what(self) -> str:
        """Command and what is wrong about its input."""
        return " ".join((self.command, *self.wrong, self.file and f"({self.file})")).strip()


# Arguments with which commands do their work, in a folder beside that of the good files.
RUN = "../good/run.h5"
DATA = ("dataset.path=../good/data",)
CHECKPOINT = ("checkpoint=../good/out/best.ckpt",)
CUT = tuple(SHORT)
_PATH = "scene.path=../good/path.csv"
CUT_ON_PATH = (*CUT, "scene.motion=path", _PATH)
_BODY = (*SHORT[:4], "scene=body", _PATH)
ON_PATH = (*_BODY, "scene.tool.size=[0.1,0.1,0.08]")
WITH_MESH = (*_BODY, "scene/tool=mesh", "scene.tool.file=../good/tool.obj")
_DRAW = ("dataset.draw.path=[../good/path.csv]", "+dataset.draw.gravity=[1.62,3.7,9.81]")
CAMPAIGN = ("dataset=own", "dataset.path=data", *_DRAW, *ON_PATH)
LEARN = (*DATA, *TRAIN)
FIT = (*LEARN[:3], "model=polynomial", "training=polynomial")
PUBLISHED = ("dataset=published", "dataset.path=../good/published", *TRAIN[1:])


def good_files(folder: Path) -> None:
    """A dataset of a small bed, a checkpoint, a run, published runs, a path and meshes."""
    folder.mkdir(parents=True)
    small_dataset(folder / "data")
    done = call("train", f"dataset.path={folder / 'data'}", *TRAIN, f"output={folder / 'out'}")
    assert done.returncode == 0, done.stderr
    done = call("rollout", f"checkpoint={folder / 'out' / 'best.ckpt'}", f"output={folder / 'run.h5'}")
    assert done.returncode == 0, done.stderr
    shutil.copy(folder / "data" / "runs" / "g.h5", folder / "of_data.h5")
    rows = "t,x,y,z,qx,qy,qz,qw\n0,0.1,0.1,0.06,0,0,0,1\n0.2,0.15,0.1,0.06,0,0,0,1\n"
    (folder / "path.csv").write_text(rows)
    corners, triangles = box_corners((0.1, 0.1, 0.08)), box_triangles()
    write_obj(folder / "tool.obj", corners, triangles)
    write_stl(folder / "tool.stl", corners, triangles)
    write_text_stl(folder / "text.stl", corners, triangles)
    for suffix in ("ply", "off", "glb", "3mf"):
        trimesh.Trimesh(corners, triangles).export(folder / f"tool.{suffix}")
    published = folder / "published"
    published.mkdir()
    for split, count in (("train", 4), ("valid", 2), ("test", 1)):
        chance = np.random.default_rng(count)
        nodes = chance.normal(0.3, 0.1, (count, 12, 8, 3))
        nodes[:, :, :4] = nodes[:1, :1, :4] + np.arange(12)[:, None, None] * [-0.01, -0.001, 0.0]
        force = chance.normal(10.0, 1.0, (count, 12, 3))
        records = [record(n, [3] * 4 + [6] * 4, f) for n, f in zip(nodes, force, strict=True)]
        data = b"".join(struct.pack("<Q", len(one)) + b"crc!" + one + b"crc!" for one in records)
        (published / f"{split}.tfrecord").write_bytes(data)
    (published / "metadata.json").write_text(json.dumps({"dataset_split": {}}))
    from importlib.resources import files

    shutil.copy(str(files("sgns.frontier").joinpath("table.csv")), folder / "points.csv")
    (folder / "experiment").mkdir()
    (folder / "experiment" / "x.yaml").write_text("# @package _global_\nseed: 0\n")


# --- Who reads a file -----------------------------------------------------------------------------------

_MESHES = ("tool.obj", "tool.stl", "text.stl", "tool.ply", "tool.off", "tool.glb", "tool.3mf")
# Good file, where the wrong one stands, what else is copied, and the commands that read it.
Reader = tuple[str, tuple[str, ...], tuple[str, ...]]
_RUN_READERS: tuple[Reader, ...] = (
    ("check", (), ("bad.h5",)),
    ("plot", (), ("bad.h5", "output=a.png")),
    ("render", (), ("bad.h5", "output=a.gif")),
    ("evaluate", (*DATA, *CHECKPOINT), ("new_rollouts=[bad.h5]",)),
    ("simulate", (), ("continue_from=bad.h5",)),
)
_DATA_READERS: tuple[Reader, ...] = (
    ("reduce", LEARN[1:3], ("dataset.path=data",)),
    ("train", LEARN[1:], ("dataset.path=data",)),
    ("evaluate", CHECKPOINT, ("dataset.path=data",)),
)
_CHECKPOINT_READERS: tuple[Reader, ...] = (
    ("rollout", (), ("checkpoint=bad.ckpt",)),
    ("evaluate", DATA, ("checkpoint=bad.ckpt",)),
    ("train", LEARN, ("checkpoint=bad.ckpt",)),
)
_PATH_READERS: tuple[Reader, ...] = (
    ("simulate", ON_PATH, ("scene.path=bad.csv",)),
    ("simulate", CUT_ON_PATH, ("scene.path=bad.csv",)),
)
_EXPERIMENT_READERS: tuple[Reader, ...] = (
    ("simulate", CUT, ("--config-dir", ".", "experiment=x")),
    ("train", LEARN, ("--config-dir", ".", "experiment=x")),
    ("rollout", (*CHECKPOINT, *SMALL), ("--config-dir", ".", "experiment=x")),
)
READ: dict[str, tuple[str, str, tuple[Reader, ...]]] = {
    "run.h5": ("", "bad.h5", _RUN_READERS),
    "of_data.h5": ("data", "data/runs/a.h5", _DATA_READERS),
    "data/dataset.yaml": ("data", "data/dataset.yaml", _DATA_READERS),
    "out/best.ckpt": ("", "bad.ckpt", _CHECKPOINT_READERS),
    "path.csv": ("", "bad.csv", _PATH_READERS),
    "points.csv": ("", "bad.csv", (("advise", ("error.force=0.35",), ("table=bad.csv",)),)),
    "experiment/x.yaml": ("experiment", "experiment/x.yaml", _EXPERIMENT_READERS),
    "published/metadata.json": (
        "published",
        "published/metadata.json",
        (("train", (PUBLISHED[0], *PUBLISHED[2:]), ("dataset.path=published",)),),
    ),
    "published/train.tfrecord": (
        "published",
        "published/train.tfrecord",
        (("train", (PUBLISHED[0], *PUBLISHED[2:]), ("dataset.path=published",)),),
    ),
} | {
    name: (
        "",
        f"bad.{name[5:]}",
        (("simulate", (*_BODY, "scene/tool=mesh"), (f"scene.tool.file=bad.{name[5:]}",)),),
    )
    for name in _MESHES
}
"""Good file -> folder that is copied with it, the place of the wrong one, and who reads it."""


def wrong_file(
    good: str, kind: str, file: str, write: Callable[[Path], None], readers: Any = None
) -> Iterator[Case]:
    """A wrong file for everybody who reads it, made by `write` of the good one."""
    folder, place, known = READ[good]

    def make(here: Path, there: Path) -> None:
        if folder:
            shutil.copytree(there / folder, here / folder)
        bad = here / place
        bad.unlink(missing_ok=True)
        shutil.copyfile(there / good, bad)
        write(bad)

    for command, base, wrong in known if readers is None else readers:
        named = Path(place).name if command not in ("check",) else ""
        yield Case(
            kind, command, base, wrong, "" if readers is _DATA_READERS else named, make, f"{good}: {file}"
        )


def wrong_files() -> Iterator[Case]:
    """All of them."""
    yield from _impostors()
    yield from _runs()
    yield from _texts()
    yield from _meshes()
    yield from _checkpoints()


# --- Files that are not what their name says ------------------------------------------------------------


def _replaced(action: Callable[[Path], None]) -> Callable[[Path], None]:
    def write(file: Path) -> None:
        file.unlink()
        action(file)

    return write


def _archive(file: Path) -> None:
    with file.open("wb") as stream:
        np.savez(stream, x=np.arange(3))


def _endless(file: Path) -> None:
    with file.open("wb") as stream:
        stream.truncate(1 << 40)  # without a block on the disk


_IMPOSTORS: dict[str, Callable[[Path], None]] = {
    "empty": lambda file: file.write_bytes(b"") and None,
    "a text": lambda file: file.write_text("hello\n") and None,
    "random bytes": lambda file: file.write_bytes(np.random.default_rng(1).bytes(5000)) and None,
    "a picture": lambda file: file.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(300)) and None,
    "an archive of arrays": _archive,
    "cut in half": lambda file: file.write_bytes(file.read_bytes()[: file.stat().st_size // 2]) and None,
    "a folder": _replaced(lambda file: file.mkdir()),
    "a pipe": _replaced(lambda file: os.mkfifo(file)),
    "a device": _replaced(lambda file: file.symlink_to("/dev/zero")),
    "1 TB of zeros": _endless,
    "not readable": _replaced(lambda file: file.symlink_to("/nosuch/file")),
}
_FINE = {("experiment/x.yaml", "empty"), ("experiment/x.yaml", "cut in half")}


def _impostors() -> Iterator[Case]:
    for good in READ:
        for words, write in _IMPOSTORS.items():
            if (good, words) not in _FINE:
                yield from wrong_file(good, "not what its name says", words, write)


# --- Runs -----------------------------------------------------------------------------------------------

Spoil = Callable[[h5py.File], None]


def _attribute(name: str, value: Any) -> Spoil:
    def apply(file: h5py.File) -> None:
        del file.attrs[name]
        if value is not None:
            file.attrs[name] = np.bytes_(value) if isinstance(value, str) else value

    return apply


def _other(name: str, new: Callable[[np.ndarray], Any]) -> Spoil:
    def apply(file: h5py.File) -> None:
        old = file[name][...]
        del file[name]
        if (value := new(old)) is not None:
            file[name] = value

    return apply


def _scene(key: str, value: Any) -> Spoil:
    """Another value in the scene, at a dotted key; None takes it out."""

    def apply(file: h5py.File) -> None:
        scene = yaml.safe_load(file.attrs["scene"])
        *groups, last = key.split(".")
        group = scene
        for name in groups:
            group = group[name]
        group.pop(last, None) if value is None else group.__setitem__(last, value)
        file.attrs["scene"] = np.bytes_(json.dumps(scene))

    return apply


def _bomb(name: str) -> Spoil:
    """Gigabytes of zeros, packed as tightly as they can be."""

    def apply(file: h5py.File) -> None:
        tail = file[name].shape[1:]
        del file[name]
        count = (8 << 30) // (4 * int(np.prod(tail)))
        chunks = (max(1, count // 64), *tail)
        made = file.create_dataset(name, (count, *tail), "f4", chunks=chunks, compression="gzip")
        made[: chunks[0]] = 0.0

    return apply


def _claims(name: str) -> Spoil:
    """Rows that nobody stored."""

    def apply(file: h5py.File) -> None:
        tail = file[name].shape[1:]
        del file[name]
        file.create_dataset(name, (10**12, *tail), "f4", chunks=(1, *tail))

    return apply


_POSITION, _FORCE, _POSE = "particles/soil/position", "observables/body/force", "observables/body/pose"
_POINTS = "particles/body/position"
_STRUCTURE: dict[str, Spoil] = {
    **{
        f"{name} = {value!r:.20}": _attribute(name, value)
        for name, values in {
            "frame_rate": (0.0, -1.0, np.nan, np.inf, "fast", None, [1.0, 2.0]),
            "seed": ("x", None, 0.5),
            "wall_time_s": (-1.0, np.nan, "x"),
            "producer": (5, None),
            "format": ("other", None, 3),
            "format_version": (99, "x", None),
            "content_hash": ("../../x", None, 7),
            "scene": (None, 5),
            "effects": (None, 5),
        }.items()
        for value in values
    },
    **{
        f"{name} {words}": _other(name, new)
        for name in (
            f"{_POSITION}/value",
            f"{_FORCE}/value",
            f"{_POSE}/value",
            f"{_POINTS}/value",
            f"{_FORCE}/time",
        )
        for words, new in {
            "missing": lambda old: None,
            "a frame short": lambda old: old[:-1],
            "of another shape": lambda old: np.zeros((2, 5)),
            "a number": lambda old: 5.0,
            "a text": lambda old: "x",
            "whole numbers": lambda old: np.zeros(old.shape, int),
            "no frame": lambda old: old[:0],
        }.items()
    },
    **{
        f"{name} packed gigabytes": _bomb(name)
        for name in (f"{_POSITION}/value", f"{_FORCE}/value", f"{_POSE}/value")
    },
    **{f"{name} of 1e12 frames": _claims(name) for name in (f"{_POSITION}/value", f"{_POINTS}/value")},
}
"""What makes a run no run, for everybody."""
_NESTED = "{a: " * 3000
_LAUGHS = "a: &a [x, x]\n" + "".join(
    f"b{i}: &{chr(98 + i)} [*{chr(97 + i)}, *{chr(97 + i)}]\n" for i in range(24)
)
_SELF = "a: &a [*a]"
_CONTENT: dict[str, Spoil] = {
    **{
        f"scene {words}": _attribute("scene", text)
        for words, text in {
            "empty": " ",
            "a list": "[]",
            "a number": "5",
            "cut": "{",
            "nested": _NESTED,
            "multiplies": _LAUGHS,
            "of itself": _SELF,
            "with a tag": "!!python/name:os.system x",
        }.items()
    },
    **{
        f"scene.{key} = {value!r:.20}": _scene(key, value)
        for key, value in {
            "bed": "text",
            "bed.size": "big",
            "gravity": "text",
            "blade": "text",
            "blade.width": "wide",
            "depth": [1],
            "speed": -1e400,
        }.items()
    },
    **{
        f"{key} = {value!r:.20}": _scene(key, value)
        for key, value in {"blade.thickness": None, "bed.size ": [1, 2], "rake": {"a": 1}}.items()
    },
    **{
        f"{name} {words}": _other(f"{name}/value", new)
        for name in (_POSITION, _FORCE, _POSE, _POINTS)
        for words, new in {"not finite": lambda old: old * np.nan, "1e30": lambda old: old * 0 + 1e30}.items()
    },
    "times that stand still": _other(f"{_POSITION}/time", np.zeros_like),
    "no unit quaternion": _other(f"{_POSE}/value", np.zeros_like),
    "other values": _other(f"{_POSITION}/value", lambda old: old + 0.01),
    "effects of nothing": _attribute("effects", "{yielding: 3}"),
    "an unknown producer": _attribute("producer", "nobody"),
}
"""What `check` has to find in a run that has all its parts."""


def _runs() -> Iterator[Case]:
    def opened(spoil: Spoil) -> Callable[[Path], None]:
        def write(path: Path) -> None:
            with h5py.File(path, "r+") as file:
                spoil(file)

        return write

    for number, (words, spoil) in enumerate(_STRUCTURE.items()):
        yield from wrong_file("run.h5", "parts of a run", words, opened(spoil), _RUN_READERS[:1])
        yield from wrong_file(
            "run.h5", "parts of a run", words, opened(spoil), [_RUN_READERS[1 + number % 4]]
        )
        if number % 3 == 0:
            readers = [_DATA_READERS[number // 3 % 2]]
            yield from wrong_file("of_data.h5", "parts of a run", words, opened(spoil), readers)
    for words, spoil in _CONTENT.items():
        yield from wrong_file("run.h5", "content of a run", words, opened(spoil), _RUN_READERS[:1])


# --- Texts: datasets, settings, paths, tables -----------------------------------------------------------

_SPLIT = "split: {train: [a, b, c, d], validation: [e, f], test: [g]}"
_TEXTS: dict[str, dict[str, str]] = {
    "data/dataset.yaml": {
        "a list": "[]",
        "of itself": "split: &s {train: *s}",
        "multiplies": f"{_SPLIT}\n{_LAUGHS}",
        "nested": "[" * 5000,
        "a tag": f"{_SPLIT}\nx: !!python/name:os.system x",
        "a split that is no group": "split: 5",
        "names that are numbers": "split: {train: [1], validation: [2], test: [3]}",
        "names outside": "split: {train: [../x], validation: [e], test: [g]}",
        "a part missing": "split: {train: [a, b], test: [g]}",
        "a run that is not there": "split: {train: [a, b, z], validation: [e], test: [g]}",
        "no runs": "split: {train: [], validation: [], test: []}",
        "a zero byte": f"{_SPLIT}\n\0",
        "an alias of nothing": f"{_SPLIT}\nx: *y",
        "a long name": f"split: {{train: [{'a' * 100_000}], validation: [], test: []}}",
    },
    "experiment/x.yaml": {
        "of itself": "scene: &s {a: *s}",
        "multiplies": _LAUGHS,
        "nested": "a: " + "[" * 3000,
        "a tag": "x: !!python/name:os.system x",
        "a list": "- 1",
        "a number for a group": "material: 5",
        "an unknown key": "nosuch: 1",
        "defaults that are no list": "defaults: 5",
        "an unknown default": "defaults: [nosuch]",
        "an unknown option": "defaults: [{override /material: nosuch}]",
        "hydra that is no group": "hydra: 5",
        "an object": "material: {_target_: os.system}",
        "a tab": "material:\n\t- 1",
        "a zero byte": "seed: 1\0",
        "an alias of nothing": "seed: *x",
        "the same key twice": "seed: 1\nseed: 2",
        "a seed that is text": "seed: text",
        "a value of nothing": "seed: ${nosuch}",
    },
    "path.csv": {
        "a header only": "t,x,y,z,qx,qy,qz,qw\n",
        "other columns": "a,b\n1,2\n",
        "three columns": "1,2,3\n",
        "a row short": "0,0.1,0.1,0.06,0,0,0,1\n1,2\n",
        "a huge number": "0,1e300,0.1,0.06,0,0,0,1\n",
        "400 digits": f"{'9' * 400},0.1,0.1,0.06,0,0,0,1\n",
        "not a number": "nan,0.1,0.1,0.06,0,0,0,1\n",
        "no rotation": "0,0.1,0.1,0.06,0,0,0,0\n",
        "a huge rotation": "0,0.1,0.1,0.06,1e200,0,0,1e200\n",
        "times that go back": "1,0.1,0.1,0.06,0,0,0,1\n0,0.1,0.1,0.06,0,0,0,1\n",
        "a text": "0,0.1,up,0.06,0,0,0,1\n",
        "an open quote": '"' * 999,
        "zero bytes": "\0" * 99,
        "one long line": "x" * 200_000,
        "into a wall": "0,0.1,0.1,0.06,0,0,0,1\n0.05,5,0.1,0.06,0,0,0,1\n",
        "semicolons and commas": "0;0,1;0,1;0,06;0;0;0;1\n",
        "nine columns": "0,0.1,0.1,0.06,0,0,0,1,9\n",
    },
    "points.csv": {
        "a header only": "study,scene,kind,axis,label\n",
        "other columns": "a,b\n1,2\n",
        "a text for a number": "study,scene,kind,axis,label,particles\na,cut,solver,b,c,many\n",
        "an unknown kind": "study,scene,kind,axis,label\na,cut,guess,b,c\n",
        "zero bytes": "\0" * 99,
        "an open quote": '"' * 999,
        "one long line": "x" * 200_000,
    },
    "published/metadata.json": {
        "a list": "[]",
        "no split": "{}",
        "a split that is text": '{"dataset_split": "x"}',
        "cases that are text": '{"dataset_split": {"train": ["a", "b", "c", "d"]}}',
        "other counts": '{"dataset_split": {"train": [1]}}',
        "nested": '{"a":' * 50_000,
        "cut": '{"dataset_split": {',
    },
}


def _texts() -> Iterator[Case]:
    for good, texts in _TEXTS.items():
        head = "# @package _global_\n" if good == "experiment/x.yaml" else ""
        for words, text in texts.items():

            def write(file: Path, text: str = head + text) -> None:
                file.write_text(text)

            readers = None if good != "experiment/x.yaml" else _EXPERIMENT_READERS[:2]
            yield from wrong_file(good, "text", words, write, readers)


# --- Meshes ---------------------------------------------------------------------------------------------

_OBJ = {
    "corners only": "v 0 0 0\n",
    "faces only": "f 1 2 3\n",
    "corners that are text": "v a b c\nf 1 1 1\n",
    "a single face": "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
    "corners that are not numbers": "v nan 0 0\n" * 3 + "f 1 2 3\n",
    "huge corners": "v 1e300 0 0\nv 0 1e300 0\nv 0 0 1e300\nv 0 0 0\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n",
    "corner 0": "v 0 0 0\nf 0 0 0\n",
    "a corner beyond": "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 99999999999999999999\n",
    "no area": "v 0 0 0\n" * 4 + "f 1 2 3\nf 1 2 4\nf 2 3 4\nf 1 3 4\n",
    "two coordinates": "v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n",
    "a face of 80000 corners": "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf " + "1 2 3 4 " * 20_000 + "\n",
    "100000 equal corners": "v 1 2 3\n" * 100_000,
}
_ASCII = {
    "no corner": "solid x\nfacet\nendsolid x\n",
    "two corners": "solid x\nfacet normal 0 0 0\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nendloop\nendfacet\nendsolid\n",
    "text": "solid x\nfacet normal 0 0 0\nouter loop\nvertex a b c\nendloop\nendfacet\nendsolid\n",
}


def _one_face_less(file: Path) -> None:
    text = file.read_text().rstrip().splitlines()
    file.write_text("\n".join(text[:-1]) + "\n")


def _count(file: Path) -> None:
    data = bytearray(file.read_bytes())
    data[80:84] = b"\xff\xff\xff\xff"
    file.write_bytes(data)


def _plus(file: Path) -> None:
    file.write_bytes(file.read_bytes().replace(b"element face 12", b"element face 999999999"))


def _meshes() -> Iterator[Case]:
    for good, texts in (("tool.obj", _OBJ), ("text.stl", _ASCII)):
        for words, text in texts.items():
            yield from wrong_file(good, "mesh", words, lambda file, text=text: file.write_text(text))
    yield from wrong_file("tool.obj", "mesh", "a face missing", _one_face_less)
    yield from wrong_file("tool.stl", "mesh", "4e9 triangles", _count)
    yield from wrong_file("tool.ply", "mesh", "1e9 faces", _plus)
    for good in _MESHES:
        for words, text in {"half a header": b"ply\nformat", "zero bytes": bytes(84)}.items():
            yield from wrong_file(good, "mesh", words, lambda file, text=text: file.write_bytes(text))


# --- Checkpoints ----------------------------------------------------------------------------------------


def _checkpoints() -> Iterator[Case]:
    endless: list[Any] = []
    endless.append(endless)
    doubled: Any = "x"
    for _ in range(40):
        doubled = [doubled, doubled]
    odd = {
        "missing": None,
        "a number": 5,
        "a text": "text",
        "of itself": endless,
        "2**40 texts": doubled,
        "a list": [],
    }

    def stored(change: Callable[[dict[str, Any]], None]) -> Callable[[Path], None]:
        def write(file: Path) -> None:
            content = torch.load(file, weights_only=True)
            change(content)
            torch.save(content, file)

        return write

    def other(path: tuple[str, ...], value: Any) -> Callable[[dict[str, Any]], None]:
        def change(content: dict[str, Any]) -> None:
            for key in path[:-1]:
                content = content[key]
            content.pop(path[-1]) if value is None else content.__setitem__(path[-1], value)

        return change

    def weight(value: Callable[[torch.Tensor], Any]) -> Callable[[dict[str, Any]], None]:
        def change(content: dict[str, Any]) -> None:
            state = content["state_dict"]
            name = max(state, key=lambda key: state[key].numel())
            state[name] = value(state[name])

        return change

    card = "hyper_parameters"
    places: list[tuple[str, ...]] = [
        (card,),
        ("state_dict",),
        (card, "model"),
        (card, "scene"),
        (card, "settings"),
    ]
    made = {
        f"{'.'.join(path)} {words}": other(path, value) for path in places for words, value in odd.items()
    }
    made |= {
        f"model.{key} = {value!r}": other((card, "model", key), value)
        for key, value in {
            "hidden_width": 10**6,
            "history": "x",
            "message_passing_steps": 1000,
            "kind": "nosuch",
            "context": [1],
            "body_nodes": 5,
        }.items()
    }
    made |= {
        "weights that are not finite": weight(lambda w: torch.full_like(w, torch.nan)),
        "weights of 1e12 values": weight(lambda w: torch.zeros(1).expand(10**12)),
        "weights of another shape": weight(lambda w: w[..., None]),
        "weights that are whole numbers": weight(lambda w: w.to(torch.int8)),
        "weights that are text": weight(lambda w: "x"),
        "weights that are sparse": weight(lambda w: w.to_sparse()),
    }
    for number, (words, change) in enumerate(made.items()):
        readers = [_CHECKPOINT_READERS[number % 2]]
        yield from wrong_file("out/best.ckpt", "checkpoint", words, stored(change), readers)

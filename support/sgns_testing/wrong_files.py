"""Good files of every type that commands read, and wrong ones made of them."""

from __future__ import annotations

import json
import os
import shutil
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import trimesh
import yaml

from sgns_testing.commands import REDUCED, SHORT, SMALL, TRAIN, call, small_dataset
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
JUDGE = (*DATA, *CHECKPOINT)
ADVISE = ("error.force=0.35",)
CUT = tuple(SHORT)
_PATH = "scene.path=../good/path.csv"
CUT_ON_PATH = (*CUT, "scene.motion=path", _PATH)
_BODY = (*SHORT[:4], "scene=body", _PATH)
ON_PATH = (*_BODY, "scene.tool.size=[0.1,0.1,0.08]")
WITH_MESH = (*_BODY, "scene/tool=mesh", "scene.tool.file=../good/tool.obj")
_DRAW = ("dataset.draw.path=[../good/path.csv]", "+dataset.draw.gravity=[1.62,3.7,9.81]")
CAMPAIGN = ("dataset=own", "dataset.path=data", *_DRAW, *SHORT[:4], ON_PATH[-1])
LEARN = (*DATA, *TRAIN)
FIT = (*LEARN[:3], "model=polynomial", "training=polynomial")
PACKED = ("dataset=quick_reduced", "dataset.path=../good/packed", *TRAIN)
PUBLISHED = ("dataset=published", "dataset.path=../good/published", *TRAIN[1:])


def good_files(folder: Path) -> None:
    """A dataset of a small bed, a checkpoint, a run, published runs, a path and meshes."""
    folder.mkdir(parents=True)
    small_dataset(folder / "data")
    done = call("train", f"dataset.path={folder / 'data'}", *TRAIN, f"output={folder / 'out'}")
    assert done.returncode == 0, done.stderr
    packed = (f"pack={folder / 'packed'}", f"output={folder / 'reduced'}")
    done = call("reduce", f"dataset.path={folder / 'data'}", *REDUCED, *packed)
    assert done.returncode == 0, done.stderr
    done = call("rollout", f"checkpoint={folder / 'out' / 'best.ckpt'}", f"output={folder / 'run.h5'}")
    assert done.returncode == 0, done.stderr
    shutil.copy(folder / "data" / "runs" / "g.h5", folder / "of_data.h5")
    soft = ("scene.gravity=500", "material.youngs_modulus=1e4", f"output={folder / 'soft.h5'}")
    done = call("simulate", *CUT, *soft)
    assert (folder / "soft.stopped.h5").exists(), done.stderr
    rows = "t,x,y,z,qx,qy,qz,qw\n0,0.1,0.1,0.06,0,0,0,1\n0.2,0.15,0.1,0.06,0,0,0,1\n"
    (folder / "path.csv").write_text(rows)
    corners, triangles = box_corners((0.1, 0.1, 0.08)), box_triangles()
    write_obj(folder / "tool.obj", corners, triangles)
    write_stl(folder / "tool.stl", corners, triangles)
    write_text_stl(folder / "text.stl", corners, triangles)
    for suffix in ("ply", "off", "glb", "3mf"):
        unit = 1000.0 if suffix == "3mf" else 1.0  # which says that it is in millimetres
        trimesh.Trimesh(corners * unit, triangles).export(folder / f"tool.{suffix}")
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
RUN_READERS: tuple[Reader, ...] = (
    ("check", (), ("bad.h5",)),
    ("plot", (), ("bad.h5", "output=a.png")),
    ("render", (), ("bad.h5", "output=a.gif")),
    ("convert", (), ("bad.h5", "output=a.vtkhdf")),
    ("evaluate", JUDGE, ("new_rollouts=[bad.h5]",)),
)
DATA_READERS: tuple[Reader, ...] = (
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
_GO_ON: tuple[Reader, ...] = (("simulate", (), ("continue_from=bad.h5",)),)
READ: dict[str, tuple[str, str, tuple[Reader, ...]]] = {
    "run.h5": ("", "bad.h5", RUN_READERS),
    "soft.stopped.h5": ("", "bad.h5", _GO_ON),
    "of_data.h5": ("data", "data/runs/a.h5", DATA_READERS),
    "data/dataset.yaml": ("data", "data/dataset.yaml", DATA_READERS),
    "out/best.ckpt": ("", "bad.ckpt", _CHECKPOINT_READERS),
    "path.csv": ("", "bad.csv", _PATH_READERS),
    "points.csv": ("", "bad.csv", (("advise", ADVISE, ("table=bad.csv",)),)),
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
        # `check` lists what is wrong with each file; of a dataset, settings or path the part that is wrong is named.
        named = {"data": "data", "experiment": ""}.get(
            folder, "path" if good == "path.csv" else Path(place).name
        )
        yield Case(kind, command, base, wrong, "" if command == "check" else named, make, f"{good}: {file}")


def wrong_files() -> Iterator[Case]:
    """All of them."""
    yield from _impostors()
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
    "cut short": lambda file: file.write_bytes(file.read_bytes()[: int(0.45 * file.stat().st_size)]) and None,
    "a folder": _replaced(lambda file: file.mkdir()),
    "a pipe": _replaced(lambda file: os.mkfifo(file)),
    "a device": _replaced(lambda file: file.symlink_to("/dev/zero")),
    "1 TB of zeros": _endless,
    "not readable": _replaced(lambda file: file.symlink_to("/nosuch/file")),
}
_FINE = {("experiment/x.yaml", "empty"), ("experiment/x.yaml", "cut short")}


def _impostors() -> Iterator[Case]:
    for good, (_, _, readers) in READ.items():
        for number, (words, write) in enumerate(_IMPOSTORS.items()):
            if (good, words) not in _FINE:
                few = [readers[(number + i) % len(readers)] for i in range(min(2, len(readers)))]
                yield from wrong_file(good, "not what its name says", words, write, few)


# --- Texts: datasets, settings, paths, tables -----------------------------------------------------------

_LONG = {
    "data/dataset.yaml": {
        "nested": "[" * 5000,
        "a long name": f"split: {{train: [{'a' * 100_000}], validation: [], test: []}}",
    },
    "experiment/x.yaml": {"nested": "a: " + "[" * 3000},
    "path.csv": {
        "400 digits": f"{'9' * 400},0,0,0,0,0,0,1\n",
        "an open quote": '"' * 999,
        "one long line": "x" * 200_000,
    },
    "points.csv": {"an open quote": '"' * 999, "one long line": "x" * 200_000},
    "published/metadata.json": {"nested": '{"a":' * 50_000},
    "tool.obj": {
        "a face of 80000 corners": "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf " + "1 2 3 4 " * 20_000 + "\n",
        "100000 equal corners": "v 1 2 3\n" * 100_000,
    },
}


LAUGHS = "a: &a [x, x]\n" + "".join(
    f"b{i}: &{chr(98 + i)} [*{chr(97 + i)}, *{chr(97 + i)}]\n" for i in range(24)
)


def _texts() -> Iterator[Case]:
    for good, texts in yaml.safe_load(Path(__file__).with_name("wrong_texts.yaml").read_text()).items():
        head = "# @package _global_\n" if good == "experiment/x.yaml" else ""
        for words, text in (texts | _LONG.get(good, {})).items():

            def write(file: Path, text: str = head + text.replace("LAUGHS", LAUGHS)) -> None:
                file.write_text(text)

            readers = READ[good][2][:2]
            yield from wrong_file(good, "text", words, write, readers)


# --- Meshes ---------------------------------------------------------------------------------------------


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
    del made[f"{card}.settings missing"]  # they are told, not needed
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

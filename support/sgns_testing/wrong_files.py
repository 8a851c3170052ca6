"""Good files of every type that commands read, and damaged ones."""

from __future__ import annotations

import copy
import json
import random
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
import yaml

from sgns_testing.commands import SHORT, TRAIN, call, small_dataset
from sgns_testing.meshes import box_corners, box_triangles, write_obj, write_stl, write_text_stl
from sgns_testing.runs import make_run

PATH = "t,x,y,z,qx,qy,qz,qw\n0,0.1,0.1,0.06,0,0,0,1\n0.2,0.15,0.1,0.06,0,0,0,1\n"


def good_files(folder: Path) -> None:
    """A dataset of a small bed, a checkpoint, a run, a stopped run, a path and meshes."""
    folder.mkdir(parents=True, exist_ok=True)
    small_dataset(folder / "data")
    done = call("train", f"dataset.path={folder / 'data'}", *TRAIN, f"output={folder / 'out'}")
    assert done.returncode == 0, done.stderr
    make_run(folder / "run.h5", frames=4, n=6, m=3)
    (folder / "path.csv").write_text(PATH)
    corners, triangles = box_corners((0.1, 0.1, 0.08)), box_triangles()
    write_obj(folder / "tool.obj", corners, triangles)
    write_stl(folder / "tool.stl", corners, triangles)
    write_text_stl(folder / "text.stl", corners, triangles)


def wrong_files(folder: Path, seed: int) -> Iterator[tuple[str, tuple[str, ...], bool]]:
    """Make damaged files in the folder `bad`: of each command that reads one its kind, its arguments, and whether it is
    certainly wrong."""
    random_ = random.Random(seed)
    bad = folder / "bad"
    bad.mkdir(exist_ok=True)
    yield from _damaged_runs(folder, bad)
    yield from _cut_short(folder, bad, random_)
    yield from _texts(folder, bad)
    yield from _reduced(folder, bad)
    yield from _checkpoints(folder, bad)


# --- Runs -----------------------------------------------------------------------------------------------


def _scene(change: Callable[[dict[str, Any]], dict[str, Any]]) -> Callable[[h5py.File], None]:
    def apply(file: h5py.File) -> None:
        file.attrs["scene"] = np.bytes_(json.dumps(change(yaml.safe_load(file.attrs["scene"]))))

    return apply


def _attribute(name: str, value: Any) -> Callable[[h5py.File], None]:
    text = np.bytes_(value) if isinstance(value, str) else value
    return lambda file: file.attrs.__setitem__(name, text)


def _bomb(name: str) -> Callable[[h5py.File], None]:
    """Gigabytes of zeros, packed."""

    def apply(file: h5py.File) -> None:
        tail = file[name].shape[1:]
        del file[name]
        count = (8 << 30) // (4 * int(np.prod(tail)))
        file.create_dataset(
            name, (count, *tail), "f4", chunks=(max(1, count // 64), *tail), compression="gzip", fillvalue=0.0
        )
        file[name][: count // 64] = 0.0

    return apply


def _other(name: str, value: Any) -> Callable[[h5py.File], None]:
    def apply(file: h5py.File) -> None:
        del file[name]
        if value is not None:
            file[name] = value

    return apply


_SPOILT: dict[str, list[Callable[[h5py.File], None]]] = {
    "attributes of a run": [
        *(
            _attribute("frame_rate", v)
            for v in (0.0, -1.0, np.nan, np.inf, 1e300, 1e-300, "fast", [1.0, 2.0])
        ),
        *(_attribute("seed", v) for v in (-1, 1e300, "x")),
        *(_attribute("wall_time_s", v) for v in (-1.0, np.nan, "x", 1e300)),
        *(_attribute("effects", v) for v in ("", "[]", "{", "5", '{"yielding": 3}')),
        *(_attribute("extra", v) for v in ("", "[]", "{", "5")),
        *(_attribute("producer", v) for v in (5, "", "nobody")),
        *(_attribute("format_version", v) for v in (-1, 99, "x")),
    ],
    "scene of a run": [
        *(_attribute("scene", v) for v in ("", "[]", "5", "{", '{"a":' * 200, "null", '"text"', np.zeros(3))),
        *(
            _scene(lambda scene, key=key, value=value: scene | {key: value})
            for key in ("gravity", "duration", "bed", "blade", "depth", "speed", "kind", "name")
            for value in ("text", None, [1], {"a": 1}, -1e300)
        ),
        *(
            _scene(lambda scene, key=key: {k: v for k, v in scene.items() if k != key})
            for key in ("bed", "kind", "blade")
        ),
        *(
            _scene(lambda scene, value=value: scene | {"bed": scene["bed"] | {"size": value}})
            for value in ("big", [], [1, 2], ["a", "b", "c"], None, [1e300, 1, 1], [0, 0, 0], [-1, 1, 1])
        ),
        *(
            _scene(lambda scene, value=value: scene | {"bed": scene["bed"] | {"spacing": value}})
            for value in (0, "x", None, 1e-300, 1e300)
        ),
    ],
}


def _names(file: Path) -> list[str]:
    found: list[str] = []
    with h5py.File(file) as opened:
        opened.visititems(lambda name, item: found.append(name) if isinstance(item, h5py.Dataset) else None)
    return found


def _damaged_runs(folder: Path, bad: Path) -> Iterator[tuple[str, tuple[str, ...], bool]]:
    actions = [(kind, action) for kind, every in _SPOILT.items() for action in every]
    with h5py.File(folder / "run.h5") as file:
        arrays = {name: file[name][...] for name in _names(folder / "run.h5")}
    for name, values in arrays.items():
        actions += [
            ("arrays of a run", _other(name, new)) for new in (None, values[:1], np.zeros((2, 5)), 5, "x")
        ]
        if values.dtype.kind == "f" and values.size:
            actions += [("arrays of a run", _other(name, values * factor)) for factor in (np.nan, 1e30)]
        if values.ndim > 1:
            actions.append(("packed arrays", _bomb(name)))
    for number, (kind, action) in enumerate(actions):
        file = bad / f"run{number}.h5"
        shutil.copyfile(folder / "run.h5", file)
        with h5py.File(file, "r+") as opened:
            action(opened)
        name = f"bad/{file.name}"
        yield kind, ("check", name), False
        command = ("plot", "render", "evaluate", "continue", "plot")[number % 5]
        if command == "evaluate":
            yield (
                kind,
                ("evaluate", "dataset.path=data", "checkpoint=out/best.ckpt", f"new_rollouts=[{name}]"),
                False,
            )
        elif command == "continue":
            yield kind, ("simulate", f"continue_from={name}"), True
        else:
            yield kind, (command, f"run={name}"), False


def _cut_short(
    folder: Path, bad: Path, random_: random.Random
) -> Iterator[tuple[str, tuple[str, ...], bool]]:
    body = (*SHORT[:4], "scene=body", "scene.path=path.csv", "scene/tool=mesh")
    readers: dict[str, Callable[[str], tuple[str, ...]]] = {
        "run.h5": lambda name: ("check", name),
        "out/best.ckpt": lambda name: ("rollout", f"checkpoint={name}"),
        "tool.stl": lambda name: ("simulate", *body, f"scene.tool.file={name}"),
        "tool.obj": lambda name: ("simulate", *body, f"scene.tool.file={name}"),
        "text.stl": lambda name: ("simulate", *body, f"scene.tool.file={name}"),
        "path.csv": lambda name: ("simulate", *SHORT, "scene.motion=path", f"scene.path={name}"),
    }
    for good, reader in readers.items():
        content = (folder / good).read_bytes()
        for number in range(12):
            at, data = random_.randrange(len(content)), bytearray(content)
            if number == 0:
                data = bytearray()
            elif number < 4:
                data = data[:at]
            elif number < 8:
                data[at : at + 8] = random_.randbytes(8)
            else:
                data[at:at] = (b"\0" * 8, b"1e400 ", b"\xff\xfe", b"\n\n[[[{{{")[number - 8]
            path = Path(good)
            file = bad / f"{path.stem}{number}{path.suffix}"
            file.write_bytes(data)
            yield f"damaged {path.suffix[1:]} file", reader(f"bad/{file.name}"), number == 0


# --- Texts: datasets, settings, paths, meshes, tables ---------------------------------------------------

_LAUGHS = "a: &a [x,x]\n" + "".join(
    f"b{i}: &{chr(98 + i)} [*{chr(97 + i)},*{chr(97 + i)}]\n" for i in range(24)
)
_YAML = (
    *(
        "",
        "5",
        "[]",
        "a: &a [*a]",
        "a: &a {b: *a}",
        _LAUGHS,
        "[" * 5000,
        "{a: " * 300,
        "!!python/name:os.system x",
    ),
    *(
        "split: 5",
        "split: {train: 5}",
        "split: {train: [../x]}",
        "split: {train: [a, a]}",
        "split: {train: [[a]]}",
    ),
    *("name: [1]\nsplit: {train: [a], validation: [], test: []}", "split: null", "\x00", "\ufffe", "a: b: c"),
    *(
        "split: &s {train: *s}",
        "split: {train: [a], validation: [], test: []}\nscenes: 5",
        "? [a]\n: b",
        "<<: *x",
    ),
    *("split: {train: [.nan]}", "split: {train: [1e400]}", "split: {train: ['" + "a" * 100_000 + "']}"),
)
_EXPERIMENTS = (
    *(
        "scene: &s {a: *s}",
        _LAUGHS,
        "scene: 5",
        "scene: [1]",
        "seed: [1]",
        "defaults: 5",
        "defaults: [nosuch]",
    ),
    *(
        "defaults: [{scene: [a, b]}]",
        "defaults: [{override /scene: nosuch}]",
        "scene: {speed: {a: 1}}",
        "scene:\n\t- 1",
    ),
    *(
        "scene: {bed: null}",
        "material: text",
        "effects: {yielding: 5}",
        "x: 1",
        "hydra: 5",
        "hydra: {job: 3}",
        "[" * 3000,
    ),
    *(
        "- 1",
        "text",
        "scene: {path: &p [*p]}",
        "scene: {speed: ${scene.speed}}",
        "scene: {speed: .nan}",
        "\x00",
    ),
)
_ROW = "0,0.1,0.1,0.06,0,0,0,1\n"
_TABLES = (
    *(
        "",
        "\n\n",
        "t\n",
        "a,b\n",
        "1,2,3\n",
        _ROW * 2,
        "1e400" + _ROW,
        "9" * 400 + _ROW,
        "nan" + _ROW[1:],
        "x" * 200_000,
    ),
    *(
        _ROW + "1,2\n",
        _ROW + "0.1,1e300,0.1,0.06,0,0,0,1\n",
        _ROW + "0.1,0.1,0.1,0.06,0,0,0,0\n",
        '"' * 999,
        "\0" * 99,
    ),
    *(
        _ROW + "0.1,0.1,0.1,0.06,1e200,0,0,1e200\n",
        _ROW + "0.1,0.1,0.1,0.06,1e-300,0,0,0\n",
        ";".join(_ROW.split(",")),
    ),
    *(
        _ROW + "-1,0.1,0.1,0.06,0,0,0,1\n",
        _ROW + "0.1,0.1,0.1,-5,0,0,0,1\n",
        _ROW + "inf,0.1,0.1,0.06,0,0,0,1\n",
    ),
    "t,x,y,z,qx,qy,qz,qw\n" + "".join(f"{i}e-9,{i % 2},0.1,0.06,0,0,0,1\n" for i in range(2000)),
)
_MESHES = (
    *(
        "",
        "v 0 0 0\n",
        "f 1 2 3\n",
        "v a b c\n",
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
        "v nan 0 0\n" * 3 + "f 1 2 3\n",
    ),
    *(
        "v 1e300 0 0\nv 0 1e300 0\nv 0 0 1e300\nv 0 0 0\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n",
        "f 0 0 0\n",
        "mtllib x\n",
    ),
    *(
        "v 0 0 0\n" * 4 + "f 1 2 3\nf 1 2 4\nf 2 3 4\nf 1 3 4\n",
        "v 0 0\nf 1 1 1\n",
        "f 99999999999999999999 1 2\n",
    ),
    *(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf " + "1 2 3 4 " * 20_000 + "\n",
        "solid x\nfacet\n",
        "v 1 2 3\n" * 100_000,
    ),
)


def _texts(folder: Path, bad: Path) -> Iterator[tuple[str, tuple[str, ...], bool]]:
    for number, text in enumerate(_YAML):
        data = bad / f"data{number}"
        (data / "runs").mkdir(parents=True, exist_ok=True)
        shutil.copyfile(folder / "run.h5", data / "runs" / "a.h5")
        (data / "dataset.yaml").write_text(text)
        for command in ("train", "reduce"):
            few = TRAIN if command == "train" else TRAIN[:2]
            yield "dataset.yaml", (command, f"dataset.path=bad/{data.name}", *few), False
    for number, text in enumerate(_EXPERIMENTS):
        experiment = bad / f"conf{number}" / "experiment"
        experiment.mkdir(parents=True, exist_ok=True)
        (experiment / "x.yaml").write_text("# @package _global_\n" + text)
        for command in ("simulate", "rollout"):
            start = SHORT if command == "simulate" else ("checkpoint=out/best.ckpt",)
            yield (
                "file of settings",
                (command, *start, "--config-dir", f"bad/conf{number}", "experiment=x"),
                False,
            )
    for number, text in enumerate(_TABLES):
        (bad / f"table{number}.csv").write_text(text)
        name = f"bad/table{number}.csv"
        yield "path file", ("simulate", *SHORT, "scene.motion=path", f"scene.path={name}"), False
        yield "table of points", ("advise", f"table={name}"), True
    for number, text in enumerate(_MESHES):
        for suffix in ("obj", "stl"):
            (bad / f"mesh{number}.{suffix}").write_text(text)
            body = (*SHORT[:4], "scene=body", "scene.path=path.csv", "scene/tool=mesh")
            yield "mesh file", ("simulate", *body, f"scene.tool.file=bad/mesh{number}.{suffix}"), True


# --- Reduced runs and checkpoints -----------------------------------------------------------------------


def _reduced(folder: Path, bad: Path) -> Iterator[tuple[str, tuple[str, ...], bool]]:
    """What is kept beside a dataset and does not fit together is made again, or refused."""
    kept = sorted((folder / "data" / "reduced").rglob("*.h5"))
    number = 0
    for file in (kept[0], next(one for one in kept if one.name == "basis.h5")):
        for name in _names(file):
            for value in (None, np.zeros((2, 5)), np.full(3, np.nan), "x"):
                data = bad / f"reduced{number}"
                shutil.copytree(folder / "data", data, dirs_exist_ok=True)
                with h5py.File(data / file.relative_to(folder / "data"), "r+") as opened:
                    _other(name, value)(opened)
                yield "reduced runs", ("train", f"dataset.path=bad/{data.name}", *TRAIN), False
                number += 1


def _checkpoints(folder: Path, bad: Path) -> Iterator[tuple[str, tuple[str, ...], bool]]:
    good = torch.load(folder / "out" / "best.ckpt", weights_only=True)
    endless: list[Any] = []
    endless.append(endless)
    card, number = good["hyper_parameters"], 0
    values = [None, 5, "text", [], {}, endless, -1, 1e300, float("nan"), 10**20]
    changes = [good | {"hyper_parameters": value} for value in values] + [
        good | {"state_dict": v} for v in values
    ]
    changes += [good | {"hyper_parameters": card | {key: value}} for key in card for value in values]
    for key in card["model"]:
        model = card["model"]
        changes += [
            good | {"hyper_parameters": card | {"model": model | {key: v}}} for v in (None, 10**6, [1])
        ]
    for content in changes:
        file = bad / f"card{number}.ckpt"
        torch.save(copy.deepcopy(content), file)
        yield "checkpoint", ("rollout", f"checkpoint=bad/{file.name}"), False
        number += 1

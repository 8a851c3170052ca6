"""Bad input of every kind ends in one line and status 2: never a traceback, a hang, or memory without bound.

Random cases from a fixed seed; `SGNS_FUZZ=20` makes twenty times as many from random seeds.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import resource
import signal
import string
import struct
import sys
import zipfile
from collections import Counter
from pathlib import Path
from types import FrameType
from typing import Any

import h5py
import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_module
from hydra.core.global_hydra import GlobalHydra
from hypothesis import HealthCheck, Phase, given, settings
from omegaconf import OmegaConf
from synthetic import make_run
from test_published import record
from tiny import make_dataset

from mpm_warp import Scene, SceneError
from mpm_warp.mesh_file import closed_mesh, read_mesh
from sgns.campaign import Dataset
from sgns.cli import main
from sgns.errors import UserError
from sgns.learning.surrogate import load_surrogate
from sgns.published_dataset import published_dataset
from sgns.reduction import Basis
from sgns.runs import Run, check_run
from sgns.scenes import read_path
from sgns.settings import flattened
from sgns.yaml_text import parse_yaml

MORE = int(os.environ.get("SGNS_FUZZ", "1"))
SECONDS = 10
"""Of computing time, that a case may take."""
MEMORY = 2 << 30
"""Bytes of address space that a case may take beside what the tests have."""


OUTCOMES: Counter[str] = Counter()


@pytest.fixture(autouse=True)
def outcomes(request: pytest.FixtureRequest) -> Any:
    """Say with `pytest -s` how many cases there were: a test whose cases are all refused shows less than it seems."""
    OUTCOMES.clear()
    yield
    print(f"\n{request.node.name}: {OUTCOMES['accepted']} cases accepted, {OUTCOMES['refused']} refused")


def cases(count: int) -> Any:
    """Decorator's settings: so many cases, the same every time."""
    return settings(
        max_examples=count * MORE,
        derandomize=MORE == 1,
        database=None,
        deadline=None,
        phases=[Phase.generate],  # looking for smaller examples takes minutes
        suppress_health_check=list(HealthCheck),
    )


@contextlib.contextmanager
def bounded() -> Any:
    """Time and memory that a case may take."""

    def too_slow(number: int, frame: FrameType | None) -> None:
        raise AssertionError(f"more than {SECONDS} s of computing")

    limits = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    before = signal.signal(signal.SIGPROF, too_slow)
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limits)
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def refused_or_read(action: Any) -> None:
    """The action does its work, or says in one line why not."""
    with bounded():
        try:
            action()
            OUTCOMES["accepted"] += 1
        except (UserError, SceneError) as error:
            OUTCOMES["refused"] += 1
            assert str(error).strip() and len(str(error)) < 5000, error


# --- values -----------------------------------------------------------------------------------------------

NUMBERS = st.sampled_from(
    [0, -1, 1, 2, 3, 7, 1e-300, -1e300, 1e300, 10**20, -(10**20), 10**6, float("nan"), float("inf"), 0.5, 1e9]
)
TEXTS = st.text(max_size=12) | st.sampled_from(
    ["", "a", "..", "/", "\x00", "no such file", "../../x", "nan", "1"]
)
VALUES = st.recursive(
    NUMBERS | TEXTS | st.none() | st.booleans(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(TEXTS, inner, max_size=3),
    max_leaves=5,
)


@st.composite
def changed(draw: Any, tree: Any) -> Any:
    """Nested data in which a few values are other ones, missing or new."""
    if isinstance(tree, dict) and tree and draw(st.integers(0, 3)):
        key = draw(st.sampled_from(sorted(tree, key=str)))
        kept = {k: v for k, v in tree.items() if k != key}
        action = draw(st.integers(0, 5))
        if action == 0:
            return kept
        if action == 1:
            return tree | {draw(TEXTS): draw(VALUES)}
        return tree | {key: draw(changed(tree[key]))}
    if isinstance(tree, list) and tree and draw(st.booleans()):
        index = draw(st.integers(0, len(tree) - 1))
        return [*tree[:index], draw(changed(tree[index])), *tree[index + 1 :]]
    return draw(VALUES)


@st.composite
def damaged(draw: Any, content: bytes) -> bytes:
    """A file that was cut short, or in which bytes were changed, doubled or inserted."""
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, max(0, len(content) - 1)))
        action = draw(st.integers(0, 4))
        if action == 0:
            content = content[:at]
        elif action == 1:
            content = content[:at] + draw(st.binary(min_size=1, max_size=8)) + content[at + 8 :]
        elif action == 2:
            content = content[:at] + draw(st.binary(min_size=1, max_size=20)) + content[at:]
        elif action == 3:
            content = (
                content[:at]
                + bytes([content[at] ^ 1 << draw(st.integers(0, 7))] if content else [])
                + content[at + 1 :]
            )
        else:
            content = content[:at] + b"\xff" * 8 + content[at + 8 :]
    return content


# --- files that are good ----------------------------------------------------------------------------------

BED = {"size": [0.4, 0.2, 0.16], "spacing": 0.04}
BLADE = {"length": 0.1, "width": 0.1, "thickness": 0.08}
SCENE = {"kind": "excavation", "duration": 0.2, "speed": 0.05, "blade": BLADE, "bed": BED}
SMALL = [
    *("scene.bed.size=[0.4,0.2,0.16]", "scene.bed.spacing=0.04", "scene.duration=0.2", "scene.speed=0.05"),
    *("scene.blade.length=0.1", "scene.blade.width=0.1", "scene.blade.thickness=0.08"),
]
TRAIN = [
    *(
        "reduction.max_modes=6",
        "reduction.num_modes=3",
        "model.hidden_width=8",
        "model.message_passing_steps=1",
    ),
    *("training.max_steps=2", "training.validate_every=2", "training.warmup_steps=0", "training.threads=1"),
]


def call(*arguments: str) -> tuple[int, str]:
    """Status and last words of a command in this process."""
    GlobalHydra.instance().clear()
    said, before = io.StringIO(), sys.argv
    sys.argv = ["sgns", *arguments]
    try:
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()), bounded():
            status = main()
    finally:
        sys.argv = before
    return status, said.getvalue()


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a dataset of a real bed, a checkpoint, a run, a basis and everything else that is read."""
    folder = tmp_path_factory.mktemp("good")
    scene = Scene.from_dict(SCENE)
    make_dataset(
        folder / "data",
        n=len(scene.stored),
        arrangement_hash=scene.arrangement_hash,
        scene=scene.to_dict() | {"duration": 0.2},
    )
    status, said = call("train", f"dataset.path={folder / 'data'}", *TRAIN, f"output={folder / 'out'}")
    assert status == 0, said
    make_run(folder / "run.h5", frames=4, n=6, m=3)
    return folder


# --- overrides --------------------------------------------------------------------------------------------

SHOWN = st.one_of(
    NUMBERS.map(str),
    VALUES.map(lambda value: json.dumps(value)),
    st.text(string.printable, max_size=12),
    st.sampled_from(
        [
            "null",
            "[]",
            "{}",
            "???",
            "${seed}",
            "${oc.env:HOME}",
            "${x",
            "${scene}",
            "[1",
            "'",
            "1,2",
            "range(3)",
        ]
    ),
    st.sampled_from(
        ["{a:1}", "[1,[2]]", "true", "auto", "nope", "-0.0", "1e400", "0x10", "é", "a=b", "  ", "~"]
    ),
)


@st.composite
def overrides(draw: Any) -> list[str]:
    """A command with some of its settings changed at random."""
    command = draw(
        st.sampled_from(["simulate", "simulate", "train", "train", "rollout", "reduce", "evaluate", "check"])
    )
    arguments = [command]
    for _ in range(draw(st.integers(1, 3))):
        key = draw(st.sampled_from(KEYS[command]))
        sign = draw(st.sampled_from(["", "", "", "", "+", "++", "~"]))
        arguments.append(f"{sign}{key}={draw(SHOWN)}")
    return arguments


def keys_of(command: str) -> list[str]:
    """Dotted keys of a command's settings and groups."""
    with initialize_config_module("sgns.conf", version_base="1.3"):
        keys = flattened(OmegaConf.to_container(compose(command), resolve=False))
    return sorted(
        {*keys, *(key.partition(".")[0] for key in keys), *(key.rpartition(".")[0] or key for key in keys)}
    )


KEYS = {name: keys_of(name) for name in ("simulate", "train", "rollout", "reduce", "evaluate", "check")}


class Begun(UserError):
    """The settings were good enough to begin the long part."""


@pytest.fixture
def nothing_long(monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands end where the computing would begin."""

    def begun(*_: Any, **__: Any) -> None:
        raise Begun("begun")

    for name in (
        "sgns.simulate.simulate_scene",
        "sgns.campaign_runs._compile",
        "sgns.learning.training.fit",
        "sgns.learning.training.fit_polynomial",
        "sgns.evaluation.evaluate.roll_out",
        "sgns.rollout.rollout_scene",
    ):
        monkeypatch.setattr(name, begun)


def test_overrides(good, empty_folder, nothing_long) -> None:
    @cases(60)
    @given(overrides())
    def check(arguments: list[str]) -> None:
        command, *rest = arguments
        given_before = {
            "simulate": SMALL,
            "rollout": [*SMALL, f"checkpoint={good / 'out' / 'best.ckpt'}"],
            "train": [f"dataset.path={good / 'data'}", *TRAIN],
            "reduce": [f"dataset.path={good / 'data'}", *TRAIN[:2]],
            "evaluate": [f"dataset.path={good / 'data'}", f"checkpoint={good / 'out' / 'best.ckpt'}"],
            "check": [f"files=[{good / 'run.h5'}]"],
        }[command]
        status, said = call(command, *given_before, *rest)
        assert status in (0, 2), (status, said)
        OUTCOMES["accepted" if status == 0 or said.endswith(": begun\n") else "refused"] += 1
        assert "Traceback" not in said and (status == 0 or said.count("\n") >= 1), said
        assert status == 0 or said.splitlines()[-1].startswith(f"sgns {command}: "), said

    check()


# --- YAML -------------------------------------------------------------------------------------------------

YAML = st.one_of(
    st.text(max_size=40),
    st.lists(
        st.sampled_from(
            [
                "a: ",
                "- ",
                "&x ",
                "*x",
                "[",
                "]",
                "{",
                "}",
                "\n",
                "  ",
                "!!python/object:os.system ",
                "!!binary ",
                "|\n",
                "<<: ",
                "? ",
                ": ",
                "'",
                '"',
                "# ",
                "%TAG",
                "---\n",
                "1",
                "2001-13-45",
                "split: ",
                "train: ",
                "scenes: ",
                "${oc.env:HOME}",
            ]
        ),
        max_size=25,
    ).map("".join),
    VALUES.map(json.dumps),
    st.integers(1, 30).map(lambda n: "a: &a [x,x]\n" + "b: &a [*a,*a]\n" * n),
    st.sampled_from([1, 90, 110, 5000]).map(lambda n: "[" * n + "]" * n),
)


@pytest.fixture
def runs(tmp_path: Path) -> None:
    """Files that are looked for, not into."""
    (tmp_path / "runs").mkdir()
    for name in "abc":
        (tmp_path / "runs" / f"{name}.h5").touch()


def test_yaml_of_data(tmp_path, runs) -> None:
    @cases(100)
    @given(YAML, st.booleans())
    def check(text: str, alone: bool) -> None:
        with bounded(), contextlib.suppress(ValueError):
            parse_yaml(text)
        content = text if alone else f"split: {{train: [a], validation: [], test: []}}\n{text}"
        (tmp_path / "dataset.yaml").write_text(content, encoding="utf-8", errors="surrogatepass")
        refused_or_read(lambda: Dataset.open(tmp_path, {"gravity": 9.81} if alone else None))

    check()


def test_dataset_yaml(tmp_path, runs) -> None:
    content = {
        "name": "a",
        "split": {"train": ["a", "b"], "validation": [], "test": ["c"]},
        "scenes": {key: {"gravity": 1.0} for key in "abc"},
    }

    @cases(60)
    @given(changed(content), st.sampled_from([None, {"gravity": 1.0}, {"gravity": [1.0]}]))
    def check(tree: Any, where: Any) -> None:
        (tmp_path / "dataset.yaml").write_text(json.dumps(tree))
        refused_or_read(lambda: Dataset.open(tmp_path, where))

    check()


def test_yaml_of_settings(empty_folder, good, nothing_long) -> None:
    (empty_folder / "conf" / "experiment").mkdir(parents=True)

    @cases(30)
    @given(
        YAML
        | changed({"scene": SCENE, "seed": 1, "hydra": {"verbose": True}, "defaults": ["_self_"]}).map(
            json.dumps
        )
    )
    def check(text: str) -> None:
        file = empty_folder / "conf" / "experiment" / "x.yaml"
        file.write_text("# @package _global_\n" + text, encoding="utf-8", errors="surrogatepass")
        status, said = call("simulate", "--config-dir", str(empty_folder / "conf"), *SMALL, "experiment=x")
        assert status in (0, 2) and "Traceback" not in said, said
        OUTCOMES["accepted" if status == 0 or said.endswith(": begun\n") else "refused"] += 1

    check()


# --- HDF5 -------------------------------------------------------------------------------------------------


@st.composite
def spoiled(draw: Any, names: list[str], attributes: list[str]) -> list[tuple[Any, ...]]:
    """What is done to an HDF5 file."""
    actions = []
    for _ in range(draw(st.integers(1, 3))):
        kind = draw(
            st.sampled_from(
                ["missing", "shape", "huge", "type", "values", "group", "link", "attribute", "text"]
            )
        )
        shape = draw(st.lists(st.sampled_from([0, 1, 2, 3, 4, 6, 7]), max_size=4))
        dtype = draw(st.sampled_from(["<f4", "<f8", "<i8", "u1", "S5", ">f8", "<f2", "c16", "?"]))
        huge = draw(st.sampled_from([10**6, 10**9, 10**12, 10**15]))
        actions.append(
            (
                kind,
                draw(st.sampled_from(names)),
                shape,
                dtype,
                huge,
                draw(st.sampled_from(attributes)),
                draw(VALUES),
                draw(YAML),
            )
        )
    return actions


def spoil(file: h5py.File, actions: list[tuple[Any, ...]]) -> None:
    """Do it."""
    for kind, name, shape, dtype, huge, attribute, value, text in actions:
        old = file.get(name)
        if kind == "attribute":
            with contextlib.suppress(TypeError, ValueError, OverflowError, UnicodeEncodeError):
                file.attrs[attribute] = value if value is not None else np.zeros(shape, dtype)
            continue
        if kind == "text":
            with contextlib.suppress(ValueError, UnicodeEncodeError):
                file.attrs[attribute] = np.bytes_(text.encode("utf-8"))
            continue
        if not isinstance(old, h5py.Dataset):
            continue
        shown = old.shape
        if kind == "values" and old.size > 10**6:
            continue
        values = old[...] if kind == "values" else None
        del file[name]
        if kind == "shape":
            file.create_dataset(name, tuple(shape), dtype)
        elif kind == "huge":
            tail = shown[1:] if len(shown) else ()
            file.create_dataset(
                name, (huge, *tail), old_dtype(dtype), chunks=(1, *tail), maxshape=(None, *tail)
            )
        elif kind == "type":
            file.create_dataset(name, shown, dtype)
        elif kind == "values":
            if values.dtype in (np.float32, np.float64) and values.size:
                values = values.copy()
                values.flat[huge % values.size] = np.nan if huge % 2 else 1e30
            file[name] = values
        elif kind == "group":
            file.create_group(name)
        elif kind == "link":
            file[name] = (
                h5py.ExternalLink("/etc/hostname", "/x") if huge > 10**9 else h5py.SoftLink("/nowhere")
            )


def old_dtype(dtype: str) -> str:
    return dtype if dtype[0] == "<" else "<f8"


def datasets_of(path: Path) -> tuple[list[str], list[str]]:
    names: list[str] = []
    with h5py.File(path) as file:
        file.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
        return names, list(file.attrs)


def read_run(path: Path) -> None:
    """Everything a command reads of a run."""
    with Run(path) as run:
        run.scene, run.effects, run.extra, run.seed, run.frame_rate, run.wall_time_s, run.content_hash  # noqa: B018
        run.time, run.pose, run.force, run.torque, run.body_points  # noqa: B018
        for frame in range(min(run.frame_count, 10)):
            run.positions(frame), run.velocities(frame)


def test_runs(good, tmp_path) -> None:
    whole, path = (good / "run.h5").read_bytes(), tmp_path / "a.h5"
    names, attributes = datasets_of(good / "run.h5")

    @cases(110)
    @given(spoiled(names, attributes))
    def check(actions: list[tuple[Any, ...]]) -> None:
        path.write_bytes(whole)
        with h5py.File(path, "r+") as file:
            spoil(file, actions)
        with bounded():
            assert all(isinstance(problem, str) for problem in check_run(path))
        refused_or_read(lambda: read_run(path))

    check()


def test_runs_cut_short_or_changed(good, tmp_path) -> None:
    whole, path = (good / "run.h5").read_bytes(), tmp_path / "a.h5"

    @cases(60)
    @given(damaged(whole))
    def check(content: bytes) -> None:
        path.write_bytes(content)
        with bounded():
            problems = check_run(path)
        refused_or_read(lambda: read_run(path))
        assert problems or content == whole or unread(whole, content)

    check()


def unread(whole: bytes, content: bytes) -> bool:
    """Whether only bytes differ that no number and no text of a run depends on, as far as that can be told: few."""
    return len(whole) == len(content) and sum(a != b for a, b in zip(whole, content, strict=True)) < 64


def test_bases(good, tmp_path) -> None:
    basis = next((good / "data" / "reduced").glob("*/basis.h5"))
    whole, path = basis.read_bytes(), tmp_path / "basis.h5"
    names, attributes = datasets_of(basis)

    @cases(40)
    @given(spoiled(names, attributes))
    def spoil_it(actions: list[tuple[Any, ...]]) -> None:
        path.write_bytes(whole)
        with h5py.File(path, "r+") as file:
            spoil(file, actions)
        refused_or_read(lambda: Basis.load(path))

    @cases(30)
    @given(damaged(whole))
    def damage_it(content: bytes) -> None:
        path.write_bytes(content)
        refused_or_read(lambda: Basis.load(path))

    spoil_it()
    damage_it()


# --- paths, meshes, checkpoints, TFRecords ----------------------------------------------------------------

LINES = st.lists(
    st.sampled_from(["0", "1.5", "nan", "inf", "-1e400", "", "a", '"', "0x1", "1_0", "\0", "é"]), max_size=9
).map(",".join)


def test_csv_paths(tmp_path) -> None:
    header = "t,x,y,z,qx,qy,qz,qw\n"
    good = header + "".join(f"{0.1 * i},0.1,0.1,0.2,0,0,0,1\n" for i in range(4))

    @cases(60)
    @given(
        damaged(good.encode())
        | st.lists(LINES, max_size=5).map(lambda rows: (header + "\n".join(rows)).encode())
    )
    def check(content: bytes) -> None:
        (tmp_path / "path.csv").write_bytes(content)
        body = {
            "kind": "body",
            "bed": BED,
            "duration": 0.2,
            "tool": {"shape": "box", "size": [0.1, 0.1, 0.1]},
        }
        refused_or_read(lambda: Scene.from_dict(body | {"path": read_path(tmp_path / "path.csv")}))

    check()


def test_meshes(tmp_path) -> None:
    corners = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    binary = b"x" * 80 + struct.pack("<I", 4)
    for face in faces:
        binary += struct.pack("<12fH", 0, 0, 0, *(value for k in face for value in corners[k]), 0)
    rows = "".join(
        "facet\n" + "".join("vertex {} {} {}\n".format(*corners[k]) for k in face) for face in faces
    )
    obj = "".join("v {} {} {}\n".format(*c) for c in corners) + "".join(
        f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in faces
    )
    words = st.lists(
        st.sampled_from(
            ["v 1 2 3", "f 1 2 3", "f 1/2 2 9", "f 1e9", "f -1 -2 -3", "v a b c", f"f {10**30} 1 2"]
        ),
        max_size=6,
    )

    @cases(60)
    @given(
        damaged(binary).map(lambda c: ("a.stl", c))
        | damaged(b"solid\n" + rows.encode()).map(lambda c: ("a.stl", c))
        | damaged(obj.encode()).map(lambda c: ("a.obj", c))
        | words.map(lambda w: ("a.obj", "\n".join(w).encode()))
    )
    def check(file: tuple[str, bytes]) -> None:
        name, content = file
        (tmp_path / name).write_bytes(content)
        refused_or_read(lambda: closed_mesh(*read_mesh(tmp_path / name), name))

    check()


def test_checkpoints(good, tmp_path) -> None:
    whole = torch.load(good / "out" / "best.ckpt", weights_only=True)
    card, state = whole["hyper_parameters"], whole["state_dict"]
    path = tmp_path / "a.ckpt"
    with initialize_config_module("sgns.conf", version_base="1.3"):
        cfg = compose("rollout", [*SMALL, f"checkpoint={path}", f"output={tmp_path / 'rollout.h5'}"])

    def play() -> None:
        from sgns.rollout import main

        main(cfg)

    @cases(50)
    @given(changed(card))
    def other_card(changed_card: Any) -> None:
        torch.save({"state_dict": state, "hyper_parameters": changed_card}, path)
        refused_or_read(play)

    @cases(30)
    @given(
        st.sampled_from(sorted(state)),
        st.sampled_from(["missing", "huge", "shape", "type", "nan", "sparse", "none"]),
    )
    def other_state(name: str, kind: str) -> None:
        value = state[name]
        changes = {
            "huge": torch.zeros(1).expand(10**12),
            "shape": torch.zeros(*value.shape, 2),
            "type": torch.zeros(value.shape, dtype=torch.int8),
            "nan": torch.full_like(value, torch.nan),
            "sparse": torch.zeros(value.shape).to_sparse(),
            "none": None,
        }
        tensors = {k: v for k, v in state.items() if k != name}
        if kind != "missing":
            tensors[name] = changes[kind]
        torch.save({"state_dict": tensors, "hyper_parameters": card}, path)
        refused_or_read(play)

    @cases(30)
    @given(damaged((good / "out" / "best.ckpt").read_bytes()))
    def damage(content: bytes) -> None:
        path.write_bytes(content)
        refused_or_read(lambda: load_surrogate(path))

    other_card()
    other_state()
    damage()


def test_archives_that_claim_more_than_they_hold(good, tmp_path) -> None:
    with zipfile.ZipFile(good / "out" / "best.ckpt") as old, zipfile.ZipFile(tmp_path / "a.ckpt", "w") as new:
        for part in old.infolist():
            new.writestr(part.filename, old.read(part), compress_type=zipfile.ZIP_DEFLATED)
    with pytest.raises(UserError, match="cannot be read as a checkpoint"):
        load_surrogate(tmp_path / "a.ckpt")


def test_published_files(tmp_path) -> None:
    first = [[0.82, 0.30, 0.50], [0.82, 0.4, 0.50], [0.82, 0.3, 0.6], [1.0, 2.0, 3.0]]
    one = record([first] * 4, [3, 3, 3, 6], [[9, 9, 9]] * 4)
    data = struct.pack("<Q", len(one)) + b"crc!" + one + b"crc!"

    @cases(80)
    @given(
        damaged(data) | st.just(data),
        changed({"dataset_split": {"valid": [186]}}) | st.just({"dataset_split": {"valid": [186]}}),
    )
    def check(content: bytes, about: Any) -> None:
        (tmp_path / "valid.tfrecord").write_bytes(content)
        (tmp_path / "metadata.json").write_text(json.dumps(about))
        refused_or_read(lambda: published_dataset({"path": str(tmp_path)}, 1))

    check()

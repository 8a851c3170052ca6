"""Runs and bases: missing, wrong and huge datasets and attributes; bytes lost or changed."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import h5py
import hypothesis.strategies as st
import numpy as np
from hypothesis import given
from kills import as_bytes

from sgns.data.check import check_run
from sgns.data.run import Run
from sgns.reduction.basis import Basis
from sgns_testing.fuzzing import VALUES, YAML, bounded, cases, damaged, refused_or_read


@st.composite
def spoiled(draw: Any, names: list[str], attributes: list[str]) -> list[tuple[Any, ...]]:
    """What is done to an HDF5 file."""
    actions = []
    kinds = ["more", "missing", "shape", "huge", "type", "values", "group", "link", "attribute", "text"]
    for _ in range(draw(st.integers(1, 3))):
        kind = draw(st.sampled_from(kinds))
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
        if kind == "more":  # something of somebody else's, which nobody reads
            group = file.require_group("more")
            group.create_dataset(f"{len(group)}", tuple(shape), dtype)
            group.attrs["note"] = huge
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


def read_run(path: Path) -> list[Any]:
    """Everything a command reads of a run; returns its arrays."""
    with Run(path) as run:
        run.scene, run.effects, run.extra, run.seed, run.frame_rate, run.wall_time_s, run.content_hash  # noqa: B018
        soil = [(run.positions(frame), run.velocities(frame)) for frame in range(min(run.frame_count, 10))]
        return [run.time, run.pose, run.force, run.torque, run.body_points, *soil]


def test_runs(good, tmp_path) -> None:
    whole, path = (good / "run.h5").read_bytes(), tmp_path / "a.h5"
    names, attributes = datasets_of(good / "run.h5")

    @cases(30)
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
    known = as_bytes(read_run(good / "run.h5"))

    @cases(20)
    @given(damaged(whole))
    def check(content: bytes) -> None:
        path.write_bytes(content)
        with bounded():
            problems = check_run(path)
        refused_or_read(lambda: read_run(path))
        assert problems or as_bytes(read_run(path)) == known  # bytes that no number depends on

    check()


def test_bases(good, tmp_path) -> None:
    basis = next((good / "data" / "reduced").glob("*/basis.h5"))
    whole, path = basis.read_bytes(), tmp_path / "basis.h5"
    names, attributes = datasets_of(basis)

    @cases(12)
    @given(spoiled(names, attributes))
    def spoil_it(actions: list[tuple[Any, ...]]) -> None:
        path.write_bytes(whole)
        with h5py.File(path, "r+") as file:
            spoil(file, actions)
        refused_or_read(lambda: Basis.load(path))

    @cases(10)
    @given(damaged(whole))
    def damage_it(content: bytes) -> None:
        path.write_bytes(content)
        refused_or_read(lambda: Basis.load(path))

    spoil_it()
    damage_it()

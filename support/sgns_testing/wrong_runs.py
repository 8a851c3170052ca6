"""Run files in which something is missing, of another kind, or more than it seems."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import yaml

from sgns_testing.wrong_files import DATA_READERS, LAUGHS, RUN_READERS, Case, wrong_file

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
_CONTENT: dict[str, Spoil] = {
    **{
        f"scene {words}": _attribute("scene", text)
        for words, text in {
            "empty": " ",
            "a list": "[]",
            "a number": "5",
            "cut": "{",
            "nested": "{a: " * 3000,
            "multiplies": LAUGHS,
            "of itself": "a: &a [*a]",
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
        for key, value in {"blade.thickness": None, "bed": {"size": [1, 2]}, "rake": {"a": 1}}.items()
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


def wrong_runs() -> Iterator[Case]:
    def spoilt(spoil: Spoil) -> Callable[[Path], None]:
        def write(path: Path) -> None:
            with h5py.File(path, "r+") as file:
                spoil(file)

        return write

    for number, (words, spoil) in enumerate(_STRUCTURE.items()):
        yield from wrong_file("run.h5", "parts of a run", words, spoilt(spoil), RUN_READERS[:1])
        yield from wrong_file("run.h5", "parts of a run", words, spoilt(spoil), [RUN_READERS[1 + number % 3]])
        if number % 3 == 0:
            yield from wrong_file("soft.stopped.h5", "parts of a run", words, spoilt(spoil))
            readers = [DATA_READERS[number // 3 % 2]]
            yield from wrong_file("of_data.h5", "parts of a run", words, spoilt(spoil), readers)
    for words, spoil in _CONTENT.items():
        yield from wrong_file("run.h5", "content of a run", words, spoilt(spoil), RUN_READERS[:1])

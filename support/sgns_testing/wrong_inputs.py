"""Inputs that are wrong by the way they are made: every command refuses each with status 2, in a line, soon and small.

Wrong settings come from the definitions of the settings and from what people wrote, wrong files from `wrong_files`.
"""

from __future__ import annotations

import importlib
import os
import random
import resource
import shlex
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Iterable, Iterator
from dataclasses import fields, is_dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, get_args, get_type_hints

from mpm_warp import Bed, Effects, Material
from mpm_warp.bed import Walls
from mpm_warp.bodies import Box, Cylinder, MeshBody, Plate
from mpm_warp.scenes import Body, Column, Excavation, Incline, Wheel
from mpm_warp.settings import Setting
from sgns import command_settings
from sgns import settings as typed
from sgns.cli import COMMANDS
from sgns_testing.commands import call
from sgns_testing.wrong_files import (
    ADVISE,
    CAMPAIGN,
    CHECKPOINT,
    CUT,
    CUT_ON_PATH,
    FIT,
    JUDGE,
    LEARN,
    ON_PATH,
    PACKED,
    PUBLISHED,
    READ,
    RUN,
    WITH_MESH,
    Case,
    good_files,
    wrong_file,
    wrong_files,
)
from sgns_testing.wrong_runs import wrong_runs

SECONDS, BYTES = 20.0, 3 << 30
"""That a command may take to refuse; the bytes are all that its process holds at its highest."""


class Outcome(NamedTuple):
    """What a command did."""

    case: Case
    status: int
    """2: refused; 0: done; 1: a bug; negative: ended by a signal."""
    said: str
    """On standard error."""
    seconds: float
    bytes: int

    @property
    def line(self) -> str:
        """The last that was said."""
        return (self.said.strip().splitlines() or [""])[-1]

    @property
    def fault(self) -> str:
        """What is bad about it; empty: nothing."""
        if self.status != (0 if self.case.kind == "good" else 2):
            return f"status {self.status}"
        if self.seconds > SECONDS or self.bytes > BYTES:
            return f"{self.seconds:.0f} s, {self.bytes / 1e9:.1f} GB"
        if self.case.kind == "good":
            return ""
        if not self.line.startswith("sgns") or "Traceback" in self.said or self.said.count("\n") > 1:
            return "not one line"
        return "" if self.case.names in self.line else f"does not name {self.case.names}"


# --- Settings, by their definitions ---------------------------------------------------------------------

_SCENES: list[tuple[tuple[str, ...], Any]] = [
    (CUT, Excavation),
    (ON_PATH, Body),
    (("scene=quick_wheel", "scene.duration=0.05", "scene.settle=0"), Wheel),
    (("scene=column", "scene.bed.spacing=0.04", "scene.duration=0.05"), Column),
    (("scene=incline", "scene.duration=0.05"), Incline),
]


def _groups() -> Iterator[tuple[str, tuple[str, ...], str, Any]]:
    """Command, arguments with which it is good, prefix of keys and class of every group of settings."""
    for base, cls in _SCENES:
        yield "simulate", base, "scene.", cls
    for prefix, cls in (
        ("scene.bed.", Bed),
        ("scene.bed.walls.", Walls),
        ("scene.blade.", Plate),
        ("material.", Material),
        ("effects.", Effects),
        ("solver.", typed.SolverSettings),
        ("limits.", command_settings.Limits),
    ):
        yield "simulate", CUT, prefix, cls
    yield "simulate", ON_PATH, "scene.tool.", Box
    round_tool = ("scene/tool=cylinder", "scene.tool.diameter=0.1", "scene.tool.width=0.1")
    yield "simulate", (*ON_PATH[:-1], *round_tool), "scene.tool.", Cylinder
    yield "simulate", WITH_MESH, "scene.tool.", MeshBody
    yield "simulate", CAMPAIGN, "dataset.", typed.DatasetSettings
    yield "reduce", LEARN[:3], "reduction.", typed.ReductionSettings
    yield "reduce", LEARN[:3], "dataset.", typed.DatasetSettings
    for prefix, cls in (
        ("reduction.", typed.ReductionSettings),
        ("model.", typed.ModelSettings),
        ("training.", typed.TrainingSettings),
        ("training.loss.", typed.LossWeights),
        ("dataset.", typed.DatasetSettings),
    ):
        yield "train", LEARN, prefix, cls
    yield "train", FIT, "model.", typed.PolynomialSettings
    yield "train", FIT, "training.", typed.FitSettings
    yield "train", PUBLISHED, "dataset.", typed.PublishedSettings
    yield "rollout", CHECKPOINT, "scene.", Excavation
    yield "evaluate", JUDGE, "dataset.", typed.DatasetSettings
    yield "advise", ADVISE, "error.", command_settings.Errors
    own = {
        "simulate": CUT,
        "reduce": LEARN[:3],
        "train": LEARN,
        "rollout": CHECKPOINT,
        "evaluate": JUDGE,
        "advise": ADVISE,
        "check": (f"files=[{RUN}]",),
        "plot": (f"run={RUN}", "output=a.png"),
        "render": (f"run={RUN}", "output=a.gif"),
        "convert": (f"run={RUN}", "output=a.csv"),
        "import": (f"source=[{RUN}]", "output=a.h5"),
    }
    for name, cls in command_settings.COMMANDS.items():
        yield name, own.get(name, ()), "", cls
    yield "train", PACKED, "dataset.", typed.PackedSettings


def _setting_of(cls: Any, name: str) -> Setting:
    """A class that changes only a default has the setting of its base."""
    for base in cls.__mro__:
        found = base.__dict__.get("__dataclass_fields__", {}).get(name)
        if found is not None and "setting" in found.metadata:
            return found.metadata["setting"]
    return Setting("")


def _wrong_values(known: Setting, hint: Any) -> tuple[list[str], list[str]]:
    """Values of another type, and numbers that are too large or too small."""
    kinds = {part for one in (hint, *get_args(hint)) for part in (one, *get_args(one))}
    origins = {getattr(part, "__origin__", part) for part in kinds}
    types, sizes = ["{a: 1}", "[[1, 2], [3]]"], []
    if type(None) not in kinds:
        types.append("null")
    if bool in kinds or any(isinstance(choice, bool) for part in kinds for choice in get_args(part)):
        types += ["maybe", "7", "[true]", "1e300"]
    elif int in kinds or float in kinds:
        types += ["nan", "inf", "-inf", "1e400", "true", "''", "[a, b, c]", "[nan, 0, 0]"]
        types += ["text", "10.5.1", "0x1g"]
        wrong = [(known.ge, -1), (known.gt, 0), (known.le, 1), (known.lt, 0)]
        sizes = [f"{v + sign * (abs(v) / 2 + 1e-3):.17g}" for v, sign in wrong if v is not None]
        sizes += ["1e300", "-1e300", "1" + "0" * 30] + ["1e-300"] * (
            known.gt == 0
        )  # where 0 is right it is, too
        if int in kinds and float not in kinds:
            sizes += ["10.5", "1e19", "-1000000000000000000000"]
        if list in origins or tuple in origins:
            types += ["[]", "5"]
            sizes = [f"[{', '.join([size] * (3 if float in kinds else 2))}]" for size in sizes]
    elif known.choices or any(getattr(part, "__origin__", None) is not None for part in kinds):
        types += ["5", "1e300"] + (["nosuch"] if dict not in origins and list not in origins else [])
    else:
        types += ["[]", "5", "true", "[a]"]
    return types, sizes


def _of_settings(chance: random.Random) -> Iterator[Case]:
    """Of every setting a value of another type and, if it is a number, one that it cannot be, too."""
    for command, base, prefix, cls in _groups():
        hints = get_type_hints(cls, localns={cls.__name__: cls})
        for one in fields(cls):
            if (
                prefix == "scene."
                and one.name not in cls.__annotations__
                and (command, base) != ("simulate", CUT)
            ):
                continue  # the same setting as of another kind of scene
            if one.name == "output" and command in COMMANDS and COMMANDS[command].output == "folder":
                continue  # any word is a name
            hint, key = hints[one.name], f"{prefix}{one.name}"
            if any(is_dataclass(part) for part in (hint, *get_args(hint))):
                types, sizes = ["[a]", "5", "text", "[[1]]"], []
            else:
                types, sizes = _wrong_values(_setting_of(cls, one.name), hint)
            picked = [chance.choice(types), chance.choice(sizes)] if sizes else chance.sample(types, 1)
            for kind, value in zip(("type", "size"), picked, strict=False):
                yield Case(f"setting, {kind}", command, base, (f"{key}={value}",), one.name)


# --- What people wrote ----------------------------------------------------------------------------------

_BASES = {
    "CUT": CUT,
    "CUT_ON_PATH": CUT_ON_PATH,
    "ON_PATH": ON_PATH,
    "CAMPAIGN": CAMPAIGN,
    "REDUCE": LEARN[:3],
    "LEARN": LEARN,
    "CHECKPOINT": CHECKPOINT,
    "JUDGE": JUDGE,
    "ADVISE": ADVISE,
    "NOTHING": (),
}


def _written() -> Iterator[Case]:
    """The lines of wrong_inputs.txt."""
    command, base = "", ""
    for line in Path(__file__).with_suffix(".txt").read_text().splitlines():
        if line.startswith("["):
            command, base = line[1:-1].split()
        elif line and not line.startswith("#"):
            text, _, names = line.rpartition(" -> ")
            kind = "path" if "scene.path=" in text else "as people wrote it"
            yield Case(kind, command, _BASES[base], tuple(filter(None, shlex.split(text))), names)


# --- All of them ----------------------------------------------------------------------------------------


def every_case(seed: int = 15) -> list[Case]:
    """All of them, in an order that follows from the seed."""
    chance = random.Random(seed)
    found = [*_of_settings(chance), *_written(), *wrong_files(), *wrong_runs()]
    chance.shuffle(found)
    return list({one.what: one for one in found}.values())


def good_cases() -> list[Case]:
    """The commands as the cases have them, with nothing wrong: they do their work."""
    used = {(command, base) for command, base, *_ in _groups() if base}
    files = [good for good in READ if good != "soft.stopped.h5"]  # it stops again, which is right
    found = [Case("good", command, base, (), file=" ".join(base)) for command, base in sorted(used)]
    return [
        *found,
        *(one for good in files for one in wrong_file(good, "good", "as it is", lambda file: None)),
    ]


def run_cases(cases: Iterable[Case], folder: Path) -> Iterator[Outcome]:
    """What the commands do with them, each in a process and an empty folder of its own, one after another.

    The start of Python is not in their times. Good files are made in `folder` first.
    """
    for command in COMMANDS.values():  # loaded once, for all of them
        importlib.import_module(command.module)
    if not (folder / "good").exists():
        _in_a_process(lambda: good_files(folder / "good"), sys.stderr.fileno())
    for case in cases:
        place = folder / "place"
        place.mkdir()
        if case.make is not None:
            case.make(place, folder / "good")
        with tempfile.TemporaryFile("w+") as said:
            began = time.perf_counter()
            status, memory = _in_a_process(partial(_run, case, place, said.fileno()), said.fileno())
            seconds = time.perf_counter() - began
            said.seek(0)
            yield Outcome(case, status, said.read(), seconds, memory)
        shutil.rmtree(place)


def _in_a_process(action: Any, said: int) -> tuple[int, int]:
    """What an action answers in a process of its own, its status, and the most bytes that it held."""
    child = os.fork()
    if child == 0:
        status = 1
        try:
            status = action() or 0
        except BaseException:
            os.write(said, traceback.format_exc().encode())
        finally:
            os._exit(status if 0 <= status < 256 else 1)
    _, status, used = os.wait4(child, 0)
    return os.waitstatus_to_exitcode(status), used.ru_maxrss * 1024


def _run(case: Case, place: Path, said: int) -> int:
    os.chdir(place)
    null = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1):
        os.dup2(null, stream)
    signal.alarm(int(2 * SECONDS))
    resource.setrlimit(resource.RLIMIT_AS, (3 * BYTES, 3 * BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    done = call(case.command, *case.base, *case.wrong)
    os.write(said, done.stderr.encode(errors="replace"))
    return done.returncode

"""Wrong inputs for every command, made from the definitions of the settings; and what the commands do with them.

Each case is a process of its own, with a limit on its time and memory.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import re
import resource
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, NamedTuple, get_args, get_type_hints
from unittest.mock import patch

import torch

from mpm_warp import Bed, Effects, Material
from mpm_warp.bed import Walls
from mpm_warp.bodies import Box, Cylinder, MeshBody, Plate
from mpm_warp.scenes import Body, Column, Excavation, Incline, Wheel
from mpm_warp.settings import Setting
from sgns import settings as typed
from sgns.config import UserError
from sgns_testing.commands import SHORT, TRAIN, call
from sgns_testing.wrong_files import good_files, wrong_files

SECONDS, MEMORY = 20.0, 3 << 30
"""That a case may take; the memory [bytes] is all that the process holds at its highest."""
MOST_OF_A_KIND = 300
"""Cases that are drawn of one kind."""


class Case(NamedTuple):
    """A command that is to be refused."""

    kind: str
    arguments: tuple[str, ...]
    wrong: bool = True
    """False: it may be right after all."""


class Outcome(NamedTuple):
    """What a command did."""

    case: Case
    status: int
    """2: refused; 0: done, or good enough to begin the long part; 1: a bug; negative: ended by a signal."""
    said: str
    seconds: float
    memory: int

    @property
    def fault(self) -> str:
        """What is bad about it; empty: nothing."""
        if self.status not in (0, 2):
            return f"status {self.status}"
        if self.seconds > SECONDS or self.memory > MEMORY:
            return f"{self.seconds:.0f} s, {self.memory / 1e9:.1f} GB"
        if "Traceback" in self.said or (self.status == 2 and not self.said.startswith("sgns")):
            return "no line of its own"
        return "accepted" if self.case.wrong and self.status == 0 else ""


# --- Settings, by their definitions ---------------------------------------------------------------------

_ABSURD = ("1e300", "-1e300", "1e30", "1e-300", "-1", "1000000000000", str(1 << 70), "0.4999999999", "10.5")
_NO_NUMBER = ("[a]", "{a: 1}", "text", "[]", "true", "nan", "inf", "-inf", "[[1,2],[3]]", "1e400", "''")
_NO_TEXT = ("[a]", "{a: 1}", "[]", "5", "true", "[[1,2],[3]]", "'a\\0b'")

_BODY = ("scene=body", "scene.path=path.csv")
_SCENES = {
    "excavation": (SHORT, Excavation),
    "body": (
        [*SHORT[:4], *_BODY, "scene.tool.size=[0.1,0.1,0.08]"],
        Body,
    ),
    "wheel": (["scene=quick_wheel"], Wheel),
    "column": (["scene=column"], Column),
    "incline": (["scene=incline"], Incline),
}
_DATA = ("dataset.path=data",)
_CHECKPOINT = "checkpoint=out/best.ckpt"


def _groups() -> Iterator[tuple[str, list[str], str, Any]]:
    """Command, arguments with which it is good, prefix of keys and class of every group of settings."""
    for arguments, cls in _SCENES.values():
        yield "simulate", arguments, "scene.", cls
    for prefix, cls in (("scene.bed.", Bed), ("scene.bed.walls.", Walls), ("scene.blade.", Plate)):
        yield "simulate", SHORT, prefix, cls
    for prefix, cls in (("material.", Material), ("effects.", Effects), ("solver.", typed.SolverSettings)):
        yield "simulate", SHORT, prefix, cls
    yield "simulate", _SCENES["body"][0], "scene.tool.", Box
    round_tool = ["scene.tool.diameter=0.1", "scene.tool.width=0.1"]
    yield "simulate", [*SHORT[:4], *_BODY, "scene/tool=cylinder", *round_tool], "scene.tool.", Cylinder
    yield (
        "simulate",
        [*SHORT[:4], *_BODY, "scene/tool=mesh", "scene.tool.file=tool.obj"],
        "scene.tool.",
        MeshBody,
    )
    learn = [*_DATA, *TRAIN]
    yield "reduce", [*_DATA, *TRAIN[:2]], "reduction.", typed.ReductionSettings
    for prefix, cls in (
        ("reduction.", typed.ReductionSettings),
        ("model.", typed.ModelSettings),
        ("training.", typed.TrainingSettings),
        ("training.loss.", typed.LossWeights),
        ("dataset.", typed.DatasetSettings),
    ):
        yield "train", learn, prefix, cls
    fit = [*_DATA, *TRAIN[:2], "model=polynomial", "training=polynomial"]
    yield "train", fit, "model.", typed.PolynomialSettings
    yield "train", fit, "training.", typed.FitSettings
    yield "train", ["dataset=published"], "dataset.", typed.PublishedSettings
    yield "simulate", ["dataset=quick"], "dataset.", typed.DatasetSettings
    yield "rollout", [_CHECKPOINT], "scene.", Excavation
    yield "advise", [], "error.", typed.Errors
    own = {
        "simulate": SHORT,
        "reduce": [*_DATA, *TRAIN[:2]],
        "train": learn,
        "rollout": [_CHECKPOINT],
        "evaluate": [*_DATA, _CHECKPOINT],
        "check": ["run.h5"],
        "plot": ["run=run.h5"],
        "render": ["run=run.h5"],
    }
    for name, cls in typed.COMMANDS.items():
        yield name, own.get(name, []), "", cls


def _setting_of(cls: Any, name: str) -> Setting:
    """A class that changes only a default has the setting of its base."""
    for base in cls.__mro__:
        found = base.__dict__.get("__dataclass_fields__", {}).get(name)
        if found is not None and "setting" in found.metadata:
            return found.metadata["setting"]
    return Setting("")


def _values(known: Setting, hint: Any) -> Iterator[tuple[str, str, bool]]:
    """Kind, value, and whether it is certainly wrong."""
    kinds = {part for one in (hint, *get_args(hint)) for part in (one, *get_args(one))}
    optional = type(None) in kinds
    if known.choices:
        yield from (("wrong type", value, True) for value in ("[a]", "{a: 1}", "nosuch", "1e300"))
        if not optional:
            yield "wrong type", "null", True
    elif kinds & {int, float}:
        for limit, beyond in ((known.ge, -1), (known.gt, 0), (known.le, 1), (known.lt, 0)):
            if limit is not None:
                yield (
                    "out of range",
                    f"{limit + beyond * (abs(limit) * 0.5 + 1e-6):.17g}",
                    kinds & {list} == set(),
                )
        yield from (("absurd number", value, False) for value in _ABSURD)
        lists = bool({list, tuple} & {getattr(part, "__origin__", part) for part in kinds})
        yield from (("wrong type", value, not (lists and value == "[]")) for value in _NO_NUMBER)
        if not optional:
            yield "wrong type", "null", True
    elif bool in kinds:
        yield from (("wrong type", value, True) for value in ("[a]", "{a: 1}", "maybe", "7", "null"))
    else:
        yield from (("wrong type", value, False) for value in (*_NO_TEXT, "null"))


def _of_settings() -> Iterator[Case]:
    for command, good, prefix, cls in _groups():
        hints = get_type_hints(cls, localns={cls.__name__: cls})
        for one in fields(cls):
            hint = hints[one.name]
            if any(is_dataclass(part) for part in (hint, *get_args(hint))):
                for value in ("[a]", "5", "null", "{nosuch: 1}"):
                    yield Case("wrong type", (command, *good, f"{prefix}{one.name}={value}"))
                continue
            for kind, value, wrong in _values(_setting_of(cls, one.name), hint):
                certain = wrong and (prefix, one.name) != ("", "device")
                yield Case(kind, (command, *good, f"{prefix}{one.name}={value}"), certain)


# --- What people have written --------------------------------------------------------------------------

_PATHS = (
    *(
        "[1,2,3]",
        "[a,b]",
        "[[1,2],[3]]",
        "[null]",
        "[[[0,0,0,0,0,0,0,1]]]",
        "[[0,0,0,0,0,0,0,null]]",
        "{}",
        "5",
    ),
    *(
        "[]",
        "[[]]",
        "[[nan,0,0,0,0,0,0,1]]",
        "[[0,1e300,0,0,0,0,0,1]]",
        "[[0,0,0,0,0,0,0,0]]",
        "true",
        "null",
    ),
    *("[[0,0.2,0.1,0.1,0,0,0,1],[0,0.2,0.1,0.1,0,0,0,1]]", "[[0,a,b,c,d,e,f,g]]", "[[0,0,0,0,0,0,0,1,1]]"),
)
_WRITTEN = [
    *(
        ("simulate", *SHORT, text)
        for text in (
            *(
                "scene.duration=1e5",
                "scene.duration=1e300",
                "scene.gravity=1e30",
                "material.youngs_modulus=1e20",
            ),
            *(
                "scene.courant=1e-300",
                "scene.bed.headroom=1e6",
                "material.packing=1e-300",
                "scene.bed.spacing=1e-9",
            ),
            *(
                "material.poissons_ratio=0.4999999999",
                f"seed={1 << 64}",
                f"seed={10**30}",
                "seed=1e30",
                "seed=-1",
            ),
            *("device=meta", "device=mps", "device=cuda:99", "device=xpu", "device=''", "device=cpu:7"),
            *("scene.bed.size=[1e3,1e3,1e3]", "scene.bed.size=[1e300,1,1]", "scene.bed.size=[0.4,0.2]"),
            *("scene.bed.particles_per_cell=1e12", "scene.frame_rate=1e-300", "scene.frame_rate=1e300"),
            *(
                "scene.speed=1e300",
                "scene.speed=1e5",
                "scene.blade.width=1e300",
                "scene.blade.friction=1e300",
            ),
            *("material.grain_density=1e-300", "material.grain_density=1e300", "scene.body_grid=[1e9,1e9]"),
            *(
                "scene.motion=path",
                "scene.tilt=89.99999999",
                "scene.bed.store_every=0",
                "scene.velocity_memory=1e-300",
            ),
            *(
                "scene.remap_distance=1e-300",
                "scene.bed.seed=1e30",
                "scene.bed.arrangement=poisson scene.bed.size=9",
            ),
            *(
                "shards=1000000000000",
                "shard=-1",
                "shard=5",
                "continue_from=nosuch.h5",
                "continue_from=run.h5",
            ),
            *(
                "output=/dev/full",
                "output=/proc/x.h5",
                "output=.",
                f"output={'x' * 5000}",
                "output=''",
                "output=null",
            ),
            *(
                "scene.bed=null",
                "scene=null",
                "scene=[]",
                "scene={}",
                "material=null",
                "effects=null",
                "solver=null",
            ),
            *("dataset=nosuch", "scene=nosuch", "+scene.x=1", "~scene.speed", "scene.speed=${scene.speed}"),
            *(
                "scene.speed=${nosuch}",
                "scene.speed=???",
                "scene.speed=0.1.2",
                "scene.speed='",
                "=3",
                "scene..x=1",
            ),
            *(
                "hydra.run.dir=/proc/x",
                "hydra.job.name=[]",
                "hydra.verbose={}",
                "hydra=null",
                "--nosuch",
                "nosuch",
            ),
        )
    ),
    *(
        ("simulate", *SHORT, "-m", text)
        for text in (
            *(
                "seed=range(0,1e12)",
                "seed=range(0,1000000000000)",
                "seed=range(0,10,0)",
                "seed=choice()",
                "seed=a,b",
            ),
            *("seed=interval(0,1)", "seed=range(nan,3)", "scene.speed=range(0,1,1e-300)", "seed=glob(*)"),
        )
    ),
    *(("simulate", *SHORT[:4], "scene=body", f"scene.path={text}") for text in _PATHS),
    *(("simulate", *SHORT, "scene.motion=path", f"scene.path={text}") for text in _PATHS),
    *(
        ("simulate", "dataset=own", "dataset.path=o/campaign", *more)
        for more in (
            *(
                ("dataset.runs=10.5",),
                ("dataset.runs=1e12",),
                ("dataset.split=[a,b,c]",),
                ("dataset.split=5",),
            ),
            *(("dataset.split=null",), ("dataset.split=[nan,0,0]",), ("dataset.split=[1e300,-1e300,1]",)),
            *(
                ("dataset.path=[a]",),
                ("dataset.draw=5",),
                ("dataset.draw={scene.speed: []}",),
                ("dataset.draw={x: [1]}",),
            ),
            *(
                ("dataset.draw={scene.speed: 5}",),
                ("dataset.change=[1]",),
                ("dataset.scene=[]",),
                ("dataset.where=5",),
            ),
            (f"dataset.draw={{{','.join(f'scene.k{i}: {list(range(100))}' for i in range(20))}}}",),
        )
    ),
    *(
        ("train", *_DATA, *TRAIN, text)
        for text in (
            *(
                "model.kind=[]",
                "model.kind=null",
                "model.history=100000",
                "model.message_passing_steps=1000000",
            ),
            *(
                "training.threads=100000",
                "device=meta",
                "model.hidden_width=1000000000",
                "training.max_steps=1e300",
            ),
            *("model.hidden_width=10000 model.hidden_layers=100", "training.batch_size=1000000000000"),
            *("dataset.split=[a,b,c]", "dataset.split=5", "dataset.split=null", "dataset.split=[nan,0,0]"),
            *(
                "dataset.path=[a]",
                "dataset.path={}",
                "dataset.path=nosuch",
                "dataset.path=run.h5",
                "dataset.where={a: 1}",
            ),
            *(
                "reduction.num_modes=1000000",
                "reduction.max_modes=100000000",
                "checkpoint=run.h5",
                "checkpoint=[a]",
            ),
            *(
                "training.loss=null",
                "training.loss=[1]",
                "model.context=[1,2]",
                "model.context={}",
                "seed=1e30",
            ),
        )
    ),
    *(
        ("rollout", _CHECKPOINT, text)
        for text in (
            *(
                "num_modes=100",
                "num_modes=1e300",
                "device=meta",
                "scene.duration=1e300",
                "scene.gravity=1e30",
            ),
            *("scene.duration=1e5", "checkpoint=[]", "checkpoint=run.h5", "checkpoint=data", "scene=nosuch"),
        )
    ),
    *(
        ("evaluate", *_DATA, _CHECKPOINT, text)
        for text in (
            *(
                "num_modes=100",
                "timing_repeats=1e12",
                "new_rollouts=[1,2]",
                "new_rollouts={}",
                "new_rollouts=[run.h5]",
            ),
            *("split=nosuch", "device=meta", "new_rollouts=[nosuch.h5]", "output=/proc/x"),
        )
    ),
    *(
        ("frontier", text)
        for text in ("axis=[]", "study=nosuch", "study=null", "+study.x=1", "output=/proc/x")
    ),
    *(
        ("advise", text)
        for text in (
            *(
                "task=nosuch",
                "time=0",
                "time=1e400",
                "table=nosuch.csv",
                "table=run.h5",
                "table=[]",
                "error=5",
            ),
            *("error.force=nan", "error.force=[1]", "against=[]", "table=path.csv", "particles=5"),
        )
    ),
    *(
        ("check", text)
        for text in ("nosuch.h5", "path.csv", "out/best.ckpt", "files=5", "files=[[a]]", "files={}")
    ),
    *(
        (name, *rest)
        for name in ("plot", "render")
        for rest in (
            *(
                ("nosuch.h5",),
                ("path.csv",),
                ("out/best.ckpt",),
                ("run.h5", "output=x.txt"),
                ("run=[a]",),
                ("run={}",),
            ),
            *(
                ("run.h5", "a.png", "b.png"),
                ("run=data",),
                ("run.h5", "output=/proc/x"),
                ("run.h5", "output=[a]"),
            ),
        )
    ),
    *((name,) for name in ("rollout", "evaluate", "train", "reduce", "check", "plot", "render", "nosuch")),
]


def _written() -> Iterator[Case]:
    for arguments in _WRITTEN:
        *rest, last = arguments
        kind = "a path that is no table" if "scene.path=" in last else "as people wrote it"
        yield Case(kind, (*rest, *(last.split(" ") if "=" in last else [last])))


# --- All of them ----------------------------------------------------------------------------------------


def every_case(folder: Path, seed: int = 15) -> list[Case]:
    """All of them, in an order that follows from the seed; the good files that they name and the wrong ones are made
    in the folder."""
    good_files(folder)
    found = [*_of_settings(), *_written()]
    found += [Case(kind, arguments, wrong) for kind, arguments, wrong in wrong_files(folder, seed)]
    found = list(dict.fromkeys(found))
    random.Random(seed).shuffle(found)
    counts: Counter[str] = Counter()
    kept = []
    for one in found:
        counts[one.kind] += 1
        if counts[one.kind] <= MOST_OF_A_KIND:
            kept.append(one)
    return kept


# --- Run ------------------------------------------------------------------------------------------------


class _Begun(UserError):
    """The settings were good enough to begin the long part."""


@contextlib.contextmanager
def _nothing_long() -> Iterator[None]:
    """Commands end where the computing would begin."""

    def begun(*_: Any, **__: Any) -> None:
        raise _Begun("begun")

    with contextlib.ExitStack() as stack:
        for name in (
            "mpm_warp.solver.Solver.stages",
            "sgns.simulate.workers.compile_kernels",
            "sgns.train.lightning_module.run_trainer",
            "sgns.train.polynomial.best_polynomial",
            "sgns.evaluate.command.roll_out",
            "sgns.rollout.rollout_scene",
            "sgns.frontier.command.measure",
        ):
            with contextlib.suppress(AttributeError):
                stack.enter_context(patch(name, begun))
        yield


def run_cases(cases: Iterable[Case], folder: Path) -> Iterator[Outcome]:
    """Each in a process of its own, one after another, in `folder`."""
    torch.set_num_threads(1)
    call("simulate", "--cfg", "job")  # what is loaded once
    for number, case in enumerate(cases):
        yield _run(case, folder, f"o/{number}")


def _run(case: Case, folder: Path, output: str) -> Outcome:
    with tempfile.TemporaryFile("w+") as said:
        began = time.perf_counter()
        child = os.fork()
        if child == 0:
            _be_the_case(case, folder, output, said.fileno())
        _, status, used = os.wait4(child, 0)
        seconds = time.perf_counter() - began
        said.seek(0)
        text = said.read()
    code = os.waitstatus_to_exitcode(status)
    return Outcome(case, code, text, seconds, used.ru_maxrss * 1024)


def _be_the_case(case: Case, folder: Path, output: str, said: int) -> None:
    """What the process does, to its end."""
    status = 1
    try:
        os.chdir(folder)
        null = os.open(os.devnull, os.O_RDWR)
        os.dup2(null, 0), os.dup2(null, 1), os.dup2(said, 2)  # noqa: B018
        signal.alarm(int(1.5 * SECONDS))
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        limit = pages * resource.getpagesize() + MEMORY
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        command, *rest = case.arguments
        named = any(re.match(r"output=|--|-m$", text) for text in rest)
        has = command in ("simulate", "rollout", "plot", "render") and not named and rest
        name = {"plot": ".png", "render": ".gif"}.get(command, ".h5")
        if has and not (command in ("plot", "render") and len(rest) > 1):
            rest.append(f"output={output}{name}")
        elif command in ("train", "reduce", "evaluate", "frontier") and not named and rest:
            rest.append(f"output={output}")
        with _nothing_long():
            done = call(command, *rest)
        lines = done.stderr.splitlines() or [""]
        begun = done.returncode == 2 and lines[-1].endswith(": begun")
        status = 0 if begun else done.returncode
        os.write(said, (lines[-1] + "\n" if "Traceback" not in done.stderr else done.stderr).encode())
    except BaseException:
        os.write(said, traceback.format_exc().encode())
    finally:
        os._exit(status if 0 <= status < 256 else 1)


def main() -> None:
    """`python -m sgns_testing.wrong_inputs FOLDER OUT.jsonl [MOST]`: try them, and keep what happened."""
    folder, kept = Path(sys.argv[1]), Path(sys.argv[2])
    cases = every_case(folder)[: int(sys.argv[3]) if len(sys.argv) > 3 else None]
    with kept.open("w") as file:
        for one in run_cases(cases, folder):
            record = {"kind": one.case.kind, "arguments": one.case.arguments, "wrong": one.case.wrong}
            record |= {
                "status": one.status,
                "said": one.said[-3000:],
                "seconds": one.seconds,
                "memory": one.memory,
            }
            file.write(json.dumps(record | {"fault": one.fault}) + "\n")
            file.flush()


if __name__ == "__main__":
    main()

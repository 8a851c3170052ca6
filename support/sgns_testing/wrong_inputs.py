"""Inputs that are wrong by the way they are made: every command refuses each with status 2, in a line, soon and small.

Wrong settings come from the definitions of the settings and from what people wrote, wrong files from `wrong_files`.
"""

from __future__ import annotations

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
from sgns import settings as typed
from sgns_testing.commands import call
from sgns_testing.wrong_files import (
    CAMPAIGN,
    CHECKPOINT,
    CUT,
    CUT_ON_PATH,
    DATA,
    FIT,
    LEARN,
    ON_PATH,
    PUBLISHED,
    READ,
    RUN,
    WITH_MESH,
    Case,
    good_files,
    wrong_file,
    wrong_files,
)

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
        if self.status != 2:
            return f"status {self.status}"
        if self.seconds > SECONDS or self.bytes > BYTES:
            return f"{self.seconds:.0f} s, {self.bytes / 1e9:.1f} GB"
        if not self.line.startswith("sgns") or "Traceback" in self.said or self.said.count("\n") > 1:
            return "not one line"
        known = "no such key" in self.case.names or "no such key" not in self.line
        return "" if known and self.case.names in self.line else f"does not name {self.case.names}"


# --- Settings, by their definitions ---------------------------------------------------------------------

_SCENES: list[tuple[tuple[str, ...], Any]] = [
    (CUT, Excavation),
    (ON_PATH, Body),
    (("scene=quick_wheel", "scene.duration=0.05", "scene.settle=0"), Wheel),
    (("scene=column", "scene.bed.spacing=0.04", "scene.duration=0.05"), Column),
    (("scene=incline", "scene.bed.spacing=0.02", "scene.duration=0.05"), Incline),
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
        ("limits.", typed.Limits),
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
    for prefix, cls in (("scene.", Excavation), ("scene.blade.", Plate), ("material.", Material)):
        yield "rollout", CHECKPOINT, prefix, cls
    yield "evaluate", (*DATA, *CHECKPOINT), "dataset.", typed.DatasetSettings
    yield "advise", ("error.force=0.35",), "error.", typed.Errors
    own = {
        "simulate": CUT,
        "reduce": LEARN[:3],
        "train": LEARN,
        "rollout": CHECKPOINT,
        "evaluate": (*DATA, *CHECKPOINT),
        "advise": ("error.force=0.35",),
        "check": (f"files=[{RUN}]",),
        "plot": (f"run={RUN}", "output=a.png"),
        "render": (f"run={RUN}", "output=a.gif"),
    }
    for name, cls in typed.COMMANDS.items():
        yield name, own.get(name, ()), "", cls


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
        sizes += ["1e300", "-1e300", "1" + "0" * 30, "1e-300"]
        if int in kinds and float not in kinds:
            sizes += ["10.5", "1e17", "-1000000000000000000000"]
        if list in origins or tuple in origins:
            types += ["[]", "5"]
            sizes = [f"[{', '.join([size] * (3 if float in kinds else 2))}]" for size in sizes]
    elif known.choices or any(getattr(part, "__origin__", None) is not None for part in kinds):
        types += ["5", "1e300"] + (["nosuch"] if dict not in origins and list not in origins else [])
    else:
        types += ["[]", "5", "true", "[a]"] + ([] if dict in origins else ["'a\\0b'"])
    return types, sizes


_RIGHT = {("device", "'a\\0b'")}
"""Key and value of what the rules above take for wrong and is not."""


def _of_settings(chance: random.Random) -> Iterator[Case]:
    """Of every setting a value of another type and, if it is a number, one that it cannot be, too."""
    for command, base, prefix, cls in _groups():
        hints = get_type_hints(cls, localns={cls.__name__: cls})
        for one in fields(cls):
            hint, key = hints[one.name], f"{prefix}{one.name}"
            if any(is_dataclass(part) for part in (hint, *get_args(hint))):
                types, sizes = ["[a]", "5", "text", "[[1]]"], []
            else:
                types, sizes = _wrong_values(_setting_of(cls, one.name), hint)
            types = [value for value in types if (key, value) not in _RIGHT]
            picked = [chance.choice(types), chance.choice(sizes)] if sizes else chance.sample(types, 1)
            for kind, value in zip(("type", "size"), picked, strict=False):
                yield Case(f"setting, {kind}", command, base, (f"{key}={value}",), one.name)


# --- What people wrote ----------------------------------------------------------------------------------

_PATHS = """
[1,2,3]
[a,b]
[[1,2],[3]]
[null]
[[[0,0,0,0,0,0,0,1]]]
[[0,0,0,0,0,0,0,null]]
{}
{a: [0,0,0,0,0,0,0,1]}
5
[]
[[]]
[[nan,0,0,0,0,0,0,1]]
[[0,1e300,0,0,0,0,0,1]]
[[0,0,0,0,0,0,0,0]]
true
[[0,0.2,0.1,0.1,0,0,0,1],[0,0.2,0.1,0.1,0,0,0,1]]
[[0,a,b,c,d,e,f,g]]
[[0,0,0,0,0,0,0,1,1]]
nosuch.csv
""".strip().splitlines()
# Command and arguments with which it is good, then an input a line; what its line must name stands after `->`.
_WRITTEN: list[tuple[str, tuple[str, ...], str]] = [
    (
        "simulate",
        CUT,
        CUT_ON_PATH,
        """
scene.duration=1e5 -> limits.time
scene.duration=1e300 -> duration
scene.gravity=1e30 -> gravity
material.youngs_modulus=1e20 -> youngs_modulus
scene.courant=1e-300 -> courant
scene.bed.headroom=1e6 -> headroom
material.packing=1e-300 -> packing
scene.bed.spacing=1e-9 -> spacing
scene.bed.spacing=1e-4 -> spacing
material.poissons_ratio=0.4999999999 -> poissons_ratio
seed=18446744073709551616 -> seed
seed=1e30 -> seed
seed=-1 -> seed
device=meta -> device
device=mps -> device
device=cuda:99 -> device
device=xpu -> device
"device=''" -> device
device=cpu:7 -> device
scene.bed.size=[1e3,1e3,1e3] -> bed
scene.bed.size=[1e300,1,1] -> size
scene.bed.size=[0.4,0.2] -> size
scene.bed.size=[0.4,0.2,0] -> size
"scene.bed.size='0.4 0.2 0.1'" -> size
scene.bed.particles_per_cell=1e12 -> particles_per_cell
scene.bed.arrangement=random -> arrangement
scene.bed.walls.x=rough -> walls
scene.bed.walls.x=-0.5 -> walls
scene.bed.walls.floor=periodic -> walls
scene.frame_rate=1e-300 -> frame_rate
scene.frame_rate=1e300 -> frame_rate
scene.speed=1e300 -> speed
scene.speed=1e5 -> speed
scene.speed=0 -> speed
scene.blade.width=1e300 -> width
scene.blade.thickness=0 -> thickness
scene.blade.friction=1e300 -> friction
scene.blade.friction=-0.1 -> friction
material.grain_density=1e-300 -> grain_density
material.grain_density=1e300 -> grain_density
material.friction_angle=90 -> friction_angle
scene.body_grid=[1e9,1e9] -> body_grid
scene.body_grid=[0,4] -> body_grid
scene.motion=path -> path
scene.motion=fly -> motion
scene.tilt=90 -> tilt
scene.rake=89 -> rake
scene.bed.store_every=0 -> store_every
scene.velocity_memory=1e-300 -> velocity_memory
scene.remap_distance=1e-300 -> remap_distance
scene.bed.seed=1e30 -> seed
scene.bed.seed=-1 -> seed
shards=1000000000000 -> shards
shard=-1 -> shard
shard=5 -> shard
continue_from=nosuch.h5 -> nosuch.h5
continue_from=../good/run.h5 -> run.h5
output=/dev/full -> /dev/full
output=/proc/x.h5 -> /proc/x.h5
output=. -> output
"output=''" -> output
output=null -> output
output=../good/run.h5 -> overwrite=true
output=../good/run.h5/a.h5 -> run.h5
scene.bed=null -> bed
scene={} -> scene
scene=[] -> scene
scene=null -> scene
material=null -> material
effects=null -> effects
solver=null -> solver
dataset=nosuch -> nosuch
scene=nosuch -> nosuch
material=nosuch -> nosuch
+scene.x=1 -> x
scene.sped=0.1 -> no such key
speed=0.1 -> no such key
~scene.speed_ -> speed_
scene.speed=${scene.speed} -> speed
scene.speed=${nosuch} -> nosuch
scene.speed=${oc.env:NOSUCH_1} -> NOSUCH_1
scene.speed=??? -> speed
scene.speed=0.1.2 -> speed
scene.speed=0,1 -> speed
"scene.speed='" -> speed
scene.speed=0.1;scene.rake=1 -> ;
=3 -> =3
scene..x=1 -> x
hydra.run.dir=/proc/x -> /proc/x
hydra.verbose={} -> verbose
hydra=null -> hydra
hydra.job_logging.root.level=LOUD -> logging
'+hydra.callbacks.x={_target_: os.system}' -> callbacks
hydra.sweeper.max_batch_size=0 -m seed=1,2 -> max_batch_size
hydra.searchpath=[pkg://os] -> searchpath
hydra/launcher=nosuch -> nosuch
'hydra.job.env_set={A: b}' -> env_set
--nosuch -> --nosuch
--config-dir nosuch -> nosuch
--cfg nosuch -> nosuch
--package scene -> --package
--resolve -> --resolve
--info nosuch -> nosuch
--version -> --version
nosuch -> nosuch
experiment=nosuch -> nosuch
-m seed=range(0,1e12) -> jobs
-m seed=range(0,1000000000000) -> jobs
-m seed=range(0,10,0) -> range
-m seed=choice() -> choice
-m seed=range(nan,3) -> range
-m seed=interval(0,1) -> seed
-m seed=a,b -> seed
-m scene.speed=range(0,1,1e-300) -> speed
-m seed=1,2 --cfg job -> --cfg
""",
    ),
    ("simulate", ON_PATH, "\n".join(f"'scene.path={text}' -> path" for text in _PATHS)),
    (
        "simulate",
        CUT_ON_PATH,
        "\n".join(f"'scene.path={text}' -> path" for text in _PATHS[::2]),
    ),
    (
        "simulate",
        CAMPAIGN,
        """
dataset.runs=10.5 -> runs
dataset.runs=1e12 -> runs
dataset.runs=2 -> runs
dataset.split=[a,b,c] -> split
dataset.split=5 -> split
dataset.split=null -> split
dataset.split=[nan,0,0] -> split
dataset.split=[1,1,1] -> split
dataset.split=[1e300,-1e300,1] -> split
dataset.path=[a] -> path
dataset.path=/proc/x -> /proc/x
dataset.draw=5 -> draw
+dataset.draw.speed=[0.1] -> speed
+dataset.draw.tool=[1] -> tool
dataset.draw.path=[] -> path
dataset.draw.path=5 -> path
dataset.draw.path=[nosuch.csv] -> nosuch.csv
dataset.draw.path=[nosuch*.csv] -> nosuch
+dataset.draw.duration=[a] -> duration
+dataset.draw.duration=[-1] -> duration
'dataset.draw=[[1]]' -> draw
dataset.draw.seed=1 -> seed
dataset.change=[1] -> change
'dataset.change={nosuch: 1}' -> nosuch
dataset.scene=[] -> scene
dataset.scene=nosuch -> nosuch
dataset.where=5 -> where
shards=3 shard=3 -> shard
limits.disk=1e-7 -> limits.disk
limits.time=1e-12 -> limits.time
""",
    ),
    (
        "train",
        LEARN,
        """
model.kind=[] -> kind
model.kind=nosuch -> kind
model=nosuch -> nosuch
preset=nosuch -> nosuch
model.history=100000 -> history
model.message_passing_steps=1000000 -> message_passing_steps
model.hidden_width=1000000000 -> hidden_width
model.hidden_width=10000 model.hidden_layers=100 -> hidden_width
training.threads=100000 -> threads
training.max_steps=1e300 -> max_steps
training.batch_size=1000000000000 -> batch_size
training.learning_rate=0 -> learning_rate
training.learning_rate=1e300 -> learning_rate
training.horizon=1000 -> horizon
training.loss=null -> loss
training.loss=[1] -> loss
training.resume=maybe -> resume
model.context=[1,2] -> context
model.context={} -> context
model.context=[nosuch] -> context
reduction.num_modes=7 -> num_modes
reduction.num_modes=1000000 -> num_modes
reduction.max_modes=100000000 -> max_modes
dataset.split=[a,b,c] -> split
dataset.path=nosuch -> nosuch
dataset.path=../good/run.h5 -> run.h5
dataset.path={} -> path
'dataset.where={a: 1}' -> a
'dataset.where={gravity: 7}' -> gravity
checkpoint=../good/run.h5 -> run.h5
checkpoint=nosuch.ckpt -> nosuch.ckpt
checkpoint=[a] -> checkpoint
device=meta -> device
device=cuda:99 -> device
device=nosuch -> device
seed=1e30 -> seed
output=/proc/x -> /proc/x
output=../good/run.h5 -> run.h5
dataset=nosuch -> nosuch
model=polynomial -> training
""",
    ),
    (
        "rollout",
        CHECKPOINT,
        """
num_modes=100 -> num_modes
num_modes=0 -> num_modes
num_modes=1e300 -> num_modes
device=meta -> device
device=cuda:99 -> device
scene.duration=1e300 -> duration
scene.duration=1e5 -> duration
scene.gravity=1e30 -> gravity
scene.depth=-1 -> depth
checkpoint=[] -> checkpoint
checkpoint=null -> checkpoint
checkpoint=nosuch.ckpt -> nosuch.ckpt
checkpoint=../good/run.h5 -> run.h5
checkpoint=../good/data -> data
scene=nosuch -> nosuch
scene=wheel -> wheel
scene=column -> scene
scene.motion=path -> path
scene.bed.size=[0.8,0.4,0.16] -> bed
scene.bed.spacing=0.02 -> bed
rate_independent=nope -> rate_independent
output=/proc/x.h5 -> /proc/x.h5
output=../good/run.h5 -> overwrite=true
effects.yielding=false -> no such key
solver.precision=float64 -> no such key
""",
    ),
    (
        "evaluate",
        (*DATA, *CHECKPOINT),
        """
num_modes=100 -> num_modes
timing_repeats=1e12 -> timing_repeats
timing_repeats=1 -> timing_repeats
new_rollouts=[1,2] -> new_rollouts
new_rollouts={} -> new_rollouts
new_rollouts=[nosuch.h5] -> nosuch.h5
new_rollouts=[../good/path.csv] -> path.csv
split=nosuch -> split
device=meta -> device
output=/proc/x -> /proc/x
dataset.path=nosuch -> nosuch
dataset=quick -> quick
checkpoint=nosuch.ckpt -> nosuch.ckpt
'dataset.where={gravity: 7}' -> gravity
""",
    ),
    (
        "frontier",
        (),
        """
axis=[] -> axis
axis=nosuch -> axis
axis=none -> axis
study=nosuch -> nosuch
study=null -> study
study.name=[a] -> name
study.scenes=5 -> scenes
study.scenes={} -> scenes
study.scenes.cut.scene=nosuch -> nosuch
study.scenes.cut.scene=5 -> scene
study.scenes.cut.dataset=nosuch -> nosuch
study.scenes.cut.dataset=[a] -> dataset
study.scenes.cut.cases=5 -> cases
study.scenes.cut.cases={} -> cases
study.scenes.cut.cases.deep=[scene.nosuch=1] -> nosuch
study.scenes.cut.cases.deep=5 -> deep
study.scenes.cut.bands=5 -> bands
study.scenes.cut.bands.force_nrmse=text -> force_nrmse
study.scenes.cut.bands.force_nrmse=-1 -> force_nrmse
study.scenes.cut.reference=5 -> reference
study.scenes.cut.reference.set=[scene.bed.spacing=-1] -> spacing
study.scenes.cut.reference.label=[a] -> label
study.scenes.cut.solver=5 -> solver
'study.scenes.cut.solver=[{axis: dx}]' -> label
'study.scenes.cut.solver=[{axis: dx, label: a, sett: [b]}]' -> sett
'study.scenes.cut.solver=[{axis: dx, label: a},{axis: dx, label: a}]' -> label
'study.scenes.cut.reduction=[{axis: r, label: a, modes: [0]}] axis=reduction' -> modes
+study.scenes.cut.x=1 -> x
+study.x=1 -> x
output=/proc/x -> /proc/x
output=../good/run.h5 -> run.h5
""",
    ),
    (
        "advise",
        ("error.force=0.35",),
        """
task=nosuch -> nosuch
time=0 -> time
time=1e400 -> time
time=-1 -> time
table=nosuch.csv -> nosuch.csv
table=../good/run.h5 -> run.h5
table=../good/path.csv -> path.csv
table=[] -> table
error=5 -> error
error.force=nan -> force
error.force=[1] -> force
error.nosuch=1 -> nosuch
against=[] -> against
particles=5 -> particles
output=a -> no such key
scene=wheel -> scene
""",
    ),
    (
        "check",
        (),
        """
nosuch.h5 -> nosuch.h5
../good/path.csv -> good
../good/out/best.ckpt -> good
../good/tool.stl -> good
../good/run.h5 ../good/path.csv -> good
. -> .h5
files=5 -> files
files=[[a]] -> files
files={} -> files
files=null -> files
files=[] -> run
-m files=a,b -> a
""",
    ),
    *(
        (
            name,
            (),
            f"""
nosuch.h5 -> nosuch.h5
../good/path.csv -> path.csv
../good/out/best.ckpt -> best.ckpt
../good/data -> data
run=[a] -> run
run=null -> run
{RUN} output=x.txt -> x.txt
{RUN} output=/proc/x.{suffix} -> /proc/x.{suffix}
{RUN} output=[a] -> output
{RUN} output=../good/run.h5 -> run.h5
{RUN} a.{suffix} b.{suffix} -> b.{suffix}
{RUN} overwrite=maybe -> overwrite
{RUN} frame=3 -> no such key
""",
        )
        for name, suffix in (("plot", "png"), ("render", "gif"))
    ),
    *((name, (), f"'' -> {name}") for name in ("rollout", "evaluate", "check", "plot", "render")),
    ("reduce", (), "dataset=own -> data/own\ndataset.path=null -> path\ndevice=tpu -> device"),
    ("nosuch", (), "'' -> nosuch\nscene.speed=1 -> nosuch\n--help -> nosuch"),
]


def _written() -> Iterator[Case]:
    for command, base, lines in _WRITTEN:
        for line in lines.strip().splitlines():
            text, _, names = line.rpartition(" -> ")
            kind = "path" if "scene.path=" in text else "as people wrote it"
            yield Case(kind, command, base, tuple(filter(None, shlex.split(text))), names)


# --- All of them ----------------------------------------------------------------------------------------


def every_case(seed: int = 15) -> list[Case]:
    """All of them, in an order that follows from the seed."""
    chance = random.Random(seed)
    found = [*_of_settings(chance), *_written(), *wrong_files()]
    chance.shuffle(found)
    return list({one.what: one for one in found}.values())


def good_cases() -> list[Case]:
    """The commands as the cases have them, with nothing wrong: they do their work."""
    used = {(command, base, ()) for command, base, *_ in (*_groups(), *_WRITTEN) if base}
    found = [Case("good", command, base, ()) for command, base, _ in sorted(used)]
    return [
        *found,
        *(one for good in READ for one in wrong_file(good, "good", "as it is", lambda file: None)),
    ]


def run_cases(cases: Iterable[Case], folder: Path) -> Iterator[Outcome]:
    """What the commands do with them, each in a process and an empty folder of its own, one after another.

    The start of Python is not in their times. Good files are made in `folder` first.
    """
    call("simulate", "--cfg", "job")  # what is loaded once
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

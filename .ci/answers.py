"""What sgns answers: a list of jobs, run and written down; and two such records compared.

    python .ci/answers.py record INTERPRETER FOLDER [--core N] [--only WORD] [--keep] [--work DIR]
    python .ci/answers.py compare old/answers.json new/answers.json [--close R] [--lines N]
    python .ci/answers.py list

`record` runs every job with the `sgns` command beside INTERPRETER (or `INTERPRETER -m sgns`) in a fresh temporary folder,
on one core, and writes FOLDER/answers.json. This file needs the standard library only; what is in result files is read by
INTERPRETER, which has h5py, numpy, torch. Nothing of sgns is imported but `sgns` and `mpm_warp`, as README.md does.

`compare` lists what differs, job by job, and exits 1 if anything does. --close 1e-6 lets arrays pass whose sums, norms and
extremes agree to that share (of the norm); without it digests count.

For large rearrangements: record a checkout of before and one of after, about 5 minutes of one core each. Ruff leaves this
file out; it is a tool for a while, not part of the package.
"""

from __future__ import annotations

import argparse
import difflib
import hashlib
import json
import math
import os
import re
import shutil
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path

FORMAT = 1

# ------------------------------------------------------------------------------------------------------------ the jobs

COARSE = ["scene.bed.spacing=0.04", "scene.bed.particles_per_cell=1"]
BLADE = [*COARSE, "scene.blade.thickness=0.084"]
CUT = [*BLADE, "scene.duration=0.6"]
Q = ["dataset=quick", "dataset.path=data/q"]
TRAIN = ["training.max_steps=20", "training.validate_every=10", "training.log_every=5", "training.warmup_steps=2"]
NET = [*TRAIN, "training.threads=1", "model.hidden_width=32"]
W = ["dataset=quick_wheel", "dataset.path=data/w"]
WHEEL = ["scene.bed.particles_per_cell=1", "scene.settle=0.1", "scene.duration=0.5"]
COMMANDS = ["simulate", "reduce", "train", "rollout", "evaluate", "frontier", "advise", "check"]

SIGNATURES = r"""
import inspect, dataclasses
import sgns, mpm_warp
def plain(value):
    text = repr(value)
    return "<object>" if " at 0x" in text else text
def arguments(call):
    try:
        found = inspect.signature(call)
    except (TypeError, ValueError):
        return "(?)"
    return "(" + ", ".join({0: "", 1: "", 2: "*", 3: "", 4: "**"}[int(p.kind)] + p.name + ("" if p.default is p.empty else "=" + plain(p.default))
        + (" [keyword]" if p.kind is p.KEYWORD_ONLY else "") for p in found.parameters.values()) + ")"
for module in (sgns, mpm_warp):
    print(module.__name__, sorted(module.__all__))
    for name in sorted(module.__all__):
        thing = getattr(module, name)
        if not callable(thing):
            print(f"{module.__name__}.{name}", type(thing).__name__)
            continue
        print(f"{module.__name__}.{name}{arguments(thing)}")
        if isinstance(thing, type):
            for key in sorted(k for k in dir(thing) if not k.startswith("_")):
                value = inspect.getattr_static(thing, key)
                if any(key in vars(base) for base in thing.__mro__ if base.__module__.split(".")[0] in ("sgns", "mpm_warp")):
                    if isinstance(value, (staticmethod, classmethod)):
                        value = value.__func__
                    print(f"    .{key}" + (arguments(value) if inspect.isfunction(value) else f": {type(value).__name__}"))
"""

README = r"""
import hashlib, numpy as np
import mpm_warp, sgns
sim = sgns.Simulator.load("outputs/first/best.ckpt")
scene = mpm_warp.Scene.from_dict(sim.scene)
state = sim.reset(scene)
for pose in scene.body_poses()[1:]:
    state = sim.step(pose)
show = lambda a: print(a.dtype, a.shape, hashlib.sha256(np.ascontiguousarray(a).tobytes()).hexdigest(), float(np.float64(a).sum()))
print(np.asarray(state.force).tolist(), np.asarray(state.torque).tolist())
show(np.asarray(state.soil()))
print(sim.num_modes, sim.history, sim.frame_rate, sim.predicts_body, sim.context_keys, sim.step_count, sim.arrangement_hash)
print(np.asarray(sim.mean_force).tolist())
print({k: v for k, v in sorted(sim.scene.items())})
print(sorted(sim.card), sim.card["settings"])
many = sim.rollouts(np.stack([scene.body_poses()] * 2))
show(np.asarray(many.latent)); show(np.asarray(many.force))
fewer = sgns.Simulator.load("outputs/first/best.ckpt", num_modes=3)
fewer.reset(scene.body_poses()[0])
print(np.asarray(fewer.step(scene.body_poses()[1]).force).tolist())
for call in (lambda: sim.step(np.zeros(7)), lambda: sim.step(np.full(7, np.nan)), lambda: sgns.Simulator.load("nope.ckpt"), lambda: sgns.nope):
    try:
        call(); print("no error")
    except Exception as error:
        print(type(error).__name__, error)
"""

FILES = r"""
import glob, hashlib, numpy as np, torch
from sgns import Basis, IncrementalPCA, Run
torch.set_num_threads(1)
show = lambda name, a: print(name, np.asarray(a).dtype, np.shape(a), hashlib.sha256(np.ascontiguousarray(np.asarray(a)).tobytes()).hexdigest()[:16], float(np.asarray(a, dtype=float).sum()))
paths = sorted(glob.glob("data/q/runs/*.h5"))
path = sorted(glob.glob("data/q/reduced/*/basis.h5"))[0]
basis = Basis.load(path)
pca = IncrementalPCA(num_modes=8)
for each in paths[:3]:
    with Run(each) as run:
        pca.partial_fit(run.positions())
        print(run.producer, run.frame_count, run.scene["rake"], run.force.shape)
        show("last", run.positions(-1)[0])
        show("force", run.force)
        latent = basis.transform(run.positions())
        show("latent", latent)
        show("back", basis.inverse(latent))
mine = pca.basis("particle_axis")
with Run(paths[3]) as run:
    show("mine", mine.transform(run.positions()))
print(pca.frame_count, pca.rank())
"""

SOLVER = r"""
import hashlib, numpy as np
from mpm_warp import *
import mpm_warp
show = lambda name, a: print(name, np.asarray(a).dtype, np.shape(a), hashlib.sha256(np.ascontiguousarray(np.asarray(a)).tobytes()).hexdigest()[:16], float(np.asarray(a, dtype=float).sum()))
scene = Excavation(bed=Bed(size=(0.48, 0.40, 0.16), spacing=0.04, headroom=0.12), blade=Plate(length=0.2, width=0.19, thickness=0.084),
    material=Material(youngs_modulus=1.0e6), rake=10.0, depth=0.06, speed=0.2, start=0.25, motion="curved", duration=0.1)
print(scene.warnings())
effects, decisions = effects_for(scene)
print(effects); print(decisions)
print(substeps_per_frame(scene)); print(asymmetry(scene)); [show(f"bed {kind}", arrange(kind, (0.2, 0.2, 0.1), 0.02, 3, mirrored)[0]) for kind in ("lattice", "jittered", "poisson") for mirrored in (False, True)]
for frame in Solver(scene).frames():
    print(frame.time, np.asarray(frame.force).tolist(), np.asarray(frame.torque).tolist()); show("soil", frame.position)
print(Scene.from_dict(scene.to_dict()) == scene, scene.to_dict())
for number, frame in frames_together([scene, scene], device="cpu", at_once=2):
    print(number, frame.time, np.asarray(frame.force).tolist()) if isinstance(frame, Frame) else print(number, frame)
for call in (lambda: Excavation(rake=200.0), lambda: Bed(spacing=-1.0), lambda: Material(packing=2.0), lambda: Wheel(load=-1), lambda: Scene.from_dict({"kind": "no"}), lambda: Plate(width=0)):
    try:
        call(); print("no error")
    except Exception as error:
        print(type(error).__name__, error)
"""

HEAD = "t,x,y,z,qx,qy,qz,qw\n"


def jobs() -> list[dict]:
    """All jobs in their order. `at`: the folder they run in; `args` for sgns, `code` for Python, `prepare` for this file."""
    listed: list[dict] = []

    def add(name: str, *args: str, at: str = "chain", **more) -> None:
        listed.append({"name": name, "args": list(args), "at": at, **more})

    def python(name: str, code: str, at: str = "chain") -> None:
        listed.append({"name": name, "code": code, "at": at})

    # (d) help and settings
    add("help", "--help", at="help")
    add("help/version", "--version", at="help")
    add("help/nothing", at="help")
    for command in COMMANDS:
        add(f"help/{command}", command, "--help", at="help")
    for command in COMMANDS:
        add(f"cfg/{command}", command, "--cfg", "job", at="help")
    for extra in (
        ["simulate", "dataset=quick"], ["simulate", "scene=quick_wheel"], ["simulate", "scene=body", "scene/tool=mesh"],
        ["simulate", "scene=incline", "effects=all", "--resolve"], ["simulate", "scene=column"], ["simulate", "scene=thin_layer"],
        ["simulate", "scene=paper_wheel", "material=wheel_sand"], ["simulate", "scene=published_excavation"],
        ["simulate", "scene=published_wheel"], ["simulate", "dataset=paper_wheel", "scene=paper_excavation"],
        ["train", "preset=paper"], ["train", "preset=released"], ["train", "preset=fast"], ["train", "model=polynomial"],
        ["train", "dataset=published"], ["frontier", "study=full"], ["evaluate", "dataset=desktop_wheel"],
    ):
        add("cfg/" + " ".join(extra), extra[0], "--cfg", "job", *extra[1:], at="help")
    python("python/names", SIGNATURES, at="help")

    # (a) the demo's chain, and a wheel's
    add("chain/simulate", "simulate", *Q, "dataset.runs=8", *CUT)
    add("chain/simulate again", "simulate", *Q, "dataset.runs=8", *CUT)
    add("chain/simulate other settings", "simulate", *Q, "dataset.runs=8", *CUT, "scene.gravity=5", wrong=True)
    add("chain/check", "check", "data/q")
    add("chain/reduce", "reduce", *Q, "output=outputs/reduce")
    add("chain/reduce auto", "reduce", *Q, "reduction.num_modes=auto", "reduction.tolerance=0.5", "output=outputs/auto")
    add("chain/reduce energy scalar", "reduce", *Q, "reduction.num_modes=auto", "reduction.choose=energy", "reduction.centring=scalar",
        "output=outputs/scalar")
    add("chain/train", "train", *Q, *NET, "output=outputs/first")
    add("chain/train again", "train", *Q, *NET, "output=outputs/first")
    add("chain/train further", "train", *Q, *NET, "training.max_steps=30", "output=outputs/first_further",
        "checkpoint=outputs/first/best.ckpt")
    add("chain/train paper", "train", *Q, "preset=paper", *NET, "output=outputs/paper")
    add("chain/train released", "train", *Q, "preset=released", *NET, "training.max_steps=4", "training.validate_every=4",
        "output=outputs/released")
    add("chain/train options", "train", *Q, *NET, "training.horizon=2", "training.fewer_modes=0.5", "model.activation=silu",
        "model.body_nodes=points", "model.edges=star", "model.predicts=acceleration", "model.message_passing_steps=2", "model.residual=true",
        "reduction.num_modes=4", "seed=3", "output=outputs/options")
    add("chain/train polynomial", "train", *Q, "model=polynomial", "training.threads=1", "output=outputs/polynomial")
    add("chain/train linear", "train", *Q, "model=polynomial", "model.degree=1", "training.threads=1", "output=outputs/linear")
    add("chain/train -m", "train", "-m", *Q, *NET, "reduction.num_modes=1,2", "training.max_steps=10", "output=outputs/sweep")
    NEW = ["scene=quick_excavation", *CUT, "scene.rake=20", "scene.depth=0.06", "scene.speed=0.12"]
    add("chain/rollout", "rollout", "checkpoint=outputs/first/best.ckpt", *NEW, "output=new.h5")
    add("chain/rollout polynomial", "rollout", "checkpoint=outputs/polynomial/best.ckpt", *NEW, "output=new_polynomial.h5")
    add("chain/rollout fewer modes", "rollout", "checkpoint=outputs/first/best.ckpt", *NEW, "num_modes=3", "output=fewer.h5")
    add("chain/rollout slow", "rollout", "checkpoint=outputs/first/best.ckpt", *NEW, "scene.speed=0.01", "output=slow.h5")
    add("chain/rollout slow own drift", "rollout", "checkpoint=outputs/first/best.ckpt", *NEW, "scene.speed=0.01", "rate_independent=false",
        "output=slow_own.h5")
    add("chain/rollout other blade", "rollout", "checkpoint=outputs/first/best.ckpt", *NEW, "scene.blade.friction=0.5", "scene.gravity=3",
        "output=other.h5")
    add("chain/rollout -m", "rollout", "-m", "checkpoint=outputs/first/best.ckpt", *NEW, "scene.rake=0,30", "output=sweep.h5",
        "hydra.sweep.dir=multirun/rollout")
    add("chain/evaluate", "evaluate", *Q, "checkpoint=outputs/first/best.ckpt", "new_rollouts=[new.h5]", "output=outputs/evaluate")
    add("chain/evaluate polynomial", "evaluate", *Q, "checkpoint=outputs/polynomial/best.ckpt", "split=validation",
        "output=outputs/evaluate_polynomial")
    add("chain/check rollouts", "check", "new.h5", "outputs/evaluate/rollouts")
    python("python/README", README)
    python("python/files", FILES)
    python("python/solver", SOLVER)
    WHEELS = "+dataset.change={settle: 0.1, duration: 0.5, bed.particles_per_cell: 1}"
    add("wheel/simulate", "simulate", *W, "dataset.runs=6", WHEELS)
    add("wheel/simulate keys of another scene", "simulate", *W, "scene.settle=0.1", wrong=True)
    add("wheel/train", "train", *W, *NET, "output=outputs/wheel")
    add("wheel/train polynomial", "train", *W, "model=polynomial", "training.threads=1", "output=outputs/wheel_polynomial")
    add("wheel/rollout", "rollout", "checkpoint=outputs/wheel/best.ckpt", "scene=quick_wheel", *WHEEL, "scene.slip=0.5", "output=wheel.h5")
    add("wheel/evaluate", "evaluate", *W, "checkpoint=outputs/wheel/best.ckpt", "output=outputs/evaluate_wheel")
    add("wheel/shard", "simulate", "dataset=quick_wheel", "dataset.path=data/s", "dataset.runs=4", WHEELS, "shard=1", "shards=2")

    # (b) every kind of scene
    def scene(name: str, *args: str, **more) -> None:
        file = re.sub(r"\W+", "_", name) + ".h5"
        add(f"scene/{name}", "simulate", *args, f"output={file}", at="scenes", **more)

    short = [*BLADE, "scene.duration=0.15"]
    scene("curved", "scene=excavation", "scene.depth=0.08", "scene.rake=10", "scene.motion=curved", *short)
    scene("ramp", "scene=excavation", "scene.motion=ramp", *short)
    scene("rest", "scene=excavation", "scene.motion=rest", *short)
    scene("path", "scene=excavation", "scene.motion=path", "scene.path=blade.csv", *short)
    scene("tilted slip walls", "scene=excavation", "scene.tilt=5", "scene.bed.walls.y=slip", "scene.bed.walls.floor=0.4", *short)
    scene("float64 whole bed", "scene=excavation", "solver.precision=float64", "effects.symmetry=false", *short)
    scene("all effects", "scene=excavation", "effects=all", *short)
    scene("no separation torque", "scene=excavation", "effects.separation=false", "effects.torque=false", *short)
    scene("elastic", "scene=excavation", "effects.yielding=false", *short)
    scene("every step", "scene=excavation", "numerics@scene=every_step", *short)
    scene("jittered stored", "scene=excavation", "scene.bed.arrangement=jittered", "scene.bed.store_every=5", "seed=7", *short)
    scene("mirrored k0", "scene=excavation", "scene.bed.arrangement=poisson", "scene.bed.mirrored=true", "scene.bed.initial_stress=k0",
          "material.friction_angle=35", *short)
    scene("paper excavation", "scene=paper_excavation", "material=paper_sand", *short)
    scene("published excavation", "scene=published_excavation", *short)
    rolling = ["scene.settle=0.05", "scene.duration=0.15"]
    scene("wheel", "scene=quick_wheel", *rolling)
    scene("wheel grousers", "scene=quick_wheel", *rolling, "scene.grousers=8", "scene.grouser_height=0.02", "scene.grouser_thickness=0.02",
          "scene.bilateral=true", "scene.friction_angle=30")
    scene("paper wheel", "scene=paper_wheel", "scene.bed.particles_per_cell=1", *rolling)
    scene("published wheel", "scene=published_wheel", "scene.settle=0.02", "scene.duration=0.05")
    driven = [*COARSE, "scene.duration=0.15", "scene.path=body.csv"]
    scene("body box", "scene=body", "scene.tool.size=[0.1,0.2,0.1]", *driven)
    scene("body cylinder", "scene=body", "scene/tool=cylinder", *driven)
    scene("body mesh", "scene=body", "scene/tool=mesh", "scene.tool.file=box.stl", "scene.tool.scale=0.001", *driven)
    scene("body mesh obj", "scene=body", "scene/tool=mesh", "scene.tool.file=box.obj", *driven)
    scene("column", "scene=column", "scene.bed.spacing=0.02", "scene.bed.particles_per_cell=4", "scene.duration=0.15")
    scene("column slab", "scene=column", "scene.shape=slab", "scene.tilt=3", "scene.bed.walls.y=periodic", "scene.bed.spacing=0.02",
          "scene.bed.particles_per_cell=4", "scene.duration=0.1")
    scene("incline", "scene=incline", "scene.bed.spacing=0.003", "scene.duration=0.1")
    scene("incline from rest", "scene=incline", "scene.bed.spacing=0.003", "scene.duration=0.1", "scene.flowing=false", "effects.fluidity=true")
    scene("thin layer", "scene=thin_layer", "scene.bed.spacing=0.0015", "scene.duration=0.05")
    scene("stops", "scene=excavation", *BLADE, "scene.duration=0.18", "effects.yielding=false", "scene.depth=0.1", "scene.speed=2", wrong=True)
    add("scene/goes on", "simulate", "continue_from=stops.stopped.h5", "scene.bed.headroom=0.5", "output=gone_on.h5", at="scenes")
    scene("too soft", "scene=excavation", *short, "material.youngs_modulus=100", wrong=True)
    add("scene/-m", "simulate", "-m", "scene=excavation", *short, "scene.depth=0.02,0.04", "hydra.sweep.dir=multirun/scene", at="scenes")

    # (c) check and advise
    add("check/good", "check", "curved.h5", at="scenes")
    for kind in ("numbers", "cut short", "no force", "not hdf5", "times"):
        listed.append({"name": f"check/prepare {kind}", "prepare": kind, "at": "scenes"})
        add(f"check/{kind}", "check", "curved.h5", f"bad {kind}.h5", at="scenes", wrong=True)
    add("check/stopped", "check", "stops.stopped.h5", at="scenes", wrong=True)
    for request in (
        ["error.force=0.35", "time=0.01"], ["error.position=0.005", "particles=true"], ["task=wheel", "error.sinkage=0.002"],
        ["time=0.0001"], ["error.force=0.1"], ["error.surface=0.004", "error.position=0.003"], ["error.force=0.3", "against=training"],
        ["task=wheel", "time=0.05", "particles=true"],
    ):
        add("advise/" + " ".join(request), "advise", *request, at="help")

    # what looks wrong and is taken
    add("taken/thin blade", "simulate", "scene=excavation", *BLADE, "scene.blade.thickness=0.001", "scene.duration=0.1", "output=thin.h5", at="scenes")
    add("taken/unknown context", "train", *Q, *NET, "model.context=[mass]", "output=outputs/context")
    add("taken/small wheel", "simulate", "scene=quick_wheel", "scene.diameter=0.01", *rolling, "output=small_wheel.h5", at="scenes")

    add("taken/path of one row", "simulate", "scene=excavation", *CUT, "scene.motion=path", "scene.path=../files/one_row.csv", "output=one_row.h5",
        at="scenes")

    # a tiny study
    add("frontier/solver", "frontier", "--config-dir", "own", "study=tiny", "axis=solver", "output=outputs/study", at="study")
    add("frontier/again", "frontier", "--config-dir", "own", "study=tiny", "axis=none", "output=outputs/study", at="study")
    add("frontier/advise", "advise", "table=outputs/study/points.csv", "error.force=0.9", at="study")

    # (e) wrong inputs, each in a folder of its own
    number = 0

    D = "dataset.path=../../chain/data/q"

    def wrong(*args: str) -> None:
        nonlocal number
        number += 1
        short = [*NET[: 5 if "model=polynomial" not in args else 0]] if args[:2] == ("train", D) and args[-1] != C else []
        args = (*args[:2], *(s for s in short if s.split("=")[0] not in {a.split("=")[0] for a in args}), *args[2:])
        add("wrong/" + " ".join(args), *args, at=f"wrong/{number:03d}", wrong=True)

    X = "scene=quick_excavation"
    C = "checkpoint=../../chain/outputs/first/best.ckpt"
    D = "dataset.path=../../chain/data/q"
    for args in (
        # command line
        ["foo"], ["-m", "train"], ["Simulate"], ["train", "--nope"], ["train", "--cfg", "nope"], ["train", "--cfg", "job", "-m"],
        ["train", "--resolve"], ["train", "--config-name", "simulate"], ["train", "--config-dir", "nope"], ["train", "--version"],
        ["train", "reduction"], ["train", "seed=[1"], ["train", "seed=1,2"], ["train", "seed=range(1,3)"], ["train", "seed=${nope}"],
        ["train", "~nope"], ["train", "~model"], ["train", "+seed=1"], ["train", "hydra.verbose=3"],
        ["train", "+hydra.callbacks.a._target_=os.system"],
        ["train", "hydra/launcher=joblibb"],
        # unknown keys, groups and options
        ["simulate", "foo=1"], ["train", "foo=1"], ["train", "num_modes=3"], ["train", "reduction.num_mode=3"], ["train", "dataset=nope"],
        ["train", "scene=excavation"], ["train", "model=nope"], ["train", "preset=nope"], ["simulate", "scene=exavation"],
        ["simulate", "scene/tool=ball"], ["simulate", "material=mud"], ["simulate", "scene.dept=0.1"], ["simulate", "effects=none"],
        ["simulate", "effects.yield=true"], ["rollout", "solver.precision=float64"], ["advise", "error.forces=0.1"], ["frontier", "study=huge"],
        ["train", "-m", "reduction.num_mode=1,2", "output=x"], ["frontier", "axis=everything"],
        # wrong types and values
        ["train", "seed=1.5"], ["train", "seed=x"], ["train", "seed=null"], ["train", "device=gpu"], ["train", "dataset.path=null"],
        ["train", "dataset=null"], ["train", D, "training.max_steps=0"], ["train", D, "training.max_steps=many"],
        ["train", D, "training.batch_size=-1"], ["train", D, "training.learning_rate=fast"], ["train", D, "training.schedule=linear"],
        ["train", D, "training.resume=maybe"], ["train", D, "training.loss.force=-1"], ["train", D, "model.history=1"],
        ["train", D, "model.activation=tanhh"], ["train", D, "model.hidden_width=0"],
        ["train", D, "model=polynomial", "model.degree=3"], ["train", D, "model=polynomial", "training.max_steps=5"],
        ["train", D, "reduction.num_modes=0"], ["train", D, "reduction.num_modes=100"], ["train", D, "reduction.centring=mean"],
        ["reduce", D, "reduction.choose=luck", "reduction.num_modes=auto"], ["reduce", D, "reduction.num_modes=few"],
        ["reduce", D, "reduction.tolerance=-1", "reduction.num_modes=auto"],
        ["simulate", X, "scene.rake=200"], ["simulate", X, "scene.depth=1"], ["simulate", X, "scene.depth=deep"], ["simulate", X, "scene.speed=-1"],
        ["simulate", X, "scene.motion=spiral"], ["simulate", X, "scene.motion=path"], ["simulate", X, "scene.duration=0"],
        ["simulate", X, "scene.frame_rate=nan"], ["simulate", X, "scene.courant=8"], ["simulate", X, "scene.start=2"],
        ["simulate", X, "scene.body_grid=[0,5]"], ["simulate", X, "scene.blade.friction=-0.1"],
        ["simulate", X, "scene.bed.spacing=0"], ["simulate", X, "scene.bed.spacing=1e-5"], ["simulate", X, "scene.bed.size=[1,2]"],
        ["simulate", X, "scene.bed.arrangement=heap"], ["simulate", X, "scene.bed.store_every=0"], ["simulate", X, "scene.bed.walls.x=ice"],
        ["simulate", X, "scene.bed.walls.floor=periodic"], ["simulate", X, "scene.bed.initial_stress=high"], ["simulate", X, "scene.tilt=95"],
        ["simulate", X, "scene.bed.particles_per_cell=0"], ["simulate", X, "scene.kind=wheel"], ["simulate", X, "scene=null"],
        ["simulate", X, "material.packing=1.5"], ["simulate", X, "material.poissons_ratio=0.5"], ["simulate", X, "material.rate_law=cubic"],
        ["simulate", X, "material.friction_angle=95"], ["simulate", X, "material=null"], ["simulate", X, "solver.precision=float16"],
        ["simulate", X, "solver.batch=0"], ["simulate", X, "effects.yielding=maybe"], ["simulate", X, "effects.free_body=true"],
        ["simulate", X, "effects.symmetry=true", "scene.bed.arrangement=jittered"], ["simulate", X, "effects.tolerance.grid=-1"],
        ["simulate", X, "shard=1"], ["simulate", X, "output=null"], ["simulate", X, "output=nope.txt/x.h5", "seed=-1"], ["simulate", X, "device=tpu"],
        ["simulate", "scene=quick_wheel", "scene.load=-1"], ["simulate", "scene=quick_wheel", "scene.slip=1.5"],
        ["simulate", "scene=quick_wheel", "scene.settle=9"], ["simulate", "scene=quick_wheel", "scene.diameter=-1"],
        ["simulate", "scene=quick_wheel", "scene.grousers=3"], ["simulate", "scene=quick_wheel", "effects.free_body=false"],
        ["simulate", "scene=column", "scene.radius=0.5"], ["simulate", "scene=column", "scene.shape=cone"], ["simulate", "scene=incline", "scene.tilt=80"],
        ["simulate", "scene=incline", "scene.bed.walls.x=slip"], ["simulate", "scene=body"], ["simulate", "scene=body", "scene.path=nope.csv"],
        # paths and meshes
        *(["simulate", X, *CUT, "scene.motion=path", f"scene.path=../../files/{name}.csv"]
          for name in ("bad_quaternion", "leaves_bin", "nan", "short_row", "words", "backwards", "empty", "no_header", "jump")),
        ["rollout", C, X, *CUT, "scene.motion=path", "scene.path=../../files/leaves_bin.csv"],
        ["simulate", "scene=body", "scene.path=../../files/body.csv", "scene/tool=mesh"],
        ["simulate", "scene=body", "scene.path=../../files/body.csv", "scene/tool=mesh", "scene.tool.file=nope.stl"],
        ["simulate", "scene=body", "scene.path=../../files/body.csv", "scene/tool=mesh", "scene.tool.file=../../files/open.stl"],
        ["simulate", "scene=body", "scene.path=../../files/body.csv", "scene/tool=mesh", "scene.tool.file=../../files/body.csv"],
        ["simulate", "scene=body", "scene.path=../../files/body.csv", "scene/tool=mesh", "scene.tool.file=../../files/box.stl", "scene.tool.scale=-1"],
        ["simulate", "scene=body", "scene.path=../../files/body.csv", "scene/tool=cylinder", "scene.tool.width=0"],
        # datasets
        ["simulate", "dataset=quick", "scene=excavation"], ["simulate", "dataset=published"], ["simulate", "dataset=quick", "dataset.runs=-1"],
        ["simulate", "dataset=quick", "dataset.runs=1000"], ["simulate", "dataset=quick", "dataset.split=[0.5,0.1,0.1]"],
        ["simulate", "dataset=quick", "dataset.draw=[{colour: [1]}]"], ["simulate", "dataset=quick", "dataset.draw=[]"],
        ["simulate", "dataset=quick", "dataset.where={rake: 10}"], ["simulate", "dataset=quick", "shards=0"], ["simulate", "dataset=quick", "shard=2", "shards=2"],
        ["simulate", "dataset=quick", "continue_from=x.h5"], ["reduce", "dataset.path=nope"], ["train", "dataset.path=../../files"],
        ["train", "dataset=published", "dataset.path=../../files"], ["train", D, "dataset.where={rake: 99}"], ["train", D, "dataset.where={colour: 1}"],
        # missing and damaged files
        ["rollout"], ["evaluate"], ["check"], ["check", "nope.h5"], ["check", "../../files"], ["rollout", "checkpoint=null"], ["rollout", "checkpoint=nope.ckpt", X],
        ["rollout", "checkpoint=../../files/truncated.ckpt", X], ["rollout", "checkpoint=../../files/foreign.ckpt", X],
        ["rollout", "checkpoint=../../files/body.csv", X], ["rollout", "checkpoint=../../files", X], ["evaluate", D, "checkpoint=../../files/foreign.ckpt"],
        ["train", D, "checkpoint=nope.ckpt"], ["train", D, *NET, "checkpoint=../../chain/outputs/polynomial/best.ckpt"], ["train", D, *NET, "model.hidden_width=16", C],
        ["simulate", "continue_from=nope.h5"], ["simulate", "continue_from=../../scenes/curved.h5", "output=x.h5"],
        ["simulate", "continue_from=../../scenes/stops.stopped.h5", "scene.depth=0.2", "output=x.h5"],
        ["advise", "table=nope.csv", "time=1"], ["advise", "table=../../files/body.csv", "time=1"],
        # what does not fit together
        ["rollout", C, X], ["rollout", C, X, *CUT, "scene.frame_rate=30"], ["rollout", C, "scene=quick_wheel"], ["rollout", C, "scene=column"],
        ["rollout", C, X, *CUT, "num_modes=99"], ["rollout", C, X, *CUT, "num_modes=0"], ["rollout", C, X, *CUT, "rate_independent=3"],
        ["rollout", C, X, *CUT, "output=null"], ["rollout", C, X, *CUT, "seed=1", "scene.bed.arrangement=jittered"],
        ["evaluate", C, "dataset=quick_wheel", "dataset.path=../../chain/data/w"], ["evaluate", C, D, "split=all"], ["evaluate", C, D, "timing_repeats=1"],
        ["evaluate", C, D, "full_space=3"], ["evaluate", C, D, "new_rollouts=[nope.h5]"], ["evaluate", C, D, "new_rollouts=3"],
        ["evaluate", C, D, "num_modes=99"], ["evaluate", C, "dataset=null"], ["evaluate", C, "~dataset"],
        ["rollout", "-m", C, X, *CUT, "scene.depth=0.05,5", "output=x.h5", "hydra.sweep.dir=sweep"],
        ["simulate", "-m", X, "scene.rake=200,210", "hydra.sweep.dir=sweep"],
        # advice
        ["advise"], ["advise", "error.force=-1"], ["advise", "error.force=x"], ["advise", "error=3"], ["advise", "task=dig", "time=1"],
        ["advise", "against=nobody", "time=1"], ["advise", "particles=3", "time=1"], ["advise", "time=0"], ["advise", "error.sinkage=0.001"],
        ["check", "files=3"],
    ):
        wrong(*args)
    return listed


# ------------------------------------------------------------------------------------------------ what jobs need to be there


def prepare_files(work: Path) -> None:
    """Paths, meshes and a study that the jobs read, and damaged ones."""
    files, scenes, study = work / "files", work / "scenes", work / "study"
    for folder in (files, scenes, study / "own" / "study", work / "chain", work / "help"):
        folder.mkdir(parents=True, exist_ok=True)
    identity = "0,0,0,1"
    half = math.radians(10) / 2
    body = [(0.0, 0.20, 0.30, 0.20, identity), (1.0, 0.50, 0.30, 0.10, f"0,{math.sin(half)!r},0,{math.cos(half)!r}")]
    for folder in (files, scenes):
        (folder / "body.csv").write_text(HEAD + "".join(f"{t},{x},{y},{z},{q}\n" for t, x, y, z, q in body))
    start = f"0,0.15,0.3,0.32,{identity}\n"
    (scenes / "blade.csv").write_text(HEAD + start + f"1,0.30,0.3,0.25,{identity}\n2,0.30,0.3,0.25,{identity}\n")
    for name, text in {
        "bad_quaternion": HEAD + start + "1,0.2,0.3,0.3,0,0,0,2\n",
        "leaves_bin": HEAD + start + f"0.5,0.95,0.3,0.1,{identity}\n",
        "nan": HEAD + start + f"1,0.2,nan,0.3,{identity}\n",
        "short_row": HEAD + start + "1,0.2,0.3\n",
        "words": HEAD + start + f"1,left,0.3,0.3,{identity}\n",
        "backwards": HEAD + f"1,0.15,0.3,0.32,{identity}\n" + f"0,0.2,0.3,0.3,{identity}\n",
        "empty": "",
        "no_header": start + f"1,0.2,0.3,0.3,{identity}\n",
        "one_row": HEAD + start,
        "jump": HEAD + start + f"0.001,0.5,0.3,0.32,{identity}\n" + f"1,0.5,0.3,0.32,{identity}\n",
    }.items():
        (files / f"{name}.csv").write_text(text)

    faces = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    corners = [(0.1 * (i & 1), 0.2 * (i >> 1 & 1), 0.1 * (i >> 2)) for i in range(8)]
    triangles = [(f[0], f[k], f[k + 1]) for f in faces for k in (1, 2)]

    def stl(path: Path, chosen: list, scale: float) -> None:
        data = b"box".ljust(80) + struct.pack("<I", len(chosen))
        for triangle in chosen:
            data += struct.pack("<12fH", 0, 0, 0, *(scale * v for c in triangle for v in corners[c]), 0)
        path.write_bytes(data)

    for folder in (files, scenes):
        stl(folder / "box.stl", triangles, 1000.0)
    stl(files / "open.stl", triangles[:-1], 1.0)
    lines = ["v " + " ".join(map(repr, c)) for c in corners] + ["f " + " ".join(str(c + 1) for c in f) for f in faces]
    (scenes / "box.obj").write_text("\n".join(lines) + "\n")
    (study / "own" / "study" / "tiny.yaml").write_text("""\
name: tiny
scenes:
  cut:
    scene: quick_excavation
    dataset: quick
    cases: {deep: [scene.duration=0.1, scene.bed.spacing=0.05, scene.blade.thickness=0.12, scene.clearance=0]}
    bands: {force_nrmse: 0.2}
    reference: {label: finer, set: [scene.bed.spacing=0.04]}
    solver:
      - {axis: dx, label: base}
      - {axis: precision, label: float64, set: [solver.precision=float64]}
""")


DAMAGE = r"""
import sys, shutil, h5py, torch
kind, good, bad = sys.argv[1:]
if kind == "not hdf5":
    open(bad, "wb").write(b"not HDF5")
elif kind == "cut short":
    data = open(good, "rb").read()
    open(bad, "wb").write(data[: len(data) // 2])
else:
    shutil.copy(good, bad)
    with h5py.File(bad, "r+") as file:
        if kind == "numbers":
            file["particles/soil/position/value"][2, 5, 1] = float("nan")
            file["observables/body/pose/value"][3, 6] = 2.0
        elif kind == "no force":
            del file["observables/body/force"]
        elif kind == "times":
            file["particles/soil/position/time"][3] = 9.0
            file.attrs["frame_rate"] = 50.0
"""

CHECKPOINTS = r"""
import torch
torch.save({"weights": torch.zeros(3)}, "foreign.ckpt")
torch.save({"state_dict": {}, "hyper_parameters": {}}, "truncated.ckpt")
data = open("truncated.ckpt", "rb").read()
open("truncated.ckpt", "wb").write(data[:-300])
"""


# --------------------------------------------------------------------------------------- what is left out of the answers

NUMBER = r"[0-9][0-9.,]*(?:e[+-]?[0-9]+)?"
TEXT_RULES = [  # what differs between two runs of the same job: (pattern, what stands in its place, why)
    (r"\d{4}-\d\d-\d\d[_T ]\d\d[-:]\d\d[-:]\d\d(?:\.\d+)?", "<date>", "dates"),
    (r"\d{4}-\d\d-\d\d \d\d:\d\d(?: UTC)?|\b20\d\d-\d\d-\d\d\b", "<date>", "dates"),
    (rf"\b{NUMBER} s for ({NUMBER} simulated s): {NUMBER} s per simulated second, {NUMBER} M particle-steps/s",
     r"<t> s for \1: <t> s per simulated second, <t> M particle-steps/s", "rate of a simulation"),
    (rf"about {NUMBER} (?:s|min|h) with (\d+) at once", r"about <t> with \1 at once", "estimate of a campaign"),
    (rf"(?:about )?{NUMBER} (?:s|min|h) (left|to go|more)\b", r"<t> \1", "remaining time"),
    (rf"\btrained in {NUMBER} (?:s|min|h)", "trained in <t>", "time of training"),
    (rf"wall seconds per simulated second: {NUMBER} (stepping|with)", r"wall seconds per simulated second: <t> \1", "rate of a rollout"),
    (rf"wall seconds per simulated second: network {NUMBER} \(with decoding {NUMBER}, one thread\), solver {NUMBER}",
     "wall seconds per simulated second: network <t> (with decoding <t>, one thread), solver <t>", "rates in evaluate"),
    (r"events\.out\.tfevents\.\d+\.[^ /]*\.(\d+)(?=$|[\s/])", r"events.out.tfevents.<name>.\1", "names of TensorBoard files"),
    (r"\.[^ /]+\.partial", "<partial>", "names of partial files"),
    (r"<work>/wrong/\d+", "<work>/wrong/<n>", "numbers of folders"),
    (r"(?m)^(\w+, (?:solver|reduction|surrogate): .*) \(\d+ (?:s|min)\)$", r"\1 (<t>)", "time of a point of a study"),
    (r"0x[0-9a-f]{6,}", "<address>", "addresses"),
]
DROPPED_KEYS = re.compile(  # of JSON, CSV, YAML, attributes, checkpoints: wall times, machines and versions
    r"(^|[./ ])(wall_time_s|package_version|checkpoint_version|creator|version|commit|machine|host|date|seconds|"
    r"solver_wall_s_per_s|wall_s_per_simulated_s\w*|workload_wall_s_per_simulated_s\w*|ratio\w*|cost\w*|decoded_cost\w*|"
    r"pytorch-lightning_version|memory\w*|peak\w*|\w*_seconds|\w*wall_\w*|samples_per_s|processor_s_per_simulated_s\w*)($|[./ \[:])"
)


class Places:
    """Text without the folders, versions and times that differ from run to run."""

    def __init__(self, work: Path, interpreter: Path) -> None:
        code = (
            "import sys, os, sgns, mpm_warp, socket; print(sgns.__version__); print(sys.prefix); print(os.path.dirname(mpm_warp.__file__)); "
            "print(os.path.dirname(sgns.__file__)); print(socket.gethostname()); import torch; print(os.path.dirname(os.path.dirname(torch.__file__)))"
        )
        version, prefix, mpm, package, _, libraries = subprocess.run(
            [interpreter, "-c", code], capture_output=True, text=True, check=True, env=environment(), cwd=work
        ).stdout.split("\n")[:6]
        self.version = version
        pairs = {str(work): "<work>", os.path.realpath(work): "<work>", prefix: "<venv>", libraries: "<libraries>",
                 package: "<sgns>", mpm: "<mpm_warp>", os.path.dirname(mpm): "<repository>", str(interpreter.parent.parent): "<venv>"}
        self.pairs = sorted(((a, b) for a, b in pairs.items() if len(a) > 4), key=lambda p: -len(p[0]))

    @classmethod
    def stored(cls, pairs: list, version: str) -> Places:
        places = cls.__new__(cls)
        places.pairs, places.version = pairs, version
        return places

    def plain(self, text: str) -> str:
        for path, name in self.pairs:
            text = text.replace(path, name)
        text = text.replace(f"sgns {self.version}", "sgns <version>")
        for pattern, instead, _ in TEXT_RULES:
            text = re.sub(pattern, instead, text, flags=re.M)
        return text


def environment() -> dict[str, str]:
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "COV", "SGNS", "HYDRA"))}
    return kept | {
        "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "PYTHONHASHSEED": "0", "MPLBACKEND": "Agg",
        "CUDA_VISIBLE_DEVICES": "", "LC_ALL": "C.UTF-8", "COLUMNS": "120", "TZ": "UTC", "PYTHONDONTWRITEBYTECODE": "1",
    }


# ----------------------------------------------------------------------- result files, read by the interpreter under test


def array_digest(array) -> dict:
    import numpy as np

    array = np.asarray(array)
    if array.dtype.kind in "OSU":
        return {"text": hashlib.sha256("\0".join(map(str, array.ravel().tolist())).encode()).hexdigest()[:32], "shape": list(array.shape)}
    data = np.ascontiguousarray(array)
    if data.dtype.names or data.dtype.kind not in "biuf":
        return {"sha256": hashlib.sha256(data.tobytes()).hexdigest()[:32], "dtype": str(data.dtype), "shape": list(data.shape)}
    wide = data.astype(np.float64).ravel()
    digest = {"dtype": str(data.dtype), "shape": list(data.shape), "sha256": hashlib.sha256(data.tobytes()).hexdigest()[:32]}
    if wide.size == 1:
        digest["value"] = repr(float(wide[0]))
    elif wide.size:
        finite = wide[np.isfinite(wide)]
        weights = np.cos(np.arange(finite.size) * 1.2345)  # a fixed direction: feels a change of order, too
        digest |= {
            "norm": repr(float(np.sqrt(np.sum(finite * finite)))), "along": repr(float(np.sum(finite * weights))),
            "min": repr(float(finite.min())) if finite.size else None, "max": repr(float(finite.max())) if finite.size else None,
        }
        if finite.size < wide.size:
            digest["not_finite"] = int(wide.size - finite.size)
    return digest


def plain_tree(value, name: str = "") -> dict:
    """A nest of dicts and lists as {dotted name: value}."""
    if isinstance(value, dict):
        found = {}
        for key, item in value.items():
            found |= plain_tree(item, f"{name}.{key}" if name else str(key))
        return found or {name: "{}"}
    if isinstance(value, (list, tuple)) and any(isinstance(v, (dict, list, tuple)) or hasattr(v, "numpy") for v in value):
        found = {}
        for number, item in enumerate(value):
            found |= plain_tree(item, f"{name}[{number}]")
        return found
    if hasattr(value, "detach"):
        return {name: array_digest(value.detach().cpu().numpy())}
    return {name: repr(value)}


def h5_digest(path: Path) -> dict:
    import h5py
    import numpy as np

    found: dict = {}

    def attributes(name: str, thing) -> None:
        for key in sorted(thing.attrs):
            try:
                value = thing.attrs[key]
            except Exception as error:
                value = f"unreadable: {type(error).__name__}"
            value = value.decode() if isinstance(value, bytes) else value
            if isinstance(value, h5py.Reference):
                value = "<reference>"
            if isinstance(value, np.ndarray) and value.dtype.kind != "O":
                value = value.tolist()
            found[f"{name}@{key}"] = value if isinstance(value, str) else repr(value)

    def walk(name: str, group) -> None:
        attributes(name or "/", group)
        for key in sorted(group):
            item = group[key]
            if isinstance(item, h5py.Group):
                walk(f"{name}/{key}", item)
            else:
                attributes(f"{name}/{key}", item)
                found[f"{name}/{key}"] = array_digest(item[()])

    with h5py.File(path) as file:
        walk("", file)
    return found


def events_digest(path: Path) -> dict:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(path), size_guidance={"scalars": 0, "images": 0, "tensors": 0})
    events.Reload()
    tags = events.Tags()
    found = {f"scalar {tag}": repr([(e.step, e.value) for e in events.Scalars(tag)]) for tag in sorted(tags["scalars"])}
    for kind in ("images", "tensors"):
        found |= {f"{kind} {tag}": "there" for tag in sorted(tags[kind])}
    return found


def file_digest(path: Path) -> dict:
    """What is in a result file: {name: text or digest of an array}."""
    name = path.name
    if name.endswith(".h5"):
        return h5_digest(path)
    if name.endswith(".ckpt"):
        import torch

        return plain_tree(torch.load(path, map_location="cpu", weights_only=True))
    if "tfevents" in name:
        return events_digest(path)
    if name.endswith(".json"):
        return plain_tree(json.loads(path.read_text()))
    if name.endswith(".csv"):
        import csv

        with open(path, newline="") as file:
            rows = list(csv.reader(file))
        if not rows:
            return {"": "empty"}
        found = {"header": ",".join(rows[0])}
        for number, row in enumerate(rows[1:]):
            label = row[0] if not re.fullmatch(r"[-+0-9.e]*", row[0]) else str(number)
            found |= {f"{number} {label}.{key}": value for key, value in zip(rows[0], row)}
        return found
    if name.endswith(".npz"):
        import numpy as np

        with np.load(path) as file:
            return {key: array_digest(file[key]) for key in sorted(file.files)}
    if name.endswith(".html"):
        text = re.sub(r"data:image/[^\"')]*", "<picture>", path.read_text())
        return {"text": re.sub(r"(</(?:p|div|tr|h\d|figcaption|li|style|nav|a)>)", r"\1\n", text)}
    if name.endswith((".yaml", ".csv", ".txt", ".lock")):
        return {"text": path.read_text()}
    return {"sha256": hashlib.sha256(path.read_bytes()).hexdigest()[:32], "size": path.stat().st_size}


def server() -> int:
    """Runs jobs in forks of a process that has loaded the libraries; run by the interpreter under test.

    Reads a line of JSON each, {arguments, folder, stdout, stderr}; answers the exit status. What runs is the console script
    `sgns` of the installed package. Libraries and the public names are loaded once, which saves most of a short job's time.
    """
    import atexit
    import importlib
    import signal
    import traceback
    from importlib.metadata import entry_points

    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    for name in ("hydra", "omegaconf", "h5py", "torch", "warp", "lightning", "torch_geometric", "matplotlib.pyplot", "tqdm", "yaml"):
        try:
            importlib.import_module(name)
        except ImportError:
            pass
    import mpm_warp
    import sgns

    for module in (sgns, mpm_warp):
        for name in module.__all__:
            getattr(module, name)
    (script,) = entry_points(group="console_scripts", name="sgns")
    main = script.load()
    for line in sys.stdin:
        job = json.loads(line)
        child = os.fork()
        if child == 0:
            status = 1
            try:
                os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
                for number, path in ((1, job["stdout"]), (2, job["stderr"])):
                    os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
                os.chdir(job["folder"])
                signal.alarm(200)  # ends a job that does not end
                sys.argv = [job["name"], *job["arguments"]]
                try:
                    code = main()
                except SystemExit as stop:
                    code = stop.code
                status = code if isinstance(code, int) else 0 if code is None else 1
                if isinstance(code, str):
                    sys.stderr.write(code + "\n")
            except BaseException:
                traceback.print_exc()
            finally:
                try:
                    atexit._run_exitfuncs()
                    sys.stdout.flush()
                    sys.stderr.flush()
                finally:
                    os._exit(status)
        found = os.waitpid(child, 0)[1]
        answers.write(f"{os.waitstatus_to_exitcode(found)}\n")
        answers.flush()
    return 0


def worker() -> int:
    """Reads paths on stdin, answers a line of JSON each; run by the interpreter under test."""
    for line in sys.stdin:
        try:
            answer = file_digest(Path(json.loads(line)))
        except Exception as error:
            answer = {"unreadable": f"{type(error).__name__}: {error}"}
        sys.stdout.write(json.dumps(answer) + "\n")
        sys.stdout.flush()
    return 0


# ---------------------------------------------------------------------------------------------------------------- record


def snapshot(folder: Path) -> dict[str, tuple]:
    found = {}
    for path in folder.rglob("*"):
        if path.is_file() or path.is_symlink():
            stat = path.lstat()
            found[str(path.relative_to(folder))] = (stat.st_mtime_ns, stat.st_size, stat.st_ino)
    return found


# These start a process each, as a person does; the others are forks of one that has loaded the libraries.
FRESH = re.compile(
    r"^(help|cfg/[a-z]+$|(chain|wheel)/simulate|wheel/shard|chain/(reduce|train|train -m|rollout|evaluate)$|scene/(curved|stops)$|check/good|advise/error.force=0.35"
    r"|frontier/|wrong/(foo|train foo=1|rollout$|check nope.h5))"
)
UNREAD = re.compile(r"(^|/)\.hydra/hydra\.yaml$|\.lock$")


def cleaned(digest: dict, places: Places, path: str, job: str) -> dict:
    study = job.startswith("frontier/")
    if study and path.endswith(".png"):
        return {"": "there; times are drawn in it"}
    found = {}
    for key, value in digest.items():
        key = places.plain(key)
        if DROPPED_KEYS.search(key.replace("@", ".")):
            found[key] = "<left out>"
        elif isinstance(value, str):
            found[key] = places.plain(value)
            if study:
                for pattern, instead in STUDY_RULES:
                    found[key] = re.sub(pattern, instead, found[key])
            if "\n" in value:  # YAML, HTML
                found[key] = "\n".join(line_of(line) for line in found[key].split("\n"))
        else:
            found[key] = value
    return found


HTML_TIMES = [  # rows and sentences of report.html
    (re.compile(r'<td class="text">(wall seconds per simulated second|solver&#x27;s time / this|training|peak memory|memory|time)[^\n]*'), "<row of times>"),
    (re.compile(r"One simulated second takes [^\n]*?<"), "One simulated second takes <t>.<"),
    (re.compile(rf"<b>{NUMBER} ×</b>[^<]*"), "<b><t> ×</b>"),
]
STUDY_RULES = [  # of a study measured here: its times, and what shows them
    (r"  costs [^\n]*", "  costs <t>"),
    (r"[0-9.]+ to [0-9.]+ s per simulated s", "<t> s per simulated s"),
    (r'(<td class="text">(?:solver|reduction|surrogate)</td>)(<td class="">[^<]*</td>){3}', r"\1<times>"),
]


def line_of(line: str) -> str:
    named = re.match(r"\s*-?\s*([\w-]+): ", line)
    if named and DROPPED_KEYS.search(named[1]):
        return f"{line[: named.end()]}<left out>"
    for pattern, instead in HTML_TIMES:
        line = pattern.sub(instead, line)
    return line


def normalise(folder: Path) -> None:
    """answers.json from raw.json."""
    stored = json.loads((folder / "raw.json").read_text())
    places = Places.stored(stored["pairs"], stored["version"])
    answers = {
        name: {
            "command": job["command"],
            "status": job["status"],
            "stdout": [re.sub(*STUDY_RULES[0], line) if name.startswith("frontier/") else line for line in places.plain(job["stdout"]).split("\n")],
            "stderr": places.plain(job["stderr"]).split("\n"),
            "files": {places.plain(path): cleaned(digest, places, path, name) for path, digest in job["files"].items()},
        }
        | ({"gone": [places.plain(path) for path in job["gone"]]} if job["gone"] else {})
        for name, job in stored["jobs"].items()
    }
    written = {"format": FORMAT, "version": places.version, "jobs": answers}
    (folder / "answers.json").write_text(json.dumps(written, indent=1, ensure_ascii=False) + "\n")


def record(interpreter: Path, folder: Path, core: int | None, only: str | None, keep: bool, at: Path | None, merge: bool) -> int:
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0)) if core is None else core})  # so that a campaign has one worker
    folder.mkdir(parents=True, exist_ok=True)
    work = at or Path(tempfile.mkdtemp(prefix="sgns_answers_"))
    work.mkdir(parents=True, exist_ok=True)
    prepare_files(work)
    script = interpreter.parent / "sgns"
    command = [str(script)] if script.exists() else [str(interpreter), "-m", "sgns"]
    places = Places(work, interpreter)
    subprocess.run([interpreter, "-c", CHECKPOINTS], cwd=work / "files", env=environment(), check=True)
    reader = subprocess.Popen(
        [interpreter, str(Path(__file__).resolve()), "worker"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment()
    )
    forks = subprocess.Popen(
        [interpreter, str(Path(__file__).resolve()), "server"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment(),
        cwd=work,
    )
    raw: dict = {}
    begin = time.time()
    trouble = []
    for job in jobs():
        name = job["name"]
        if only and not re.search(only, name):
            continue
        here = work / job["at"]
        here.mkdir(parents=True, exist_ok=True)
        if "prepare" in job:
            kind = job["prepare"]
            subprocess.run([interpreter, "-c", DAMAGE, kind, "curved.h5", f"bad {kind}.h5"], cwd=here, env=environment(), check=False)
            continue
        line = [str(interpreter), "-c", job["code"]] if "code" in job else [*command, *job["args"]]
        before = snapshot(here)
        start = time.time()
        if "code" not in job and not FRESH.search(name):
            out_file, err_file = work / "stdout", work / "stderr"
            told = {"arguments": job["args"], "folder": str(here), "stdout": str(out_file), "stderr": str(err_file), "name": command[0]}
            forks.stdin.write(json.dumps(told) + "\n")
            forks.stdin.flush()
            status = int(forks.stdout.readline())
            out, err = (file.read_text(errors="replace") for file in (out_file, err_file))
        else:
            try:
                done = subprocess.run(line, cwd=here, env=environment(), capture_output=True, text=True, timeout=300, stdin=subprocess.DEVNULL)
                status, out, err = done.returncode, done.stdout, done.stderr
            except subprocess.TimeoutExpired:
                status, out, err = "timeout", "", ""
        took = time.time() - start
        after = snapshot(here)
        files: dict = {}
        for path in sorted(after):
            if before.get(path) == after[path]:
                continue
            if UNREAD.search(path):
                files[path] = {"": "there"}
                continue
            reader.stdin.write(json.dumps(str(here / path)) + "\n")
            reader.stdin.flush()
            files[path] = json.loads(reader.stdout.readline())
        shown = "python -c ..." if "code" in job else "sgns " + " ".join(job["args"])
        raw[name] = {"command": shown, "status": status, "stdout": out, "stderr": err, "files": files, "gone": sorted(set(before) - set(after))}
        expected = job.get("wrong", False)
        if expected is True and (status != 2 or err.count("\n") != 1):
            trouble.append(f"{name}: status {status}, {err.count(chr(10))} lines on stderr; expected 2 and 1")
        elif expected is False and status != 0:
            trouble.append(f"{name}: status {status}: {err.strip()[-200:]}")
        sys.stdout.write(f"{took:6.1f} s  {status}  {name}\n")
        sys.stdout.flush()
    for process in (reader, forks):
        process.stdin.close()
        process.wait()
    used = os.times()
    cpu = used.user + used.system + used.children_user + used.children_system
    if merge and (folder / "raw.json").exists():
        raw = json.loads((folder / "raw.json").read_text())["jobs"] | raw
        raw = {name: raw[name] for name in (j["name"] for j in jobs()) if name in raw}
    (folder / "raw.json").write_text(json.dumps({"pairs": places.pairs, "version": places.version, "jobs": raw}) + "\n")
    normalise(folder)
    if not keep:
        shutil.rmtree(work, ignore_errors=True)
    sys.stdout.write(f"{len(raw)} jobs in {time.time() - begin:.0f} s, {cpu:.0f} s of processor time; {folder / 'answers.json'}{f'; files kept in {work}' if keep else ''}\n")
    for line in trouble:
        sys.stdout.write(f"unexpected: {line}\n")
    return 0


# --------------------------------------------------------------------------------------------------------------- compare


def share(a: dict, b: dict) -> float:
    """How far two digests of arrays are apart, as a share of the norm; infinite where they cannot be compared."""
    if a.get("shape") != b.get("shape") or a.get("not_finite") != b.get("not_finite"):
        return math.inf
    keys = [k for k in ("value", "norm", "along", "min", "max") if a.get(k) is not None and b.get(k) is not None]
    if not keys:
        return math.inf
    first, second = ([float(d[k]) for k in keys] for d in (a, b))
    scale = max(map(abs, first + second)) or 1.0
    return max(abs(p - q) for p, q in zip(first, second)) / scale


def text_difference(where: str, old: str | list, new: str | list, lines: int) -> list[str]:
    old, new = (t.split("\n") if isinstance(t, str) else t for t in (old, new))
    changed = [l for l in difflib.unified_diff(old, new, lineterm="", n=0) if not l.startswith(("---", "+++", "@@"))]
    told = [f"    {l[:400]}" for l in changed[:lines]]
    return [f"  {where}:", *told, *([f"    ... {len(changed) - lines} more lines"] if len(changed) > lines else [])]


def compare(first: Path, second: Path, close: float, lines: int) -> int:
    old, new = (json.loads(p.read_text())["jobs"] for p in (first, second))
    bad = 0
    rounded = 0
    for name in [*old, *(n for n in new if n not in old)]:
        said: list[str] = []
        if name not in new or name not in old:
            said.append(f"  only in {'the old' if name in old else 'the new'} record")
        else:
            a, b = old[name], new[name]
            if a["command"] != b["command"]:
                said.append(f"  command: {a['command']} -> {b['command']}")
            if a["status"] != b["status"]:
                said.append(f"  status: {a['status']} -> {b['status']}")
            for stream in ("stdout", "stderr"):
                if a[stream] != b[stream]:
                    said += text_difference(stream, a[stream], b[stream], lines)
            if a.get("gone", []) != b.get("gone", []):
                said.append(f"  files removed: {a.get('gone', [])} -> {b.get('gone', [])}")
            for file in [*a["files"], *(f for f in b["files"] if f not in a["files"])]:
                x, y = a["files"].get(file), b["files"].get(file)
                if x is None or y is None:
                    said.append(f"  {file}: only in the {'new' if x is None else 'old'} record")
                    continue
                inner: list[str] = []
                for key in [*x, *(k for k in y if k not in x)]:
                    p, q = x.get(key), y.get(key)
                    if p == q:
                        continue
                    if isinstance(p, dict) and isinstance(q, dict):
                        apart = share(p, q)
                        if apart <= close:
                            rounded += 1
                            continue
                        kind = "" if p.get("dtype") == q.get("dtype") else f" {p.get('dtype')} -> {q.get('dtype')}"
                        shape = "" if p.get("shape") == q.get("shape") else f" shape {p.get('shape')} -> {q.get('shape')}"
                        value = f" {p['value']} -> {q['value']}" if "value" in p and "value" in q else ""
                        inner.append(f"    {key}: numbers differ{kind}{shape}{value}, by {apart:.2g} of their size")
                    elif isinstance(p, str) and isinstance(q, str):
                        try:
                            number = abs(float(p) - float(q)) <= close * max(abs(float(p)), abs(float(q)))
                        except ValueError:
                            number = False
                        if number:
                            rounded += 1
                            continue
                        if "\n" in p + q or len(p) + len(q) > 200:
                            inner += [f"  {l}" for l in text_difference(key or "text", p, q, lines)]
                        else:
                            inner.append(f"    {key}: {p} -> {q}")
                    else:
                        inner.append(f"    {key}: {'missing' if p is None else 'there'} -> {'missing' if q is None else 'there'}")
                if inner:
                    said.append(f"  {file}:")
                    said += inner[:lines]
                    if len(inner) > lines:
                        said.append(f"    ... {len(inner) - lines} more")
        if said:
            bad += 1
            sys.stdout.write("\n".join([f"{name}   [{(old.get(name) or new[name])['command'][:160]}]", *said]) + "\n")
    close_words = f"; {rounded} numbers or arrays differ by {close:g} of their size or less" if rounded else ""
    sys.stdout.write(f"{bad} of {len(set(old) | set(new))} jobs differ{close_words}\n")
    return 1 if bad else 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="what", required=True)
    one = commands.add_parser("record")
    one.add_argument("interpreter", type=Path)
    one.add_argument("folder", type=Path)
    one.add_argument("--core", type=int, help="the core to use; the last one")
    one.add_argument("--only", help="regular expression: jobs to run (later jobs need the files of earlier ones)")
    one.add_argument("--keep", action="store_true", help="keep the working folder")
    one.add_argument("--merge", action="store_true", help="keep the other jobs that are in FOLDER/answers.json; with --only and --work")
    one.add_argument("--work", type=Path, help="the working folder, new or empty")
    two = commands.add_parser("compare")
    two.add_argument("old", type=Path)
    two.add_argument("new", type=Path)
    two.add_argument("--close", type=float, default=0.0)
    two.add_argument("--lines", type=int, default=12)
    again = commands.add_parser("normalise", help="make answers.json anew from raw.json, after a change of what is left out")
    again.add_argument("folder", type=Path)
    commands.add_parser("list")
    commands.add_parser("worker")
    commands.add_parser("server")
    asked = parser.parse_args()
    if asked.what == "worker":
        return worker()
    if asked.what == "server":
        return server()
    if asked.what == "list":
        for job in jobs():
            if "prepare" not in job:
                sys.stdout.write(f"{job['name']}\t{'python -c ...' if 'code' in job else 'sgns ' + ' '.join(job['args'])}\n")
        return 0
    if asked.what == "normalise":
        normalise(asked.folder)
        return 0
    if asked.what == "compare":
        return compare(asked.old, asked.new, asked.close, asked.lines)
    interpreter = Path(os.path.abspath(asked.interpreter))  # not resolved: a virtual environment's is a link
    return record(interpreter, asked.folder.absolute(), asked.core, asked.only, asked.keep, asked.work and asked.work.absolute(), asked.merge)


if __name__ == "__main__":
    sys.exit(main())

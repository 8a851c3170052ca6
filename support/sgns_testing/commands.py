"""Settings with which every command takes a second, and how tests call them."""

import contextlib
import io
import logging
import os
import subprocess
import sys
from pathlib import Path

import torch
from hydra import compose, initialize_config_module
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig

from sgns.cli.commands import main
from sgns.simulate.scene import scene_from_config
from sgns_testing.tiny import make_dataset

SMALL = [
    *("scene.bed.size=[0.4,0.2,0.16]", "scene.bed.spacing=0.04", "scene.duration=0.2", "scene.speed=0.05"),
    *(
        "scene.blade.length=0.1",
        "scene.blade.width=0.1",
        "scene.blade.thickness=0.08",
        "scene.blade.edge=square",
    ),
]
SHORT = [
    *("scene.bed.size=[0.4,0.2,0.16]", "scene.bed.spacing=0.04", "scene.bed.particles_per_cell=1"),
    *(
        "scene.duration=0.05",
        "scene.blade={length: 0.1, width: 0.1, thickness: 0.08, friction: 0.3, edge: square}",
    ),
]
REDUCED = ["reduction.max_modes=6", "reduction.num_modes=3"]
TRAIN = [
    *REDUCED,
    *("model.hidden_width=8", "model.message_passing_steps=1", "training.threads=1"),
    *("training.max_steps=2", "training.validate_every=2", "training.warmup_steps=0"),
]


def call(*arguments: str) -> subprocess.CompletedProcess[str]:
    """A command, called in this process: its status, and what it says on standard output and standard error."""
    GlobalHydra.instance().clear()
    root, before, said = logging.getLogger(), sys.argv, (io.StringIO(), io.StringIO())
    handlers, level, threads = root.handlers[:], root.level, torch.get_num_threads()
    sys.argv = ["sgns", *arguments]
    try:
        with contextlib.redirect_stdout(said[0]), contextlib.redirect_stderr(said[1]):
            status = main()
    except SystemExit as stop:
        status = stop.code or 0
    finally:
        sys.argv = before
        for handler in set(root.handlers) - set(handlers):  # Hydra's
            handler.close()
        root.handlers[:] = handlers
        root.setLevel(level)
        torch.set_num_threads(threads)
    return subprocess.CompletedProcess(arguments, status, *(one.getvalue() for one in said))


def refused(*arguments: str) -> str:
    """The one line with which a command ends that has wrong settings or cannot go on."""
    done = call(*arguments)
    assert done.returncode == 2 and done.stderr.count("\n") == 1, done
    return done.stderr


def sgns(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """`call` in a folder."""
    before = Path.cwd()
    os.chdir(folder)
    try:
        return call(*arguments)
    finally:
        os.chdir(before)


def refusal(folder: Path, *arguments: str) -> str:
    """The line with which a command refuses in a folder where nothing is written."""
    before = sorted(folder.iterdir())
    done = sgns(folder, *arguments)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert sorted(folder.iterdir()) == before
    return done.stderr


def composed(*overrides: str, command: str = "simulate") -> DictConfig:
    """The settings of `sgns <command> <overrides>`."""
    GlobalHydra.instance().clear()
    with initialize_config_module("sgns.conf", version_base="1.3"):
        return compose(command, list(overrides))


def environment() -> dict[str, str]:
    """Of a process that finds this package, too."""
    return os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}


def python(code: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    """Another process that runs some code with these arguments."""
    command = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=100, env=environment())


def files(folder: Path) -> dict[str, bytes]:
    """Everything in a folder, the records that commands write about themselves left out."""
    kept = (path for path in folder.rglob("*") if path.is_file() and path.parent.name != "tensorboard")
    return {
        str(p.relative_to(folder)): p.read_bytes()
        for p in kept
        if p.suffix != ".log" and ".hydra" not in p.parts
    }


def small_dataset(folder: Path) -> None:
    """Synthetic runs of as many particles as the small scene has, and that say they are of it: what is trained on them
    can roll the scene out."""
    scene = scene_from_config(composed(*SMALL))
    make_dataset(folder, n=len(scene.stored), arrangement_hash=scene.arrangement_hash, scene=scene.to_dict())

"""A bed so small that every command takes a second, and commands called in this process."""

from __future__ import annotations

import contextlib
import io
import sys
from pathlib import Path

from hydra import compose, initialize_config_module
from hydra.core.global_hydra import GlobalHydra
from tiny import make_dataset

from sgns.cli.commands import main
from sgns.simulate.scene import scene_from_config

__all__ = ["REDUCED", "SMALL", "TRAIN", "call", "small_dataset"]

SMALL = [
    *("scene.bed.size=[0.4,0.2,0.16]", "scene.bed.spacing=0.04", "scene.duration=0.2", "scene.speed=0.05"),
    *("scene.blade.length=0.1", "scene.blade.width=0.1", "scene.blade.thickness=0.08"),
]
REDUCED = ["reduction.max_modes=6", "reduction.num_modes=3"]
TRAIN = [
    *REDUCED,
    *("model.hidden_width=8", "model.message_passing_steps=1", "training.threads=1"),
    *("training.max_steps=2", "training.validate_every=2", "training.warmup_steps=0"),
]


def call(*arguments: str) -> tuple[int, str]:
    """Status of a command and what it says on standard error."""
    GlobalHydra.instance().clear()
    said, before = io.StringIO(), sys.argv
    sys.argv = ["sgns", *arguments]
    try:
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
            status = main()
    finally:
        sys.argv = before
    return status, said.getvalue()


def small_dataset(folder: Path) -> None:
    """Synthetic runs of as many particles as the small scene has, and that say they are of it: what is trained on them
    can roll the scene out."""
    GlobalHydra.instance().clear()
    with initialize_config_module("sgns.conf", version_base="1.3"):
        scene = scene_from_config(compose("simulate", SMALL))
    make_dataset(folder, n=len(scene.stored), arrangement_hash=scene.arrangement_hash, scene=scene.to_dict())

"""What the experiments share: settings as the command line puts them together, and tables."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_module
from omegaconf import DictConfig, OmegaConf

from mpm_warp import Effects, Scene
from sgns.simulate.scene import asked_effects, decided, scene_from_config


def composed(command: str, *overrides: str) -> DictConfig:
    """Settings of `sgns <command> <overrides>`."""
    with initialize_config_module("sgns.conf", version_base="1.3"):
        return compose(command, list(overrides))


def training_settings(*overrides: str) -> dict[str, Any]:
    """Settings of `sgns train <overrides>` as plain values."""
    config = composed("train", *overrides)
    config.output = ""
    plain = OmegaConf.to_container(config, resolve=True)
    assert isinstance(plain, dict)
    return plain


def scene_of(*overrides: str) -> tuple[Scene, Effects]:
    """The scene of `sgns simulate <overrides>` and the effects that it is computed with."""
    config = composed("simulate", *overrides)
    scene = scene_from_config(config)
    return scene, decided(scene, asked_effects(config))[0]


def read_rows(file: Path) -> list[dict[str, str]]:
    """Rows of a table; none where there is no file."""
    if not file.exists():
        return []
    with file.open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def write_rows(file: Path, rows: Iterable[Mapping[str, Any]], digits: int = 4) -> None:
    """Write a table with all columns that any row has, numbers with so many digits."""
    rows = list(rows)
    with file.open("w", newline="", encoding="utf-8") as stream:
        columns = dict.fromkeys(key for row in rows for key in row)
        writer = csv.DictWriter(stream, list(columns), restval="", lineterminator="\n")
        writer.writeheader()
        for row in rows:
            writer.writerow({k: f"{v:.{digits}g}" if isinstance(v, float) else v for k, v in row.items()})

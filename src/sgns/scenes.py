"""From conf to a scene of mpm_warp."""

from __future__ import annotations

import csv
import io
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from mpm_warp import Scene
from mpm_warp.inputs import read_text
from sgns.errors import UserError

__all__ = ["read_path", "scene_from_config"]


_MOST_BYTES = 1 << 26
"""Of a path file: a minute in steps of a millisecond takes a tenth of that."""


def scene_from_config(cfg: DictConfig) -> Scene:
    """The scene in `cfg.scene` with the soil in `cfg.material`; a path file is read into the scene."""
    data = OmegaConf.to_container(cfg.scene, resolve=True)
    data["material"] = OmegaConf.to_container(cfg.material, resolve=True)
    if isinstance(data.get("path"), str):
        data["path"] = read_path(Path(data["path"]))
    return Scene.from_dict(data)


def read_path(file: Path) -> list[list[float]]:
    """Rows t, x, y, z, qx, qy, qz, qw of a CSV file with a header line."""
    wanted = ["t", "x", "y", "z", "qx", "qy", "qz", "qw"]
    try:
        rows = csv.reader(io.StringIO(read_text(file, _MOST_BYTES), newline=""))
        first = next(rows, [])
    except (OSError, ValueError, csv.Error) as error:
        raise UserError(f"scene.path: cannot read {file}: {error}") from None
    if [name.strip() for name in first] != wanted:
        raise UserError(f"scene.path: the first line of {file} must be {','.join(wanted)}")
    values: list[list[float]] = []
    number = 1
    try:
        for number, row in enumerate(rows, start=2):
            if len(row) != len(wanted):
                raise UserError(
                    f"scene.path: line {number} of {file} has {len(row)} values instead of {len(wanted)}"
                )
            values.append([float(v) for v in row])
    except csv.Error as error:
        raise UserError(f"scene.path: cannot read {file} after line {number}: {error}") from None
    except ValueError:
        raise UserError(f"scene.path: line {number} of {file} holds something that is not a number") from None
    return values

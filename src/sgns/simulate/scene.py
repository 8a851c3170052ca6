"""From the settings to a scene, and to the effects that it calls for."""

from __future__ import annotations

import copy
import csv
import io
import re
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, cast

from omegaconf import DictConfig, OmegaConf

from mpm_warp import Decision, Effects, Preview, Scene, Tolerances, effects_for
from mpm_warp.inputs import read_text
from sgns.config import UserError, flattened

# --- From conf to a scene of mpm_warp -------------------------------------------------------------------

_MOST_BYTES = 1 << 26
"""Of a path file: a minute in steps of a millisecond takes a tenth of that."""


def scene_from_config(cfg: DictConfig) -> Scene:
    """The scene in `cfg.scene` with the soil in `cfg.material`; a path file is read into the scene."""
    return scene_from_data(plain(cfg.scene) | {"material": plain(cfg.material)})


def scene_from_data(data: dict[str, Any]) -> Scene:
    """A scene from nested data, in which `path` may be the name of a file."""
    if isinstance(data.get("path"), str):
        data = {**data, "path": read_path(Path(data["path"]))}
    return Scene.from_dict(data)


def plain(group: DictConfig) -> dict[str, Any]:
    """A group of settings as plain data."""
    return cast(dict[str, Any], OmegaConf.to_container(group, resolve=True))


def replaced(data: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of nested settings with other values at some dotted keys."""
    found = copy.deepcopy(dict(data))
    for key, value in flattened(changes).items():
        *groups, last = key.split(".")
        place = found
        for group in groups:
            if not isinstance(place.get(group), dict):
                place[group] = {}
            place = place[group]
        place[last] = value
    return found


def read_path(file: Path) -> list[list[float]]:
    """Rows t, x, y, z, qx, qy, qz, qw of a CSV file.

    A first line with these names may be there or not. Blank lines, commas at the end of a line and what stands behind
    a # are left out.
    """
    wanted = ["t", "x", "y", "z", "qx", "qy", "qz", "qw"]
    values: list[list[float]] = []
    number, first = 0, True
    try:
        rows = csv.reader(io.StringIO(read_text(file, _MOST_BYTES), newline=""))
        for number, cells in enumerate(rows, start=1):
            row = _without_comment(cells)
            if not row:
                continue
            if not first or _is_number(row[0]):
                if len(row) != len(wanted):
                    raise UserError(
                        f"scene.path: line {number} of {file} has {len(row)} values instead of {len(wanted)}"
                    )
                if not all(map(_is_number, row)):
                    raise UserError(
                        f"scene.path: line {number} of {file} holds something that is not a number"
                    )
                values.append([float(v) for v in row])
            elif [name.lower() for name in row] != wanted:
                raise UserError(f"scene.path: the first line of {file} must be {','.join(wanted)}")
            first = False
    except csv.Error as error:
        raise UserError(f"scene.path: cannot read {file} after line {number}: {error}") from None
    except (OSError, ValueError) as error:
        raise UserError(f"scene.path: cannot read {file}: {error}") from None
    if first:
        raise UserError(f"scene.path: {file} is empty; it needs rows {','.join(wanted)}")
    return values


def _without_comment(cells: list[str]) -> list[str]:
    """What a line of a table says: nothing from a # on, and no empty cells at the end."""
    row = [cell.strip() for cell in ",".join(cells).partition("#")[0].split(",")]
    while row and not row[-1]:
        row.pop()
    return row


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def warning_summary(scenes: Mapping[str, Scene]) -> list[str]:
    """What a user should know about the runs of a dataset before they are made, by name: one line for each kind of
    warning, with how often it comes and the words of the first."""
    found: dict[str, list[str]] = {}
    for name, scene in scenes.items():
        for words in Preview.of(scene).warnings:
            found.setdefault(re.sub(r"[\d.e+-]*\d", "", words), []).append(f"{name}: {words}")
    lines = [f"{len(every)} of {len(scenes)} runs, such as {every[0]}" for every in found.values()]
    if len({scene.arrangement_hash for scene in scenes.values()}) > 1:
        lines.append(
            "the runs do not start from the same particles, and `sgns reduce` takes one bed: let all tools begin above "
            "the soil, or at one place in it, and draw no keys of scene.bed"
        )
    return lines


# --- From the group `effects` of the settings to the physics of one scene -------------------------------


def asked_effects(cfg: DictConfig) -> dict[str, Any]:
    """`cfg.effects` as plain data: each effect true, false or auto, and the group `tolerance`."""
    asked = plain(cfg.effects)
    asked.pop("nonlocal", None)  # its other name has its value
    return asked


def decided(scene: Scene, asked: Mapping[str, Any]) -> tuple[Effects, dict[str, Decision]]:
    """The effects of a scene, and the decision about each, for effects asked for as `asked_effects` gives them.

    Raises:
        SceneError: effects or tolerances are not what they should be, or the scene cannot have them.
    """
    switches = dict(asked)
    tolerance = switches.pop("tolerance", None)
    return effects_for(scene, switches, Tolerances.from_dict({} if tolerance is None else tolerance))


def recorded(decisions: Mapping[str, Decision]) -> dict[str, dict[str, Any]]:
    """Decisions as a run file keeps them."""
    return {name: decision._asdict() for name, decision in decisions.items()}


def decision_line(name: str, decision: Decision) -> str:
    """A decision for people to read."""
    return f"{name} {'on' if decision.on else 'off'}: {decision.reason}"


def decision_summary(every: Iterable[Mapping[str, Decision]]) -> list[str]:
    """One line for each effect over all runs of a dataset: how often it is on, and the most frequent reason."""
    lines, every = [], list(every)
    for name in every[0]:
        made = [decisions[name] for decisions in every]
        on = sum(decision.on for decision in made)
        if on in (0, len(made)):
            lines.append(f"{decision_line(name, made[0])}{' (the first run)' if len(made) > 1 else ''}")
        else:
            reasons = Counter(decision.reason for decision in made if not decision.on)
            lines.append(f"{name} on in {on} of {len(made)} runs; else off: {reasons.most_common(1)[0][0]}")
    return lines

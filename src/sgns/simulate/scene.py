"""Scenes from settings, the effects they call for, and tool paths: read from files, or drawn by chance."""

from __future__ import annotations

import copy
import csv
import io
import math
import os
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
from omegaconf import DictConfig, OmegaConf
from scipy.interpolate import PchipInterpolator

from mpm_warp import Bed, Decision, Effects, Preview, Scene, SceneError, Soil, Tolerances, effects_for
from mpm_warp.bed import MOST_HEIGHTS
from mpm_warp.bodies import Tool
from mpm_warp.poses import rotation_matrices
from mpm_warp.settings import read_bytes, read_text, short
from sgns.config import UserError, flattened
from sgns.data.files import one_line
from sgns.data.run import Run

# --- From conf to a scene of mpm_warp -------------------------------------------------------------------

_MOST_BYTES = 1 << 26
"""Of a path file: a minute in steps of a millisecond takes a tenth of that."""
_COLUMNS = ["t", "x", "y", "z", "qx", "qy", "qz", "qw"]


def scene_from_config(cfg: DictConfig, overrides: Sequence[str] = ()) -> Scene:
    """The scene in `cfg.scene` with the soil in `cfg.material`; a path file is read into the scene. The command's
    `overrides` say who decides about a wheel's soil, see `data_from_config`."""
    return scene_from_data(data_from_config(cfg, overrides))


_OF_FRICTION = ("material.friction_angle", "material.static_friction")


def data_from_config(cfg: DictConfig, overrides: Sequence[str]) -> dict[str, Any]:
    """Scene and soil of `cfg` as nested data. A soil or friction that the command's `overrides` choose goes before
    the friction angle that a scene has by default."""
    data = plain(cfg.scene) | {"material": plain(cfg.material)}
    given = {key: value for key, _, value in (one.lstrip("+~").partition("=") for one in overrides)}
    chosen = given.get("material", "sand") != "sand" or any(key in given for key in _OF_FRICTION)
    if chosen and "friction_angle" in data and "scene.friction_angle" not in given:
        data["friction_angle"] = None
    return data


def scene_from_data(data: dict[str, Any]) -> Scene:
    """A scene from nested data, in which `bed.surface`, `path` and those of further bodies may be names of files."""
    if isinstance(data.get("bed"), dict) and isinstance(data["bed"].get("surface"), str):
        data = replaced(data, {"bed.surface": read_heights(Path(data["bed"]["surface"]))})
    read: dict[str, tuple[Path, list[int]]] = {}

    def with_path(body: Any, place: str) -> Any:
        """A body's data with the rows of its path file; remembers which line each row was."""
        if not isinstance(body, dict) or not isinstance(body.get("path"), str):
            return body
        file = Path(body["path"])
        rows = _rows_by_line(file, f"{place}.path")
        read[place] = file, list(rows)
        return {**body, "path": list(rows.values())}

    data = with_path(data, "scene")
    if isinstance(others := data.get("others"), list):
        every = [with_path(one, f"scene.others[{number}]") for number, one in enumerate(others)]
        data = {**data, "others": every}
    try:
        return Scene.from_dict(data)
    except SceneError as error:  # its rows are lines of the file
        further = re.search(r"scene\.others\[\d+\]", words := str(error))
        file, lines = read.get(further[0] if further else "scene", (None, []))
        if file is None or "bed.surface" in words:  # whose rows are others
            raise
        words = re.sub(r"\brow (\d+)", lambda row: f"line {lines[int(row[1]) - 1]} of {file}", words)
        raise SceneError(words) from None


_FROM_THE_RUN = ("bed", "material", "gravity", "tilt")
"""Of the scene: what the run to start from says, unless the command does."""


def soil_of(words: str) -> Soil:
    """What `start_from` names: a run, or run@frame with the number of its last frame.

    Raises:
        UserError: the file is no run with a state, or another frame is asked for.
    """
    name, _, frame = words.rpartition("@")
    if Path(words).exists() or not name or not re.fullmatch(r"-?\d+", frame):
        name, frame = words, "-1"
    with Run(name) as run:
        last = run.frame_count - 1
        if int(frame) not in (-1, last):
            raise UserError(
                f"start_from: {name} keeps stresses and all else that soil remembers for its last frame only, number "
                f"{last}; for frame {frame} simulate it again with scene.duration={int(frame) / run.frame_rate:.6g}"
            )
        return run.soil


def scene_on(soil: Soil, cfg: DictConfig, overrides: Sequence[str]) -> Scene:
    """The scene of `cfg` in the bed and soil of another run; gravity and tilt are that run's, too, if the command's
    `overrides` do not say otherwise.

    Raises:
        SceneError: they say something of bed or soil that does not fit.
    """
    data, there = plain(cfg.scene) | {"material": plain(cfg.material)}, soil.scene.to_dict()
    given = {one.lstrip("+~").partition("=")[0] for one in overrides} - {"scene"}  # which chooses a kind
    for key, value in flattened({name: there[name] for name in _FROM_THE_RUN}).items():
        place = key if key.startswith("material") else f"scene.{key}"
        if not any(place == one or place.startswith(f"{one}.") for one in given):
            data = replaced(data, {key: value})
    if "friction_angle" in data and "scene.friction_angle" not in given:
        data["friction_angle"] = None  # the soil's own
    return scene_from_data(data).starting_from(soil)


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
    return list(_rows_by_line(file).values())


def _rows_by_line(file: Path, place: str = "scene.path") -> dict[int, list[float]]:
    """As `read_path`, by the number of the line; errors name the setting `place`."""
    values: dict[int, list[float]] = {}
    first, rows = True, csv.reader([])
    try:
        rows = csv.reader(io.StringIO(read_text(file, _MOST_BYTES), newline=""))
        for cells in rows:
            row = _without_comment(cells)
            if not row:
                continue
            if len(row) == len(_COLUMNS) and all(map(_is_number, row)):
                values[rows.line_num] = [float(value) for value in row]
            elif not first or [name.lower() for name in row] != _COLUMNS:
                raise UserError(f"{place}: {_not_a_row(file, rows.line_num, row, first)}")
            first = False
    except csv.Error as error:
        raise UserError(f"{place}: cannot read {file} after line {rows.line_num}: {error}") from None
    except (OSError, ValueError) as error:
        words = getattr(error, "strerror", None) or error
        raise UserError(f"{place}: cannot read {file}: {words}") from None
    if first:
        raise UserError(f"{place}: {file} is empty; it needs rows {','.join(_COLUMNS)}")
    return values


def _not_a_row(file: Path, number: int, row: list[str], first: bool) -> str:
    """What is wrong with a line of a path."""
    text, names = ",".join(row), [name.lower() for name in row]
    begin = f"line {number} of {file} is {short(text)}"
    for mark, words in ((";", "semicolons"), ("\t", "tabs"), (None, "spaces")):
        if len(row) < len(_COLUMNS) <= len(text.split(mark)):
            return f"{begin}: its values have {words} between them; they need commas (and points in 0.5)"
    if not first or _is_number(row[0]):
        if len(row) != len(_COLUMNS):
            return f"{begin}: {len(row)} values instead of {len(_COLUMNS)}: {','.join(_COLUMNS)}"
        return f"{begin}: {next(cell for cell in row if not _is_number(cell))!r} is not a number"
    missing = [name for name in _COLUMNS if name not in names]
    if not missing:
        return f"{begin}: the columns must stand in this order, and no others: {','.join(_COLUMNS)}"
    return f"{begin}: it lacks {', '.join(missing)}; the first line must be {','.join(_COLUMNS)}, or there is none"


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


def read_heights(file: Path) -> list[list[float]]:
    """A map of heights [m] for `scene.bed.surface`: rows from x = 0 to Lx of heights from y = 0 to Ly.

    A `.npy` array or a table (`.csv`, `.txt`) is such rows. A TIFF of decimal numbers is a map seen from above: its
    first line is the far side, y = Ly, and its columns go along x.
    """
    kind, allowed = file.suffix.lower(), ".npy, .csv, .txt, .tif"
    try:
        content = read_bytes(file, _MOST_BYTES)
        if kind == ".npy":
            found = np.load(io.BytesIO(content), allow_pickle=False)
            if not isinstance(found, np.ndarray):
                raise ValueError("it is an archive of arrays; save one array with numpy.save")
        elif kind in (".csv", ".txt"):
            mark = "," if b"," in content else None
            found = np.loadtxt(io.StringIO(content.decode("utf-8-sig")), delimiter=mark, ndmin=2)
        elif kind in (".tif", ".tiff"):
            found = _read_tiff(content)
        else:
            raise ValueError(f"it is no map of heights in metres; allowed: {allowed}")
        if found.ndim != 2 or found.dtype.kind not in "fiu":
            raise ValueError(
                f"it holds {found.dtype} of shape {found.shape}; a map of heights has rows of numbers"
            )
    except (OSError, ValueError, EOFError, MemoryError) as error:
        words = one_line(getattr(error, "strerror", None) or error)
        raise UserError(f"scene.bed.surface: cannot read {file}: {words}") from None
    return found.astype(float).tolist()


def _read_tiff(content: bytes) -> np.ndarray:
    from PIL import Image

    try:
        opened = Image.open(io.BytesIO(content), formats=["TIFF"])
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise ValueError(f"{error}; at most {MOST_HEIGHTS} heights are allowed; coarsen it") from None
    with opened as picture:
        if picture.mode != "F":
            raise ValueError(
                "its heights are whole numbers, of no unit; save them as decimal numbers, in metres"
            )
        if picture.width * picture.height > MOST_HEIGHTS:
            raise ValueError(
                f"it holds {picture.width} x {picture.height} heights, at most {MOST_HEIGHTS} are allowed; coarsen it"
            )
        return np.asarray(picture)[::-1].T


def require_meant(preview: Preview, remedy: str, name: str = "") -> None:
    """Refuses a scene that would come to nothing because its numbers are in another unit.

    Raises:
        UserError: what looks wrong in the scene `name`, and how to begin all the same.
    """
    if preview.not_meant:
        raise UserError(f"{name}{preview.not_meant[0]}; if it is meant: {remedy}")


def warning_summary(scenes: Mapping[str, Scene], any_unit: bool = False) -> list[str]:
    """What a user should know about the runs of a dataset before they are made, by name: one line for each kind of
    warning, with how often it comes and the words of the first.

    Raises:
        UserError: a run would come to nothing because its numbers are in another unit, unless `any_unit` is true.
    """
    found: dict[str, list[str]] = {}
    for name, scene in scenes.items():
        preview = Preview.of(scene)
        if not any_unit:
            require_meant(preview, "limits.any_unit=true", f"{name}: ")
        for words in preview.warnings:
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


def effects_line(every: Sequence[Mapping[str, Decision]]) -> str:
    """The effects of all runs of a dataset, or of one run, in a line: what is on; and why, where a number decided it,
    where it is another in some runs, and where it was asked for against it."""
    on, told = [], []
    for name in every[0]:
        made = [decisions[name] for decisions in every]
        first, count = made[0], sum(decision.on for decision in made)
        if 0 < count < len(made):
            reasons = Counter(decision.reason for decision in made if not decision.on)
            told.append(f"{name} on in {count} of {len(made)} runs; else off: {reasons.most_common(1)[0][0]}")
        elif first.reason.startswith("asked for; auto") or (first.on and first.number is not None):
            told.append(f"{name} {'on' if first.on else 'off'}: {first.reason}")
        elif first.on:
            on.append(name)
    return "; ".join([f"effects on: {', '.join(on) or 'no others'}", *told, "the run file has every reason"])


# --- Tool paths drawn by chance, to simulate and to train on --------------------------------------------


_ROWS_PER_SECOND = 30
_PLACES = 5
"""Of a path, between which it is smooth; the tool is above the soil at the first and the last."""


def random_paths(
    count: int,
    tool: Tool,
    bed: Bed,
    *,
    duration: float = 2.0,
    depth: float = 0.06,
    tilt: float = 15.0,
    seed: int = 0,
    folder: str | os.PathLike[str] | None = None,
) -> list[np.ndarray]:
    """Smooth paths through the bed along +x: into the soil, through it and out again.

    The tool begins and ends at rest and above the soil. It stays three grid spacings away from walls and floor.
    Path number i is the same whatever the count.

        random_paths(60, MeshBody(file="bucket.stl", scale=0.001), Bed(spacing=0.02), folder="paths")

    Args:
        count: how many.
        tool: that is to follow them.
        bed: that it moves through.
        duration: of each path [s].
        depth: greatest depth of the tool's lowest point [m]; every path draws its own, from a quarter of it on.
        tilt: largest angle about y [degrees].
        seed: of the draws.
        folder: where to write them as path_000.csv and so on, for `scene.path`; None: nowhere.

    Returns:
        Paths with rows t [s], x, y, z [m], qx, qy, qz, qw, each of shape (T, 8).

    Raises:
        UserError: the tool has no room to move, or a number is out of range.
    """
    for name, value, good, allowed in (
        ("count", count, 1 <= count <= 100_000, "1 to 100000"),
        ("duration", duration, 0.1 <= duration <= 1000.0, "0.1 to 1000 s"),
        ("tilt", tilt, 0.0 <= tilt <= 60.0, "0 to 60 degrees"),
    ):
        if not good:
            raise UserError(f"{name} is {value}; allowed: {allowed}")
    lx, ly, lz = bed.size
    away, outline = 3.0 * bed.spacing, tool.outline()
    if not 0.0 < depth <= lz - away:
        raise UserError(
            f"depth is {depth} m; allowed: above 0 up to {lz - away:g} m, three grid spacings above the floor"
        )
    reach = np.hypot(outline[:, 0], outline[:, 2]).max()
    low = np.array([away + reach, away - outline[:, 1].min()])
    high = np.array([lx - away - reach, ly - away - outline[:, 1].max()])
    if not (low[0] < high[0] and low[1] <= high[1]):
        raise UserError(
            f"the tool has no room in a bin of {lx:g} x {ly:g} m with three grid spacings to every wall; use a larger "
            "bed.size or check the unit of the tool"
        )
    times = np.linspace(0.0, duration, max(2, round(duration * _ROWS_PER_SECOND)) + 1)
    paths = []
    for number in range(count):
        rng = np.random.default_rng([seed, number])
        places = _places(rng, low, high, bed.spacing, depth, math.radians(tilt))
        x, y, lowest, angle = PchipInterpolator(np.linspace(0.0, 1.0, _PLACES), places, axis=0)(
            _eased(times / duration)
        ).T
        zero = np.zeros_like(angle)
        turned = np.stack([zero, np.sin(0.5 * angle), zero, np.cos(0.5 * angle)], axis=-1)
        z = lowest - np.array([(outline @ matrix[2]).min() for matrix in rotation_matrices(turned)])
        paths.append(np.column_stack([times, x, y, z, turned]))
    if folder is not None:
        _write(paths, Path(folder))
    return paths


def _places(
    rng: np.random.Generator, low: np.ndarray, high: np.ndarray, spacing: float, depth: float, tilt: float
) -> np.ndarray:
    """Where a path passes: x, y, height of the tool's lowest point [m] and angle about y, shape (_PLACES, 4)."""
    begin, end = low[0], high[0]
    share = np.cumsum(rng.uniform(0.5, 1.5, _PLACES - 1))
    travel = rng.uniform(0.5, 1.0) * (end - begin)
    x = begin + rng.uniform(0.0, end - begin - travel) + travel * np.concatenate([[0.0], share / share[-1]])
    across = 0.25 * (high[1] - low[1])
    y = np.clip(0.5 * (low[1] + high[1]) + rng.uniform(-across, across), low[1], high[1])
    y = np.clip(y + rng.uniform(-0.2, 0.2, _PLACES) * across, low[1], high[1])
    deepest = depth * rng.uniform(0.25, 1.0)
    inside = -deepest * rng.uniform(0.5, 1.0, _PLACES - 2)
    inside[rng.integers(_PLACES - 2)] = -deepest
    lowest = np.concatenate([[spacing], inside, [spacing]])
    return np.stack([x, y, lowest, rng.uniform(-tilt, tilt, _PLACES)], axis=-1)


def _eased(share: np.ndarray) -> np.ndarray:
    """From 0 to 1 with speed 0 at both ends, for a tenth of the time; constant speed between."""
    ease = 0.1
    rest = 1.0 - ease
    s = np.minimum(share, 1.0 - share)
    way = np.where(s < ease, s**2 / (2.0 * ease), s - 0.5 * ease) / rest
    return np.where(share <= 0.5, way, 1.0 - way)


def _write(paths: list[np.ndarray], folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for number, path in enumerate(paths):
            with open(folder / f"path_{number:03d}.csv", "w", newline="", encoding="utf-8") as file:
                rows = csv.writer(file, lineterminator="\n")
                rows.writerow("t x y z qx qy qz qw".split())
                rows.writerows([f"{value:.9g}" for value in row] for row in path)
    except OSError as error:
        raise UserError(f"cannot write {error.filename or folder}: {error.strerror}") from None

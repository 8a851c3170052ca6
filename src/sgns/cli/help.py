"""What the command line says: help, lines in the terminal, tables of sweeps, one line for wrong settings."""

from __future__ import annotations

import csv
import difflib
import io
import json
import logging
import math
import os
import re
import sys
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Any, TextIO

import yaml

from sgns.config import UserError, shared_overrides

if TYPE_CHECKING:
    from hydra.errors import ConfigCompositionException, MissingConfigException, OverrideParseException
    from omegaconf import Container
    from omegaconf.errors import ConfigAttributeError, ConfigKeyError

# --- The terminal: how log lines look, and what becomes of text that cannot be written ------------------


class LineFormatter(logging.Formatter):
    """Plain text for information, the level's name first for warnings and errors."""

    def format(self, record: logging.LogRecord) -> str:
        line = super().format(record)
        if record.name.startswith("hydra") and line.startswith("\t#"):  # Hydra's line for each job
            for one in shared_overrides:
                line = line.replace(f" {one}", "", 1)
        return f"{record.levelname.lower()}: {line}" if record.levelno >= logging.WARNING else line


def open_closed_streams() -> None:
    """Let standard streams that were closed (`2>&-`) lead nowhere.

    Otherwise the next file that is opened gets the stream's number, and messages of libraries are written into it.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            nowhere = os.open(os.devnull, os.O_RDWR)  # the lowest number that is free
            os.set_inheritable(nowhere, True)
            stream = open(nowhere, "r" if number == 0 else "w", encoding="utf-8", closefd=False)
            setattr(sys, name, stream)


def write_output(text: str) -> None:
    """Write to standard output all that was and is to be written; what nobody reads any more is dropped.

    Raises:
        UserError: It cannot be written, for example since the disk is full.
    """
    try:
        sys.stdout.write(text)
        sys.stdout.flush()
    except OSError as error:
        _lead_nowhere(sys.stdout)
        if not isinstance(error, BrokenPipeError):
            raise UserError(f"cannot write to standard output: {error.strerror}") from None


def write_error(line: str) -> None:
    """Write a line to standard error, if that is possible."""
    try:
        sys.stderr.write(f"{line}\n")
        sys.stderr.flush()
    except OSError:
        _lead_nowhere(sys.stderr)


def _lead_nowhere(stream: TextIO) -> None:
    """What is left in the stream's buffer would else fail once more when Python ends."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)


# --- `sgns <command> --help`: the text in the command's yaml, with the options of its groups ------------


def groups_of(command: str) -> dict[str, str | None]:
    """Config groups of a command, in its order, each with the option it takes by default."""
    groups: dict[str, str | None] = {}
    for entry in _settings(command)["defaults"]:
        if isinstance(entry, dict):
            groups.update(entry)
    return groups


def options_of(group: str) -> list[str]:
    """Names of the options of a group that ship with the package."""
    folder = files("sgns.conf").joinpath(group)
    if not folder.is_dir():
        return []
    return sorted(
        entry.name.removesuffix(".yaml") for entry in folder.iterdir() if entry.name.endswith(".yaml")
    )


def command_help(command: str) -> str:
    """Help text of a command, ready to print."""
    template = _settings(command)["hydra"]["help"]["template"]
    groups = {group: default for group, default in groups_of(command).items() if options_of(group)}
    width = max(map(len, groups), default=0)
    lines = []
    for group, default in groups.items():
        of_checkpoint = command == "rollout"  # both of its groups
        usual = None if of_checkpoint else default
        options = (f"{name} (default)" if name == usual else name for name in options_of(group))
        end = "; default: the checkpoint's" if of_checkpoint else ""
        lines.append(f"  {group:<{width}}  {', '.join(options)}{end}")
    text = Template(template).substitute(
        APP_CONFIG_GROUPS="\n".join(lines), KEYS="\n".join(key_lines(command))
    )
    return f"{text.rstrip()}\n\nAll settings and their values: sgns {command} --cfg job\n"


def key_lines(command: str) -> list[str]:
    """A line for each key of a command, and for the main keys of its groups, from their definitions."""
    from mpm_warp.settings import described  # loads Warp: a second
    from sgns.command_settings import COMMANDS, MAIN_KEYS, Errors, ImportNames, Limits

    rows = [
        (f"{group}.{name}", *rest)
        for group, cls, names in MAIN_KEYS.get(command, ())
        for name, *rest in described(cls)
        if name in names
    ]
    groups = {"error": Errors, "limits": Limits, "names": ImportNames}
    for name, *rest in described(COMMANDS[command]):
        rows += (
            [(f"{name}.{part}", *more) for part, *more in described(groups[name])]
            if name in groups
            else [(name, *rest)]
        )
    lines = []
    for name, default, allowed, words in rows:
        default = default.replace("'", "").replace("False", "false").replace("True", "true")
        usual = f"default {default}" if default[:4] not in ("", "[]", "None") else default[4:]
        known = "; ".join(filter(None, (usual.strip(), allowed)))  # without a default the unit alone
        lines.append(f"  {name:<22} {words}{known and f' ({known})'}")
    return lines


@cache
def _settings(command: str) -> dict:
    return yaml.safe_load(files("sgns.conf").joinpath(f"{command}.yaml").read_text(encoding="utf-8"))


# --- The end of a sweep: what its jobs were given, how good and fast they are, and where ----------------


def end_sweep(jobs: Sequence[Any], value: str | None) -> None:
    """Print a table of Hydra's finished jobs, and write it as `sweep.csv` into the folder of the sweep.

    Args:
        jobs: In their order.
        value: Name of what they return, if it is a number.
    """
    from sgns.data.files import write_whole  # loads Warp

    given = [dict(one.partition("=")[::2] for one in job.overrides) for job in jobs]
    varied = [key for key in given[0] if len({one.get(key) for one in given}) > 1]
    rows = []
    for job, settings in zip(jobs, given, strict=True):
        row = {key: settings.get(key, "") for key in varied} | _found(job.cfg.get("output"))
        rows.append(row if value is None else {**row, value: job.return_value})
    names = list(dict.fromkeys(name for row in rows for name in row))
    table = [names, *([_short(row.get(name)) for name in names] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    text = io.StringIO()
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    own = jobs[0].hydra_cfg.hydra  # `sweep.dir` itself may hold a time
    folder = Path(own.runtime.output_dir).parents[len(Path(own.sweep.subdir).parts) - 1]
    file = Path(os.path.relpath(folder)) / "sweep.csv"
    write_whole(file, text.getvalue())
    lines = ["  ".join(map(str.ljust, line, widths)).rstrip() for line in table]
    write_output("\n".join([*lines, f"as a table: {file}", ""]))


def _found(output: str | None) -> dict[str, Any]:
    """Errors, or forces of a run, time and place of a job's result, as far as its files say them."""
    from mpm_warp import Scene  # loads Warp
    from sgns.data.run import Run

    if output is None:
        return {}
    folder = Path(output)
    if (file := folder / "training.json").is_file():
        found = json.loads(file.read_text(encoding="utf-8"))
        soil, of, result = 1e3 * found.get("position_rmse", math.nan), found, folder / "best.ckpt"
    elif (file := folder / "metrics.json").is_file():
        of = json.loads(file.read_text(encoding="utf-8"))["aggregate"]
        soil, result = of["rmse_total_mm"], folder
    elif folder.suffix == ".h5" and folder.is_file():
        with Run(folder) as run:
            scene = Scene.from_dict(run.scene, *run.meshes)
            return scene.results(run.force, run.torque, run.pose) | {"output": output}
    else:
        return {"output": output}
    errors = {"soil_error_mm": soil, "force_nrmse": of["force_nrmse"]}
    return errors | ({"training_s": of["seconds"]} if "seconds" in of else {}) | {"output": str(result)}


def _short(cell: Any) -> str:
    return f"{cell:.4g}" if isinstance(cell, float) else "" if cell is None else str(cell)


# --- Wrong settings: one line for what Hydra and OmegaConf say, with the key and what is allowed --------


# What a value holds without quotes; quotes, brackets and `${` have a meaning of their own.
_UNQUOTED = re.compile(r"[\w \t\\/%+.$*@?|:,=()\[\]{}'\"-]", re.ASCII)
# How Python's logging begins what it says of its settings.
_LOGGING = ("Unable to ", "Unsupported version", "dictionary doesn't specify a version")


def describe(error: Exception) -> str | None:
    """The line for an error about settings; None when the error is another one."""
    from hydra import errors  # here and below: Hydra takes longer to load than a help text may
    from hydra.plugins.config_source import ConfigLoadError
    from omegaconf.errors import GrammarParseError, InterpolationResolutionError, MissingMandatoryValue

    # OmegaConf's errors that come from what a person wrote, even when they appear inside a command; its other
    # errors there (an unknown attribute, a wrong type) are mistakes of the command.
    written = (MissingMandatoryValue, InterpolationResolutionError, GrammarParseError)
    if isinstance(error, errors.OverrideParseException):
        return _unreadable(error)
    if isinstance(error, errors.MissingConfigException):
        return _missing_option(error)
    if isinstance(error, errors.ConfigCompositionException):
        return _composition(error)
    if isinstance(error, ValueError) and str(error).startswith(_LOGGING):
        cause = "" if error.__cause__ is None else f": {error.__cause__}"
        return _flat(f"the settings of the logging are wrong: {error}{cause}")
    if isinstance(error, (errors.HydraException, ConfigLoadError, yaml.YAMLError, *written)):
        return _flat(str(error))
    return None


def _unreadable(error: OverrideParseException) -> str:
    if "=" not in error.override and not error.override.startswith("~"):
        return f"cannot read {error.override!r}; settings are written key=value"
    key, _, value = error.override.partition("=")
    odd = next((sign for sign in value if not _UNQUOTED.match(sign)), None)
    if odd is not None and not set(value) & {"'", '"', "\\"} and "${" not in value:
        if not odd.isprintable():
            return f"cannot read {error.override!r}: {odd!r} cannot be part of a value"
        quoted = f'["{odd}"]' if set(value) & set("[]{}()") else f'"{value}"'
        return f"cannot read {error.override!r}: {odd!r} needs quotes, as in '{key}={quoted}'"
    reason = _flat(error.message.split("\nSee ")[0])
    return (
        f"cannot read {error.override!r} ({reason}); settings are written key=value;"
        " put a value with spaces, commas, =, or brackets in quotes, as in 'key=\"a, b\"'"
    )


def _missing_option(error: MissingConfigException) -> str:
    """A group option that does not exist, for example dataset=nope."""
    name = error.missing_cfg_file or ""
    group, *parts = name.split("/")
    if not parts:
        return _flat(str(error))
    while len(parts) > 1 and (group == "hydra" or (parts[0].isalpha() and options_of(f"{group}/{parts[0]}"))):
        group += f"/{parts.pop(0)}"
    option = "/".join(parts)  # of which a path may have been given
    options = sorted(error.options or [])
    line = f"{group}={option}: no such option; {_of_own_file(group, option)}{_allowed('allowed', option, options)}"
    if group == "hydra/launcher":
        line += "; more launchers: pip install hydra-submitit-launcher (clusters) or hydra-joblib-launcher (processes)"
    return line


def _of_own_file(group: str, option: str) -> str:
    """What to write for a folder or a file that was given where the name of an option is wanted."""
    path, end = Path(option), Path(option).suffix.lower()
    if group == "dataset":
        found = next((one for one in (path, "data" / path) if one.is_dir()), path)
        return f"a dataset's folder is dataset.path={found}; " if found.is_dir() or "/" in option else ""
    if end in (".yaml", ".yml"):
        return f"your own file FOLDER/{group}/{path.stem}.yaml is --config-dir FOLDER {group}={path.stem}; "
    if group == "scene" and end == ".csv":
        return f"a path is scene.path={option}; "
    if group in ("scene", "scene/tool") and end in (".stl", ".obj", ".ply", ".off", ".glb", ".3mf"):
        return f"a mesh is scene=body scene/tool=mesh scene.tool.file={option}; "
    return ""


def _composition(error: ConfigCompositionException) -> str:
    from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

    text, cause = str(error), error.__cause__
    if isinstance(cause, (ConfigAttributeError, ConfigKeyError)) and cause.full_key:
        return _unknown_key(cause)
    found = re.search(r"Could not override '([^']*)'\.\s*No match in the defaults list", text)
    if found:
        hint = "it goes with scene=body; " if found[1] == "scene/tool" else ""
        return f"{found[1]}=...: this command has no group {found[1]!r}; {hint}its groups and keys: --help"
    found = re.search(r"Ambiguous value for argument '(.*)'", text)
    if found:
        key, _, value = found[1].partition("=")
        return f"{found[1]}: several values; add -m for a sweep, or write a list as '{key}=[{value}]'"
    found = re.search(r"Sweep parameters '(.*)' requires --multirun", text)
    if found:
        return f"{found[1]}: several values; add -m for a sweep"
    reasons = [text, *([str(cause)] if isinstance(cause, OmegaConfBaseException) else [])]
    return _flat("; ".join(filter(None, (_flat(reason) for reason in reasons))))


_SYMBOLS = {
    "phi": "friction_angle",
    "c": "cohesion",
    "e": "youngs_modulus",
    "nu": "poissons_ratio",
    "rho": "grain_density",
    "d": "grain_diameter",
    "mu": "static_friction",
}
"""Of soil → its key."""
_SURELY = 0.92
"""Likeness of two keys of which one is surely the other with a slip of the keyboard."""


def _unknown_key(cause: ConfigAttributeError | ConfigKeyError) -> str:
    from omegaconf import DictConfig, OmegaConf

    key = str(cause.full_key)
    parent = cause.parent_node
    if not isinstance(parent, DictConfig):
        return f"{key}: no such key"
    known = _keys(parent._get_root())
    name = key.rpartition(".")[2]
    near = [other for other in known if other.rpartition(".")[2] == name]
    symbol = f"{key.rpartition('.')[0]}.{_SYMBOLS.get(name.lower())}"
    near += [symbol] if symbol in known else []
    alike = difflib.get_close_matches(key, known, n=3, cutoff=0.7)
    if alike and difflib.SequenceMatcher(None, key, alike[0]).ratio() > _SURELY:
        alike = alike[:1]
    near += [other for other in alike if other not in near]
    siblings = sorted(str(other) for other in parent.keys() if other != "hydra")
    where = key.rpartition(".")[0]
    line = f"{key}: no such key; "
    if f"{key}.".startswith("scene.tool."):
        kind = OmegaConf.select(parent._get_root(), "scene.kind")
        has = {"excavation": "a plate, scene.blade", "wheel": "a wheel"}.get(kind, "no tool")
        has = (
            f"scene.tool has the keys {', '.join(siblings)}"
            if where == "scene.tool"
            else f"the {kind} scene has {has}"
        )
        height = ", whose height the path prescribes" if kind == "wheel" else ""
        return f"{line}{has}; for a mesh{height}: scene=body scene/tool=mesh scene.tool.file=..."
    if near:
        line += f"did you mean {' or '.join(near[:3])}? "
    return line + _allowed(f"keys of {where}" if where else "keys", name, siblings)


def _keys(cfg: Container) -> list[str]:
    """Dotted names of all settings, without Hydra's own."""
    from omegaconf import OmegaConf

    plain = OmegaConf.to_container(cfg, resolve=False)
    names: list[str] = []

    def walk(node: object, prefix: str) -> None:
        if isinstance(node, dict):
            for key, value in node.items():
                if prefix or key != "hydra":
                    names.append(f"{prefix}{key}")
                    walk(value, f"{prefix}{key}.")

    walk(plain, "")
    return names


def _allowed(what: str, given: str, names: list[str], limit: int = 30) -> str:
    if not names:
        return f"{what}: none"
    near = difflib.get_close_matches(given, names, n=1, cutoff=0.6)
    first = [*near, *(name for name in names if name not in near)][:limit]
    return f"{what}: {', '.join(first)}{', ...' if len(names) > limit else ''}"


def _flat(text: str) -> str:
    return "; ".join(part.strip() for part in text.splitlines() if part.strip())

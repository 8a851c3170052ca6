"""The texts of `sgns <command> --help`, and lines in the terminal."""

from __future__ import annotations

import logging
import os
import sys
from importlib.resources import files
from string import Template
from typing import TextIO

import yaml

from sgns.config import UserError

# --- The terminal: how log lines look, and what becomes of text that cannot be written ------------------


class LineFormatter(logging.Formatter):
    """Plain text for information, the level's name first for warnings and errors."""

    def format(self, record: logging.LogRecord) -> str:
        line = super().format(record)
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
        options = (f"{name} (default)" if name == default else name for name in options_of(group))
        lines.append(f"  {group:<{width}}  {', '.join(options)}")
    text = Template(template).substitute(
        APP_CONFIG_GROUPS="\n".join(lines), KEYS="\n".join(key_lines(command))
    )
    return f"{text.rstrip()}\n\nAll settings and their values: sgns {command} --cfg job\n"


def key_lines(command: str) -> list[str]:
    """A line for each key of a command, and for the main keys of its groups, from their definitions."""
    from mpm_warp.settings import described  # loads Warp: a second
    from sgns.settings import COMMANDS, MAIN_KEYS, Errors, Limits

    rows = [
        (f"{group}.{name}", *rest)
        for group, cls, names in MAIN_KEYS.get(command, ())
        for name, *rest in described(cls)
        if name in names
    ]
    groups = {"error": Errors, "limits": Limits}
    for name, *rest in described(COMMANDS[command]):
        rows += (
            [(f"{name}.{part}", *more) for part, *more in described(groups[name])]
            if name in groups
            else [(name, *rest)]
        )
    return [f"  {name:<22} {words}{allowed and f' ({allowed})'}" for name, _, allowed, words in rows]


def _settings(command: str) -> dict:
    return yaml.safe_load(files("sgns.conf").joinpath(f"{command}.yaml").read_text(encoding="utf-8"))

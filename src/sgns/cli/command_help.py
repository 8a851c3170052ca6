"""`sgns <command> --help`: the text in the command's yaml, with the options of its groups."""

from __future__ import annotations

from importlib.resources import files
from string import Template

import yaml

__all__ = ["command_help", "groups_of", "options_of"]


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
    text = Template(template).substitute(APP_CONFIG_GROUPS="\n".join(lines))
    return f"{text.rstrip()}\n\nAll settings and their values: sgns {command} --cfg job\n"


def _settings(command: str) -> dict:
    return yaml.safe_load(files("sgns.conf").joinpath(f"{command}.yaml").read_text(encoding="utf-8"))

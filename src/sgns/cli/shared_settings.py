"""The settings that mean the same in every command, checked before any work is done."""

from __future__ import annotations

from typing import Any

from omegaconf import DictConfig, OmegaConf

from sgns.cli.command_help import groups_of, options_of
from sgns.errors import UserError

__all__ = ["check_shared"]


def check_shared(cfg: DictConfig, command: str, needed: tuple[str, ...]) -> None:
    """Refuse settings that lack a value (???), point nowhere, or are not what every command takes them for.

    Args:
        cfg: All settings.
        command: Name of the command, for the message.
        needed: Dotted keys of paths that the command cannot do without.

    Raises:
        UserError: The line names the key.
    """
    missing = sorted(OmegaConf.missing_keys(cfg))
    if missing:
        keys = " ".join(f"{key}=..." for key in missing)
        what = "a value is" if len(missing) == 1 else "values are"
        give = "run files, as in sgns check run.h5" if command == "check" else keys
        raise UserError(f"{what} missing for {', '.join(missing)}; give {give}; see sgns {command} --help")
    OmegaConf.to_container(cfg, resolve=True)
    for group, default in groups_of(command).items():
        if default is not None and cfg.get(group) is None:
            allowed = ", ".join(options_of(group))
            raise UserError(f"{group} is missing; sgns {command} needs one; allowed: {allowed}")
    for key in needed:
        value = OmegaConf.select(cfg, key)
        if not isinstance(value, str) or not value:
            raise UserError(f"{key} is {_shown(value)}; it must be a path; see sgns {command} --help")
    if cfg.get("checkpoint") is not None and not isinstance(cfg.checkpoint, str):
        raise UserError(f"checkpoint is {_shown(cfg.checkpoint)}; it must be a path")
    if "seed" in cfg and (not isinstance(cfg.seed, int) or isinstance(cfg.seed, bool) or cfg.seed < 0):
        raise UserError(f"seed is {_shown(cfg.seed)}; it must be a whole number, 0 or more")
    modes = cfg.get("num_modes")
    if modes is not None and (not isinstance(modes, int) or isinstance(modes, bool) or modes < 1):
        raise UserError(f"num_modes is {_shown(modes)}; it must be a whole number, 1 or more, or null")
    if isinstance(cfg.get("dataset"), DictConfig) and cfg.dataset.get("name") is None:
        raise UserError(
            "dataset.name is missing; choose a dataset, as in dataset=quick, or give this one a name"
        )
    where = OmegaConf.select(cfg, "dataset.where")
    if where is not None and not isinstance(where, DictConfig):
        raise UserError(
            f"dataset.where is {_shown(where)}; it must be keys of the scene with their values, or null"
        )
    if "device" in cfg and not isinstance(cfg.device, str):
        raise UserError(f"device is {_shown(cfg.device)}; allowed: cpu, cuda")


def _shown(value: Any) -> str:
    return "null" if value is None else repr(value)

"""Settings name no Python objects of their own.

Hydra makes objects by their names: `_target_` in its launchers, sweepers and callbacks, classes in its logging. A file
of settings that somebody passes on could so run anything. Here only the objects that come with Hydra, its
plugins and this package may be named.
"""

from __future__ import annotations

from typing import Any

from omegaconf import OmegaConf

from sgns.errors import UserError

__all__ = ["require_own_objects"]

_PLUGINS = ("hydra._internal.core_plugins.", "hydra_plugins.")
_LOGGING = {
    "class": ("logging.StreamHandler", "logging.FileHandler", "logging.NullHandler"),
    "()": ("sgns.cli.console.LineFormatter", "colorlog.ColoredFormatter"),
    "stream": ("ext://sys.stdout", "ext://sys.stderr"),
}


def require_own_objects(cfg: Any) -> None:
    """Refuses composed settings that would make other objects.

    Raises:
        UserError: The line names the key.
    """
    plain = OmegaConf.to_container(cfg, resolve=False)
    assert isinstance(plain, dict)
    hydra = plain.pop("hydra", None) or {}
    for name in ("job_logging", "hydra_logging"):
        _check_logging(hydra.pop(name, None), f"hydra.{name}")
    for key, value in _entries(plain, ""):
        if key.rpartition(".")[2] == "_target_":
            raise _refusal(key, value)
    for key, value in _entries(hydra, "hydra."):
        if key.rpartition(".")[2] != "_target_":
            continue
        if key.startswith("hydra.callbacks.") or not str(value).startswith(_PLUGINS):
            raise _refusal(key, value)


def _check_logging(settings: Any, name: str) -> None:
    for key, value in _entries(settings, f"{name}."):
        last = key.rpartition(".")[2]
        looked_up = isinstance(value, str) and "://" in value
        if (last in _LOGGING or looked_up or last in ("_target_", "")) and value not in _LOGGING.get(
            last, ()
        ):
            raise _refusal(key, value)


def _entries(node: Any, path: str) -> Any:
    """Dotted key and value of everything below a node."""
    pairs = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, value in pairs:
        yield f"{path}{key}", value
        yield from _entries(value, f"{path}{key}.")


def _refusal(key: str, value: Any) -> UserError:
    return UserError(
        f"{key} is {value!r}; settings cannot name Python objects to be made or called; leave it out"
    )

"""One line for what Hydra and OmegaConf say about wrong settings: the key, and what is allowed."""

from __future__ import annotations

import difflib
import re

import yaml
from hydra.errors import (
    ConfigCompositionException,
    HydraException,
    MissingConfigException,
    OverrideParseException,
)
from hydra.plugins.config_source import ConfigLoadError
from omegaconf import Container, DictConfig, OmegaConf
from omegaconf.errors import (
    ConfigAttributeError,
    ConfigKeyError,
    GrammarParseError,
    InterpolationResolutionError,
    MissingMandatoryValue,
    OmegaConfBaseException,
)

# OmegaConf's errors that come from what a person wrote, even when they appear inside a command; its other
# errors there (an unknown attribute, a wrong type) are mistakes of the command.
_WRITTEN = (MissingMandatoryValue, InterpolationResolutionError, GrammarParseError)
# What a value holds without quotes; quotes, brackets and `${` have a meaning of their own.
_UNQUOTED = re.compile(r"[\w \t\\/%+.$*@?|:,=()\[\]{}'\"-]", re.ASCII)
# How Python's logging begins what it says of its settings.
_LOGGING = ("Unable to ", "Unsupported version", "dictionary doesn't specify a version")


def describe(error: Exception) -> str | None:
    """The line for an error about settings; None when the error is another one."""
    if isinstance(error, OverrideParseException):
        return _unreadable(error)
    if isinstance(error, MissingConfigException):
        return _missing_option(error)
    if isinstance(error, ConfigCompositionException):
        return _composition(error)
    if isinstance(error, ValueError) and str(error).startswith("Config group override must be a string"):
        return (
            "a group is null or a number; groups take one of their options, as in dataset=quick; see --help"
        )
    if isinstance(error, ValueError) and str(error).startswith(_LOGGING):
        cause = "" if error.__cause__ is None else f": {error.__cause__}"
        return _flat(f"the settings of the logging are wrong: {error}{cause}")
    if isinstance(error, (HydraException, ConfigLoadError, yaml.YAMLError, *_WRITTEN)):
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
    group, _, option = (error.missing_cfg_file or "").rpartition("/")
    if not group:
        return _flat(str(error))
    options = sorted(error.options or [])
    line = f"{group}={option}: no such option; {_allowed('allowed', option, options)}"
    if group == "hydra/launcher":
        line += "; more launchers: pip install hydra-submitit-launcher (clusters) or hydra-joblib-launcher (processes)"
    return line


def _composition(error: ConfigCompositionException) -> str:
    text, cause = str(error), error.__cause__
    if isinstance(cause, (ConfigAttributeError, ConfigKeyError)) and cause.full_key:
        return _unknown_key(cause)
    found = re.search(r"Could not override '([^']*)'\.\s*No match in the defaults list", text)
    if found:
        return f"{found[1]}=...: this command has no group {found[1]!r}; its groups and keys: --help"
    found = re.search(r"Ambiguous value for argument '(.*)'", text)
    if found:
        key, _, value = found[1].partition("=")
        return f"{found[1]}: several values; add -m for a sweep, or write a list as '{key}=[{value}]'"
    found = re.search(r"Sweep parameters '(.*)' requires --multirun", text)
    if found:
        return f"{found[1]}: several values; add -m for a sweep"
    reasons = [text, *([str(cause)] if isinstance(cause, OmegaConfBaseException) else [])]
    return _flat("; ".join(filter(None, (_flat(reason) for reason in reasons))))


def _unknown_key(cause: ConfigAttributeError | ConfigKeyError) -> str:
    key = str(cause.full_key)
    parent = cause.parent_node
    if not isinstance(parent, DictConfig):
        return f"{key}: no such key"
    known = _keys(parent._get_root())
    name = key.rpartition(".")[2]
    near = [other for other in known if other.rpartition(".")[2] == name]
    near += [other for other in difflib.get_close_matches(key, known, n=3, cutoff=0.7) if other not in near]
    siblings = sorted(str(other) for other in parent.keys() if other != "hydra")
    where = key.rpartition(".")[0]
    line = f"{key}: no such key; "
    if near:
        line += f"did you mean {' or '.join(near[:3])}? "
    return line + _allowed(f"keys of {where}" if where else "keys", name, siblings)


def _keys(cfg: Container) -> list[str]:
    """Dotted names of all settings, without Hydra's own."""
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

"""What settings may hold of Hydra's own: nothing that runs anything, and no file to open."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Any

from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from omegaconf import DictConfig, OmegaConf

from sgns.config import UserError

# Hydra makes objects by their names: `_target_` in its launchers, sweepers and callbacks, classes in its
# logging. It sets environment variables, and launchers of clusters run shell commands. A file of settings that
# somebody passes on could so run anything. What is allowed is listed here; everything else is refused. What may
# run a command, but is of use, is taken from the command line only.

# Logging: sections with the keys that an entry of theirs may have.
_SECTIONS = {
    "formatters": ("()", "format", "datefmt", "style", "validate", "log_colors", "secondary_log_colors"),
    "filters": ("name",),
    "handlers": ("class", "stream", "level", "formatter", "filters"),
    "loggers": ("level", "propagate", "handlers", "filters"),
}
_ROOT = ("level", "handlers", "filters")
_SETTINGS = ("version", "disable_existing_loggers", "incremental")
_NAMED = {
    "class": ("logging.StreamHandler", "logging.NullHandler"),
    "()": ("sgns.cli.help.LineFormatter", "colorlog.ColoredFormatter"),
    "stream": ("ext://sys.stdout", "ext://sys.stderr"),
}
# Texts that a file may give a launcher: they go into the head of a cluster's script, so they are single words.
_WORDS = ("account", "constraint", "exclude", "gres", "mem_per_cpu", "mem_per_gpu", "partition", "qos")
_WORD = re.compile(r"[A-Za-z0-9_.,:&|\[\]-]+")
_FOLDER = re.compile(r"\.?\w[\w.-]*")
Keys = tuple[str, ...]


def require_plain_overrides(overrides: Sequence[str]) -> None:
    """Refuse overrides that import a package while the settings are put together, so before they can be looked at.

    Raises:
        UserError: There is one.
    """
    for override in overrides:
        if "hydra.searchpath" in override.partition("=")[0]:
            raise UserError(f"{override}: cannot be set; --config-dir adds a folder of your own")


def require_own_objects(cfg: DictConfig, typed: Sequence[str]) -> None:
    """Refuse composed settings that would make other objects, run commands or open files.

    Interpolations are refused wherever their value would be acted on: what they stand for can change after this.

    Args:
        cfg: The settings, with Hydra's own.
        typed: The overrides that stand on the command line itself.

    Raises:
        UserError: The line names the key.
    """
    plain = OmegaConf.to_container(cfg, resolve=False)
    assert isinstance(plain, dict)
    hydra = plain.pop("hydra")
    for path, value in _leaves(plain):
        if "_target_" in path:
            raise _refusal(path, value)
    if hydra["callbacks"]:
        raise _refusal(("hydra", "callbacks"), hydra["callbacks"])
    for name in ("job_logging", "hydra_logging"):
        _check_logging(hydra[name], ("hydra", name))
    parsed = OverridesParser.create().parse_overrides([text for text in typed if "hydra" in text])
    for group in ("launcher", "sweeper"):
        _check_plugin(cfg.hydra, group, parsed)
    for key in ("env_copy", "env_set"):
        if hydra["job"][key]:
            raise UserError(
                f"hydra.job.{key} is {hydra['job'][key]!r}; settings cannot set environment variables; "
                "set them in the shell, as in NAME=value sgns ..."
            )
    _check_record(hydra["output_subdir"], parsed)
    verbose = cfg.hydra.verbose
    names = [verbose] if isinstance(verbose, str) else verbose
    if not isinstance(names, bool) and not (
        isinstance(names, Sequence) and all(isinstance(name, str) for name in names)
    ):
        raise UserError(f"hydra.verbose is {verbose!r}; it must be true, false, or names of loggers")


def _check_logging(settings: Any, where: Keys) -> None:
    if settings is None:
        return
    if isinstance(settings, dict) and "root" not in settings:
        raise UserError(f"{'.'.join(where)}.root is missing; it must be a group of settings, or null")
    for path, value in _leaves(settings, where):
        below = path[len(where) :]
        if not _is_plain_logging(below, value):
            known = len(below) == 3 and below[2] in _SECTIONS.get(below[0], ())
            allowed = _NAMED.get(below[2]) if known else None
            hint = f"allowed: {', '.join(allowed)}; " if allowed else ""
            if "FileHandler" in str(value):
                hint += "to keep the lines in a file: sgns ... > run.log; "
            raise _refusal(path, value, hint)


def _is_plain_logging(path: Keys, value: Any) -> bool:
    """Whether an entry is one that can neither name an object nor open a file."""
    section, *rest = path or ("",)
    if section == "root":
        known = rest[0] in _ROOT and len(rest) == 1 if rest else value is None
    elif section in _SECTIONS:
        known = len(rest) >= 2 and rest[1] in _SECTIONS[section]
        known = known and (len(rest) == 2 or (len(rest) == 3 and rest[1].endswith("log_colors")))
    else:
        known = section in _SETTINGS and not rest
    values = value if isinstance(value, list) else [value]
    texts = [text for text in values if isinstance(text, str)]
    if not known or any(isinstance(one, (dict, list)) for one in values):
        return False
    if path[-1] in _NAMED and len(path) == 3:
        return value in _NAMED[path[-1]]
    return not any("${" in text or re.match("[a-z]+://", text) for text in texts)


def _check_plugin(hydra: DictConfig, group: str, typed: Sequence[Override]) -> None:
    """Check the settings of the launcher or the sweeper against those that its own code has registered."""
    where = ("hydra", group)
    everything: Any = OmegaConf.to_container(hydra, resolve=False)
    plain = everything[group]
    target = plain.get("_target_") if isinstance(plain, dict) else None
    registered = [node for node in _registered(group) if node.get("_target_") == target]
    if not registered:
        raise _refusal((*where, "_target_") if isinstance(plain, dict) else where, target or plain)
    leaves = dict(_leaves(plain, where))
    for path, value in leaves.items():
        below = path[len(where) :]
        if any(_is_at(node, below, value) for node in registered):
            continue
        if any(re.fullmatch("_.*_", key) for key in below):
            raise _refusal(path, value)
        if not (_is_harmless(below, value) or _is_typed(path, value, typed)):
            raise UserError(
                f"{'.'.join(path)} is {value!r}; files of settings cannot set this, which may run commands; "
                "leave it out there, or give it on the command line"
            )
    batch = plain.get("max_batch_size")
    if batch is not None and batch < 1:
        raise UserError(f"hydra.{group}.max_batch_size is {batch}; it must be 1 or more, or null")
    for path, value in _leaves(OmegaConf.to_container(hydra[group], resolve=True), where):
        if path not in leaves or (isinstance(value, str) and not value.isprintable()):
            raise _refusal(path, value)


def _registered(group: str) -> list[dict[str, Any]]:
    """Settings that Hydra and its installed plugins have registered for the options of a group of Hydra's."""
    store = ConfigStore.instance()
    names = [name for name in store.list(f"hydra/{group}") if name.endswith(".yaml")]
    return [
        OmegaConf.to_container(store.load(f"hydra/{group}/{name}").node, resolve=False)  # type: ignore[misc]
        for name in names
    ]


def _is_harmless(path: Keys, value: Any) -> bool:
    if isinstance(value, str):
        word = path[-1] in _WORDS and len(path) == 1 and _WORD.fullmatch(value) is not None
        # what a sweeper is to try: each job's settings are checked again
        return word or (path[0] == "params" and len(path) == 2 and "${" not in value)
    return value is None or isinstance(value, (bool, int, float)) or value == []


def _is_typed(path: Keys, value: Any, typed: Sequence[Override]) -> bool:
    """Whether the command line gives this key this value."""
    for override in typed:
        name = tuple(override.key_or_group.split("."))
        at = path[: len(name)] == name and not override.is_delete()
        if at and _is_at(override.value(), path[len(name) :], value):
            return True
    return False


def _is_at(node: Any, path: Keys, value: Any) -> bool:
    """Whether a tree has this value, of this type, at this place."""
    for key in path:
        if not isinstance(node, dict) or key not in node:
            return False
        node = node[key]
    return type(node) is type(value) and bool(node == value)


def _check_record(folder: Any, typed: Sequence[Override]) -> None:
    """Hydra overwrites `config.yaml` and more in this folder, and an empty run's are removed."""
    if folder in (None, ".hydra"):
        return
    if not _FOLDER.fullmatch(str(folder)) or not _is_typed(("hydra", "output_subdir"), folder, typed):
        raise UserError(
            f"hydra.output_subdir is {folder!r}; it must be null or .hydra, on the command line also another "
            "plain name of a folder"
        )


def _leaves(node: Any, path: Keys = ()) -> Iterator[tuple[Keys, Any]]:
    """Path and value of everything in a tree that is no group; of lists also the groups in them."""
    if isinstance(node, dict):
        for key, value in node.items():
            yield from _leaves(value, (*path, str(key)))
        return
    yield path, node
    for number, entry in enumerate(node if isinstance(node, list) else ()):
        if isinstance(entry, (dict, list)):
            yield from _leaves(entry, (*path, str(number)))


def _refusal(path: Keys, value: Any, hint: str = "") -> UserError:
    return UserError(
        f"{'.'.join(path)} is {value!r}; settings cannot name Python objects to be made or called, "
        f"or files to be opened; {hint}leave it out"
    )

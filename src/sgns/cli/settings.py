"""How settings are put together, and what they may not name."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import fields
from pathlib import Path
from typing import Any, ClassVar

from hydra.core.config_loader import ConfigLoader
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, Override, QuotedString, RangeSweep
from hydra.core.plugins import Plugins
from hydra.errors import HydraException
from hydra.plugins.config_source import ConfigResult, ConfigSource
from hydra.plugins.search_path_plugin import SearchPathPlugin
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from sgns import settings as typed
from sgns.cli.help import describe, groups_of, options_of
from sgns.config import UserError, parse_yaml

# --- Settings run nothing and open no file: what Hydra's own settings may hold --------------------------
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


MOST_JOBS = 10_000
"""Of a sweep."""


def require_options(overrides: Sequence[str], groups: Iterable[str]) -> None:
    """Refuse null and numbers as options of a group.

    Raises:
        UserError: It names the group.
    """
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        key, value = override.key_or_group, None if override.is_sweep_override() else override.value()
        if not key:
            raise UserError(f"cannot read {override.input_line!r}; settings are written key=value")
        if key == "experiment" and ConfigDir.folder is None:
            raise UserError(
                f"{override.input_line}: --config-dir is missing, the folder that holds experiment/*.yaml"
            )
        if key in groups and not (override.is_delete() or override.is_sweep_override()):
            if not isinstance(value, (str, list, dict)):
                raise UserError(
                    f"{key} is {_shown(value)}; allowed: {', '.join(options_of(key)) or 'names of files'}"
                )


def require_few_jobs(overrides: Sequence[str]) -> None:
    """Refuse a sweep of more jobs than anybody waits for, before its values are listed.

    Raises:
        UserError: It names the range, or the number of jobs.
    """
    jobs = 1.0
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        sweep = override.value() if override.is_sweep_override() else None
        if isinstance(sweep, RangeSweep):
            start, stop, step = (float(x or 0.0) for x in (sweep.start, sweep.stop, sweep.step))
            count = (stop - start) / step if step else math.nan
            if math.isnan(count):
                raise UserError(f"{override.input_line}: a range needs numbers and a step that is not 0")
            jobs *= max(1.0, math.ceil(count) if math.isfinite(count) else count)
        elif isinstance(sweep, ChoiceSweep):
            jobs *= max(1, len(sweep.list))
    if jobs > MOST_JOBS:
        raise UserError(f"the sweep has {jobs:.3g} jobs; at most {MOST_JOBS} are allowed: give fewer values")


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


# --- How settings are put together: by Hydra, with a look at each result before anybody acts on it ------

_sources: Any = Plugins.instance().discover(ConfigSource)
_Files: Any = next(one for one in _sources if one.scheme() == "file")
_MOST_BYTES = 1 << 20
"""Of a file of settings."""


class OwnFiles(_Files):
    """Files of settings that anybody may have written: looked at before OmegaConf copies what aliases stand for."""

    @staticmethod
    def scheme() -> str:
        return "own"

    def load_config(self, config_path: str) -> ConfigResult:
        """As Hydra's own.

        Raises:
            UserError: The file is no group of settings, or stands for more than fits in memory.
        """
        from sgns.data.files import read_text

        file = Path(self.path, self._normalize_file_name(config_path))
        text = read_text(file, "no file of settings", "repair it", _MOST_BYTES)
        try:
            content = parse_yaml(text)
        except ValueError as error:
            raise UserError(f"{file} is no file of settings: {error}; repair it") from None
        if not isinstance(content, dict | None):
            raise UserError(f"{file} is no file of settings: it holds no keys with values; repair it")
        return super().load_config(config_path)


class ConfigDir(SearchPathPlugin):
    """Adds the folder of `--config-dir` to the places where options of groups are found."""

    folder: ClassVar[str | None] = None

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        if ConfigDir.folder is not None:
            search_path.append("command-line", f"{OwnFiles.scheme()}://{ConfigDir.folder}")


class CheckedLoader:
    """Hydra's loader, which refuses settings that would run something.

    Hydra makes objects right after it has composed the settings, and calls nobody in between. A sweep's jobs are
    composed one by one, by launchers also in other processes, where this loader comes along.

    Args:
        loader: Hydra's own.
        typed: The overrides of the command line.
    """

    def __init__(self, loader: ConfigLoader, typed: Sequence[str]) -> None:
        self._loader = loader
        self._typed = list(typed)

    def load_configuration(
        self,
        config_name: str | None,
        overrides: list[str],
        run_mode: RunMode,
        from_shell: bool = True,
        validate_sweep_overrides: bool = True,
    ) -> DictConfig:
        with suppress(HydraException):  # composing says what cannot be read
            require_options(overrides, ("hydra", *groups_of(config_name or "")))
        how = (run_mode, from_shell, validate_sweep_overrides)
        return self._composed(
            config_name, overrides, lambda all_: self._loader.load_configuration(config_name, all_, *how)
        )

    def load_sweep_config(self, master_config: DictConfig, sweep_overrides: list[str]) -> DictConfig:
        return self._composed(
            master_config.hydra.job.config_name,
            sweep_overrides,
            lambda all_: self._loader.load_sweep_config(master_config, all_),
        )

    def _composed(
        self, command: str | None, overrides: list[str], compose: Callable[[list[str]], DictConfig]
    ) -> DictConfig:
        require_plain_overrides(overrides)
        scene = self._scene(command, overrides)
        try:
            cfg = compose([*scene, *overrides])
        except Exception as error:
            if (whole := _of_grids(overrides, error)) != overrides:
                return self._composed(command, whole, compose)
            if isinstance(error, (MemoryError, UserError)) or describe(error) is not None:
                raise
            # Composing runs nothing of ours: what goes wrong there is in the settings.
            raise UserError(
                f"the settings cannot be put together: {type(error).__name__}: {error}"
            ) from error
        # Nobody has typed these, and every job of a sweep finds its own.
        cfg.hydra.overrides.task = cfg.hydra.overrides.task[len(scene) :]
        require_own_objects(cfg, self._typed)
        _expand_home(cfg)
        return cfg

    def _scene(self, command: str | None, overrides: list[str]) -> list[str]:
        """What chooses the scene of a dataset or a checkpoint, to stand first: then overrides can be of its keys.

        A sweep's own settings are composed before those of its jobs: with the first option of each group it is over.
        """
        parser = OverridesParser.create()
        try:
            parsed = parser.parse_overrides(overrides)
        except HydraException:  # composing says what is wrong
            return []
        first = [
            f"{one.key_or_group}={_first(sweep)}"
            for one in parsed
            if isinstance(sweep := one.value(), ChoiceSweep) and options_of(one.key_or_group)
        ]
        given = {override.key_or_group: override for override in [*parsed, *parser.parse_overrides(first)]}
        return [*first, *self._chosen(command, given)]

    def _chosen(self, command: str | None, given: dict[str, Override]) -> list[str]:
        if "scene" in given:
            return []
        if command == "rollout" and "experiment" not in given and (checkpoint := given.get("checkpoint")):
            file = checkpoint.value()
            if isinstance(file, ChoiceSweep):  # until each job has its own
                file = _first(file)
            return _of_checkpoint(file, given)
        if command == "simulate" and "dataset" in given:
            try:
                lines = [str(given[key].input_line) for key in ("dataset", "dataset.scene") if key in given]
                alone = self._loader.load_configuration("simulate", lines, RunMode.RUN)
                scene = alone.dataset.get("scene")
            except Exception:  # said where everything is composed
                return []
            return [f"scene={scene}"] if isinstance(scene, str) else []
        return []

    def compute_defaults_list(self, config_name: str | None, overrides: list[str], run_mode: RunMode) -> Any:
        require_plain_overrides(overrides)
        return self._loader.compute_defaults_list(config_name, overrides, run_mode)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):  # of an object that is not yet unpickled
            raise AttributeError(name)
        return getattr(self._loader, name)


def _first(sweep: ChoiceSweep) -> Any:
    first = sweep.list[0]
    return first.text if isinstance(first, QuotedString) else first


def _of_grids(overrides: list[str], error: Exception) -> list[str]:
    """The overrides with `dataset.draw` in place of the dataset's own, where composing failed since only one of the two
    is a list of grids.

    Raises:
        UserError: One is of a key of that list.
    """
    if "Cannot merge DictConfig with ListConfig" in f"{error.__cause__}":
        return [
            part
            for one in overrides
            for part in (("~dataset.draw", f"+{one}") if one.startswith("dataset.draw=") else (one,))
        ]
    for one in overrides if isinstance(error, ValueError) else ():
        if found := re.match(r"\+*dataset\.draw\.([^\d=][^=]*)=(.*)", one):
            key, values = found.groups()
            raise UserError(
                f"dataset.draw.{key}: this dataset draws from a list of grids; give the keys to draw together, "
                f"as in 'dataset.draw={{{key}: {values}, ...}}'"
            ) from error
    return overrides


def _of_checkpoint(file: Any, given: Container[str]) -> list[str]:
    """Overrides that choose scene and soil of a checkpoint, but for groups that are given."""
    if not isinstance(file, str) or not file:  # said later
        return []
    from sgns.rollout import scene_groups  # loads torch: seconds

    groups = scene_groups(os.path.expanduser(file))
    for group, node in groups.items():
        ConfigStore.instance().store(name="of_checkpoint", node=node, group=group, provider="sgns")
    return [f"{group}=of_checkpoint" for group in groups if group not in given]


def _expand_home(node: Any) -> None:
    """Put the home folder in place of `~` at the beginning of values, as a shell does of words without quotes."""
    for key in list(node) if isinstance(node, DictConfig) else range(len(node)):
        if OmegaConf.is_missing(node, key) or OmegaConf.is_interpolation(node, key) or key == "hydra":
            continue
        value = node[key]
        if OmegaConf.is_config(value):
            _expand_home(value)
        elif isinstance(value, str) and value.startswith("~"):
            node[key] = os.path.expanduser(value)


# --- The settings that mean the same in every command, checked before any work is done ------------------


def check_shared(cfg: DictConfig, command: str, needed: tuple[str, ...]) -> None:
    """Refuse settings that lack a value (???), point nowhere, or are not what every command takes them for.

    Args:
        cfg: All settings.
        command: Name of the command, for the message.
        needed: Dotted keys of paths that the command cannot do without.

    Raises:
        UserError: The line names the key.
    """
    own: Any = typed.COMMANDS[command]
    if odd := set(cfg) - _keys_of(command):
        # A file of settings may be for several commands.
        if odd := odd.difference(*map(_keys_of, typed.COMMANDS)):
            known = ", ".join(sorted(_keys_of(command)))
            raise UserError(f"{min(odd)}: no such key; keys of sgns {command}: {known}")
    campaign = command == "simulate" and cfg.get("dataset") is not None  # may draw what its scene lacks
    missing = sorted(
        key for key in OmegaConf.missing_keys(cfg) if not (campaign and key.startswith("scene."))
    )
    if missing:
        keys = " ".join(f"{key}=..." for key in missing)
        what = "a value is" if len(missing) == 1 else "values are"
        takes = {"check": "run files", "plot": "a run file", "render": "a run file"}.get(command)
        give = keys if takes is None else f"{takes}, as in sgns {command} run.h5"
        raise UserError(f"{what} missing for {', '.join(missing)}; give {give}; see sgns {command} --help")
    every: Any = OmegaConf.to_container(cfg, resolve=True)
    plain = {key: value for key, value in every.items() if key in _keys_of(command)}
    for group, default in groups_of(command).items():
        if default is not None and cfg.get(group) is None:
            allowed = ", ".join(options_of(group))
            raise UserError(f"{group} is missing; sgns {command} needs one; allowed: {allowed}")
        if default is not None and not OmegaConf.is_config(cfg[group]):
            raise UserError(f"{group} is {_shown(cfg[group])}; it must be a group of settings")
    for key in needed:
        value = OmegaConf.select(cfg, key)
        if not isinstance(value, str) or not value:
            raise UserError(f"{key} is {_shown(value)}; it must be a path; see sgns {command} --help")
    if isinstance(plain.get("dataset"), dict) and plain["dataset"].get("name") is None:
        raise UserError(
            "dataset.name is missing; choose a dataset, as in dataset=quick, or give this one a name"
        )
    own.from_dict({one.name: plain[one.name] for one in fields(own) if one.name in plain})
    if plain.get("dataset") is not None:
        typed.dataset_settings(plain["dataset"])
    if "reduction" in plain:
        typed.ReductionSettings.from_dict(plain["reduction"])
    if "model" in plain:
        typed.training_settings(plain["model"], plain["training"])
    if "solver" in plain:
        typed.SolverSettings.from_dict(plain["solver"])


def _keys_of(command: str) -> set[str]:
    """Keys and groups of a command."""
    return {one.name for one in fields(typed.COMMANDS[command])} | set(groups_of(command))  # type: ignore[arg-type]


def _shown(value: Any) -> str:
    return "null" if value is None else repr(value)

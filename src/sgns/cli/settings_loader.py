"""How settings are put together: by Hydra, with a look at each result before anybody acts on it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, ClassVar

from hydra.core.config_loader import ConfigLoader
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.object_type import ObjectType
from hydra.plugins.config_source import ConfigSource
from hydra.plugins.search_path_plugin import SearchPathPlugin
from hydra.types import RunMode
from omegaconf import DictConfig

from sgns.cli.own_objects import require_own_objects, require_plain_overrides
from sgns.cli.setting_errors import describe
from sgns.errors import UserError

__all__ = ["CheckedLoader", "ConfigDir"]


class ConfigDir(SearchPathPlugin):
    """Adds the folder of `--config-dir` to the places where options of groups are found."""

    folder: ClassVar[str | None] = None

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        if ConfigDir.folder is not None:
            search_path.append("command-line", f"file://{ConfigDir.folder}")


class CheckedLoader(ConfigLoader):
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
        return self._checked(
            overrides,
            lambda: self._loader.load_configuration(
                config_name, overrides, run_mode, from_shell, validate_sweep_overrides
            ),
        )

    def load_sweep_config(self, master_config: DictConfig, sweep_overrides: list[str]) -> DictConfig:
        overrides = [*master_config.hydra.overrides.hydra, *sweep_overrides]
        return self._checked(
            overrides, lambda: self._loader.load_sweep_config(master_config, sweep_overrides)
        )

    def _checked(self, overrides: Sequence[str], compose: Callable[[], DictConfig]) -> DictConfig:
        require_plain_overrides(overrides)
        try:
            cfg = compose()
        except Exception as error:
            if isinstance(error, MemoryError) or describe(error) is not None:
                raise
            # Composing runs nothing of ours: what goes wrong there is in the settings.
            raise UserError(
                f"the settings cannot be put together: {type(error).__name__}: {error}"
            ) from error
        require_own_objects(cfg, self._typed)
        return cfg

    def get_search_path(self) -> ConfigSearchPath:
        return self._loader.get_search_path()

    def get_sources(self) -> list[ConfigSource]:
        return self._loader.get_sources()

    def list_groups(self, parent_name: str) -> list[str]:
        return self._loader.list_groups(parent_name)

    def get_group_options(
        self,
        group_name: str,
        results_filter: ObjectType | None = ObjectType.CONFIG,
        config_name: str | None = None,
        overrides: list[str] | None = None,
    ) -> list[str]:
        return self._loader.get_group_options(group_name, results_filter, config_name, overrides)

    def compute_defaults_list(self, config_name: str | None, overrides: list[str], run_mode: RunMode) -> Any:
        require_plain_overrides(overrides)
        return self._loader.compute_defaults_list(config_name, overrides, run_mode)

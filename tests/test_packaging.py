"""What is installed: packages, data files, versions, and the direction of imports."""

from __future__ import annotations

import ast
import re
from importlib.metadata import version
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import sgns
from sgns.cli.commands import COMMANDS

ROOT = Path(__file__).resolve().parent.parent
FOLDERS = {"sgns": ROOT / "src/sgns", "sgns.conf": ROOT / "conf", "mpm_warp": ROOT / "mpm_warp"}


@pytest.fixture(scope="module")
def project() -> dict:
    tomllib = pytest.importorskip("tomllib", reason="Python 3.10 cannot read TOML by itself")
    return tomllib.loads((ROOT / "pyproject.toml").read_text())


def imports_of(path: Path) -> set[str]:
    """Top-level names of the modules that a file imports."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            names.add(node.module.partition(".")[0])
    return names


def test_every_folder_with_code_is_a_package_that_is_installed(project: dict) -> None:
    with_code = {path.parent for folder in FOLDERS.values() for path in folder.rglob("*.py")}
    names = {
        ".".join([name, *path.relative_to(folder).parts])
        for path in with_code
        for name, folder in FOLDERS.items()
        if path.is_relative_to(folder)
    }
    assert set(project["tool"]["setuptools"]["packages"]) == names


def test_the_installed_package_is_of_this_version() -> None:
    assert version("sgns") == sgns.__version__
    assert re.search(
        rf"^## {re.escape(sgns.__version__)}\b", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE
    )


def test_the_version_is_written_once(project: dict) -> None:
    assert "version" in project["project"]["dynamic"]
    places = [path for path in (ROOT / "src").rglob("*.py") if f'"{sgns.__version__}"' in path.read_text()]
    assert places == [ROOT / "src/sgns/__init__.py"]


def test_pins(project: dict) -> None:
    needs = project["project"]["dependencies"]
    for pin in ("hydra-core>=1.3.8,<1.4", "omegaconf>=2.3,<2.4", "lightning>=2.6.4", "torch>=2.6"):
        assert pin in needs
    assert project["project"]["requires-python"] == ">=3.10,<3.14"


@pytest.mark.parametrize("package", ["sgns", "mpm_warp"])
def test_types_are_published(package: str) -> None:
    assert (FOLDERS[package] / "py.typed").is_file()


def test_every_setting_file_is_readable_and_ends_in_yaml() -> None:
    for path in FOLDERS["sgns.conf"].rglob("*"):
        if path.is_file() and "__pycache__" not in path.parts and path.suffix != ".py":
            assert path.suffix == ".yaml", f"{path} would not be installed"
            yaml.safe_load(path.read_text())
    for command in COMMANDS:
        assert (FOLDERS["sgns.conf"] / f"{command}.yaml").is_file()


def test_templates_and_tables_are_installed(project: dict) -> None:
    installed = project["tool"]["setuptools"]["package-data"]
    for path in FOLDERS["sgns"].rglob("*"):
        if path.suffix in (".j2", ".csv", ".html", ".js", ".LICENSE"):
            assert any(path.match(pattern) for pattern in installed[f"sgns.{path.parent.name}"]), path


def test_the_solver_stands_alone() -> None:
    for path in FOLDERS["mpm_warp"].rglob("*.py"):
        assert not imports_of(path) & {"sgns", "torch", "hydra", "omegaconf", "lightning"}, path


def test_only_the_whole_lightning_is_imported() -> None:
    for path in [*FOLDERS["sgns"].rglob("*.py"), *(ROOT / "tests").rglob("*.py")]:
        assert "pytorch_lightning" not in imports_of(path), path


def test_public_names_load_when_used() -> None:
    assert set(sgns.__all__) <= set(dir(sgns))
    for name in sgns.__all__:
        assert getattr(sgns, name) is not None
    with pytest.raises(AttributeError, match="public names"):
        _ = sgns.no_such_name


def test_the_lock_file_pins_every_dependency_within_its_range(project: dict) -> None:
    entries = re.split(r"\n(?=\S)", (ROOT / "requirements.lock").read_text())
    locked: dict[str, list[Requirement]] = {}
    for entry in entries:
        if not entry.startswith("#"):
            assert "--hash=sha256:" in entry, entry
            pin = Requirement(entry.split("\\")[0])
            locked.setdefault(canonicalize_name(pin.name), []).append(pin)
    extras = project["project"]["optional-dependencies"]
    texts = [*project["project"]["dependencies"], *extras["test"], *extras["lint"]]
    for text in texts:
        asked = Requirement(text)
        if asked.name == "sgns":  # our own extras
            texts += [one for extra in asked.extras for one in extras[extra]]
            continue
        if asked.name == "torch":  # installed first, by its own line
            assert "torch" not in locked
            continue
        for pin in locked[canonicalize_name(asked.name)]:
            (exact,) = pin.specifier
            assert exact.operator == "==" and asked.specifier.contains(exact.version), pin


def test_the_tests_that_hold_the_rules_of_safety_are_there() -> None:
    named = set(re.findall(r"`(test_\w+)`", (ROOT / "docs/safety.md").read_text()))
    defined = {
        node.name
        for path in (ROOT / "tests").rglob("test_*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.FunctionDef)
    }
    assert len(named) > 20 and named <= defined, sorted(named - defined)

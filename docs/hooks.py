"""What `mkdocs build` adds to the pages: every setting from conf/, and links that work outside the repository."""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parent.parent
CONF = ROOT / "conf"
NOT_SETTINGS = ("hydra_file.yaml", "hydra_folder.yaml", "hydra/")
"""Files of conf/ that are for Hydra alone."""

PICTURES = (".png", ".gif")


def setting_files() -> dict[str, list[Path]]:
    """Page → yaml files it shows: one page for the commands, one for each group."""
    pages: dict[str, list[Path]] = {}
    for file in sorted(CONF.rglob("*.yaml")):
        name = file.relative_to(CONF).as_posix()
        if not name.startswith(NOT_SETTINGS):
            pages.setdefault(name.partition("/")[0] if "/" in name else "commands", []).append(file)
    return pages


def reference_page() -> str:
    """The page of all settings with default, unit, range and meaning, from the classes that define them."""
    import mpm_warp as mpm
    import sgns.command_settings as commands
    import sgns.settings as typed
    from mpm_warp.motions import Other, Passes
    from mpm_warp.settings import reference

    soil = [
        mpm.Scene,
        mpm.Excavation,
        mpm.Wheel,
        mpm.Body,
        mpm.Column,
        mpm.Incline,
        mpm.Bed,
        mpm.Walls,
        mpm.Plate,
        Passes,
        Other,
        mpm.Sphere,
    ]
    soil += [
        mpm.Box,
        mpm.Cylinder,
        mpm.MeshBody,
        mpm.Material,
        mpm.Effects,
        mpm.Tolerances,
        typed.SolverSettings,
    ]
    groups = [typed.DatasetSettings, typed.PublishedSettings, typed.ReductionSettings]
    groups += [one for kind in typed.MODELS.values() for one in kind] + [
        typed.LossWeights,
        commands.Errors,
        commands.Limits,
        commands.ImportNames,
    ]
    return reference([*soil, *groups, *commands.COMMANDS.values()])


def settings_page(name: str, files: list[Path]) -> str:
    """The Markdown of one page of settings: a heading and a table for each file."""
    parts = [f"# Settings: {name}", "", "Made from the files in `conf/` and their comments.", ""]
    for file in files:
        text = file.read_text(encoding="utf-8")
        option = file.relative_to(CONF).with_suffix("").as_posix()
        title = f"sgns {option}" if name == "commands" else f"{posixpath.dirname(option)}={file.stem}"
        parts += [f"## `{title}`", "", *about(text), ""]
        if bases := base_options(text):
            parts += [f"Starts from {', '.join(f'`{base}`' for base in bases)} and sets:", ""]
        rows = settings(text)
        if rows:
            parts += ["| key | value | meaning |", "|---|---|---|"]
            parts += [
                f"| `{key}` | {f'`{cell(value)}`' if value else ''} | {cell(meaning)} |"
                for key, value, meaning in rows
            ]
        else:
            parts.append("No keys of its own.")
        parts.append("")
    return "\n".join(parts)


def about(text: str) -> list[str]:
    """The comment at the head of a file, as Markdown; lines of commands as code."""
    lines = []
    for line in text.splitlines():
        if not line.startswith("#"):
            break
        words = line.removeprefix("#")
        if not words.strip().startswith("@package"):
            lines.append(
                f"    {words.strip()}" if words.startswith("   ") else words.strip().replace("<", "&lt;")
            )
    return lines


def base_options(text: str) -> list[str]:
    """Options that a file starts from: plain names in its defaults list."""
    defaults = (yaml.safe_load(text) or {}).get("defaults", [])
    return [
        entry
        for entry in defaults
        if isinstance(entry, str) and entry not in ("_self_", "hydra_file", "hydra_folder")
    ]


def settings(text: str) -> list[tuple[str, str, str]]:
    """Key, value and comment of every setting of a file, with dotted keys; lists are one setting."""
    lines = text.splitlines()
    found: list[tuple[str, str, str]] = []

    def walk(node: yaml.Node, prefix: str) -> None:
        for key, value in node.value:
            if not prefix and key.value in ("defaults", "hydra"):
                continue
            name = f"{prefix}{key.value}"
            inline = value.start_mark.line == key.start_mark.line
            if isinstance(value, yaml.MappingNode) and value.value and not value.flow_style:
                if meaning := comment(lines, key.start_mark.line, key.end_mark.column):
                    found.append((name, "", meaning))
                walk(value, f"{name}.")
                continue
            written = text[value.start_mark.index : value.end_mark.index] if inline else "…"
            end = value.end_mark if inline else key.end_mark
            found.append((name, " ".join(written.split()), comment(lines, end.line, end.column)))

    tree = yaml.compose(text)
    if tree is not None:
        walk(tree, "")
    return found


def comment(lines: list[str], line: int, column: int) -> str:
    """The comment behind a place in a line, with the lines of comment that go on below it."""
    start = lines[line].find("#", column)
    if start < 0:
        return ""
    words = [lines[line][start + 1 :].strip()]
    for below in lines[line + 1 :]:
        # As far to the right as the first: a comment on a line of its own belongs to what follows it.
        if below.strip().startswith("#") and below.index("#") == start:
            words.append(below.strip().lstrip("#").strip())
        else:
            break
    return " ".join(words)


def cell(text: str) -> str:
    """Text that does not end a table's cell."""
    return text.replace("|", "\\|").replace("<", "&lt;")


def on_files(files: Any, config: Any) -> Any:
    """Add the pages of settings and the pictures of experiments that pages show."""
    from mkdocs.structure.files import File

    files.append(File.generated(config, "settings.md", content=reference_page()))
    for name, sources in setting_files().items():
        content = settings_page(name, sources)
        files.append(File.generated(config, f"settings/{name}.md", content=content))
    pages = [file.content_string for file in files.documentation_pages()]
    shown = {
        path for page in pages for path in re.findall(r"!\[[^]]*\]\((?:\.\./)+(experiments/[^)]+)\)", page)
    }
    for path in sorted(shown):
        files.append(File.generated(config, path, abs_src_path=str(ROOT / path)))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Links that lead out of docs/: pictures are on the site, of everything else the text stays."""
    up = posixpath.relpath(".", posixpath.dirname(page.file.src_uri) or ".")

    def replaced(match: re.Match[str]) -> str:
        bang, text, path = match.groups()
        if bang and path.endswith(PICTURES):
            return f"![{text}]({posixpath.normpath(posixpath.join(up, path))})"
        return f"`{text}`" if text.startswith("experiments/") else text

    return re.sub(
        r"(!?)\[([^]]*)\]\((?:\.\./)+((?:examples|experiments|conf|src|mpm_warp)/[^)]*)\)", replaced, markdown
    )

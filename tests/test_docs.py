"""What the pages say works: blocks of Python run, commands have the keys they use, links lead somewhere."""

from __future__ import annotations

import ast
import importlib.util
import re
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser

import mpm_warp
from sgns.cli import COMMANDS
from sgns.train.command import train
from sgns_testing.commands import composed
from sgns_testing.runs import make_run
from sgns_testing.tiny import BRIEF, MODEL, TRAINING, reduced

ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
OPTIONAL = {"MDAnalysis", "vtkmodules"}
"""Libraries that a page may use and the package does not bring (extra `formats`)."""

BLOCK = re.compile(
    r"(?:<!-- not run: (?P<reason>[^>]+) -->\n)?^```(?P<language>\w*)\n(?P<text>.*?)^```$", re.M | re.S
)


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def blocks(page: Path, language: str) -> list[tuple[str, str | None]]:
    """Text of the fenced blocks in a language, and the reason where one is not to be run."""
    found = BLOCK.finditer(page.read_text(encoding="utf-8"))
    return [(match["text"], match["reason"]) for match in found if match["language"] == language]


def without_blocks(page: Path) -> str:
    """A page's text without its fenced blocks."""
    return re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)


def commands_of(text: str) -> Iterator[str]:
    """`sgns ...` lines of blocks, and those within sentences that change a setting and leave nothing to fill in."""
    without_python = re.sub(r"^```python\n.*?^```$", "", text, flags=re.M | re.S)
    for line in without_python.splitlines():
        if re.match(r"( {2,}|)sgns ", line):
            yield line.strip().partition(" #")[0].strip()
    for span in re.findall(r"`(sgns [^`]+)`", without_python):
        if "=" in span and not set(span) & set("<…"):
            yield span


def parse(command: str) -> tuple[str, list[str]]:
    """The command's name and its overrides, each sweep as its first value."""
    words = shlex.split(command)[1:]
    assert words, command
    name, rest = words[0], words[1:]
    if "--config-dir" in rest:  # settings of a person's own, which are not here
        place = rest.index("--config-dir")
        own = ("experiment=", "study=own")
        rest = [word for word in (*rest[:place], *rest[place + 2 :]) if not word.startswith(own)]
    overrides = [word for word in rest if not word.startswith("-") and "=" in word]
    if name == "check":
        overrides.append("files=[run.h5]")
    if name in ("plot", "render", "convert"):
        overrides.append("run=run.h5")
    if name == "import":
        overrides.append("source=[run.npz]")
    plain = []
    for override, text in zip(OverridesParser.create().parse_overrides(overrides), overrides, strict=True):
        if text.startswith(("hydra/", "hydra.launcher.")):  # a launcher that is a package of its own
            continue
        if override.is_sweep_override():
            text = f"{override.key_or_group}={next(override.sweep_string_iterator())}"
        plain.append(text)
    return name, plain


def assert_composes(command: str) -> None:
    """All of a command's keys and options exist."""
    name, overrides = parse(command)
    if name.startswith("-"):
        return
    assert name in COMMANDS, command
    if name == "simulate" and "dataset=own" in overrides:  # as the command does: the dataset's scene
        overrides = ["scene=body", *overrides]
    if name == "rollout" and "checkpoint=outputs/own/best.ckpt" in overrides:  # and the checkpoint's
        overrides = ["scene=body", "scene/tool=mesh", *overrides]
    try:
        composed(*overrides, command=name)
    except Exception as error:
        raise AssertionError(f"{command}: {error}") from error


@pytest.fixture(scope="module")
def hooks() -> ModuleType:
    spec = importlib.util.spec_from_file_location("docs_hooks", ROOT / "docs" / "hooks.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def workplace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what the pages' Python reads: run.h5, wheel.h5, basis.h5, best.ckpt, and best.ckpt of outputs/demo
    and outputs/ensemble."""
    folder = tmp_path_factory.mktemp("workplace")
    scene = mpm_warp.Excavation(
        bed=mpm_warp.Bed(size=(0.4, 0.4, 0.12), spacing=0.04, headroom=0.1),
        blade=mpm_warp.Plate(length=0.2, width=0.16, thickness=0.09),
        start=0.3,
        duration=13 / 60,
    )
    fixed = {
        key: value
        for key, value in scene.to_dict().items()
        if key not in ("depth", "speed", "rake", "motion")
    }
    particles = {"n": len(scene.initial_positions()), "arrangement_hash": scene.arrangement_hash}
    data = reduced(folder / "data", scene=fixed, **particles)
    train(data, num_modes=4, model=MODEL, training=TRAINING, output=folder / "outputs" / "demo")
    several = BRIEF | {"members": 2}
    train(data, num_modes=4, model=MODEL, training=several, output=folder / "outputs" / "ensemble")
    shutil.copy(folder / "outputs" / "demo" / "best.ckpt", folder / "best.ckpt")
    shutil.copy(folder / "data" / "runs" / "a.h5", folder / "run.h5")
    data.basis.save(folder / "basis.h5")
    make_run(folder / "wheel.h5", scene={"kind": "wheel", "diameter": 0.15, "settle": 0.1})
    return folder


@pytest.mark.timeout(300)  # kernels may have to be compiled
@pytest.mark.parametrize(
    # sgns/test_own_bucket.py runs that guide: its Python needs what its commands make
    "page",
    [page for page in PAGES if blocks(page, "python") and page.stem != "own_bucket"],
    ids=name_of,
)
def test_python_on_the_pages_runs(page: Path, workplace: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(workplace)
    names: dict[str, Any] = {"__name__": "page"}
    for text, reason in blocks(page, "python"):
        code = compile(text, name_of(page), "exec")
        needed = {
            (node.module or "" if isinstance(node, ast.ImportFrom) else alias.name).partition(".")[0]
            for node in ast.walk(ast.parse(text))
            if isinstance(node, ast.Import | ast.ImportFrom)
            for alias in node.names
        }
        lacking = {name for name in needed if importlib.util.find_spec(name) is None}
        assert lacking <= OPTIONAL, f"{name_of(page)} imports {lacking}"
        if reason is None and not lacking:
            exec(code, names)


def test_few_blocks_are_not_run() -> None:
    assert sum(reason is not None for page in PAGES for _, reason in blocks(page, "python")) <= 3


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_commands_on_the_pages_have_these_keys(page: Path) -> None:
    for command in dict.fromkeys(commands_of(page.read_text(encoding="utf-8"))):
        assert_composes(command)


def test_commands_in_help_and_comments_have_these_keys() -> None:
    shown = []
    for file in sorted((ROOT / "conf").rglob("*.yaml")):
        text = file.read_text(encoding="utf-8")
        shown += commands_of("\n".join(re.findall(r"^#( {2,}sgns .*)$", text, re.M)))
        shown += commands_of(
            ((yaml.safe_load(text) or {}).get("hydra") or {}).get("help", {}).get("template", "")
        )
    assert len(shown) > 15
    for command in shown:
        if not re.match(r"sgns \w+:", command):  # the line that says what it does
            assert_composes(command)


def test_a_wrong_key_on_a_page_is_found() -> None:
    with pytest.raises(AssertionError, match="scene\\.deep"):
        assert_composes("sgns simulate scene.deep=0.1")
    assert parse("sgns train -m seed=0,1 'shard=range(2,5)' hydra/launcher=joblib") == (
        "train",
        ["seed=0", "shard=2"],
    )


def test_settings_named_in_sentences_exist(hooks: ModuleType) -> None:
    places = {".": "", "preset": "", "numerics": "scene.", "scene/tool": "scene.tool."}
    known = {"effects.NAME", "material.KEY"}
    for file in (file for files in hooks.setting_files().values() for file in files):
        group = file.relative_to(hooks.CONF).parent.as_posix()
        keys = [key for key, _, _ in hooks.settings(file.read_text(encoding="utf-8"))]
        known |= {places.get(group, f"{group}.") + key for key in keys}
    key_like = re.compile(
        r"`((?:scene|material|effects|solver|dataset|reduction|model|training)\.[\w.]+)(?:[=:][^`]*)?`"
    )
    option_like = re.compile(r"`(scene|material|dataset|preset|study|effects|training)=(\w+)`")
    for page in PAGES:
        text = without_blocks(page)
        for key in key_like.findall(text):
            there = any(one == key or one.startswith(f"{key}.") for one in known)
            assert there or key.endswith((".yaml", ".json")), (page.name, key)
        for group, option in option_like.findall(text):
            assert (hooks.CONF / group / f"{option}.yaml").is_file(), (page.name, group, option)


def anchors(page: Path) -> set[str]:
    """Anchors of a page's headings, as GitHub and mkdocs make them."""
    headings = re.findall(r"^#+ (.*)$", without_blocks(page), re.M)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", without_blocks(page)):
        if target.startswith("https://"):
            continue
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.exists(), f"{name_of(page)}: {target}"
        assert not anchor or anchor in anchors(file), f"{name_of(page)}: {target}"


def test_every_setting_is_on_the_site(hooks: ModuleType) -> None:
    nav = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    for name, files in hooks.setting_files().items():
        assert f"settings/{name}.md" in nav
        page = hooks.settings_page(name, files)
        for file in files:
            data = yaml.safe_load(file.read_text(encoding="utf-8")) or {}
            for key in data:
                if key not in ("defaults", "hydra"):
                    assert f"| `{key}` |" in page or f"| `{key}." in page, (file, key)


def test_the_page_of_all_settings_has_ranges(hooks: ModuleType) -> None:
    lines = hooks.reference_page().splitlines()
    assert "| `hidden_width` | 128 | 1 to 10000 | width of every layer |" in lines
    assert "| `gravity` | 9.81 m/s^2 | 0 to 100000 | downwards |" in lines
    assert "## Simulate" in lines and "## Wheel (`scene`)" in lines


def test_a_settings_page_has_values_and_comments(hooks: ModuleType) -> None:
    text = "# About.\na: 1.0   # first [m],\n         # and more\nb:  # group\n  c: [1, 2]  # a | b\n  d: '#no'\n"
    assert hooks.about(text) == ["About."]
    assert hooks.settings(text) == [
        ("a", "1.0", "first [m], and more"),
        ("b", "", "group"),
        ("b.c", "[1, 2]", "a | b"),
        ("b.d", "'#no'", ""),
    ]
    assert hooks.cell("a | <b>") == "a \\| &lt;b>"


def test_the_table_of_keys_is_that_of_the_commands() -> None:
    conventions = (ROOT / "docs" / "conventions.md").read_text(encoding="utf-8")
    for command in COMMANDS:
        settings = yaml.safe_load((ROOT / "conf" / f"{command}.yaml").read_text(encoding="utf-8"))
        groups = {key for entry in settings["defaults"] if isinstance(entry, dict) for key in entry}
        (row,) = re.findall(rf"^\| `{command}` \| (.*?) \|", conventions, re.M)
        assert set(re.findall(r"`(\w+)`", row)) == (set(settings) | groups) - {"defaults", "hydra"}, command


def test_sizes_of_datasets_are_those_of_their_runs() -> None:
    for page in ("files.md", "guides/cluster.md"):
        text = (ROOT / "docs" / page).read_text(encoding="utf-8")
        for name in ("quick", "desktop_excavation", "paper_excavation"):
            conf = (ROOT / "conf" / "dataset" / f"{name}.yaml").read_text(encoding="utf-8")
            (per_run,) = re.findall(r"(\d+) MB a run", conf)  # [MB]
            ((runs, size),) = re.findall(rf"^\| `{name}` \| (\d+) \|.* ([\d.]+) GB \|", text, re.M)
            assert float(size) == pytest.approx(int(runs) * int(per_run) / 1000, rel=0.06), (page, name)


def test_every_page_is_in_the_navigation() -> None:
    nav = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    for page in (ROOT / "docs").rglob("*.md"):
        assert f": {page.relative_to(ROOT / 'docs').as_posix()}\n" in nav


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").split()) <= 700


def test_the_tool_of_start_here_is_closed(workplace: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(workplace)
    tool, path = (text for text, _ in blocks(ROOT / "docs" / "start.md", "python")[:2])
    exec(tool, {})
    exec(path, {})
    rows = [tuple(map(float, row.split(","))) for row in Path("path.csv").read_text().splitlines()[1:]]
    body = mpm_warp.MeshBody(file="wedge.stl", scale=0.001)
    scene = mpm_warp.Body(bed=mpm_warp.Bed(size=(0.8, 0.6, 0.15)), tool=body, path=tuple(rows), duration=2.0)
    assert scene.warnings() == []

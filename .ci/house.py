#!/usr/bin/env python3
"""Draw which file imports which, of one or more trees, and count lines: python .ci/house.py out.png TITLE=TREE [...]

A file stands above all that it imports. Grey lines are imports; what the commands `simulate` and `train` reach is counted,
and among these files the steps back: pairs of folders that import each other.
Printed is a table of the lines of each folder of the last tree: code, docstrings, comments, blank.
"""

from __future__ import annotations

import ast
import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

PACKAGES = {"sgns": "src/sgns", "mpm_warp": "mpm_warp"}
COMMANDS = {
    "simulate": ("sgns.simulate.command", "sgns.simulate"),
    "train": ("sgns.train.command", "sgns.learning.training"),
}


def modules(tree: Path) -> dict[str, Path]:
    found = {}
    for package, folder in PACKAGES.items():
        for path in sorted((tree / folder).rglob("*.py")):
            parts = (package, *path.relative_to(tree / folder).with_suffix("").parts)
            found[".".join(parts).removesuffix(".__init__")] = path
    return found


def imports(name: str, path: Path, known: dict[str, Path]) -> set[str]:
    """Files of ours that a file imports, without what it imports for types only."""
    code = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(code):
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
            node.body = []
    found: set[str] = set()
    for node in ast.walk(code):
        if isinstance(node, ast.Import):
            found |= {one.name for one in node.names}
        elif isinstance(node, ast.ImportFrom):
            package = name.split(".")[: None if path.name == "__init__.py" else -1]
            above = package[: len(package) - node.level + 1] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            inner = {f"{base}.{one.name}" for one in node.names} & known.keys()
            found |= inner or {base}
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and ":" in node.value:
            found.add(node.value.partition(":")[0])  # of a table of what is loaded when it is needed
    return (found & known.keys()) - {name}


def reached(start: str, graph: dict[str, set[str]]) -> set[str]:
    found, waiting = {start}, [start]
    while waiting:
        new = graph[waiting.pop()] - found
        found |= new
        waiting += new
    return found


def steps_back(files: set[str], graph: dict[str, set[str]], folder: dict[str, str]) -> int:
    """Pairs of folders that import each other, of some files."""
    ways = {(folder[name], folder[other]) for name in files for other in graph[name] & files}
    return sum(a < b and (b, a) in ways for a, b in ways)


def floors(graph: dict[str, set[str]]) -> dict[str, int]:
    """Of each file the longest way down through its imports."""
    found: dict[str, int] = {}

    def floor(name: str) -> int:
        if name not in found:
            found[name] = 0  # ends a circle
            found[name] = 1 + max(map(floor, graph[name]), default=-1)
        return found[name]

    for name in graph:
        floor(name)
    return found


def draw(axes: plt.Axes, title: str, tree: Path) -> None:
    known = modules(tree)
    graph = {name: imports(name, path, known) for name, path in known.items()}
    lines = {name: len(path.read_text(encoding="utf-8").splitlines()) for name, path in known.items()}
    level = floors(graph)
    group_of = {name: name.rpartition(".")[0] or "(package)" for name in known}
    groups = sorted(set(group_of.values()), key=lambda g: sum(level[n] for n in known if group_of[n] == g) / list(group_of.values()).count(g))
    place: dict[str, tuple[float, float]] = {}
    for column, group in enumerate(groups):
        for floor in set(level.values()):
            row = sorted(name for name in known if level[name] == floor and group_of[name] == group)
            for i, name in enumerate(row):
                place[name] = column + 0.1 + 0.8 * (i + 0.5) / len(row), floor
    for name, others in graph.items():
        for other in others:
            axes.plot(*zip(place[name], place[other], strict=True), color="0.85", lw=0.4, zorder=1)
    for column, group in enumerate(groups):
        names = [name for name in known if group_of[name] == group]
        x, y = zip(*(place[name] for name in names), strict=True)
        axes.scatter(x, y, [lines[name] / 5 for name in names], color=f"C{column % 10}", zorder=2)
    ways = []
    for command, candidates in COMMANDS.items():
        start = next(name for name in candidates if name in known)
        files = reached(start, graph)
        back = steps_back(files, graph, {name: str(path.parent) for name, path in known.items()})
        ways.append(f"{command} reaches {len(files)}, steps back: {back}")
    axes.set_title(f"{title}: {len(known)} files, {sum(lines.values())} lines\n{'; '.join(ways)}", fontsize=10)
    axes.set_ylabel("floor: a file stands above all that it imports")
    axes.set_xticks([column + 0.5 for column in range(len(groups))], groups, rotation=35, ha="right", fontsize=8)


def kinds_of_lines(path: Path) -> list[int]:
    """Lines of code, docstrings, comments, blank lines."""
    text = path.read_text(encoding="utf-8")
    kinds = ["blank" if not line.strip() else "comment" if line.lstrip().startswith("#") else "code"
             for line in text.splitlines()]
    for node in ast.walk(ast.parse(text)):
        body = getattr(node, "body", None)
        first = body[0] if isinstance(body, list) and body else None
        if isinstance(first, ast.Expr) and isinstance(getattr(first.value, "value", None), str):
            kinds[first.lineno - 1 : first.end_lineno] = ["doc"] * (first.end_lineno - first.lineno + 1)
    return [kinds.count(kind) for kind in ("code", "doc", "comment", "blank")]


def table(tree: Path) -> str:
    """Lines of every folder, in Markdown."""
    rows: dict[str, list[int]] = {}
    for path in sorted(tree.rglob("*.py")):
        folder = path.relative_to(tree).parent
        if folder.parts and (folder.parts[0][0] == "." or folder.parts[0] in ("build", "data", "outputs")):
            continue
        depth = 3 if folder.parts[:1] == ("src",) else 2 if folder.parts[:1] == ("mpm_warp",) else 1
        row = rows.setdefault("/".join(folder.parts[:depth]) or ".", [0] * 5)
        for i, count in enumerate([1, *kinds_of_lines(path)]):
            row[i] += count
    lines = ["| folder | files | code | docstrings | comments | blank | all |", "|---|---|---|---|---|---|---|"]
    for name, row in sorted(rows.items()):
        lines.append(f"| `{name}` | {' | '.join(map(str, [*row, sum(row[1:])]))} |")
    total = [sum(column) for column in zip(*rows.values(), strict=True)]
    lines.append(f"| all | {' | '.join(map(str, [*total, sum(total[1:])]))} |")
    return "\n".join(lines)


def main() -> None:
    out, *trees = sys.argv[1:]
    figure, axes = plt.subplots(1, len(trees), figsize=(7 * len(trees), 6), squeeze=False, layout="constrained")
    for ax, one in zip(axes[0], trees, strict=True):
        draw(ax, *(part if i == 0 else Path(part) for i, part in enumerate(one.split("=", 1))))
    figure.savefig(out, dpi=80)
    print(table(Path(trees[-1].split("=", 1)[1])))


if __name__ == "__main__":
    main()

"""Checkpoints that ship with the package, each with its model card, and how they are found by name.

`python -m sgns.pretrained.ship` makes them.
"""

from __future__ import annotations

from pathlib import Path

from sgns.config import UserError

FOLDER = Path(__file__).parent
"""Of `<name>.ckpt` and `<name>.md`."""


def names() -> list[str]:
    """Those that ship."""
    return sorted(file.stem for file in FOLDER.glob("*.ckpt"))


def shipped(name: str) -> Path:
    """The file of one that ships.

    Raises:
        UserError: There is none of that name.
    """
    if name not in names():
        raise UserError(f"no pretrained checkpoint is called {name!r}; {names_in_words()}")
    return FOLDER / f"{name}.ckpt"


def checkpoint_file(path: str | Path) -> Path:
    """The file of a checkpoint: a plain name that is no file here may be one that ships."""
    here = Path(path)
    return shipped(here.name) if is_name(path) and not here.is_file() and here.name in names() else here


def is_name(path: str | Path) -> bool:
    """Whether a path is a plain name, without a folder and without an ending."""
    return Path(path).name == str(path) and not Path(path).suffix


def names_in_words() -> str:
    """What ships, as part of a sentence."""
    return f"with the package ship: {', '.join(names()) or 'none'}"

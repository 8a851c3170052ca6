"""Points in a folder, one file each, so that a study goes on where it stopped.

<output>/points/<scene>_<kind>_<label>.json                 one point without its errors; written last, whole
<output>/observations/<scene>_<kind>_<label>_<case>.npz     its runs
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from sgns.errors import UserError
from sgns.frontier.observation import Observation, read_observation
from sgns.frontier.point import Point
from sgns.smallfile import read_json
from sgns.wholefile import write_whole

__all__ = ["Store"]


@dataclass(frozen=True)
class Store:
    """The folder of a study."""

    folder: Path

    def file(self, scene: str, kind: str, label: str) -> Path:
        """Where a point is; it is there when it is complete."""
        return self.folder / "points" / f"{name_of(scene, kind, label)}.json"

    def has(self, scene: str, kind: str, label: str) -> bool:
        """Whether a point has been measured."""
        return self.file(scene, kind, label).exists()

    def save(self, point: Point, observations: Mapping[str, Observation]) -> None:
        """Keep a point with its run of every case; none for a point that left the range (say so in its note)."""
        name = name_of(point.scene, point.kind, point.label)
        for case, observation in observations.items():
            observation.save(self._observation(name, case))
        content = {"point": point.row(), "cases": list(observations)}
        file = self.file(point.scene, point.kind, point.label)
        file.parent.mkdir(parents=True, exist_ok=True)
        write_whole(file, json.dumps(content, indent=1, ensure_ascii=False))

    def points(self) -> list[tuple[Point, list[str]]]:
        """All points with the names of their cases, in the order of their files' names.

        Raises:
            UserError: a file is damaged.
        """
        found = []
        for file in sorted((self.folder / "points").glob("*.json")):
            advice = "remove it to make it again"
            content = read_json(file, "no operating point", advice)
            try:
                point, cases = content["point"], content["cases"]
                if not isinstance(point, dict) or not isinstance(cases, list):
                    raise TypeError("its point is no group of keys, or its cases are no list")
                if wrong := [c for c in cases if not isinstance(c, str) or set(c) & {"/", os.sep, "\0"}]:
                    raise ValueError(f"{wrong[0]!r:.40} is no name of a case")
                found.append((Point.from_row(point), cases))
            except (ValueError, KeyError, TypeError, UserError) as error:
                raise UserError(f"{file} is no operating point ({error}); {advice}") from None
        return found

    def observation(self, point: Point, case: str) -> Observation:
        """The run of a case of a point."""
        return read_observation(self._observation(name_of(point.scene, point.kind, point.label), case))

    def _observation(self, name: str, case: str) -> Path:
        return self.folder / "observations" / f"{name}_{case}.npz"


def name_of(scene: str, kind: str, label: str) -> str:
    """A file name for a point."""
    return "_".join(re.sub(r"([^\w.+-]|_)+", "-", part) for part in (scene, kind, label))

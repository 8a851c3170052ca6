"""Going on with a run whose solver stopped."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig, OmegaConf

from mpm_warp import Effects, MeshBody, Scene, State
from sgns.errors import UserError
from sgns.runs import Run
from sgns.runs.stopped import read_state

__all__ = ["CHANGES", "Continuation", "continued"]

CHANGES = (
    "courant",
    "remap_time",
    "remap_distance",
    "velocity_memory",
    "elastic_damping",
    "volume_averaging",
    "bed.headroom",
)
"""Keys of the scene that may change half-way: how it is computed, not what it is."""

_FILE = "scene.tool.file"
_OTHERS = ("continue_from", "output", "device", "solver.precision", "hydra")


@dataclass(frozen=True)
class Continuation:
    """A stopped run and what it goes on with."""

    path: Path
    scene: Scene
    """What was asked for at first; the run file says this."""
    changes: dict[str, Any]
    """Keys of `CHANGES` with new values, those of earlier continuations included."""
    effects: Effects
    reasons: dict[str, dict[str, Any]]
    """Of the effects, as in the file."""
    precision: str
    seed: int
    state: State
    wall_time: float
    """What its frames took [s]."""
    before: list[dict[str, Any]]
    """What the file says of earlier continuations."""

    @property
    def changed_scene(self) -> Scene:
        """What is computed from here on."""
        data = self.scene.to_dict()
        for key, value in self.changes.items():
            *groups, last = key.split(".")
            place = data
            for group in groups:
                place = place[group]
            place[last] = value
        return Scene.from_dict(data, self.scene.mesh)

    @property
    def record(self) -> list[dict[str, Any]]:
        """For the run file: at which frames the solver went on, and with what changed."""
        return [*self.before, {"frame": self.state.frame, "changed": dict(self.changes)}]

    def frames(self) -> Iterator[tuple[np.ndarray, ...]]:
        """The frames that are there, as `RunWriter.append` takes them."""
        with Run(self.path) as run:
            small = (run.body_points, run.pose, run.force, run.torque)
            for index, time in enumerate(run.time):
                soil = run.positions(index)[0], run.velocities(index)[0]
                yield (time, *soil, *(series[index] for series in small))


def continued(cfg: DictConfig, overrides: Sequence[str]) -> Continuation:
    """What `cfg.continue_from` holds, with the changes among the command's `overrides`.

    Raises:
        UserError: the file is no stopped run, or something else is to be changed than how it is computed.
    """
    path = Path(str(cfg.continue_from))
    asked_changes = _changes(cfg, overrides)
    with Run(path) as run:
        reason = run.stopped
        if reason is None:
            raise UserError(f"continue_from: {path} is a whole run; there is nothing to go on with")
        scene, reasons, extra = run.scene, run.effects, run.extra
        seed, count, wall_time = run.seed, run.frame_count, run.wall_time_s
        mesh = _mesh(run, cfg, overrides)
    state = read_state(path)
    if state.frame != count - 1:
        raise UserError(f"{path} holds {count} frames but the state of frame {state.frame}; repeat the run")
    effects, before = _effects(reasons, path), _earlier(extra, path)
    changes = {key: value for earlier in before for key, value in earlier["changed"].items()} | asked_changes
    if effects.nonlocality and "bed.headroom" in changes:
        raise UserError(
            "with effects.nonlocality the grid keeps what flows, so scene.bed.headroom cannot change half-way; "
            "simulate the scene anew"
        )
    asked = any(o.startswith("solver.precision=") for o in overrides)
    return Continuation(
        path=path,
        scene=Scene.from_dict(scene, mesh),
        changes=changes,
        effects=effects,
        reasons=reasons,
        precision=cfg.solver.precision if asked else str(extra.get("precision", cfg.solver.precision)),
        seed=seed,
        state=state,
        wall_time=wall_time,
        before=before,
    )


def _mesh(run: Run, cfg: DictConfig, overrides: Sequence[str]) -> tuple[np.ndarray, np.ndarray] | None:
    """The tool's mesh: what the run holds, or for a run from before it was kept the file that the command names."""
    tool = run.scene.get("tool")
    is_mesh = isinstance(tool, dict) and tool.get("shape") == "mesh"
    given = any(o.lstrip("+").startswith(f"{_FILE}=") for o in overrides)
    if is_mesh and run.mesh is None:
        if not given:
            raise UserError(
                f"{run.path} does not hold the mesh of its tool, as runs of before did not, and no file is read "
                f"because a run names it; give the file: '+{_FILE}=...'"
            )
        asked = {"shape": "mesh", "file": str(OmegaConf.select(cfg, _FILE)), "digest": tool["digest"]}
        return MeshBody(**asked, scale=_scale(tool, run.path)).mesh[:2]
    if given:
        raise UserError(f"{run.path} brings its own tool; leave out {_FILE}")
    return run.mesh


def _scale(tool: Mapping[str, Any], path: Path) -> float:
    scale = tool.get("scale", 1.0)
    if isinstance(scale, bool) or not isinstance(scale, (int, float)):
        raise UserError(f"{path}: scene.tool.scale is {scale!r}, which is no number; repeat the run")
    return float(scale)


def _effects(reasons: Mapping[str, Any], path: Path) -> Effects:
    try:  # some of what is recorded follows from the scene and is no choice
        return Effects(**{effect.name: bool(reasons[effect.name]["on"]) for effect in fields(Effects)})
    except (TypeError, KeyError) as error:
        raise UserError(f"{path}: its effects are damaged ({error}); repeat the run") from None


def _earlier(extra: Mapping[str, Any], path: Path) -> list[dict[str, Any]]:
    found = extra.get("continued", [])
    try:
        known = all(set(one["changed"]) <= set(CHANGES) for one in found)
    except (TypeError, KeyError):
        known = False
    if not known:
        raise UserError(f"{path}: what it says of earlier continuations is damaged; repeat the run")
    return found


def _changes(cfg: DictConfig, overrides: Sequence[str]) -> dict[str, Any]:
    changes = {}
    for override in overrides:
        key = override.split("=")[0].lstrip("+~")
        if re.split(r"[@./]", key)[0] == "hydra" or key in (*_OTHERS, _FILE):
            continue
        if key.removeprefix("scene.") not in CHANGES or not key.startswith("scene."):
            raise UserError(
                f"continue_from brings its own scene, soil and effects; leave out {key}; allowed besides output, "
                f"device and solver.precision: {', '.join(f'scene.{name}' for name in CHANGES)}"
            )
        changes[key.removeprefix("scene.")] = OmegaConf.select(cfg, key)
    return changes

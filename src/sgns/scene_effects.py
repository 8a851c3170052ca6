"""From the group `effects` of the settings to the physics of one scene."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

from omegaconf import DictConfig, OmegaConf

from mpm_warp import Decision, Effects, Scene, Tolerances, effects_for
from sgns.errors import UserError
from sgns.settings import check_fields

__all__ = ["asked_effects", "decided", "decision_line", "decision_summary", "recorded"]


def asked_effects(cfg: DictConfig) -> dict[str, Any]:
    """`cfg.effects` as plain data: each effect true, false or auto, and the group `tolerance`."""
    asked = OmegaConf.to_container(cfg.effects, resolve=True)
    asked.pop("nonlocal", None)  # its other name has its value
    return asked


def decided(scene: Scene, asked: Mapping[str, Any]) -> tuple[Effects, dict[str, Decision]]:
    """The effects of a scene, and the decision about each, for effects asked for as `asked_effects` gives them.

    Raises:
        UserError: the tolerances are not what they should be.
        SceneError: the effects are not, or the scene cannot have them.
    """
    switches = dict(asked)
    tolerance = switches.pop("tolerance", None)
    if tolerance is None:
        return effects_for(scene, switches)
    if not isinstance(tolerance, Mapping):
        raise UserError(f"effects.tolerance is {tolerance!r}; it must be a group of keys")
    check_fields(Tolerances, tolerance, "effects.tolerance")
    return effects_for(scene, switches, Tolerances(**tolerance))


def recorded(decisions: Mapping[str, Decision]) -> dict[str, dict[str, Any]]:
    """Decisions as a run file keeps them."""
    return {name: decision._asdict() for name, decision in decisions.items()}


def decision_line(name: str, decision: Decision) -> str:
    """A decision for people to read."""
    return f"{name} {'on' if decision.on else 'off'}: {decision.reason}"


def decision_summary(every: Iterable[Mapping[str, Decision]]) -> list[str]:
    """One line for each effect over all runs of a dataset: how often it is on, and the most frequent reason."""
    lines, every = [], list(every)
    for name in every[0]:
        made = [decisions[name] for decisions in every]
        on = sum(decision.on for decision in made)
        if on in (0, len(made)):
            lines.append(f"{decision_line(name, made[0])}{' (the first run)' if len(made) > 1 else ''}")
        else:
            reasons = Counter(decision.reason for decision in made if not decision.on)
            lines.append(f"{name} on in {on} of {len(made)} runs; else off: {reasons.most_common(1)[0][0]}")
    return lines

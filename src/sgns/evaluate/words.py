"""Numbers, runs and scenes in plain words."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from sgns.evaluate.results import Evaluation


def number(value: float, digits: int = 3) -> str:
    """A number with so many significant digits, no exponent where it can be helped; – if it means nothing."""
    if math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    size = abs(value)
    if size >= 1e5 or 0.0 < size < 1e-4:
        text = f"{value:.{digits - 1}e}"
    else:
        decimals = digits if size == 0.0 else max(0, digits - 1 - math.floor(math.log10(size)))
        text = f"{float(f'{value:.{digits}g}') if size >= 1000 else value:.{min(decimals, 6)}f}"
    return text.replace("-", "−")


def fixed(value: float, decimals: int = 2, sign: bool = False) -> str:
    """A number with so many decimals; – if it means nothing."""
    if not math.isfinite(value):
        return number(value)
    value = round(value, decimals) + 0.0  # no minus before a zero
    return f"{value:{'+' if sign else ''}.{decimals}f}".replace("-", "−")


def quantity(value: float | None) -> str:
    """A number as people write it; whole ones with all their digits; nothing for None."""
    if value is None:
        return ""
    return f"{value:,}".replace(",", " ") if isinstance(value, int) else number(value)


def describe(scene: Mapping[str, Any]) -> str:
    """What the paper lists of a blade's or a wheel's scene, in a few words; empty for other scenes."""
    if all(key in scene for key in ("depth", "speed", "rake", "motion")):
        depth, speed, rake, motion = (scene[key] for key in ("depth", "speed", "rake", "motion"))
        return f"{100 * depth:.3g} cm deep, {100 * speed:.3g} cm/s, rake {rake:.3g}°, {motion} motion"
    if all(key in scene for key in ("diameter", "load", "slip")):
        words = (
            f"{100 * scene['diameter']:.3g} cm wheel, {scene['load']:.3g} N, slip {100 * scene['slip']:.3g} %"
        )
        angle, gravity = scene.get("friction_angle"), scene.get("gravity")
        words += "" if angle is None else f", friction angle {angle:.3g}°"
        return words + ("" if gravity is None else f", gravity {gravity:.3g} m/s²")
    return ""


def short_names(names: Sequence[str]) -> list[str]:
    """The part of every name before its first underscore, if that still tells the names apart."""
    short = [name.partition("_")[0] or name for name in names]
    return short if len(set(short)) == len(set(names)) else list(names)


def forward_name(evaluation: Evaluation) -> str:
    """What the forward force is called: wheels pull, other bodies draw."""
    return "drawbar pull" if all(run.wheel for run in evaluation.runs) else "draft"


def seen_warning(evaluation: Evaluation) -> str:
    """One sentence if the evaluation is no clean test, else nothing."""
    count = len(evaluation.runs)
    parts = [
        f"{len(names)} of the {count} evaluated runs {verb} ({names[0]}{', …' if len(names) > 1 else ''})"
        for names, verb in (
            (evaluation.trained_on, "bear the names of runs that this checkpoint was trained on"),
            (evaluation.chosen_by, "bear the names of validation runs that chose this checkpoint"),
        )
        if names
    ]
    return f"{'; '.join(parts)}: for those the numbers are no test." if parts else ""

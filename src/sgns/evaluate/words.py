"""An evaluation in plain words: which words are used follows from the numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from sgns.evaluate.results import Scores

if TYPE_CHECKING:
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


def titled(name: str, scene: Mapping[str, Any]) -> str:
    """A run's name with its scene in a few words."""
    words = describe(scene)
    return f"{name}: {words}" if words else name


def short_names(names: Sequence[str]) -> list[str]:
    """The part of every name before its first underscore, if that still tells the names apart."""
    short = [name.partition("_")[0] or name for name in names]
    return short if len(set(short)) == len(set(names)) else list(names)


def forward_name(evaluation: Evaluation) -> str:
    """What the forward force is called: wheels pull, other bodies draw."""
    return "drawbar pull" if all(run.wheel for run in evaluation.runs) else "draft"


def soil_words(total: Scores) -> str:
    """What the skill against the two baselines means, as a sentence."""
    skill = total.skill("frozen")
    numbers = (
        f"Its particles are off by {number(total.rmse_mm('total'))} mm (RMS per axis); a bed in which "
        f"nothing moves is off by {number(total.rmse_mm('frozen'))} mm"
    )
    if math.isnan(skill):
        return "How well it predicts the soil cannot be said: nothing moved in these runs."
    if skill >= 0.9:
        verdict = "It follows the motion of the soil closely"
    elif skill >= 0.5:
        verdict = "It follows most of the motion of the soil"
    elif skill > 0.0:
        verdict = "It follows the soil only roughly"
    else:
        verdict = "It does not predict the soil: it is no better than assuming that nothing moves"
    sentence = f"{verdict}. {numbers} (skill {fixed(skill)}, where 1 is perfect and 0 is no better)."
    steady = total.skill("constant_velocity")
    if not math.isnan(steady) and steady <= 0.0:
        sentence += " It is worse than letting every particle go on at the speed it had at the start."
    share = total.mse["reduction"] / total.mse["total"] if total.mse["total"] > 0.0 else math.nan
    if share >= 0.5:
        sentence += f" Of the squared error {100 * share:.0f} % is the subspace's, not the network's."
    return sentence


def force_words(total: Scores) -> str:
    """What the force error means beside the mean force of the training split."""
    own, mean = total.force.overall_nrmse, total.mean_force.overall_nrmse
    if math.isnan(own) or math.isnan(mean):
        return "How well it predicts the force cannot be said: there was none in these runs."
    ratio = own / mean if mean > 0.0 else math.inf
    if ratio < 0.5:
        verdict = "clearly better than"
    elif ratio < 0.9:
        verdict = "better than"
    elif ratio < 1.0:
        verdict = "hardly better than"
    else:
        verdict = "no better than"
    return (
        f"Its force is off by {100 * own:.0f} % of the force's RMS size, {verdict} always answering the "
        f"training runs' mean force ({100 * mean:.0f} %)."
    )


def body_words(total: Scores) -> str:
    """How far a predicted body is from its true place."""
    sentence = f"The tool itself, which it moves, is {number(1e3 * math.sqrt(total.body_mse))} mm (RMS) from its place"
    if math.isnan(total.sinkage_mae):
        return sentence + "."
    return f"{sentence}; the sinkage is off by {number(1e3 * total.sinkage_mae)} mm on average."


def time_words(evaluation: Evaluation) -> str:
    """How fast the network is beside the solver."""
    own, solver = evaluation.timing.rollout, evaluation.total.solver_rate
    sentence = f"One simulated second takes the network {number(own, 2)} s on one thread"
    if math.isnan(solver) or solver <= 0.0:
        return sentence + "; the solver's time is not recorded."
    ratio = solver / own
    compared = f"{number(ratio, 2)} times less" if ratio >= 1.0 else f"{number(1.0 / ratio, 2)} times more"
    return f"{sentence}, {compared} than the solver's {number(solver, 2)} s."


def seen_words(evaluation: Evaluation) -> str:
    """Whether the evaluated runs were new to the network."""
    count, trained_on, chosen_by = (
        len(names) for names in (evaluation.runs, evaluation.trained_on, evaluation.chosen_by)
    )
    if trained_on == count:
        return "on which it was trained, so this is no test"
    if chosen_by == count:
        return "that it was not trained on, but that chose its checkpoint"
    return "that are not all new to it" if trained_on + chosen_by else "that it never saw"


def summary(evaluation: Evaluation) -> str:
    """The result in one paragraph of plain words."""
    count, free = len(evaluation.runs), evaluation.total.body_mse > 0.0
    given = "what is prescribed of the tool's motion" if free else "the tool's path"
    sentences = [soil_words(evaluation.total), force_words(evaluation.total)]
    if free:
        sentences.append(body_words(evaluation.total))
    return (
        "A graph network learned the soil's motion and the force on the tool from material point "
        f"simulations, in a subspace of {evaluation.num_modes} modes instead of "
        f"{evaluation.particle_count} particles. It was given {given} and the first "
        f"{evaluation.history} frames of {count} run{'s' if count != 1 else ''} {seen_words(evaluation)}, and "
        f"predicted the rest. {' '.join(sentences)} {time_words(evaluation)}"
    )

"""The groups of conf and the keys of the commands are those of the typed settings, with their defaults."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from omegaconf import OmegaConf

import mpm_warp
import sgns.settings as typed
from mpm_warp.settings import described
from sgns import command_settings
from sgns.config import UserError
from sgns.settings import (
    DatasetSettings,
    FitSettings,
    Group,
    ModelSettings,
    PolynomialSettings,
    PublishedSettings,
    ReductionSettings,
    TrainingSettings,
)
from sgns_testing import commands


def composed(command: str, *overrides: str) -> dict[str, Any]:
    return OmegaConf.to_container(commands.composed(*overrides, command=command))


@pytest.mark.parametrize(
    ("settings", "overrides", "group"),
    [
        (ReductionSettings(), [], "reduction"),
        (ModelSettings(), [], "model"),
        (TrainingSettings(), [], "training"),
        (PolynomialSettings(), ["model=polynomial"], "model"),
        (FitSettings(), ["model=polynomial"], "training"),
        (PublishedSettings(), ["dataset=published"], "dataset"),
    ],
)
def test_a_group_is_the_class_with_its_defaults(settings: Group, overrides: list[str], group: str) -> None:
    assert composed("train", *overrides)[group] == settings.to_dict()


def test_the_solver_is_the_class_with_its_defaults() -> None:
    assert composed("simulate")["solver"] == typed.SolverSettings().to_dict()


@pytest.mark.parametrize("name", ["quick", "quick_wheel", "paper_excavation", "desktop_wheel"])
def test_a_campaign_states_only_what_the_class_knows(name: str) -> None:
    found = composed("simulate", f"dataset={name}")["dataset"]
    assert (
        DatasetSettings.from_dict(found).to_dict() | {"split": found["split"]}
        == DatasetSettings().to_dict() | found
    )


def test_presets_state_only_what_is_allowed() -> None:
    for preset in ("default", "fast", "paper", "released"):
        found = composed("train", f"preset={preset}")
        typed.training_settings(found["model"], found["training"])
        ReductionSettings.from_dict(found["reduction"])


@pytest.mark.parametrize(
    ("cls", "values", "line"),
    [
        (ReductionSettings, {"num_modes": 0}, "reduction.num_modes is 0; allowed: auto, 1 or more"),
        (
            ReductionSettings,
            {"num_modes": 65},
            "reduction.num_modes is 65; allowed: 1 to reduction.max_modes (64); ",
        ),
        (TrainingSettings, {"schedule": "flat"}, "training.schedule is 'flat'; allowed: cosine, exponential"),
        (TrainingSettings, {"max_steps": 2.5}, "training.max_steps is 2.5; it must be a whole number"),
        (TrainingSettings, {"max_steps": True}, "training.max_steps is True; it must be a whole number"),
        (
            TrainingSettings,
            {"learning_rate": 1e-300},
            "training.learning_rate is 1e-300; it must be 1e-15 to 1e+15 in size",
        ),
        (
            TrainingSettings,
            {"weight_decay": 1e300},
            "training.weight_decay is 1e+300; it must be 1e-15 to 1e+15 in size",
        ),
        (DatasetSettings, {"draw": [[1]]}, "dataset.draw is [[1]]; it must be a grid"),
        (typed.PointSettings, {"modes": [0]}, "study.scenes.modes is [0]; it must be 1 or more"),
        (
            typed.StudySceneSettings,
            {"bands": {"a": "x"}},
            "study.scenes.bands[a] is 'x'; it must be a finite number",
        ),
        (TrainingSettings, {"resume": True}, "training.resume is True; allowed: auto, false"),
        (TrainingSettings, {"noise": float("nan")}, "training.noise is nan; it must be a finite number"),
        (TrainingSettings, {"loss": {"force": -1}}, "training.loss.force is -1.0; it must be 0 or more"),
        (
            TrainingSettings,
            {"loss": {"frce": 1}},
            "training.loss has no key 'frce'; allowed: change, force, torque",
        ),
        (TrainingSettings, {"stps": 1}, "training has no key 'stps'; allowed: batch_size, "),
        (
            ModelSettings,
            {"context": "load"},
            "model.context is 'load'; it must be a list of keys of the scene",
        ),
        (ModelSettings, {"context": [1]}, "model.context[0] is 1; it must be text"),
        (
            ModelSettings,
            {"edge_scale": 0},
            "model.edge_scale is 0.0; it must be a length above 0 [m], or null",
        ),
        (
            FitSettings,
            {"penalties": [-1]},
            "training.penalties is [-1]; it must be a list of numbers, 0 or more",
        ),
        (
            DatasetSettings,
            {"split": [0.5, 0.5]},
            "dataset.split is [0.5, 0.5]; it must be a list of 3 values",
        ),
        (DatasetSettings, {"split": [1, 1, 0]}, "dataset.split is [1.0, 1.0, 0.0]; it needs three shares"),
        (DatasetSettings, {"draw": 5}, "dataset.draw is 5; it must be a grid"),
        (DatasetSettings, {"runs": 10.5}, "dataset.runs is 10.5; it must be a whole number"),
    ],
)
def test_a_value_that_is_not_allowed(cls: type[Group], values: dict[str, Any], line: str) -> None:
    with pytest.raises(UserError) as error:
        cls.from_dict(values)
    assert str(error.value).startswith(line)


def test_an_unknown_kind_of_model() -> None:
    with pytest.raises(UserError, match=r"model\.kind is \[\]; allowed: network, polynomial"):
        typed.model_settings({"kind": []})


SOIL = [
    "Scene",
    "Excavation",
    "Wheel",
    "Body",
    "Column",
    "Incline",
    "Bed",
    "Walls",
    "Plate",
    "Box",
    "Cylinder",
    "Other",
    "Sphere",
]
CLASSES = [
    *(getattr(mpm_warp, name) for name in (*SOIL, "MeshBody", "Material", "Effects", "Tolerances")),
    *(
        typed.SolverSettings,
        typed.LossWeights,
        command_settings.Errors,
        command_settings.Limits,
        DatasetSettings,
        PublishedSettings,
        ReductionSettings,
    ),
    *(one for kind in typed.MODELS.values() for one in kind),
    *command_settings.COMMANDS.values(),
]


def wrong_values() -> Iterator[tuple[type, str, object]]:
    """Class, setting and what it may not be, by what its definition says is allowed."""
    for cls in CLASSES:
        for name, _, allowed, _ in described(cls):
            default, wrong = getattr(cls, name, None), []
            if isinstance(default, bool):
                wrong = [1]
            elif isinstance(default, float):
                wrong = [math.nan]
            elif isinstance(default, str) and allowed:
                wrong = ["other"]
            for part in allowed.split(", "):
                wrong += map(float, re.findall(r"(?:above|below) (\S+)", part))
                wrong += [np.nextafter(float(x), -np.inf) for x in re.findall(r"(\S+) (?:or more|to )", part)]
                wrong += [np.nextafter(float(x), np.inf) for x in re.findall(r"(?:at most|to) (\S+)", part)]
            if cls in (mpm_warp.MeshBody, DatasetSettings):
                wrong = []
            several = len(default) if isinstance(default, tuple) else 0
            yield from ((cls, name, (value,) * several if several else value) for value in wrong)


def test_what_is_allowed_is_as_its_definition_says() -> None:
    wrong = list(wrong_values())
    for cls, name, value in wrong:
        with pytest.raises(cls.raises, match=rf"{name}(\[0\])? is "):
            cls(**{name: value})
    assert len(wrong) > 250

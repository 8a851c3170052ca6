"""Which kind of latent dynamics a `model` describes: a network or polynomials. Everywhere else they are `Dynamics`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sgns.errors import UserError
from sgns.learning.dynamics import LatentDynamics
from sgns.learning.model_settings import ModelSettings
from sgns.learning.polynomial import PolynomialDynamics
from sgns.learning.polynomial_settings import PolynomialSettings
from sgns.learning.stepping import Dynamics
from sgns.settings import check_fields

__all__ = ["dynamics_of", "model_settings"]

_SETTINGS: dict[Any, type[ModelSettings] | type[PolynomialSettings]] = {
    "network": ModelSettings,
    "polynomial": PolynomialSettings,
}


def model_settings(model: Mapping[str, Any]) -> ModelSettings | PolynomialSettings:
    """The settings in the values of `conf/model`, checked.

    Raises:
        UserError: A value is unknown or not allowed for this kind; the line names its key.
    """
    kind = model.get("kind")
    if kind not in _SETTINGS:
        raise UserError(f"model.kind is {kind!r}; allowed: {', '.join(_SETTINGS)}")
    check_fields(_SETTINGS[kind], model, "model")
    return _SETTINGS[kind](**model)


def dynamics_of(card: Mapping[str, Any]) -> Dynamics:
    """The dynamics that a card describes (see `Dynamics.card`), to be filled from a state dict."""
    model, num_modes = card["model"], int(card["num_modes"])
    told = tuple(map(str, card["context"])), bool(card["predicts_body"])
    # Networks of earlier versions do not say that they are one.
    if model.get("kind", "network") == "polynomial":
        return PolynomialDynamics(PolynomialSettings(**model), num_modes, *told, card["used"])
    return LatentDynamics(ModelSettings(**model), num_modes, *told)

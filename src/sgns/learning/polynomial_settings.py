"""What `conf/model/polynomial.yaml` and `conf/training/polynomial.yaml` say."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from sgns.errors import UserError
from sgns.learning.model_settings import check_context
from sgns.settings import check_fields

__all__ = ["FitSettings", "PolynomialSettings"]


@dataclass(frozen=True)
class PolynomialSettings:
    """The values of `conf/model/polynomial.yaml`; see there for the meaning of each key."""

    history: int
    degree: int
    context: list[str]
    kind: str = "polynomial"

    def __post_init__(self) -> None:
        if self.kind != "polynomial":
            raise UserError(f"model.kind is {self.kind!r}; allowed: polynomial")
        if self.history < 2:
            raise UserError(f"model.history is {self.history}; it must be at least 2")
        if self.degree not in (1, 2):
            raise UserError(f"model.degree is {self.degree}; allowed: 1, 2")
        check_context(self.context)

    @property
    def body_nodes(self) -> str:
        """The body is always shown as its pose."""
        return "pose"

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for a checkpoint."""
        return {"kind": self.kind} | asdict(self)


@dataclass(frozen=True)
class FitSettings:
    """The values of `conf/training/polynomial.yaml`; see there for the meaning of each key."""

    noises: list[float]
    penalties: list[float]
    linear: bool
    draws: int
    normalisation_floor: float
    resume: str | bool
    threads: int | None

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> FitSettings:
        """From plain values, checked.

        Raises:
            UserError: A value is out of range; the line names the key.
        """
        check_fields(cls, values, "training")
        settings = cls(**values)
        for key in ("noises", "penalties"):
            found = getattr(settings, key)
            if not isinstance(found, list) or not found or not all(map(_is_share, found)):
                raise UserError(f"training.{key} is {found!r}; it must be a list of numbers, 0 or more")
        for key, low in (("draws", 1), ("normalisation_floor", 0), ("threads", 1)):
            value = getattr(settings, key)
            if value is not None and value < low:
                raise UserError(f"training.{key} is {value}; it must be at least {low}")
        if settings.resume not in ("auto", False):
            raise UserError(f"training.resume is {settings.resume!r}; allowed: auto, false")
        return settings

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for a checkpoint."""
        return asdict(self)


def _is_share(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and 0 <= value < math.inf

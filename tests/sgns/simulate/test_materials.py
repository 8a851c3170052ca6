"""The soils in conf/material."""

from __future__ import annotations

from pathlib import Path

import pytest
from hydra import compose, initialize_config_module

import sgns.conf
from mpm_warp import Material
from sgns.simulate.scene import scene_from_config

SOILS = sorted(file.stem for file in (Path(sgns.conf.__path__[0]) / "material").glob("*.yaml"))


def soil(name: str, *overrides: str) -> Material:
    with initialize_config_module("sgns.conf", version_base="1.3"):
        return scene_from_config(compose("simulate", [f"material={name}", *overrides])).material


@pytest.mark.parametrize("name", SOILS)
def test_only_what_is_stated_is_warned_of(name: str) -> None:
    """Glass beads of both sizes are below the K0 condition; nothing else is odd about any of them."""
    warnings = soil(name).warnings()
    assert ["K0" in w for w in warnings] == ([True] if "beads" in name else [])


def test_default_soil_is_the_default_material() -> None:
    assert soil("sand") == Material()


@pytest.mark.parametrize(("angle", "friction"), [(30, 0.5774), (37, 0.7536), (43, 0.9325)])
def test_the_papers_wheel_soils(angle: int, friction: float) -> None:
    found = soil("wheel_sand", f"material.friction_angle={angle}")
    assert found.static_friction == pytest.approx(friction, abs=1e-4)
    assert found.limit_friction == 0.9616
    assert found.youngs_modulus == 15e6


def test_lunar_simulant_has_the_density_and_friction_of_its_source() -> None:
    found = soil("lunar_simulant")
    assert found.bulk_density == pytest.approx(1653.0)
    assert found.static_friction == pytest.approx(1.0)
    assert found.limit_friction == pytest.approx(1.2016)

"""The groups of conf say what the solver's own defaults say, and what else they state."""

from __future__ import annotations

import math
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

import mpm_warp
import sgns.conf
from mpm_warp import Box, Cylinder, Effects, Material, MeshBody, Scene
from mpm_warp.effects import EFFECTS
from sgns.simulate.scene import scene_from_config
from sgns_testing.commands import composed

CONF = Path(sgns.conf.__path__[0])
KINDS = ("body", "column", "excavation", "incline", "wheel")


def options(group: str) -> list[str]:
    return sorted(file.stem for file in (CONF / group).glob("*.yaml"))


SOILS = options("material")
PATH = [[0.0, 0.3, 0.3, 0.2, 0, 0, 0, 1]]


def scene_of(*overrides: str) -> Scene:
    return scene_from_config(composed(*overrides))


def soil(name: str, *overrides: str) -> Material:
    return scene_of(f"material={name}", *overrides).material


def stated(group: str, name: str, base: str = "") -> dict[str, Any]:
    """What the files of an option state beyond those of its `base`, as plain data; of other groups in their place."""
    if name == base:
        return {}
    data = OmegaConf.load(CONF / group / f"{name}.yaml")
    found = OmegaConf.create({})
    for entry in data.pop("defaults", []):
        if entry == "_self_":
            continue
        if isinstance(entry, str):
            found = OmegaConf.merge(found, stated(group, entry, base))
            continue
        ((where, option),) = entry.items()
        inner = stated(where.split("/")[1].split("@")[0], option)
        found = OmegaConf.merge(found, {"material": inner} if "material" in where else inner)
    return OmegaConf.to_container(OmegaConf.merge(found, data))


@pytest.mark.parametrize("kind", KINDS)
def test_a_kind_is_the_class_of_its_name(kind: str, tmp_path: Path) -> None:
    cls = getattr(mpm_warp, kind.title())
    if kind == "body":
        file = tmp_path / "path.csv"
        file.write_text("t,x,y,z,qx,qy,qz,qw\n" + ",".join(map(str, PATH[0])) + "\n")
        assert scene_of("scene=body", f"scene.path={file}") == cls(path=PATH)
    else:
        assert scene_of(f"scene={kind}") == cls()


@pytest.mark.parametrize("name", [name for name in options("scene") if name not in KINDS])
def test_a_preset_differs_from_its_kind_in_what_it_states(name: str) -> None:
    scene = scene_of(f"scene={name}")
    changes = stated("scene", name, scene.kind)
    expected = OmegaConf.merge(type(scene)().to_dict(), changes, {"bed": {"seed": 0}})
    assert scene == Scene.from_dict(OmegaConf.to_container(expected))


@pytest.mark.parametrize("name", SOILS)
def test_a_soil_differs_from_the_default_in_what_it_states(name: str) -> None:
    assert soil(name) == Material(**stated("material", name))
    assert soil(name) == Material(**stated("material", name, "sand"))


@pytest.mark.parametrize("cls", [Box, Cylinder, MeshBody])
def test_a_tool_is_the_class_of_its_name(cls: type) -> None:
    data = stated("scene/tool", cls.shape)
    if cls is MeshBody:
        assert data.pop("file") == "???"
    assert {name: tuple(v) if isinstance(v, list) else v for name, v in data.items()} == {
        name: getattr(cls, name) for name in data
    }


def test_the_numerics_and_effects_are_the_solvers_own() -> None:
    numerics = stated("numerics", "default")
    assert numerics == {name: getattr(Scene, name) for name in numerics}
    assert set(stated("effects", "auto")) == {*EFFECTS, "nonlocal", "tolerance"}
    assert set(EFFECTS) == {*Effects.__dataclass_fields__, "free_body"} - {"group"}


@pytest.mark.parametrize("cls", [getattr(mpm_warp, kind.title()) for kind in KINDS])
def test_the_help_of_a_scene_lists_every_setting(cls: type) -> None:
    listed = [line.split(" = ")[0].strip() for line in cls.__doc__.splitlines() if line.startswith("    ")]
    assert listed[-len(fields(cls)) :] == [one.name for one in fields(cls)]
    assert "    frame_rate = 60.0 Hz: recorded frames per second (0.001 to 1e+06)" in cls.__doc__.splitlines()
    assert all(line.split(": ")[1:] for line in cls.__doc__.splitlines() if line.startswith("    "))


@pytest.mark.parametrize("name", SOILS)
def test_only_what_is_stated_is_warned_of(name: str) -> None:
    """Glass beads of both sizes are below the K0 condition; nothing else is odd about any of them."""
    found = soil(name)
    warnings = [*found.warnings(), *found.warnings_at_rest()]
    assert ["K0" in w for w in warnings] == ([True] if "beads" in name else [])


@pytest.mark.parametrize(("angle", "friction"), [(30, 0.5774), (37, 0.7536), (43, 0.9325)])
def test_the_papers_wheel_soils(angle: int, friction: float) -> None:
    found = soil("wheel_sand", f"material.friction_angle={angle}")
    assert found.static_friction == pytest.approx(friction, abs=1e-4)
    assert found.limit_friction == 0.9616
    assert found.youngs_modulus == 15e6


def test_damp_sand_stands_where_dry_sand_would_not() -> None:
    found = soil("damp_sand")
    assert (found.friction_map, found.cohesion) == ("sin", 1000.0)
    assert found.static_friction == pytest.approx(math.sin(math.radians(36.0)))
    assert found.limit_friction - found.static_friction == pytest.approx(0.2016, abs=1e-4)


def test_lunar_simulant_has_the_density_friction_and_cohesion_of_its_source() -> None:
    found = soil("lunar_simulant")
    assert found.bulk_density == pytest.approx(1653.0)
    assert found.cohesive_pressure == pytest.approx(1000.0)  # c cot 45 degrees
    assert found.static_friction == pytest.approx(1.0)
    assert found.limit_friction == pytest.approx(1.2016)

"""`sgns simulate`: one scene, or every scene of a dataset, with the material point method."""

from __future__ import annotations

import json
import logging
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra import compose
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig
from tqdm import tqdm

from mpm_warp import Preview, Scene
from mpm_warp.preview import afterwards
from sgns.command_settings import Limits
from sgns.config import Interrupted, UserError, of_dataset
from sgns.data.files import only_here
from sgns.data.run import Run
from sgns.data.writer import require_new_run, stopped_path
from sgns.simulate.campaign import cost_line, plan, require_limits, require_space, run_cost
from sgns.simulate.run import Restart, restart_from, simulate_scene, unfinished
from sgns.simulate.scene import (
    asked_effects,
    data_from_config,
    decided,
    effects_line,
    plain,
    recorded,
    require_meant,
    scene_from_config,
    scene_on,
    soil_of,
    warning_summary,
)
from sgns.simulate.workers import simulate_campaign

log = logging.getLogger(__name__)


def base_scene(settings: dict[str, Any]) -> dict[str, Any]:
    """The scene a campaign names and changes, with the command's own overrides of scene.* and material.* on top."""
    if settings.get("scene") is None:
        raise UserError(
            f"dataset={settings['name']} has no scene: its runs come from elsewhere and are not simulated"
        )
    overrides = HydraConfig.get().overrides.task
    if any(o.startswith("scene=") and o != f"scene={settings['scene']}" for o in overrides):
        raise UserError(f"dataset={settings['name']} brings its own scene; leave out scene=")
    kept = [o for o in overrides if not o.lstrip("+~").startswith(("dataset", "scene="))]
    change = [f"scene.{key}={json.dumps(value)}" for key, value in (settings.get("change") or {}).items()]
    asked = [f"scene={settings['scene']}", *change, *kept]
    return data_from_config(compose("simulate", asked), asked)


def require_undrawn(settings: dict[str, Any], overrides: Sequence[str]) -> None:
    """Refuse overrides of what every run of a campaign draws: they would have no effect.

    Raises:
        UserError: The line names the key.
    """
    draw = settings.get("draw")
    grids = [one for one in (draw if isinstance(draw, list) else [draw]) if isinstance(one, dict)]
    for key in (override.lstrip("+").partition("=")[0] for override in overrides):
        drawn = [
            values
            for grid in grids
            for name, values in grid.items()
            if key in (f"scene.{name}", name) or key.startswith((f"scene.{name}.", f"{name}."))
        ]
        if drawn and len(drawn) == len(grids):
            count = len(
                {
                    str(value)
                    for values in drawn
                    for value in (values if isinstance(values, list) else [values])
                }
            )
            name = key.removeprefix("scene.")
            raise UserError(
                f"{key} has no effect: dataset={settings['name']} draws it ({count} values); leave it out, or give "
                f"what is to be drawn, as in 'dataset.draw={{{name}: [...], ...}}'"
            )


def check_settings(cfg: DictConfig, overrides: Sequence[str]) -> None:
    """Refuse a scene that cannot be, for a sweep before its first job.

    Raises:
        UserError, SceneError: what is wrong.
    """
    if cfg.get("dataset") is None and cfg.continue_from is None and cfg.start_from is None:
        scene = scene_from_config(cfg, overrides)
        if not cfg.limits.any_unit:
            require_meant(Preview.of(scene), "limits.any_unit=true")
        decided(scene, asked_effects(cfg))


def main(cfg: DictConfig) -> float | None:
    """Simulate `cfg.scene` into `cfg.output`, or the campaign `cfg.dataset`.

    Returns:
        Wall seconds per simulated second of a single scene.
    """
    if cfg.continue_from is not None:
        if cfg.get("dataset") is not None:
            raise UserError("continue_from goes on with one run; leave out dataset=")
        restart = restart_from(cfg, HydraConfig.get().overrides.task)
        same = {name: getattr(restart, name) for name in ("effects", "reasons", "seed", "precision")}
        return simulate_one(restart.scene, cfg, **same, restart=restart)
    asked = asked_effects(cfg)
    if cfg.start_from is not None and cfg.get("dataset") is not None:
        raise UserError(
            "start_from is for single runs: the runs of a dataset share one undisturbed bed; "
            "leave out dataset=, or let every run make several passes: scene.motion=passes"
        )
    if cfg.get("dataset") is not None:  # `dataset: null` in a defaults list leaves no key
        settings = plain(cfg.dataset)
        if settings.get("where"):
            raise UserError(
                "dataset.where picks among runs that are there; to simulate fewer change dataset.draw"
            )
        require_undrawn(settings, HydraConfig.get().overrides.task)
        if cfg.solver.threads != 1:
            raise UserError(
                f"solver.threads is {cfg.solver.threads}; a dataset makes a run per core instead: leave it out"
            )
        campaign = plan(settings, base_scene(settings), asked, cfg.solver.precision, cfg.seed)
        limits = Limits.from_dict(plain(cfg.limits))
        for line in warning_summary(campaign.scenes, limits.any_unit):
            log.warning("%s", line)
        batch = 1 if cfg.device == "cpu" else cfg.solver.batch
        share = {"shard": cfg.shard, "shards": cfg.shards}
        simulate_campaign(campaign, device=cfg.device, batch=batch, limits=limits, **share)
        if cfg.shards == 1:
            log.info("next: sgns train %s", " ".join(of_dataset(HydraConfig.get().overrides.task)))
        return None
    if (cfg.shard, cfg.shards) != (0, 1):
        raise UserError("shard and shards divide the runs of a dataset; give dataset=... or leave them out")
    if cfg.start_from is None:
        scene = scene_from_config(cfg, HydraConfig.get().overrides.task)
    else:
        scene = scene_on(soil_of(cfg.start_from), cfg, HydraConfig.get().overrides.task)
    preview = Preview.of(scene)
    if not Limits.from_dict(plain(cfg.limits)).any_unit:
        require_meant(preview, "limits.any_unit=true")
    for line in preview.lines:
        log.info("%s", line)
    for warning in preview.warnings:
        log.warning("%s", warning)
    effects, decisions = decided(scene, asked)
    log.info("%s", effects_line([decisions]))
    reasons, precision = recorded(decisions), cfg.solver.precision
    return simulate_one(scene, cfg, effects=effects, reasons=reasons, seed=cfg.seed, precision=precision)


def _way_on(cfg: DictConfig) -> str:
    """How to go on with an interrupted run."""
    if cfg.continue_from is None and HydraConfig.get().mode == RunMode.RUN:
        return "the same command goes on from there"
    kept = stopped_path(Path(cfg.output))
    soil = f" start_from={cfg.start_from}" if cfg.start_from is not None else ""
    return f"sgns simulate continue_from={kept}{soil} output={cfg.output} goes on from there"


def simulate_one(scene: Scene, cfg: DictConfig, restart: Restart | None = None, **settings: Any) -> float:
    """Simulate a scene into `cfg.output` with a bar and a few words about it; see `scene_stages`."""
    output = Path(cfg.output)
    with only_here(output):
        require_new_run(output, bool(cfg.get("overwrite")))
        if restart is None and not cfg.get("overwrite"):
            same = {name: settings[name] for name in ("effects", "seed", "precision")}
            restart = unfinished(output, scene, **same)
        if restart is not None:
            log.info("going on from frame %d of %s", restart.state.frame, restart.path)
        cost = run_cost(scene, settings["effects"])
        log.info("%s", cost_line([cost]))
        require_limits({scene.name: cost}, Limits.from_dict(plain(cfg.limits)))
        require_space(output.parent, cost.size)
        settings |= {"device": cfg.device, "threads": cfg.solver.threads, "restart": restart}
        try:
            with tqdm(total=scene.frame_count, unit="frame", desc=scene.name, disable=None) as bar:
                timing = simulate_scene(scene, output, progress=bar.update, **settings)
        except Interrupted as stop:
            if stop.said:
                stop.said += f"; {_way_on(cfg)}"
            raise
    with Run(output) as run:
        every = scene.bed.store_every
        kept = f" (one of every {every} recorded)" if every > 1 else ""
        count = run.extra["particles_simulated"]
        log.info("%s: %d particles%s, %d frames", output, count, kept, run.frame_count)
        if words := scene.summary(run.force, run.torque, run.pose):
            log.info("%s", words)
        if scene.axle is not None:  # others were told before
            for words in afterwards(scene, run.pose):
                log.warning("%s", words)
    log.info(
        "%.1f s for %.2f simulated s: %.2f s per simulated second, %.2f M particle-steps/s on %s",
        timing.wall_time,
        timing.simulated,
        timing.per_simulated_second,
        timing.rate / 1e6,
        cfg.device,
    )
    log.info("to look at it: sgns plot %s", shlex.quote(str(output)))
    return timing.per_simulated_second

"""Errors of a surrogate trained on other runs than the study's, on the study's cuts, against its reference.

    python experiments/accuracy_vs_time/better_runs.py <best.ckpt> --study outputs/full --set <overrides>

The overrides are those with which its training runs were made; the study's folder holds the reference that `sgns
frontier study=full axis=solver` makes.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from omegaconf import OmegaConf

from sgns.frontier.measure import observed
from sgns.frontier.observation import compare, errors
from sgns.frontier.point import Point
from sgns.frontier.study import Study, composed, composed_scene
from sgns.simulator import Simulator

SHOWN = ("force_nrmse", "draft_mean_error", "vertical_mean_error", "position_rmse_mm", "surface_rmse_mm")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("checkpoint", nargs="+", type=Path)
    parser.add_argument("--study", type=Path, required=True, help="folder of a finished study=full")
    parser.add_argument("--set", nargs="*", default=[], help="overrides that made the training runs")
    options = parser.parse_args()
    settings = OmegaConf.to_container(composed("frontier", ["study=full"]).study, resolve=True)
    study = Study.from_settings(settings, options.study)
    cut = next(scene for scene in study.scenes if scene.name == "cut")
    reference = Point(study.name, cut.name, "solver", "reference", cut.reference.label)
    for checkpoint in options.checkpoint:
        simulator = Simulator.load(checkpoint)
        compared = []
        for case, overrides in cut.cases.items():
            scene = composed_scene([*overrides, *options.set])[0]
            rollout = simulator.rollout(scene.body_poses(), scene.body_points(), values=scene.to_dict())
            compared.append(
                compare(observed(simulator, scene, rollout), study.store.observation(reference, case))
            )
        found = errors(compared, free_body=False)
        print(checkpoint, {key: round(float(found[key]), 3) for key in SHOWN})


if __name__ == "__main__":
    main()

from dataclasses import replace

import pytest
from synthetic import make_run
from tiny import MODEL

from sgns.evaluation.full_space_cost import full_space_cost
from sgns.learning.model_settings import ModelSettings

SETTINGS = ModelSettings(**MODEL)


@pytest.mark.parametrize("n", [200, 2000])
def test_cost_of_a_network_on_every_particle(tmp_path, n):
    run = make_run(tmp_path / "run.h5", n=n)
    cost = full_space_cost(run, SETTINGS, 3)
    assert cost.training_step > cost.rollout / 60.0 > 0.0
    assert cost.peak_bytes > 1e7 and cost.batch_size == 2
    wider = full_space_cost(run, replace(SETTINGS, hidden_width=2 * SETTINGS.hidden_width), 1)
    assert wider.parameters > 2 * cost.parameters

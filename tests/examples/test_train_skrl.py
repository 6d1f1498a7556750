"""A second library trains on the Gymnasium worlds."""

import runpy

import numpy as np

from telebip import ROOT


def test_skrl_trains_a_few_iterations() -> None:
    example = runpy.run_path(str(ROOT / "examples" / "train_skrl.py"))
    statistics = example["train"](num_envs=32, iterations=4)
    assert statistics.episode_count > 32  # untrained robots fall within a second
    assert 5 < np.mean(statistics.length_queue) < 250
    assert np.isfinite(statistics.return_queue).all()

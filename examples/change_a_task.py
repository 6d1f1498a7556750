"""Change a task in Python and train on it for a few iterations, as `scripts/train.py` does with YAML and overrides.

    python examples/change_a_task.py

Tasks are frozen dataclasses: `dataclasses.replace` makes another one, and a misspelt field or term is an error.
"""

from dataclasses import replace
from pathlib import Path

import telebip


def main() -> None:
    """Train slower strides at a price on energy that grows later on, and print the return of each iteration's episodes."""
    task = telebip.load_task("telebip_flat")
    energy = {"k_energy": -0.3, "ramp": (1e6, 3e6)}  # samples
    task = replace(task, gait=replace(task.gait, period=0.6), rewards={**task.rewards, "energy": energy})
    trainer = telebip.Trainer(telebip.make(task, num_envs=256), "slow_strides", Path("runs/slow_strides"))
    for i in range(3):
        print(f"iteration {i + 1}: return {trainer.iterate()['train/episode_return']:.2f}")


if __name__ == "__main__":
    main()

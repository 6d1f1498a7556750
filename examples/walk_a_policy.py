"""Walk a policy that comes with telebip in 64 worlds, and print how fast they walk.

    python examples/walk_a_policy.py

The worlds are those of its training: robots start in random poses and headings, are pushed, and observe with noise.
"""

import numpy as np

import telebip


def main() -> None:
    """Walk for ten seconds at a command of 0.7 m/s forward."""
    env = telebip.make("telebip_flat", num_envs=64)
    policy, _ = telebip.load_policy("telebip_flat")
    env.set_command(0.7, 0.0, 0.0)
    rollout = telebip.roll_out(env, policy, steps=round(10.0 / env.step_dt)).after(2.0)
    speed = np.linalg.norm(rollout.qvel[..., :2].mean(0), axis=-1)  # of each world's mean velocity [m/s]
    print(f"{speed.mean():.2f} m/s, {rollout.fallen.sum()} falls")


if __name__ == "__main__":
    main()

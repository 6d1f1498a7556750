"""What a notebook needs: worlds of a task, and a policy to walk in them."""

from dataclasses import replace
from pathlib import Path

from telebip.config import TaskConfig, load_task
from telebip.control.policy import Policy
from telebip.env import TelebipEnv
from telebip.rl.checkpoint import load_checkpoint
from telebip.rl.policy import load_policy as load_network
from telebip.robot import load_robot
from telebip.sim import Backend


def make(
    task: str | TaskConfig = "telebip_flat",
    num_envs: int | None = None,
    device: str = "cpu",
    backend: Backend = "auto",
    seed: int | None = None,
) -> TelebipEnv:
    """Make the worlds of a task, ready to be stepped.

        env = telebip.make("telebip_flat", num_envs=64)
        obs, rewards, dones, extras = env.step(torch.zeros(64, env.num_actions))

    Args:
        task: name of a task in `configs/`, path of a YAML file, or a configuration, as `load_task` returns it.
        num_envs: number of worlds; the task's if not given.
        device: where tensors live.
        backend: physics engine, see `telebip.sim.make_simulator`.
        seed: of all random numbers; the task's if not given.

    Raises:
        UserError: something is wrong with the task.
    """
    given = {name: value for name, value in (("num_envs", num_envs), ("seed", seed)) if value is not None}
    cfg = replace(load_task(task), **given)
    return TelebipEnv(cfg, load_robot(cfg.sim.robot), device, backend)


def load_policy(path: str | Path, device: str = "cpu") -> tuple[Policy, TaskConfig]:
    """Return a trained policy, and the task that it was trained on.

        policy, task = telebip.load_policy("telebip_efficient")
        env = telebip.make(task, num_envs=64)
        actions = policy(env.reset())

    Args:
        path: a checkpoint (.pt or .onnx), a run folder, or the name of a policy that comes with telebip.
        device: where it acts.

    Raises:
        UserError: there is none, or it is damaged.
    """
    checkpoint = load_checkpoint(path)
    return load_network(checkpoint, device), checkpoint.config

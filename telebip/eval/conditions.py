"""Under which conditions a policy is measured and shown."""

from collections.abc import Sequence

from telebip.config import TaskConfig, load_task


def as_evaluated(
    config: TaskConfig, num_envs: int | str, duration: float, overrides: Sequence[str] = (), disturbed: bool = False
) -> TaskConfig:
    """Return a task whose robots start facing x and walk `duration` s without a time-out.

    `disturbed` ones keep the task's disturbances; else there are no pushes and no observation noise, and the ground has the
    friction of the MJCF. Extra reward terms are left out: walking needs no rewards, and their functions need not be there.
    """
    switches = [] if disturbed else [f"disturbance.{name}.enabled=false" for name in ("push", "friction", "noise")]
    start = [f"num_envs={num_envs}", f"episode.length={duration + 1.0}", "episode.reset_heading=0"]
    return load_task(config, [*start, *switches, "reward.extra={}", *overrides])

"""Gymnasium's interface: after `import telebip.gym`, `gymnasium.make_vec("telebip/Flat-v0", num_envs=64)` makes worlds.

Every task of `configs/` is registered, `telebip_flat` as `telebip/Flat-v0` and so on, for `make_vec` and for `make`. Both take
the arguments of `telebip.gym.env.TelebipVectorEnv`: `make_vec("telebip/Flat-v0", task="mine.yaml")` makes worlds of your task.
"""

import gymnasium

from telebip.config import task_names
from telebip.viz.opengl import choose_opengl

choose_opengl()  # before MuJoCo is imported, for `render_mode="rgb_array"`


def env_id(task: str) -> str:
    """Return the name that Gymnasium knows a task by: `telebip/Flat-v0` for `telebip_flat`."""
    return f"telebip/{task.removeprefix('telebip_').title().replace('_', '')}-v0"


for _task in task_names():
    gymnasium.register(
        env_id(_task),
        entry_point="telebip.gym.env:TelebipSingleEnv",
        vector_entry_point="telebip.gym.env:TelebipVectorEnv",
        kwargs={"task": _task},
    )

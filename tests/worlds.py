"""What tests do to worlds: act, observe, put robots into states, watch the operators that a step runs."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from telebip.env import TelebipEnv

MakeEnv = Callable[..., TelebipEnv]
"""Of the fixture `make_env`."""

CALM = ("events.push=null", "events.friction=null", "observations.policy.noise=false")
"""Overrides of a task that leave no disturbances."""
NEVER_FALL = "terminations.fallen.min_hip_height=0"
PHASE, LAST_ACTION = slice(31, 33), slice(12, 18)
EVENTFUL = (
    *("episode.length=0.3", "commands.resampling_time=0.1", "events.push.interval=[0.06,0.2]"),
    *(
        "commands.rel_standing_envs=0.1",
        "commands.rel_forward_envs=0.2",
        "commands.rel_heading_envs=0.5",
        "commands.velocity_gain=0.5",
    ),
    *("events.push.force=150.0", "rewards.energy.k_energy=-0.3", "ppo.max_fault_rate=1.0"),
)
"""Overrides of a task with which all that the published one has happens within a second."""
MORE_EVENTFUL = (
    *EVENTFUL,
    "observations.critic={joint_pos: {noise: 0.01}, foot_force: {}, friction: {}, push_force: {}, delay: [1, 1], history: 2}",
    *("observations.policy.history=3", "observations.policy.delay=[0,2]", "actions.delay=[0,2]", "actions.physics_delay=[0,3]"),
    *("rewards.energy.ramp=[0,1000]", "rewards.cot={k_cot: -1, min_speed: 0.3, ramp: [0, 1000]}", "events.push.ramp=[10,500]"),
    *("events.kick={lin_vel: 0.3, ang_vel: 1.0, interval: [0.06, 0.12]}", "events.mass={scale: [0.8, 1.2]}"),
)
"""The same with what a task may have: a critic's group, histories, delays, kicks and masses."""
ROUGH = (
    *EVENTFUL,
    "terrain.types.boxes={height: [0.0, 0.1], width: 0.4}",
    "terrain.types.stairs_up={rise: [0.02, 0.1], tread: 0.3}",
    "terrain.types.slope_down={angle: [0, 0.3]}",
    *("terrain.levels=3", "terrain.start_level=[0,2]", "terrain.size=1.0", "terrain.platform=0.4", "events.terrain_level={}"),
    "observations.critic={base_height: {}, height_scan: {forward: [-0.2, 0.4], aside: 0.2, spacing: 0.1, noise: 0.01}}",
    *("sim.max_contacts=16", "sim.max_constraints=96"),
)
"""The same on rough ground, whose tiles are soon left."""


STATEFUL = {
    "<option ": '<size nuserdata="3"/><option ',
    '<position name="left_knee"': '<position timeconst="0.03" name="left_knee"',
    '<position name="left_hip_roll"': '<general dyntype="filter" dynprm="0.02" gainprm="200" biastype="affine" '
    'biasprm="0 -200 -6" forcerange="-50 50" name="left_hip_roll"',
    '<position name="right_hip_pitch"': '<position delay="0.012" nsample="4" name="right_hip_pitch"',
    '<joint name="right_knee"': '<joint stiffness="50" springyield="0.01" name="right_knee"',
    '<key name="home"': '<key act="0.02 0.04" mpos="0.2 0 0.7" name="home"',
    "</worldbody>": '<body name="hand" mocap="true" pos="0.2 0 0.8"/></worldbody>'
    '<equality><weld name="grip" body1="hand" body2="trunk" active="false" solref="0.1 1"/></equality>',
}
"""What gives the robot filters, a delay, a spring that yields, a mocap body, a weld to it that is off, and user data."""


def write_stateful(mjcf: Path, folder: Path) -> Path:
    """Write telebip's MJCF with every kind of state but that of plugins to a folder, and return its path."""
    text = mjcf.read_text()
    for before, after in STATEFUL.items():
        assert before in text
        text = text.replace(before, after, 1)
    (folder / "stateful.xml").write_text(text)
    return folder / "stateful.xml"


def random_actions(steps: int, num_envs: int, scale: float = 1.0, seed: int = 0) -> Tensor:
    return scale * torch.randn(steps, num_envs, 6, generator=torch.Generator().manual_seed(seed))


def observe(env: TelebipEnv) -> Tensor:
    return env.get_observations()["policy"]


def put(env: TelebipEnv, worlds: list[int], qpos: Tensor, qvel: Tensor) -> None:
    """Put the listed worlds into rows of `qpos` and `qvel`."""
    mask = torch.zeros(env.num_envs, dtype=torch.bool)
    mask[worlds] = True
    env.sim.reset(mask, qpos, qvel)


def put_low(env: TelebipEnv, worlds: list[int]) -> None:
    """Put the hips of the listed worlds at 0.3 m, below the 0.4 m that count as a fall."""
    qpos = env.sim.state.qpos.clone()
    qpos[:, 2] = 0.3
    put(env, worlds, qpos, torch.zeros(env.num_envs, 12))


def same(a: object, b: object) -> None:
    """Assert that two results of a step, or parts of them, are the same to the last bit."""
    if isinstance(a, Tensor) and isinstance(b, Tensor):
        torch.testing.assert_close(a, b, rtol=0.0, atol=0.0, equal_nan=True)
    elif isinstance(a, (dict, TensorDict)) and isinstance(b, (dict, TensorDict)):
        assert set(a.keys()) == set(b.keys())
        for name in a.keys():  # noqa: SIM118 (a TensorDict iterates over its rows)
            same(a[name], b[name])
    else:
        assert isinstance(a, (tuple, list)) and isinstance(b, (tuple, list)), (a, b)
        for part, other in zip(a, b, strict=True):
            same(part, other)


def quat_mul(a: Tensor, b: Tensor) -> Tensor:
    """Return the Hamilton product a b, (..., 4): the rotation b followed by a."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        dim=-1,
    )


class HostReads(TorchDispatchMode):
    """Notes the operators that wait for the device, or whose result's shape depends on the data."""

    OPERATORS = ("_local_scalar_dense", "item", "nonzero", "masked_select", "is_nonzero", "equal", "_unique2", "normal")

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[str] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = func.overloadpacket.__name__
        boolean_index = name in ("index", "index_put", "index_put_") and any(
            index is not None and index.dtype == torch.bool for index in args[1]
        )
        if name in self.OPERATORS or boolean_index:
            self.seen.append(name)
        return func(*args, **(kwargs or {}))

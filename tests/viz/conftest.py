# pyright: reportAttributeAccessIssue=false
"""Real walks to look at: the shipped policy, a robot that stands, and another robot, with springs that no actuator moves."""

from pathlib import Path

import mujoco
import pytest
import torch

from telebip import ROOT
from telebip.config import load_task
from telebip.control.policy import Stateless
from telebip.env import TelebipEnv
from telebip.rl.checkpoint import load_checkpoint
from telebip.rl.policy import load_policy
from telebip.robot import Robot, load_robot
from telebip.rollout import Rollout, roll_out

STEPS, STANDING_STEPS = 100, 20  # 2 s and 0.4 s


@pytest.fixture(scope="session")
def urdf(robot: Robot) -> Path:
    return robot.path.with_suffix(".urdf")


@pytest.fixture(scope="session")
def walking(robot: Robot) -> Rollout:
    """Three worlds of the shipped policy that walk at 0.7 m/s and are pushed within the first second."""
    checkpoint = load_checkpoint(ROOT / "assets" / "policies" / "telebip_flat")
    overrides = ["seed=2", "num_envs=3", "events.start_pose.heading=0", "events.push.interval=[0.3,0.6]"]
    env = TelebipEnv(load_task(checkpoint.config, overrides), robot, "cpu", "native")
    env.set_command(0.7, 0.0, 0.0)
    return roll_out(env, load_policy(checkpoint, "cpu"), STEPS)


@pytest.fixture(scope="session")
def standing(robot: Robot) -> Rollout:
    """One world that holds the nominal pose."""
    env = TelebipEnv(load_task("telebip_flat", ["num_envs=1", "events.start_pose.heading=0"]), robot, "cpu", "native")
    return roll_out(env, Stateless(lambda obs: torch.zeros(1, 6)), STANDING_STEPS)


@pytest.fixture(scope="session")
def four_joints(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    """Robot with four actuated joints and two springs, and a URDF beside its MJCF."""
    mjcf = tmp_path_factory.mktemp("robot") / "four_joints.xml"
    mjcf.write_text((ROOT / "tests" / "robots" / "four_joints.xml").read_text())
    robot = load_robot(mjcf)
    bodies = [robot.model.body(i) for i in range(robot.trunk_id, robot.model.nbody)]
    parts = [f'<link name="{body.name}"/>' for body in bodies]
    for body in bodies[1:]:
        joint = robot.model.joint(body.jntadr[0])
        kind = "prismatic" if joint.type[0] == mujoco.mjtJoint.mjJNT_SLIDE else "revolute"
        parts.append(
            f'<joint name="{joint.name}" type="{kind}"><origin xyz="{" ".join(map(str, body.pos))}"/>'
            f'<parent link="{robot.model.body(body.parentid[0]).name}"/><child link="{body.name}"/>'
            f'<axis xyz="{" ".join(map(str, joint.axis))}"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
        )
    mjcf.with_suffix(".urdf").write_text(f'<robot name="four_joints">{"".join(parts)}</robot>')
    return robot

"""What the two model-based walkers share: the plan frame, the step clock, speed and heading, and how the laws come together.

Once per policy step a walker reads the robot's state from the observation, reduces it to an inverted pendulum about the stance
contact, asks its placement law where to touch down, and turns the swing leg's path and the stance leg's force into joint
targets. The plan frame has its origin in the trunk, z up and x along the heading, low-passed: the heading itself wobbles within
a step and would shake the placement.
"""

from dataclasses import dataclass

import torch
from tensordict import TensorDict
from torch import Tensor

from telebip.control.config import WalkerConfig
from telebip.control.kinematics import Kinematics, Motion, joint_forces, rotate, rotate_back
from telebip.control.legs import Hold, stance_force, swing_path
from telebip.control.pendulum import Pendulum, Placement, Step
from telebip.math import matrix, quat_from_yaw, quat_mul, wrap_angle, yaw
from telebip.mdp.observations import LAYOUT


@dataclass(frozen=True)
class Body:
    """One observation of all worlds, as the walker sees it. Plan frame unless noted; legs right, left."""

    motion: Motion  # trunk frame
    to_plan: Tensor  # rotation from the trunk to the plan frame, (num_envs, 3, 3)
    ang_vel: Tensor  # of the trunk, trunk frame [rad/s], (num_envs, 3)
    hip_vel: Tensor  # of the trunk's origin, midway between the hips [m/s], (num_envs, 3)
    com: Tensor  # from the trunk's origin [m], (num_envs, 3)
    com_vel: Tensor  # [m/s], (num_envs, 3)
    ang_mom: Tensor  # centroidal [kg m^2/s], (num_envs, 3)
    foot: Tensor  # contact points under the feet, from the trunk's origin [m], (num_envs, 2, 3)
    joint_pos: Tensor  # [rad | m], (num_envs, 2, 3)
    joint_vel: Tensor  # [rad/s | m/s], (num_envs, 2, 3)
    command: Tensor  # (v_x, v_y) [m/s], (num_envs, 2)
    heading: Tensor  # relative to the reference heading [rad], (num_envs,)


class Walker:
    """A `Policy` that places its feet by a law for the linear inverted pendulum, at whatever rate it is called."""

    def __init__(
        self,
        cfg: WalkerConfig,
        place: Placement,
        kinematics: Kinematics,
        nominal: Tensor,
        action_scale: Tensor,
        num_envs: int,
        step_dt: float,
    ) -> None:
        """Create the walkers of all worlds.

        Args:
            cfg: parameters.
            place: foot placement law.
            kinematics: of the robot.
            nominal: joint positions of the home pose [rad | m], (6,).
            action_scale: joint displacement per unit of action [rad | m], (6,).
            num_envs: number of worlds.
            step_dt: time between two calls [s].
        """
        self.cfg, self.place, self.kinematics, self.step_dt = cfg, place, kinematics, step_dt
        self.hold = Hold(kinematics.stiffness, kinematics.damping, kinematics.force_limit, step_dt)
        self._nominal, self._action_scale = nominal, action_scale

        def zeros(*shape: int) -> Tensor:
            return torch.zeros(num_envs, *shape, device=nominal.device)

        self._is_new = torch.ones(num_envs, dtype=torch.bool, device=nominal.device)
        self._heading = zeros()  # of the plan frame, relative to the reference heading [rad]
        self._side = zeros()  # s: +1 in left stance, -1 in right stance
        self._phase = zeros()  # sigma, fraction of the step that has passed
        self._lift_off = zeros(3)  # see `swing_path`
        self._path = zeros(2)  # way of the centre of mass since the step's beginning [m]
        self._elapsed = zeros()  # time since then [s]
        self._velocity = zeros(2)  # the command, with bounded acceleration [m/s]
        self._speed = zeros(2)  # v_int, what the integral of the speed error adds to the command [m/s]

    def reset(self, mask: Tensor, /) -> None:
        """See `Policy`."""
        self._is_new |= mask

    def __call__(self, obs: TensorDict) -> Tensor:
        """See `Policy`."""
        body = self._observe(obs["policy"])
        self._begin_steps(body)
        stance_foot, _ = self._stance_and_swing(body.foot)
        (stance_pos, swing_pos), (stance_vel, swing_vel) = map(self._stance_and_swing, (body.joint_pos, body.joint_vel))
        arm = body.com - stance_foot

        swing_target = self._swing_target(body, arm, self._touch_down(body, arm))
        swing_force = self.hold.force(swing_target, swing_pos, swing_vel)
        stance_joint_force = self._stance_joint_force(body, arm, stance_foot)
        stance_joint_force[:, :2] -= swing_force[:, :2]  # what moves the swing leg at its hip turns the trunk back
        stance_target = self.hold.target(stance_pos, stance_vel, stance_joint_force)
        self._advance(body)

        left_stands = (self._side > 0.0)[:, None]
        right = torch.where(left_stands, swing_target, stance_target)
        left = torch.where(left_stands, stance_target, swing_target)
        low, high = self.kinematics.joint_range.unbind(-1)
        target = torch.cat([right, left], dim=1).clamp(low, high)
        return (target - self._nominal) / self._action_scale

    def _observe(self, obs: Tensor) -> Body:
        """Read the observation, and bring the plan frame's heading up to date."""
        part = dict(zip(LAYOUT, obs.split(list(LAYOUT.values()), dim=1), strict=True))
        heading = yaw(part["base_quat"])
        change = (self.step_dt / self.cfg.heading_filter) * wrap_angle(heading - self._heading)
        self._heading.copy_(torch.where(self._is_new, heading, wrap_angle(self._heading + change)))
        to_plan = matrix(quat_mul(quat_from_yaw(-self._heading), part["base_quat"]))
        joint_pos, joint_vel, ang_vel = part["joint_pos"] + self._nominal, part["joint_vel"], part["base_ang_vel"]
        motion = self.kinematics(joint_pos, joint_vel, ang_vel)
        foot = rotate(to_plan[:, None], self.kinematics.hip + motion.leg)
        foot[..., 2] -= self.kinematics.foot_radius
        return Body(
            motion=motion,
            to_plan=to_plan,
            ang_vel=ang_vel,
            hip_vel=rotate(to_plan, part["base_lin_vel"]),
            com=rotate(to_plan, motion.com),
            com_vel=rotate(to_plan, motion.com_vel + part["base_lin_vel"]),
            ang_mom=rotate(to_plan, motion.ang_mom),
            foot=foot,
            joint_pos=joint_pos.unflatten(1, (2, 3)),
            joint_vel=joint_vel.unflatten(1, (2, 3)),
            command=part["command"][:, :2],
            heading=heading,
        )

    def _begin_steps(self, body: Body) -> None:
        """Change sides where a step is over, and start new worlds: in mid-step, on the foot that the robot sways towards."""
        cfg, new = self.cfg, self._is_new
        over = (self._phase >= 1.0 - 1e-4) & ~new
        self._phase.copy_(torch.where(new, cfg.start_phase, self._phase - over.float()))
        sway = torch.where(body.com_vel[:, 1] > 0.0, 1.0, -1.0)
        self._side.copy_(torch.where(new, sway, torch.where(over, -self._side, self._side)))

        most = cfg.acceleration * self.step_dt
        velocity = self._velocity + (body.command - self._velocity).clamp(-most, most)
        self._velocity.copy_(torch.where(new[:, None], body.com_vel[:, :2], velocity))

        # The integral of the speed error, once per step, but not while the robot is still gathering speed.
        error = self._velocity - self._path / self._elapsed.clamp(min=self.step_dt)[:, None]
        speed = (self._speed + cfg.speed_gain * error).clamp(-cfg.speed_limit, cfg.speed_limit)
        counts = over[:, None] & (self._velocity == body.command)
        self._speed.copy_(torch.where(counts, speed, self._speed).masked_fill(new[:, None], 0.0))

        begin = (over | new)[:, None]
        stance_foot, swing_foot = self._stance_and_swing(body.foot)
        lift_off = torch.cat([swing_foot[:, :2] - body.com[:, :2], (swing_foot - stance_foot)[:, 2:]], dim=1)
        self._lift_off.copy_(torch.where(begin, lift_off, self._lift_off))
        self._path.masked_fill_(begin, 0.0)
        self._elapsed.masked_fill_(begin[:, 0], 0.0)
        self._is_new.zero_()

    def _advance(self, body: Body) -> None:
        """Let the time of one policy step pass."""
        self._phase += self.step_dt / self.cfg.step_time
        self._elapsed += self.step_dt
        self._path += self.step_dt * body.com_vel[:, :2]

    def _touch_down(self, body: Body, arm: Tensor) -> Tensor:
        """Where the swing foot should touch down, relative to the centre of mass then [m], (num_envs, 2)."""
        cfg, mass = self.cfg, self.kinematics.mass
        height = arm[:, 2].clamp(min=0.1)  # finite answers to a robot that lies on the ground
        (x, y, _), (v_x, v_y, v_z) = arm.unbind(1), body.com_vel.unbind(1)
        orbital = mass * torch.stack([y * v_z - height * v_y, height * v_x - x * v_z], dim=1)
        pendulum = Pendulum(
            mass=mass,
            height=height,
            rate=torch.sqrt(self.kinematics.gravity / height),
            pos=arm[:, :2],
            vel=body.com_vel[:, :2],
            ang_mom=body.ang_mom[:, :2] + orbital,
        )
        time_left = cfg.step_time * (1.0 - self._phase)
        step = Step(self._side, time_left, self._velocity + self._speed, cfg.step_time, cfg.step_width)
        t_x, t_y = self.place(pendulum, step).unbind(1)
        # Without a hip yaw joint the robot turns by stepping further with one foot than with the other.
        t_x = t_x + self._side * (cfg.steering_gain * body.heading).clamp(-cfg.steering_limit, cfg.steering_limit)
        t_x, t_y = t_x.clamp(-cfg.reach, cfg.reach), t_y.clamp(-cfg.reach, cfg.reach)
        # The feet must not cross: the touch-down lies on the swing leg's side of the stance foot.
        sway = pendulum.pos_after(time_left)[:, 1]
        distance = (-self._side * (t_y + sway)).clamp(*cfg.feet_distance)
        return torch.stack([t_x, -self._side * distance - sway], dim=1)

    def _swing_target(self, body: Body, arm: Tensor, touch_down: Tensor) -> Tensor:
        """Joint targets of the swing leg [rad | m], (num_envs, 3): its path in the middle of the coming policy step."""
        kin = self.kinematics
        phase = self._phase + 0.5 * self.step_dt / self.cfg.step_time
        pos, vel = swing_path(self._lift_off, touch_down, phase.clamp(max=1.0), self.cfg)
        pos[:, 2] += kin.foot_radius - arm[:, 2]  # from height over the stance contact to foot centre from centre of mass
        vel[:, 2] -= body.com_vel[:, 2]
        foot = rotate_back(body.to_plan, pos) + body.motion.com  # from the trunk's origin, trunk frame
        hip = torch.where(self._side[:, None] > 0.0, kin.hip[0], kin.hip[1])
        foot_vel = rotate_back(body.to_plan, vel) + body.motion.com_vel - torch.linalg.cross(body.ang_vel, foot)
        leg = foot - hip
        return kin.inverse(leg) + kin.damping * kin.inverse_rate(leg, foot_vel) / kin.stiffness

    def _stance_joint_force(self, body: Body, arm: Tensor, stance_foot: Tensor) -> Tensor:
        """Joint forces of the stance leg, as if the other one had no mass [N m | N], (num_envs, 3)."""
        kin = self.kinematics
        hip = torch.stack([-stance_foot[:, 2], body.hip_vel[:, 2]], dim=1)
        rate = rotate(body.to_plan, body.ang_vel)
        weight = kin.mass * kin.gravity
        force = stance_force(arm, body.to_plan[:, :, 2], rate, hip, weight, kin.friction, self.cfg)
        axes, _ = self._stance_and_swing(body.motion.axes)
        leg, _ = self._stance_and_swing(body.motion.leg)
        contact = leg - kin.foot_radius * body.to_plan[:, 2]  # the point under the foot's centre, trunk frame
        return joint_forces(axes, contact, rotate_back(body.to_plan, force))

    def _stance_and_swing(self, legs: Tensor) -> tuple[Tensor, Tensor]:
        """Split (num_envs, 2, ...), right and left, into that of the stance leg and that of the swing leg."""
        right, left = legs.unbind(1)
        left_stands = (self._side > 0.0).view(-1, *[1] * (right.dim() - 1))
        return torch.where(left_stands, left, right), torch.where(left_stands, right, left)

"""What the two model-based walkers share: the plan frame, the step clock, speed and heading, and how the laws come together.

Once per policy step a walker reads the robot's state from the observation, reduces it to an inverted pendulum about the stance
contact, asks its placement law where to touch down, and turns the swing leg's path and the stance leg's force into joint
targets. The plan frame has its origin in the trunk, z up and x along the heading, low-passed: the heading itself wobbles within
a step and would shake the placement. Tensors have worlds last, see `telebip.control.kinematics`.
"""

from dataclasses import dataclass

import torch
from tensordict import TensorDict
from torch import Tensor

from telebip.control.config import WalkerConfig
from telebip.control.kinematics import Kinematics, Motion, cross, joint_forces, leg_axis, rotate, rotate_back
from telebip.control.legs import Hold, stance_force, swing_path
from telebip.control.pendulum import Pendulum, Placement, Step
from telebip.env import TelebipEnv
from telebip.math import matrix, wrap_angle

ESTIMATE = {
    **{"joint_pos": 6, "joint_vel": 6, "last_action": 6, "base_lin_vel": 3, "base_ang_vel": 3, "base_quat": 4},
    **{"command": 3, "phase": 2},
}
"""Terms of the group of observations that a walker reads, in their order, with their sizes: the article's 33 numbers."""


@dataclass(frozen=True)
class Body:
    """One observation of all worlds, as the walker sees it. Plan frame unless noted; legs right, left."""

    motion: Motion  # trunk frame
    to_plan: Tensor  # rotation from the trunk to the plan frame, (3, 3, num_envs)
    ang_vel: Tensor  # of the trunk, trunk frame [rad/s], (3, num_envs)
    hip_vel: Tensor  # of the trunk's origin, midway between the hips [m/s], (3, num_envs)
    com: Tensor  # from the trunk's origin [m], (3, num_envs)
    com_vel: Tensor  # [m/s], (3, num_envs)
    ang_mom: Tensor  # centroidal [kg m^2/s], (3, num_envs)
    foot: Tensor  # contact points under the feet, from the trunk's origin [m], (3, 2, num_envs)
    joint_pos: Tensor  # [rad | m], (3, 2, num_envs)
    joint_vel: Tensor  # [rad/s | m/s], (3, 2, num_envs)
    command: Tensor  # (v_x, v_y) [m/s], (2, num_envs)
    heading: Tensor  # relative to the reference heading [rad], (num_envs,)


class Walker:
    """A `Policy` that places its feet by a law for the linear inverted pendulum, at whatever rate it is called."""

    def __init__(self, cfg: WalkerConfig, place: Placement, env: TelebipEnv) -> None:
        """Create the walkers of all worlds of `env`, which place their feet by the law `place`.

        Raises:
            UserError: the walkers cannot use the robot's legs.
        """
        self.cfg, self.place, self.step_dt = cfg, place, env.step_dt
        self.kinematics = Kinematics(env.robot, env.device)
        self.hold = Hold(self.kinematics.stiffness, self.kinematics.damping, self.kinematics.force_limit, env.step_dt)
        self._nominal, self._action_scale = env.world.nominal[:, None], env.world.action_scale[:, None]

        def zeros(*shape: int) -> Tensor:
            return torch.zeros(*shape, env.num_envs, device=env.device)

        self._is_new = torch.ones(env.num_envs, dtype=torch.bool, device=env.device)
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
        body = self._observe(obs["estimate"].T)
        self._begin_steps(body)
        stance_foot, _ = self._stance_and_swing(body.foot)
        stance_pos, swing_pos = self._stance_and_swing(body.joint_pos)
        _, swing_vel = self._stance_and_swing(body.joint_vel)
        arm = body.com - stance_foot

        swing_target = self._swing_target(body, arm, self._touch_down(body, arm), swing_pos + 0.5 * self.step_dt * swing_vel)
        swing_force = self.hold.force(swing_target, swing_pos, swing_vel)
        stance_joint_force = self._stance_joint_force(body, arm, stance_foot)
        stance_joint_force[:2] -= swing_force[:2]  # what moves the swing leg at its hip turns the trunk back
        stance_target = self.hold.target(stance_pos, self._stance_joint_vel(body), stance_joint_force)
        self._advance(body)

        left_stands = self._side > 0.0
        right = torch.where(left_stands, swing_target, stance_target)
        left = torch.where(left_stands, stance_target, swing_target)
        low, high = self.kinematics.joint_range.unbind(1)
        target = torch.clamp(torch.cat([right, left]), low, high)
        return ((target - self._nominal) / self._action_scale).T

    def _observe(self, obs: Tensor) -> Body:
        """Read observations (33, num_envs), and bring the plan frame's heading up to date."""
        part = dict(zip(ESTIMATE, obs.split(list(ESTIMATE.values())), strict=True))
        frame = matrix(part["base_quat"].T).permute(1, 2, 0).contiguous()
        heading = torch.atan2(frame[1, 0], frame[0, 0])
        change = (self.step_dt / self.cfg.heading_filter) * wrap_angle(heading - self._heading)
        self._heading.copy_(torch.where(self._is_new, heading, wrap_angle(self._heading + change)))
        cos, sin = self._heading.cos(), self._heading.sin()
        to_plan = torch.stack([cos * frame[0] + sin * frame[1], cos * frame[1] - sin * frame[0], frame[2]])
        joint_pos, joint_vel = part["joint_pos"] + self._nominal, part["joint_vel"].contiguous()
        joint_pos, joint_vel = (joints.unflatten(0, (2, 3)).transpose(0, 1) for joints in (joint_pos, joint_vel))
        ang_vel, hip_vel = part["base_ang_vel"].contiguous(), rotate(to_plan, part["base_lin_vel"])
        motion = self.kinematics(joint_pos, joint_vel, ang_vel)
        foot = rotate(to_plan[:, :, None], self.kinematics.hip + motion.leg)
        foot[2] -= self.kinematics.foot_radius
        return Body(
            motion=motion,
            to_plan=to_plan,
            ang_vel=ang_vel,
            hip_vel=hip_vel,
            com=rotate(to_plan, motion.com),
            com_vel=rotate(to_plan, motion.com_vel) + hip_vel,
            ang_mom=rotate(to_plan, motion.ang_mom),
            foot=foot,
            joint_pos=joint_pos,
            joint_vel=joint_vel,
            command=part["command"][:2],
            heading=heading,
        )

    def _begin_steps(self, body: Body) -> None:
        """Change sides where a step is over, and start new worlds: in mid-step, on the foot that the robot sways towards."""
        cfg, new = self.cfg, self._is_new
        over = (self._phase >= 1.0 - 1e-4) & ~new
        self._phase.copy_(torch.where(new, cfg.start_phase, self._phase - over.float()))
        sway = torch.where(body.com_vel[1] > 0.0, 1.0, -1.0)
        self._side.copy_(torch.where(new, sway, torch.where(over, -self._side, self._side)))

        most = cfg.acceleration * self.step_dt
        velocity = self._velocity + (body.command - self._velocity).clamp(-most, most)
        self._velocity.copy_(torch.where(new, body.com_vel[:2], velocity))

        # The integral of the speed error, once per step, but not while the robot is still gathering speed.
        error = self._velocity - self._path / self._elapsed.clamp(min=self.step_dt)
        speed = (self._speed + cfg.speed_gain * error).clamp(-cfg.speed_limit, cfg.speed_limit)
        counts = over & (self._velocity == body.command)
        self._speed.copy_(torch.where(counts, speed, self._speed).masked_fill(new, 0.0))

        begin = over | new
        stance_foot, swing_foot = self._stance_and_swing(body.foot)
        lift_off = torch.cat([swing_foot[:2] - body.com[:2], (swing_foot - stance_foot)[2:]])
        self._lift_off.copy_(torch.where(begin, lift_off, self._lift_off))
        self._path.masked_fill_(begin, 0.0)
        self._elapsed.masked_fill_(begin, 0.0)
        self._is_new.zero_()

    def _advance(self, body: Body) -> None:
        """Let the time of one policy step pass."""
        self._phase += self.step_dt / self.cfg.step_time
        self._elapsed += self.step_dt
        self._path += self.step_dt * body.com_vel[:2]

    def _touch_down(self, body: Body, arm: Tensor) -> Tensor:
        """Where the swing foot should touch down, relative to the centre of mass then [m], (2, num_envs)."""
        cfg, mass = self.cfg, self.kinematics.mass
        (x, y, height), (v_x, v_y, v_z) = arm, body.com_vel
        height = height.clamp(min=0.1)  # finite answers to a robot that lies on the ground
        orbital = mass * torch.stack([y * v_z - height * v_y, height * v_x - x * v_z])
        pendulum = Pendulum(
            mass=mass,
            height=height,
            rate=torch.sqrt(self.kinematics.gravity / height),
            pos=arm[:2],
            vel=body.com_vel[:2],
            ang_mom=body.ang_mom[:2] + orbital,
        )
        time_left = cfg.step_time * (1.0 - self._phase)
        step = Step(self._side, time_left, self._velocity + self._speed, cfg.step_time, cfg.step_width, cfg.error_kept)
        t_x, t_y = self.place(pendulum, step)
        # Without a hip yaw joint the robot turns by stepping further with one foot than with the other.
        t_x = t_x + self._side * (cfg.steering_gain * body.heading).clamp(-cfg.steering_limit, cfg.steering_limit)
        t_x, t_y = t_x.clamp(-cfg.reach, cfg.reach), t_y.clamp(-cfg.reach, cfg.reach)
        # The feet must not cross: the touch-down lies on the swing leg's side of the stance foot.
        sway = pendulum.pos_after(time_left)[1]
        distance = (-self._side * (t_y + sway)).clamp(*cfg.feet_distance)
        return torch.stack([t_x, -self._side * distance - sway])

    def _swing_target(self, body: Body, arm: Tensor, touch_down: Tensor, joint_pos: Tensor) -> Tensor:
        """Joint targets of the swing leg [rad | m], (3, num_envs): its path in the middle of the coming policy step.

        `joint_pos` is where the joints will be by then. The leg's length l puts the foot at the path's height in the direction
        k that the leg then has, l = -(e . r) / (e . k) with e upwards and r from the hip to the path. The hip lags behind a
        touch-down that moves on late in the step, and a leg as long as it takes there would hit the ground on the way.
        """
        kin = self.kinematics
        phase = self._phase + 0.5 * self.step_dt / self.cfg.step_time
        pos, vel = swing_path(self._lift_off, touch_down, phase.clamp(max=1.0), self.cfg)
        pos[2] += kin.foot_radius - arm[2]  # from height over the stance contact to foot centre from centre of mass
        vel[2] -= body.com_vel[2]
        foot = rotate_back(body.to_plan, pos) + body.motion.com  # from the trunk's origin, trunk frame
        foot_vel = rotate_back(body.to_plan, vel) + body.motion.com_vel - cross(body.ang_vel, foot)
        leg = foot - torch.where(self._side > 0.0, kin.hip[:, 0], kin.hip[:, 1])
        roll, pitch, _ = kin.inverse(leg)
        up, axis = body.to_plan[2], leg_axis(joint_pos[0], joint_pos[1])
        length = -(up * leg).sum(0) / (up * axis).sum(0).clamp(min=0.1)  # finite answers to a robot that lies on the ground
        target = torch.stack([roll, pitch, kin.leg_length - length])
        return target + kin.damping * kin.inverse_rate(leg, foot_vel) / kin.stiffness

    def _stance_joint_vel(self, body: Body) -> Tensor:
        """Joint velocities of the stance leg on a resting foot [rad/s | m/s], (3, num_envs).

        The measured ones are the same but for a touch-down: the foot still moves with the body when it is observed, stops
        within the call, and the knee's damping, which nothing made up for, would throw the robot up.
        """
        kin = self.kinematics
        leg, _ = self._stance_and_swing(body.motion.leg)
        foot = leg + torch.where(self._side > 0.0, kin.hip[:, 1], kin.hip[:, 0])  # from the trunk's origin, trunk frame
        leg_vel = -rotate_back(body.to_plan, body.hip_vel) - cross(body.ang_vel, foot)
        return kin.inverse_rate(leg, leg_vel)

    def _stance_joint_force(self, body: Body, arm: Tensor, stance_foot: Tensor) -> Tensor:
        """Joint forces of the stance leg, as if the other one had no mass [N m | N], (3, num_envs)."""
        kin, motion = self.kinematics, body.motion
        hip = torch.stack([-stance_foot[2], body.hip_vel[2]])
        rate = rotate(body.to_plan, body.ang_vel)
        force = stance_force(arm, body.to_plan[:, 2], rate, hip, kin.mass * kin.gravity, kin.friction, self.cfg)
        leg, pitch_axis, knee_axis = (
            self._stance_and_swing(legs)[0] for legs in (motion.leg, motion.pitch_axis, motion.knee_axis)
        )
        contact = leg - kin.foot_radius * body.to_plan[2]  # the point under the foot's centre, trunk frame
        return joint_forces(pitch_axis, knee_axis, contact, rotate_back(body.to_plan, force))

    def _stance_and_swing(self, legs: Tensor) -> tuple[Tensor, Tensor]:
        """Split (3, 2, num_envs), right and left, into that of the stance leg and that of the swing leg."""
        left_stands, right, left = self._side > 0.0, legs[:, 0], legs[:, 1]
        return torch.where(left_stands, left, right), torch.where(left_stands, right, left)

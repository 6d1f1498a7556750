# pyright: reportAttributeAccessIssue=false
"""One second in the home pose, before anything is trained or measured: what no look at the MJCF alone can tell.

A part is on C MuJoCo, with controls at the nominal pose; another one is in a handful of worlds of the task, with all its terms.
It takes some tenths of a second.
"""

import copy
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray

from telebip.config import TaskConfig
from telebip.env import TelebipEnv
from telebip.mdp.actions import scales
from telebip.robot import FEET, FOOT_SENSORS, Robot, silent_engine
from telebip.robot_check import can_collide

SECONDS = 1.0
WORLDS = 8
LEAN = 0.3
"""From here on the robot is toppling, which a walker may, and no more is asked of its joints and feet [rad]."""
MAX_STEPS = 2000
"""No more physics steps than so many."""
SETTLE = 0.1
"""Landing takes so long [s]."""

SOFTER = "take a smaller timestep, a lower kp or gear, or more armature"

Verdict = Literal["ok", "warning", "error"]


@dataclass(frozen=True)
class Finding:
    """What one check has found."""

    check: str
    found: str
    verdict: Verdict = "ok"
    remedy: str = ""

    def __str__(self) -> str:
        """Return it as the end of a line to the user."""
        return f"{self.check}: {self.found}{f'; {self.remedy}' if self.remedy else ''}"


@dataclass(frozen=True)
class Stand:
    """A second of standing on C MuJoCo, one row per physics step, until the robot topples."""

    time: NDArray[np.float64]  # (steps,) [s]
    qpos: NDArray[np.float64]  # (steps, nq)
    lean: NDArray[np.float64]  # (steps,) angle between the trunk and its home pose [rad]
    joint_force: NDArray[np.float64]  # (steps, num_joints) [N m | N]
    felt: NDArray[np.float64]  # (steps, 2) what the feet's sensors say [N]
    pressed: NDArray[np.float64]  # (steps, 3) normal force of the ground on right and left foot, and on all else [N]
    warning: str  # of the engine, or empty


def standing_test(config: TaskConfig, robot: Robot) -> list[Finding]:
    """Let the robot stand, and return all that was looked at; no more where the home pose itself is no pose to stand in."""
    placed = [*_place(robot), *_hips(config, robot)]
    if any(finding.verdict == "error" for finding in placed):
        return placed
    stand = let_stand(robot)
    if stand.warning:
        return [*placed, Finding("physics", f"{stand.warning}; {_stiffest(robot)}", "error", SOFTER)]
    physical = [*_feel(robot, stand), *_friction(config, robot), *_hold(config, robot, stand), *_overlaps(robot)]
    return [*placed, *physical, *_terms(config, robot)]


def let_stand(robot: Robot, seconds: float = SECONDS) -> Stand:
    """Hold the nominal pose on C MuJoCo, from the home pose, until the robot leans by more than `LEAN`."""
    model = copy.copy(robot.model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    data, rows, warning = mujoco.MjData(model), [], ""
    data.qpos[:], data.ctrl[:] = robot.home_qpos, robot.nominal
    feet = [int(model.site_bodyid[model.sensor(name).objid[0]]) for name in FOOT_SENSORS]
    places = [int(model.sensor(name).adr[0]) for name in FOOT_SENSORS]
    mujoco.mj_kinematics(model, data)
    home_up = data.xmat[robot.trunk_id, 6:9].copy()
    with silent_engine():
        for _ in range(min(MAX_STEPS, max(1, round(seconds / robot.physics_dt)))):
            try:
                mujoco.mj_step(model, data)
            except mujoco.FatalError as error:
                warning = f"the engine stops with '{error}' after {data.time:.3f} s in the home pose"
                break
            if data.warning.number.any() or not np.isfinite(data.qpos).all():
                kind = next((w for w in mujoco.mjtWarning.__members__ if _warned(data, w)), "mjWARN_BADQPOS")
                warning = f"the engine warns ({kind.removeprefix('mjWARN_')}) after {data.time:.3f} s in the home pose"
                break
            lean = math.acos(np.clip(data.xmat[robot.trunk_id, 6:9] @ home_up, -1.0, 1.0))
            if lean > LEAN:
                break
            force = data.actuator_force.copy()
            rows.append((data.time, data.qpos.copy(), lean, force, data.sensordata[places], _pressed(model, data, robot, feet)))
    columns = [np.array(column) for column in zip(*rows, strict=True)] if rows else [np.zeros((0, 1))] * 6
    return Stand(*columns, warning=warning)


def _stiffest(robot: Robot) -> str:
    """Return which joint is stiffest for its inertia and the physics step: kp dt^2 / I, which must not be far above 1."""
    model = robot.model
    dofs = model.jnt_dofadr[model.actuator_trnid[:, 0]]
    stiffness = model.actuator_gainprm[:, 0] * model.dof_invweight0[dofs] * robot.physics_dt**2
    i = int(stiffness.argmax())
    unit = "N/m" if robot.is_slide[i] else "N m/rad"
    return f"joint '{robot.joint_names[i]}' is the stiffest, {model.actuator_gainprm[i, 0]:.4g} {unit} with its gear"


def _warned(data: mujoco.MjData, name: str) -> bool:
    kind = int(mujoco.mjtWarning.__members__[name])
    return kind < len(data.warning) and data.warning[kind].number > 0


def _pressed(model: mujoco.MjModel, data: mujoco.MjData, robot: Robot, feet: list[int]) -> list[float]:
    """Return the normal force of the ground on each foot, with all that hangs on it, and on the rest of the robot [N]."""
    found, force = [0.0, 0.0, 0.0], np.zeros(6)
    for i, contact in enumerate(data.contact):
        if robot.floor_id in contact.geom:
            other = contact.geom[0] if contact.geom[1] == robot.floor_id else contact.geom[1]
            body = int(model.geom_bodyid[other])
            mujoco.mj_contactForce(model, data, i, force)
            found[next((k for k, foot in enumerate(feet) if _hangs_on(model, body, foot)), 2)] += force[0]
    return found


def _hangs_on(model: mujoco.MjModel, body: int, other: int) -> bool:
    """Whether a body is another one, or moves with it."""
    while body > other:
        body = int(model.body_parentid[body])
    return body == other


def clearance(robot: Robot) -> NDArray[np.float64]:
    """Return the height of each foot above the floor in the home pose, negative in the ground [m], (2,); inf if unknown."""
    model = copy.copy(robot.model)
    model.geom_margin[robot.floor_id] = model.pair_margin[:] = 100.0  # contacts are found from afar, with their distance
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE  # which would leave out geoms whose boxes do not touch
    data = mujoco.MjData(model)
    data.qpos[:] = robot.home_qpos
    with silent_engine():
        mujoco.mj_forward(model, data)
    feet = [int(model.site_bodyid[model.sensor(name).objid[0]]) for name in FOOT_SENSORS]
    heights = np.full(2, np.inf)
    for contact in data.contact:
        if robot.floor_id in contact.geom:
            other = contact.geom[0] if contact.geom[1] == robot.floor_id else contact.geom[1]
            for k, foot in enumerate(feet):
                if _hangs_on(model, int(model.geom_bodyid[other]), foot):
                    heights[k] = min(heights[k], contact.dist)
    return heights


def _place(robot: Robot) -> Iterator[Finding]:
    """Judge where the feet are in the home pose: off the ground by 1 % of the hips' height is said, by 5 % refused."""
    hips, heights = float(robot.home_qpos[2]), clearance(robot)
    for foot, height in zip(FEET, heights, strict=True):
        check, share = f"{foot} at home", abs(height) / max(hips, 1e-9)
        if not math.isfinite(height):
            yield Finding(check, "its height above the floor is unknown")
            continue
        where = "above the floor" if height >= 0.0 else "in the floor"
        verdict: Verdict = "error" if share > 0.05 else "warning" if share > 0.01 else "ok"
        level = hips - float(heights.min())
        remedy = f"a trunk at z = {level:.4g} in keyframe 'home' puts the lower foot on the ground" if verdict != "ok" else ""
        yield Finding(check, f"{1e3 * abs(height):.1f} mm {where}", verdict, remedy)


def _hips(config: TaskConfig, robot: Robot) -> Iterator[Finding]:
    """Judge whether the home pose counts as a fall."""
    hips = float(robot.home_qpos[2])
    for name, params in config.terminations.items():
        if "min_hip_height" in params:
            least, setting = params["min_hip_height"], f"terminations.{name}.min_hip_height"
            remedy = f"set {setting}={0.6 * hips:.2g} (0.6 of the hips' height)"
            verdict: Verdict = "error" if hips < least else "warning" if 0.95 * hips < least else "ok"
            found = f"{hips:.3g} m at home, and below {least:g} m ({setting}) is a fall"
            yield Finding("hips", found, verdict, "" if verdict == "ok" else remedy)


def _feel(robot: Robot, stand: Stand) -> Iterator[Finding]:
    """Judge whether the feet carry the robot, and whether their sensors feel it."""
    rows = stand.time > SETTLE if (stand.time > SETTLE).any() else slice(None)
    if not len(stand.time):
        return
    pressed, felt = stand.pressed[rows].mean(0), stand.felt[rows].mean(0)
    share = pressed[:2].sum() / robot.weight
    how = f"{100 * share:.0f} % of the robot's weight of {robot.weight:.0f} N"
    found = how + (
        f", and {100 * pressed[2] / robot.weight:.0f} % is on other parts" if pressed[2] > 0.01 * robot.weight else ""
    )
    verdict: Verdict = "ok" if share > 0.8 else "warning"
    yield Finding("load on the feet", found, verdict, "" if verdict == "ok" else "what else holds the robot up?")
    for i, (foot, sensor) in enumerate(zip(FEET, FOOT_SENSORS, strict=True)):
        if pressed[i] < 0.01 * robot.weight:
            if verdict == "ok":
                yield Finding(f"sensor '{sensor}'", f"{foot} is not on the ground", "warning", "is home a pose on both feet?")
            continue
        part = felt[i] / pressed[i]
        site = robot.model.site(int(robot.model.sensor(sensor).objid[0])).name
        remedy = f"site '{site}' must be on the body of the foot's geoms and enclose them"
        judged: Verdict = "error" if part < 0.5 else "warning" if part < 0.9 else "ok"
        found = f"feels {felt[i]:.0f} N of {pressed[i]:.0f} N"
        yield Finding(f"sensor '{sensor}'", found, judged, "" if judged == "ok" else remedy)


def _friction(config: TaskConfig, robot: Robot) -> Iterator[Finding]:
    """Say whether a friction of the ground that differs from world to world is that of the feet's contacts."""
    if not any(params.get("term", name) == "friction" for name, params in config.events.items()):
        return
    model = robot.model
    for foot, sensor in zip(FEET, FOOT_SENSORS, strict=True):
        geoms = np.flatnonzero(model.geom_bodyid == model.site_bodyid[model.sensor(sensor).objid[0]])
        touching = [int(geom) for geom in geoms if can_collide(model, geom, robot.floor_id)]
        if any(model.geom_priority[geom] >= model.geom_priority[robot.floor_id] for geom in touching):
            found = "its own friction counts beside the floor's, which events.friction draws"
            yield Finding(foot, found, "warning", "give geom 'floor' the higher priority, as priority=\"1\"")


def _hold(config: TaskConfig, robot: Robot, stand: Stand) -> Iterator[Finding]:
    """Judge whether joints stay near their targets, with room in forces and in controls."""
    if not len(stand.time):
        yield Finding(
            "stands", f"leans by {LEAN} rad at once", "warning", "is the robot balanced at home, and are its gains stable?"
        )
        return
    end = float(stand.time[-1])
    yield Finding("stands", f"for {end:.2f} s" + ("" if end > SECONDS - 0.01 else f", then leans by {LEAN} rad"))
    late = stand.time > min(SETTLE, 0.5 * end)
    columns = robot.model.jnt_qposadr[robot.model.actuator_trnid[:, 0]]
    off = np.abs(stand.qpos[-1][columns] - robot.nominal)
    force, (low, high) = stand.joint_force[late], robot.force_range.T
    at_low, at_high = (force < 0.999 * low).mean(0), (force > 0.999 * high).mean(0)
    is_full, swings = at_low + at_high > 0.5, np.minimum(at_low, at_high) > 0.1
    for i, (name, scale) in enumerate(zip(robot.joint_names, scales(config.actions.scale, robot.joint_names), strict=True)):
        unit = "m" if robot.is_slide[i] else "rad"
        problems = [f"{off[i]:.2g} {unit} from its target"] if off[i] > scale else []
        problems += ["with all of its force" + (", to and fro" if swings[i] else "")] if is_full[i] else []
        remedy = ("lower its kp or the timestep" if swings[i] else "raise its kp or forcerange") if problems else ""
        found = " ".join(problems) or f"{off[i]:.2g} {unit} from its target"
        yield Finding(f"joint '{name}'", found, "warning" if problems else "ok", remedy)
        yield from _reach(robot, i, name, scale)


def _reach(robot: Robot, i: int, name: str, scale: float) -> Iterator[Finding]:
    """Say which targets within one unit of action the actuator clips."""
    (low, high), nominal = robot.model.actuator_ctrlrange[i], robot.nominal[i]
    if robot.model.actuator_ctrllimited[i] and not low <= nominal - scale <= nominal + scale <= high:
        found = f"targets are clipped to {low:g} .. {high:g}, and actions of -1 to 1 ask for "
        remedy = f"widen the ctrlrange, or lower actions.scale of '{name}'"
        yield Finding(f"joint '{name}'", f"{found}{nominal - scale:g} .. {nominal + scale:g}", "warning", remedy)


def _overlaps(robot: Robot) -> Iterator[Finding]:
    """Say which parts of the robot are in each other in the home pose."""
    data = mujoco.MjData(robot.model)
    data.qpos[:] = robot.home_qpos
    with silent_engine():
        mujoco.mj_forward(robot.model, data)
    for contact in data.contact:
        if robot.floor_id not in contact.geom and contact.dist < -1e-3:
            names = " and ".join(f"'{robot.model.geom(int(g)).name or g}'" for g in contact.geom)
            found = f"{-1e3 * contact.dist:.1f} mm in each other at home"
            yield Finding(f"geoms {names}", found, "warning", "exclude the contact, or move them apart")


def _terms(config: TaskConfig, robot: Robot) -> Iterator[Finding]:
    """Judge the task's terms in worlds of which one holds the pose and the others act at random; half are pushed over."""
    groups = {name: replace(group, noise=False) for name, group in config.observations.items()}
    env = TelebipEnv(replace(config, num_envs=WORLDS, observations=groups), robot, "cpu", "native")
    generator, steps = torch.Generator().manual_seed(0), max(2, min(200, round(SECONDS / env.step_dt)))
    seen, logs, finite = [], [], {}
    with torch.inference_mode():
        for step in range(steps):
            actions = 0.5 * torch.randn(WORLDS, env.num_actions, generator=generator)
            actions[0] = 0.0
            shove = torch.zeros(WORLDS, 3)
            shove[WORLDS // 2 :, 1] = 2.0 * robot.weight * (step > 0.5 * steps)
            env.push(shove)
            obs, _, _, extras = env.step(actions)
            seen.append(env.reward_terms.clone())
            logs.append(extras["log"])
            for name, values in _parts(env, obs):
                finite[name] = finite.get(name, True) and bool(values.isfinite().all())
    yield from _endings(env, config, logs[0])
    if broken := env.broken_reward():
        yield Finding("rewards", broken, "error", "see what the term divides by, and its logarithms and roots")
    yield from _rewards(config, env.reward_names, torch.stack(seen))
    for name, is_finite in finite.items():
        if not is_finite:
            yield Finding(f"observation '{name}'", "is not finite", "error", "see what the term divides by")
    early = sum(float(log["fault/worlds"]) for log in logs[: steps // 2])
    for kind in [kind for kind in env.take_faults() if kind != "non_finite_reward"][:1]:
        found = f"breaks down ({kind}) {'under actions of half a unit' if early else 'in falls'}; {_stiffest(robot)}"
        yield Finding("physics", found, "error" if early else "warning", SOFTER)


def _parts(env: TelebipEnv, obs) -> Iterator[tuple[str, torch.Tensor]]:
    """Yield the parts of all groups of observations, of the newest frame, by "group.term"."""
    for group, parts in env.layout().items():
        start = 0
        for part in parts:
            yield f"{group}.{part['name']}", obs[group][:, start : start + part["size"]]
            start += part["size"]


def _endings(env: TelebipEnv, config: TaskConfig, log: dict[str, torch.Tensor]) -> Iterator[Finding]:
    """Judge whether a termination ends episodes as they begin."""
    for name in config.terminations:
        share = float(log[f"termination/{name}_per_minute"]) * env.step_dt / 60.0
        if share > 0.5:
            found = f"ends {100 * share:.0f} % of the episodes in their first step"
            yield Finding(f"terminations.{name}", found, "error", f"it has {config.terminations[name]}")


def _rewards(config: TaskConfig, names: tuple[str, ...], seen: torch.Tensor) -> Iterator[Finding]:
    """Judge reward terms (steps, terms, num_envs): which say the same whatever happens."""
    for i, name in enumerate(names):
        values, params = seen[:, i], config.rewards[name]
        factors = [value for key, value in params.items() if key.startswith("k_")]
        if factors and not any(factors):
            yield Finding(f"reward '{name}'", "switched off by its factor of 0")
        elif values.min() == values.max():
            found = f"is {values.min():g} always, also under random actions and in falls"
            yield Finding(f"reward '{name}'", found, "warning", "nothing can be learned from it")
        else:
            yield Finding(f"reward '{name}'", f"{values.min():.3g} to {values.max():.3g}")

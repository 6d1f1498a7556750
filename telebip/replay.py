"""Faults on disk, and how to repeat them: the state of one world before the step that broke it, and all that acted on it."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from telebip.archive import load_archive, save_archive
from telebip.config import TaskConfig, parse_config, to_yaml
from telebip.env import MODEL_FIELDS, TelebipEnv
from telebip.errors import UserError
from telebip.eval.rollout import Rollout
from telebip.mdp.actions import action_scale, joint_targets
from telebip.mdp.faults import KINDS
from telebip.mdp.terminations import non_finite
from telebip.robot import Robot, load_robot
from telebip.sim import Backend, SimState, make_simulator

FORMAT = "telebip-fault-1"
RECORD = {"step", "world", "action", "push_wrench_w", "time", "qpos", "qvel", "qacc_warmstart", *MODEL_FIELDS}
"""What a fault's record holds at least: all that the outcome of a step depends on."""


@dataclass(frozen=True)
class Fault:
    """What `save_fault` has written."""

    kind: str  # of `telebip.mdp.faults.KINDS`
    config: TaskConfig
    backend: Backend
    record: dict[str, Tensor]  # of one world: "step", "world", "action", "push_wrench_w", the engine's memory, model fields


@dataclass(frozen=True)
class Replay:
    """The policy step of a fault again, one physics step at a time."""

    robot: Robot
    states: list[SimState]  # of one world: before the step, and after each of its physics steps
    joint_target: Tensor  # (1, 6) [rad | m]
    push_w: Tensor  # force on the trunk's centre of mass, world frame [N], (1, 3)
    faults: list[set[str]]  # kinds seen by then, as `states`

    def reproduces(self, kind: str) -> bool:
        """Whether the fault has happened again."""
        return kind in self.faults[-1]

    def rollout(self) -> Rollout:
        """Return the physics steps as a rollout of one world, to be drawn and recorded; without commands and rewards."""
        steps = len(self.states)
        state = {
            field.name: torch.stack([getattr(state, field.name) for state in self.states]).numpy() for field in fields(SimState)
        }
        zeros = {
            name: np.zeros((steps, 1, size), np.float32) for name, size in (("phase", 2), ("command", 3), ("reward_terms", 0))
        }
        return Rollout(
            step_dt=self.robot.physics_dt,
            weight=self.robot.weight,
            reward_names=(),
            **state,
            **zeros,
            joint_target=self.joint_target.expand(steps, 1, 6).numpy(),
            push_w=self.push_w.expand(steps, 1, 3).numpy(),
            reference_heading=np.zeros((steps, 1), np.float32),
            reward=np.zeros((steps, 1), np.float32),
            fallen=np.zeros((steps, 1), bool),
        )


def fault_file(run_dir: Path, kind: str) -> Path:
    """Return where a run's first fault of a kind is dumped."""
    return run_dir / "faults" / f"{kind}.pt"


def save_fault(run_dir: Path, kind: str, record: dict[str, Tensor], task: str, env: TelebipEnv) -> Path:
    """Write `run_dir/faults/<kind>.pt`, unless it is there, and return its path.

    Raises:
        OSError: it cannot be written.
    """
    file = fault_file(run_dir, kind)
    if file.exists():
        return file
    file.parent.mkdir(exist_ok=True)
    about = {
        "format": FORMAT,
        "kind": kind,
        "task": task,
        "config": to_yaml(env.cfg),
        "seed": env.cfg.seed,
        "backend": env.sim.backend,
    }
    save_archive(file, {**about, "record": record})
    return file


def load_fault(path: str | Path) -> Fault:
    """Read what `save_fault` has written; it is data alone.

    Raises:
        UserError: there is no such file, or it is something else.
    """
    content = load_archive(Path(path), "fault", FORMAT)
    if content.get("kind") not in KINDS:
        raise UserError(f"fault '{path}': this version knows no '{content.get('kind')}'")
    record = content.get("record")
    if not (isinstance(record, dict) and record.keys() >= RECORD and all(isinstance(x, Tensor) for x in record.values())):
        raise UserError(f"fault '{path}' is not complete: of the step's beginning it lacks something")
    if content.get("backend") not in ("native", "warp") or not isinstance(content.get("config"), str):
        raise UserError(f"fault '{path}' is not complete: it lacks its engine or its configuration")
    return Fault(content["kind"], parse_config(content["config"], f"{path}:config"), content["backend"], record)


def replay(fault: Fault, backend: Backend | None = None) -> Replay:
    """Repeat the step of a fault on the CPU, on the engine that it happened on or on another.

    Physics steps are taken one by one; on `native` they are the same, bit for bit, as those of the policy step.

    Raises:
        UserError: the configuration names another robot.
    """
    cfg, record = fault.config, fault.record
    robot = load_robot(cfg.sim.robot)
    capacity = cfg.sim.max_contacts, cfg.sim.max_constraints
    sim = make_simulator(backend or fault.backend, robot, 1, 1, torch.device("cpu"), MODEL_FIELDS, capacity)
    if any(record[name].shape != value.shape[1:] for name, value in {**sim.model_fields, **sim.memory}.items()):
        raise UserError(f"the fault is of another robot than '{cfg.sim.robot}'")
    for name, field in sim.model_fields.items():
        field.copy_(record[name])
    sim.load({name: record[name][None] for name in sim.memory})
    action = record["action"][None]
    seen = set() if action.isfinite().all() else {"non_finite_action"}
    target = joint_targets(
        torch.where(action.isfinite().all(), action, 0.0), torch.as_tensor(robot.nominal).float(), action_scale(cfg.action)
    )
    states, faults = [_copy(sim.state)], [set(seen)]
    for _ in range(cfg.sim.decimation):
        sim.step(target, record["push_wrench_w"][None])
        rows = torch.cat([torch.stack([non_finite(sim.state)]), sim.faults])[:, 0]
        seen |= {kind for kind, found in zip(KINDS[1:], rows.tolist(), strict=True) if found}
        states.append(_copy(sim.state))
        faults.append(set(seen))
    return Replay(robot, states, target, record["push_wrench_w"][None, :3], faults)


def _copy(state: SimState) -> SimState:
    return SimState(**{field.name: getattr(state, field.name).clone() for field in fields(SimState)})


def describe(record: dict[str, Any]) -> str:
    """Return where and when: the world and the step of a record."""
    return f"world {int(record['world'])}, environment step {int(record['step'])}"

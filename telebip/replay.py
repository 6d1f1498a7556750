"""Faults on disk, and how to repeat them: the state of one world before the step that broke it, and all that acted on it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from telebip.archive import load_archive, save_archive
from telebip.config import TaskConfig, parse_config, to_yaml
from telebip.env import TelebipEnv
from telebip.errors import UserError
from telebip.mdp.faults import KINDS
from telebip.mdp.terminations import non_finite
from telebip.robot import Robot, load_robot
from telebip.robot_record import describe_robot, differences, is_record
from telebip.rollout import Rollout
from telebip.sim import Backend, SimState, Simulator, make_simulator
from telebip.terrain import make_terrain

FORMAT = "telebip-fault-2"
RECORD = {"step", "world", "action", "targets", "wrench_w"}
"""What a fault's record holds beside the engine's whole state and the fields of the model."""
STATE = ("qpos", "qvel", "joint_pos", "foot_force", "joint_force", "joint_power", "joint_net_power")
"""What of a state is kept for the rollout."""


@dataclass(frozen=True)
class Fault:
    """What `save_fault` has written."""

    kind: str  # of `telebip.mdp.faults.KINDS`
    config: TaskConfig
    backend: Backend
    model_fields: list[str]  # names of those that had a value per world
    record: dict[str, Tensor]  # of one world: `RECORD`, `Simulator.memory` and the fields of the model
    robot: dict[str, Any]  # see `telebip.robot_record`


@dataclass(frozen=True)
class Replay:
    """The policy step of a fault again, one physics step at a time."""

    robot: Robot
    robot_changes: list[str]  # in what that robot differs from the one that the fault happened to, a line each
    states: list[dict[str, Tensor]]  # `STATE` of one world: before the step, and after each of its physics steps
    targets: Tensor  # of each physics step (decimation, num_joints) [rad | m]
    force_w: Tensor  # on the trunk's centre of mass, world frame [N], (3,)
    faults: list[set[str]]  # kinds seen by then, as `states`

    def reproduces(self, kind: str) -> bool:
        """Whether the fault has happened again."""
        return kind in self.faults[-1]

    def rollout(self) -> Rollout:
        """Return the physics steps as a rollout of one world, to be drawn and recorded; without commands and rewards."""
        steps = len(self.states)

        def zeros(*size: int) -> np.ndarray:
            return np.zeros((steps, 1, *size), np.float32)

        return Rollout(
            step_dt=self.robot.physics_dt,
            weight=self.robot.weight,
            joint_names=self.robot.joint_names,
            reward_names=(),
            **{name: torch.stack([state[name] for state in self.states]).numpy() for name in STATE},
            joint_target=torch.cat([self.targets[:1], self.targets])[:, None].numpy(),
            push_w=self.force_w.expand(steps, 1, 3).numpy(),
            phase=zeros(2),
            command=zeros(3),
            reference_heading=zeros(),
            reward=zeros(),
            reward_terms=zeros(0),
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
        "model_fields": list(env.sim.model_fields),
        "memory": list(env.sim.memory),
        "robot": describe_robot(env.robot, env.cfg.sim.decimation),
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
    record, fields, memory, robot = (content.get(name) for name in ("record", "model_fields", "memory", "robot"))
    if (
        not isinstance(fields, list)
        or not isinstance(memory, list)
        or not (isinstance(robot, dict) and is_record(robot))
        or content.get("backend") not in ("native", "warp")
        or not isinstance(content.get("config"), str)
    ):
        raise UserError(f"fault '{path}' is not complete: it lacks its engine, its robot or its configuration")
    needed = {*RECORD, *fields, *memory}
    if not (isinstance(record, dict) and record.keys() >= needed and all(isinstance(x, Tensor) for x in record.values())):
        raise UserError(f"fault '{path}' is not complete: of the step's beginning it lacks something")
    config = parse_config(content["config"], f"{path}:config", missing=[])  # physics needs no terms
    return Fault(content["kind"], config, content["backend"], fields, record, robot)


def replay(fault: Fault, backend: Backend | None = None) -> Replay:
    """Repeat the step of a fault on the CPU, on the engine that it happened on or on another.

    Physics steps are taken one by one; on `native` they are the same, bit for bit, as those of the policy step.

    Raises:
        UserError: the configuration names another robot.
    """
    cfg, record = fault.config, fault.record
    robot = load_robot(cfg.sim.robot).on(make_terrain(cfg.terrain))
    sim = _simulator_at(fault, robot, backend or fault.backend)
    targets = record["targets"].expand(cfg.sim.decimation, -1)
    seen = set() if record["action"].isfinite().all() else {"non_finite_action"}
    states, faults = [_copy(sim.state)], [set(seen)]
    for target in targets:
        sim.step(target[None], record["wrench_w"][None])
        rows = torch.cat([torch.stack([non_finite(sim.state)]), sim.faults])[:, 0]
        seen |= {kind for kind, found in zip(KINDS[1:-1], rows.tolist(), strict=True) if found}
        states.append(_copy(sim.state))
        faults.append(set(seen))
    changes = differences(fault.robot, describe_robot(robot, cfg.sim.decimation))
    return Replay(robot, changes, states, targets, record["wrench_w"][:3], faults)


def _simulator_at(fault: Fault, robot: Robot, backend: Backend) -> Simulator:
    """Return one world where the step began."""
    sim_cfg, record = fault.config.sim, fault.record
    capacity = sim_cfg.max_contacts, sim_cfg.max_constraints
    sim = make_simulator(backend, robot, 1, 1, torch.device("cpu"), fault.model_fields, capacity=capacity)
    expected = {**sim.model_fields, **sim.memory}
    if record["targets"].shape[-1] != len(robot.joint_names) or any(
        name not in record or record[name].shape != value.shape[1:] for name, value in expected.items()
    ):
        raise UserError(f"the fault is of another robot than '{sim_cfg.robot}'")
    for name, field in sim.model_fields.items():
        field.copy_(record[name])
    sim.refresh_constants(torch.ones(1, dtype=torch.bool))
    sim.load({name: record[name][None] for name in sim.memory})
    return sim


def _copy(state: SimState) -> dict[str, Tensor]:
    return {name: getattr(state, name).clone() for name in STATE}


def describe(record: dict[str, Any]) -> str:
    """Return where and when: the world and the step of a record."""
    return f"world {int(record['world'])}, environment step {int(record['step'])}"

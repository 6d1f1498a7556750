"""A broken world is counted by the kind of its fault, starts anew, can be repeated, and leaves the others alone."""

import math
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor
from worlds import NEVER_FALL, HostReads, MakeEnv, put, random_actions

from telebip import ROOT
from telebip.archive import DamagedArchiveError, save_archive
from telebip.config import load_task
from telebip.control.policy import Stateless
from telebip.env import TelebipEnv
from telebip.errors import UserError
from telebip.mdp.faults import KINDS
from telebip.replay import load_fault, replay, save_fault
from telebip.robot import load_robot
from telebip.rollout import roll_out
from telebip.sim.native import NativeSimulator

NUM_ENVS, BAD, STEPS = 8, 3, 20
OTHERS = [world for world in range(NUM_ENVS) if world != BAD]


def break_action(env: TelebipEnv, action: Tensor) -> Tensor:
    broken = action.clone()
    broken[BAD, 4] = math.nan
    return broken


def break_pose(env: TelebipEnv, action: Tensor) -> Tensor:
    qpos = env.sim.state.qpos.clone()
    qpos[BAD, 8] = math.nan
    put(env, [BAD], qpos, env.sim.state.qvel.clone())
    return action


def break_velocity(env: TelebipEnv, action: Tensor) -> Tensor:
    """Make it faster than the engine stands: finite, and yet it warns."""
    qvel = env.sim.state.qvel.clone()
    qvel[BAD, 0] = 1e12
    put(env, [BAD], env.sim.state.qpos.clone(), qvel)
    return action


def break_friction(env: TelebipEnv, action: Tensor) -> Tensor:
    env.sim.model_fields["geom_friction"][BAD] = math.inf
    return action


INJECTIONS: dict[str, tuple[Callable[[TelebipEnv, Tensor], Tensor], set[str]]] = {
    "action": (break_action, {"non_finite_action"}),
    "pose": (break_pose, {"non_finite_state", "engine_warning"}),
    "velocity": (break_velocity, {"engine_warning"}),
    "friction": (break_friction, {"non_finite_state", "engine_warning"}),
}


def counts(extras: dict) -> dict[str, int]:
    return {kind: int(extras["log"][f"fault/{kind}"]) for kind in KINDS if extras["log"][f"fault/{kind}"]}


@pytest.mark.parametrize("injection", INJECTIONS)
def test_a_fault_is_counted_and_reset_and_stays_in_its_world(make_env: MakeEnv, injection: str) -> None:
    healthy, faulty = (make_env("events.push.interval=[0.1,0.3]", num_envs=NUM_ENVS) for _ in range(2))
    inject, kinds = INJECTIONS[injection]
    for step, action in enumerate(random_actions(STEPS, NUM_ENVS, 0.5)):
        given = inject(faulty, action) if step == 6 else action
        obs, rewards, dones, extras = faulty.step(given)
        expected_obs, expected_rewards, expected_dones, expected_extras = healthy.step(action)
        assert counts(expected_extras) == {}
        if step == 6:
            assert counts(extras) == dict.fromkeys(kinds, 1)
            assert dones[BAD] and not extras["time_outs"][BAD]
            assert faulty.episode_length_buf[BAD] == 0
            faulty.sim.model_fields["geom_friction"][BAD] = healthy.sim.model_fields["geom_friction"][BAD]
        elif step < 6:
            assert counts(extras) == {}
        for values in (obs["policy"], rewards, *extras["log"].values()):
            assert values.isfinite().all()
        assert torch.equal(obs["policy"][OTHERS], expected_obs["policy"][OTHERS])
        assert torch.equal(rewards[OTHERS], expected_rewards[OTHERS])
        assert torch.equal(dones[OTHERS], expected_dones[OTHERS])
        assert all(torch.equal(faulty.sim.memory[name][OTHERS], memory[OTHERS]) for name, memory in healthy.sim.memory.items())
    assert faulty.sim.state.qpos[BAD].isfinite().all()


def test_the_last_observation_of_a_faulty_episode_is_finite_too(robot, tmp_path: Path) -> None:
    env = TelebipEnv(load_task("telebip_flat", [f"num_envs={NUM_ENVS}"]), robot, "cpu", "native", keep_final_obs=True)
    extras = env.step(break_pose(env, torch.zeros(NUM_ENVS, 6)))[3]
    assert counts(extras)["non_finite_state"] == 1
    assert extras["final_obs"]["policy"].isfinite().all()


def test_a_small_arena_is_an_error_of_the_worlds_that_fill_it(tmp_path: Path) -> None:
    """With 6 KiB the engine has room for a robot in the air, but not for the constraints of one on the ground."""
    text = (ROOT / "assets" / "telebip.xml").read_text(encoding="utf-8")
    path = tmp_path / "small.xml"
    path.write_text(text.replace("<worldbody>", '<size memory="6K"/>\n<worldbody>', 1), encoding="utf-8")
    robot = load_robot(path)
    sim = NativeSimulator(robot, 3, 4)
    qpos = torch.as_tensor(robot.home_qpos).float().repeat(3, 1)
    qpos[1, 2] = 3.0
    sim.reset(torch.ones(3, dtype=torch.bool), qpos, torch.zeros(3, 12))
    targets = torch.as_tensor(robot.nominal).float().repeat(3, 1)
    before = sim.state.qpos.clone()
    sim.step(targets, torch.zeros(3, 6))
    assert sim.faults.tolist() == [[False] * 3, [True, False, True], [False] * 3]
    assert torch.equal(sim.state.qpos[[0, 2]], before[[0, 2]])
    assert sim.state.qpos[1, 2] < before[1, 2]  # it falls
    assert "memory" in sim.advice["engine_error"]
    qpos[:, 2] = 3.0
    sim.reset(torch.ones(3, dtype=torch.bool), qpos, torch.zeros(3, 12))
    sim.step(targets, torch.zeros(3, 6))
    assert not sim.faults.any()


def test_warp_reports_constraints_that_do_not_fit(make_env: MakeEnv) -> None:
    env = make_env("sim.max_constraints=3", calm=True, backend="warp")
    seen = [counts(env.step(torch.zeros(4, 6))[3]) for _ in range(4)]  # on landing: two feet have eight rows
    assert {kind for kinds in seen for kind in kinds} == {"capacity"}
    with pytest.raises(UserError, match=r"did not fit; raise sim\.max_contacts \(8\) or sim\.max_constraints \(3\)"):
        roll_out(env, Stateless(lambda obs: torch.zeros(4, 6)), steps=1)


def test_the_engine_leaves_no_log_file(make_env: MakeEnv, tmp_path: Path, monkeypatch, capfd) -> None:
    monkeypatch.chdir(tmp_path)
    env = make_env(num_envs=NUM_ENVS)
    assert counts(env.step(break_velocity(env, torch.zeros(NUM_ENVS, 6)))[3]) == {"engine_warning": 1}
    assert list(tmp_path.iterdir()) == []
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("injection", INJECTIONS)
def test_a_dumped_fault_happens_again(make_env: MakeEnv, tmp_path: Path, injection: str) -> None:
    env = make_env(NEVER_FALL, num_envs=NUM_ENVS)
    inject, kinds = INJECTIONS[injection]
    for step, action in enumerate(random_actions(10, NUM_ENVS, 0.5)):
        env.step(inject(env, action) if step == 5 else action)
    records = env.take_faults()
    assert set(records) == kinds
    assert env.take_faults() == {}  # once each
    for kind, record in records.items():
        assert (record["world"], record["step"]) == (BAD, 6)
        fault = load_fault(save_fault(tmp_path, kind, record, "telebip_flat", env))
        assert (fault.kind, fault.backend, fault.config) == (kind, "native", env.cfg)
        again = replay(fault)
        assert again.reproduces(kind)
        assert again.faults[0] == ({"non_finite_action"} if injection == "action" else set())
        assert len(again.states) == 1 + env.cfg.sim.decimation


RANDOM_MODEL = "events.trunk_mass={term: mass, bodies: [trunk], scale: [0.8, 1.2]}"


@pytest.mark.parametrize("overrides", [(), ("actions.physics_delay=[1,3]", RANDOM_MODEL)], ids=["plain", "late"])
def test_a_healthy_step_replays_bit_for_bit(make_env: MakeEnv, tmp_path: Path, overrides: tuple[str, ...]) -> None:
    """What a dump holds is all that the step depended on: after a broken action, the nominal pose is held."""
    env = make_env(NEVER_FALL, *overrides, num_envs=NUM_ENVS)
    for action in random_actions(10, NUM_ENVS, 0.5):
        env.step(action)
    seen, reset = {}, env.sim.reset

    def noted_reset(mask: Tensor, qpos: Tensor, qvel: Tensor) -> None:
        seen["qpos"] = env.sim.state.qpos[BAD].clone()
        reset(mask, qpos, qvel)

    env.sim.reset = noted_reset  # type: ignore[method-assign]
    env.step(break_action(env, torch.zeros(NUM_ENVS, 6)))
    again = replay(load_fault(save_fault(tmp_path, "non_finite_action", env.take_faults()["non_finite_action"], "t", env)))
    assert torch.equal(again.states[-1]["qpos"][0], seen["qpos"])
    assert not torch.equal(again.states[0]["qpos"][0], seen["qpos"])
    assert again.rollout().joint_target.shape == (1 + env.cfg.sim.decimation, 1, 6)


def test_a_step_on_rough_ground_is_repeated_on_that_ground(make_env: MakeEnv, tmp_path: Path) -> None:
    ground = ("terrain.types.slope_down={angle: [0.3, 0.3]}", "sim.max_contacts=16")  # robots stand 0.8 m above a floor
    env = make_env(NEVER_FALL, *ground, num_envs=NUM_ENVS, calm=True)
    for _ in range(5):
        env.step(torch.zeros(NUM_ENVS, 6))
    assert env.sim.state.foot_force[BAD].sum() > 50.0
    env.step(break_action(env, torch.zeros(NUM_ENVS, 6)))
    again = replay(load_fault(save_fault(tmp_path, "non_finite_action", env.take_faults()["non_finite_action"], "t", env)))
    assert again.robot.terrain is not None
    assert again.states[-1]["foot_force"].sum() > 50.0


def test_only_the_first_fault_of_a_kind_is_kept(make_env: MakeEnv, tmp_path: Path) -> None:
    env = make_env(num_envs=NUM_ENVS)
    zeros = torch.zeros(NUM_ENVS, 6)
    env.step(break_action(env, zeros))
    env.step(torch.full_like(zeros, math.nan))
    record = env.take_faults()["non_finite_action"]
    assert (record["world"], record["step"]) == (BAD, 1)
    first = save_fault(tmp_path, "non_finite_action", record, "telebip_flat", env).read_bytes()
    assert save_fault(tmp_path, "non_finite_action", record | {"step": torch.tensor(9)}, "x", env).read_bytes() == first


def test_faults_in_and_out_of_inference_mode_are_kept(make_env: MakeEnv) -> None:
    env = make_env(num_envs=NUM_ENVS)
    zeros = torch.zeros(NUM_ENVS, 6)
    with torch.inference_mode():
        env.step(torch.full_like(zeros, math.nan))
    env.sim.reset(torch.ones(NUM_ENVS, dtype=torch.bool), env.sim.state.qpos * math.nan, env.sim.state.qvel)
    env.step(zeros)
    assert env.take_faults().keys() >= {"non_finite_action", "non_finite_state"}


def test_noting_faults_waits_for_nothing(make_env: MakeEnv) -> None:
    env = make_env(num_envs=NUM_ENVS)
    with HostReads() as reads:
        env.step(break_action(env, torch.zeros(NUM_ENVS, 6)))
    assert reads.seen == []


@pytest.mark.parametrize(
    ("content", "says"),
    [(b"", "not a telebip fault"), (b"not this", "not a telebip fault"), (None, "has format 'telebip-checkpoint-2'")],
    ids=["empty", "bytes", "checkpoint"],
)
def test_what_is_no_fault_is_refused(tmp_path: Path, content: bytes | None, says: str) -> None:
    path = tmp_path / "fault.pt"
    if content is None:
        save_archive(path, {"format": "telebip-checkpoint-2"})
    else:
        path.write_bytes(content)
    with pytest.raises(UserError, match=says):
        load_fault(path)
    with pytest.raises(UserError, match="cannot be read"):
        load_fault(tmp_path / "nowhere.pt")


def test_a_damaged_fault_is_refused(make_env: MakeEnv, tmp_path: Path) -> None:
    env = make_env(num_envs=NUM_ENVS)
    env.step(break_action(env, torch.zeros(NUM_ENVS, 6)))
    path = save_fault(tmp_path, "non_finite_action", env.take_faults()["non_finite_action"], "t", env)
    content = bytearray(path.read_bytes())
    content[content.index(env.sim.backend.encode())] ^= 1
    path.write_bytes(content)
    with pytest.raises(DamagedArchiveError, match="a checksum is wrong"):
        load_fault(path)


@pytest.mark.parametrize(
    "missing", ["record", "backend", "config", "model_fields", "action", "targets", "qpos", "geom_friction"]
)
def test_an_incomplete_fault_is_refused(make_env: MakeEnv, tmp_path: Path, missing: str) -> None:
    env = make_env()
    env.step(torch.full((4, 6), torch.nan))
    file = save_fault(tmp_path, "non_finite_action", env.take_faults()["non_finite_action"], "telebip_flat", env)
    content = torch.load(file, weights_only=True)
    for part in (content, content["record"]):
        part.pop(missing, None)
    torch.save(content, file)
    with pytest.raises(UserError, match=r"non_finite_action.pt' is not complete: "):
        load_fault(file)

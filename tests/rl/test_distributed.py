"""Several processes learn what one would from the same samples, through gloo on the CPU, and one of them writes."""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from processes import FORKS
from tensordict import TensorDict
from torch.multiprocessing.spawn import start_processes

from telebip import ROOT
from telebip.config import load_task
from telebip.env import TelebipEnv
from telebip.errors import UserError
from telebip.rl.checkpoint import load_checkpoint
from telebip.rl.curve import read_curve
from telebip.rl.distributed import Ranks, joined
from telebip.rl.train import Trainer
from telebip.robot import load_robot

SIZE, WORLDS, STEPS = 2, 4, 10
CPU = torch.device("cpu")
SMALL = (f"ppo.num_steps_per_env={STEPS}", "ppo.hidden_dims=[16,16]", "ppo.num_mini_batches=1", "ppo.mixed_precision=never")
STORED = ("actions", "rewards", "dones", "values", "actions_log_prob")
"""What a rollout holds beside observations and the policy's distribution."""


def make_trainer(worlds: int, seed: int, ranks: Ranks | None = None) -> Trainer:
    config = load_task("telebip_flat", [f"num_envs={worlds}", f"seed={seed}", "episode.length=0.16", *SMALL])
    env = TelebipEnv(config, load_robot(config.sim.robot), CPU, "native")
    return Trainer(env, "telebip_flat", Path(), ranks)


def collect(trainer: Trainer) -> dict[str, Any]:
    """Return a rollout with time-outs in it: what the storage holds, and the observation after it."""
    learner, obs = trainer.learner, trainer.env.get_observations()
    learner.train_mode()
    with torch.inference_mode():
        for _ in range(STEPS):
            obs, rewards, dones, extras = trainer.env.step(learner.act(obs))
            learner.process_env_step(obs, rewards, dones, extras)
    st = learner.storage
    assert st.distribution_params is not None
    stored = {name: getattr(st, name) for name in STORED}
    seen = {"observations": st.observations["policy"], "last": obs["policy"]}
    return {**stored, **seen, "mean": st.distribution_params[0], "std": st.distribution_params[1]}


def learn(trainer: Trainer, rollout: dict[str, Any], worlds: slice) -> dict[str, Any]:
    """Learn twice from the worlds of a rollout; return the gradient of the first time and the state after the second."""
    learner, st = trainer.learner, trainer.learner.storage
    learner.train_mode()
    with torch.inference_mode():
        st.observations["policy"].copy_(rollout["observations"][:, worlds])
        for name in STORED:
            getattr(st, name).copy_(rollout[name][:, worlds])
        st.distribution_params = tuple(rollout[name][:, worlds].clone() for name in ("mean", "std"))
        last = rollout["last"][worlds]
        learner.compute_returns(TensorDict({"policy": last}, batch_size=[len(last)]))
    learner.num_learning_epochs = 1
    learner.update()
    networks = (learner.actor, learner.critic)
    gradient = [p.grad.clone() for network in networks for p in network.parameters() if p.grad is not None]
    learner.num_learning_epochs = 4
    learner.update()
    return {"gradient": gradient, "learning_rate": learner.learning_rate, "state": learner.save()}


def one_of_two(rank: int, port: int, folder: str) -> None:
    """What each process does: learn from its half of the rollout, from other initial weights than its neighbour."""
    torch.set_num_threads(1)
    os.environ |= {"RANK": str(rank), "LOCAL_RANK": str(rank), "WORLD_SIZE": str(SIZE)}
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    ranks = Ranks.from_environment()
    with joined(ranks, CPU):
        trainer = make_trainer(WORLDS, seed=1 + rank, ranks=ranks)
        start = trainer.env.sim.state.qpos.clone()
        rollout = torch.load(f"{folder}/rollout.pt", weights_only=True)
        result = learn(trainer, rollout, slice(rank * WORLDS, (rank + 1) * WORLDS))
        stops = [ranks.any(rank == 1, CPU), ranks.any(False, CPU)]
    torch.save({**result, "start": start, "stops": stops}, f"{folder}/rank_{rank}.pt")


def test_two_processes_learn_what_one_does(tmp_path: Path) -> None:
    rollout = collect(make_trainer(SIZE * WORLDS, seed=1))
    assert 0 < rollout["dones"].sum() < rollout["dones"].numel()
    torch.save(rollout, tmp_path / "rollout.pt")
    expected = learn(make_trainer(SIZE * WORLDS, seed=1), rollout, slice(None))  # its weights are those of seed 1, as rank 0's
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    start_processes(one_of_two, (port, str(tmp_path)), nprocs=SIZE, start_method=FORKS.get_start_method())
    first, second = (torch.load(tmp_path / f"rank_{rank}.pt", weights_only=True) for rank in range(SIZE))

    assert max(g.abs().max() for g in expected["gradient"]) > 1e-3
    torch.testing.assert_close(first["gradient"], expected["gradient"], rtol=1e-4, atol=1e-6)
    assert first["learning_rate"] == pytest.approx(expected["learning_rate"])
    assert first["learning_rate"] != load_task("telebip_flat").ppo.learning_rate  # the adaptive schedule has acted
    for part in ("actor_state_dict", "critic_state_dict"):
        for name, value in expected["state"][part].items():
            if "obs_normalizer" in name:
                torch.testing.assert_close(first["state"][part][name], value, rtol=1e-5, atol=1e-6)
            assert torch.equal(first["state"][part][name], second["state"][part][name]), name

    assert not torch.equal(first["start"], second["start"])  # other worlds
    assert first["stops"] == second["stops"] == [True, False]  # one that wants to stop stops both


COUNTING = """
import atexit, runpy
from pathlib import Path

def count() -> None:
    threads = [file.read_text() for file in Path("/proc/self/task").glob("*/comm")]  # none but on Linux
    print(f"gloo's threads at the end: {sum('gloo' in name for name in threads)}\\n", end="")  # at once: two processes write

atexit.register(count)
runpy.run_path("scripts/train.py", run_name="__main__")
"""


def test_torchrun_trains_into_one_folder(tmp_path: Path) -> None:
    program = tmp_path / "counting.py"
    program.write_text(COUNTING)
    tiny = ("--num-envs", "4", "--device", "cpu", "--max-iterations", "2", "ppo.num_steps_per_env=5", "ppo.hidden_dims=[16,16]")
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    done = subprocess.run(
        [*torchrun, str(program), "--task", "telebip_flat", "--log-dir", str(tmp_path), *tiny],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("gloo's threads at the end: 0") == 2  # they would abort the process now and then
    assert done.stdout.count("telebip_flat: 2 processes x 4 worlds on cpu") == 1
    (run_dir,) = (tmp_path / "telebip_flat").iterdir()
    assert sorted(path.name for path in run_dir.glob("*.pt")) == ["model_2.pt", "policy.pt"]
    assert len(list(run_dir.glob("events.out.tfevents.*"))) == 1
    assert [row["samples"] for row in read_curve(run_dir)] == [40, 80]  # of both processes
    assert json.loads((run_dir / "run.json").read_text())["starts"][0]["processes"] == 2
    checkpoint = load_checkpoint(run_dir)
    assert (checkpoint.config.seed, checkpoint.samples) == (1, 80)


def test_one_process_alone_knows_of_no_others() -> None:
    assert Ranks().multi_gpu_cfg is None
    assert Ranks().is_main
    assert Ranks().any(True, CPU)
    assert not Ranks().any(False, CPU)
    assert Ranks().device_name("cuda:3") == "cuda:3"


def test_every_process_takes_its_own_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    ranks = Ranks(rank=5, local_rank=1, size=8)
    assert ranks.multi_gpu_cfg == {"global_rank": 5, "local_rank": 1, "world_size": 8}
    assert ranks.device_name("cpu") == "cpu"
    assert ranks.device_name("cuda") == "cuda:1"
    with pytest.raises(UserError, match=r"a GPU of its own; say --device cuda, not 'cuda:0'"):
        ranks.device_name("cuda:0")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert ranks.device_name("auto") == "cuda:1"
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert ranks.device_name("auto") == "auto"

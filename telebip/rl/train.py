"""The training loop around rsl-rl's PPO.

rsl-rl's `OnPolicyRunner` prints a page per iteration, waits for the device at every environment step to log, and loads
checkpoints as pickles; this loop uses its algorithm, networks and storage and does these three differently.
"""

import contextlib
import io
import math
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from telebip.config.schema import PpoConfig
from telebip.env import TelebipEnv
from telebip.errors import UserError
from telebip.mdp.curriculum import ramp
from telebip.replay import describe, fault_file, save_fault
from telebip.rl.checkpoint import Checkpoint, prune_checkpoints, robot_properties, save_checkpoint
from telebip.rl.distributed import Ranks
from telebip.rl.log import EpisodeStatistics, RunLog
from telebip.rl.policy import OBS_GROUPS, actor_cfg, critic_cfg
from telebip.rl.ppo import FastPPO
from telebip.rl.symmetry import SymmetricEnv


class Trainer:
    """Trains one policy in one run folder."""

    def __init__(
        self,
        env: TelebipEnv,
        task: str,
        run_dir: Path,
        ranks: Ranks | None = None,
        note: Callable[[str], None] = lambda line: print(line, file=sys.stderr),
    ) -> None:
        """Build the learner for `env`, the same in every process of `ranks`; nothing is written before `learn`.

        `note` is told, in a line each, what a user should know though the training goes on.
        """
        self.env, self.task, self.run_dir, self.ranks, self.note = env, task, run_dir, ranks or Ranks(), note
        self.iteration = self.samples = 0
        self._saved = -1  # the iteration of the last checkpoint
        ppo = env.cfg.ppo
        if env.num_envs * ppo.num_steps_per_env < 2:
            raise UserError("an iteration of one sample has nothing to compare; raise num_envs or ppo.num_steps_per_env")
        if ppo.num_mini_batches > env.num_envs * ppo.num_steps_per_env:
            raise UserError(
                f"ppo.num_mini_batches is {ppo.num_mini_batches}, but an iteration has only {env.num_envs} worlds x "
                f"{ppo.num_steps_per_env} steps"
            )
        torch.manual_seed(env.cfg.seed)
        with contextlib.redirect_stdout(io.StringIO()):  # rsl-rl prints the networks
            self.learner = FastPPO.construct_algorithm(env.get_observations(), env, self._rsl_rl_cfg(), str(env.device))
        if self.ranks.size > 1:
            self.learner.broadcast_parameters()
        self.view = SymmetricEnv(env) if ppo.symmetry == "phase" else env
        self._episodes = EpisodeStatistics(env.num_envs, env.device)
        # Spread the time-outs over the iterations.
        ages = torch.randint(env.max_episode_length, (env.num_envs,), generator=env.generator, device=env.device)
        env.episode_length_buf.copy_(ages)

    @property
    def arithmetic(self) -> str:
        """What the networks compute in: bfloat16 or float32."""
        return "bfloat16" if self.learner.use_mixed_precision else "float32"

    def resume(self, checkpoint: Checkpoint) -> str:
        """Go on from a checkpoint of the same task and robot, bit for bit as if nothing had happened in between.

        Returns:
            Why the worlds start new episodes instead; empty if they do not. They do where the checkpoint has none, or others.

        Raises:
            UserError: the networks or the robot are not the checkpoint's.
        """
        own = robot_properties(self.env.robot)
        for name, value in checkpoint.robot.items():
            if own[name] != value:
                raise UserError(
                    f"checkpoint '{checkpoint.path}' was trained on another robot than '{self.env.cfg.sim.robot}': its {name} "
                    f"is {value}, not {own[name]}"
                )
        try:
            self.learner.load(checkpoint.learner, load_cfg=None, strict=True)
        except (RuntimeError, KeyError, ValueError) as error:
            raise UserError(
                f"checkpoint '{checkpoint.path}' cannot be resumed: {' '.join(str(error).split())[:120]}"
            ) from error
        self._heed_learning_rate(checkpoint.config.ppo)
        self.iteration, self.samples = checkpoint.iteration, checkpoint.samples
        if len(checkpoint.training) != self.ranks.size:
            return f"the checkpoint has worlds of {len(checkpoint.training)} processes, this run has {self.ranks.size}"
        try:
            self._load_training(checkpoint.training[self.ranks.rank])
        except ValueError as error:
            return f"the checkpoint's worlds are others: {error}"
        return ""

    def _heed_learning_rate(self, before: PpoConfig) -> None:
        """Learn at the configured rate where it, or its schedule, is not what it was before; else at the checkpoint's."""
        ppo = self.env.cfg.ppo
        if (ppo.learning_rate, ppo.schedule) != (before.learning_rate, before.schedule):
            self.learner.learning_rate = ppo.learning_rate
            for group in self.learner.optimizer.param_groups:
                group["lr"] = ppo.learning_rate

    def learn(self, stop: Callable[[], bool], report: Callable[[dict[str, float]], None]) -> None:
        """Train up to the configured total of iterations, or until `stop()` holds, and save a checkpoint at the end.

        Args:
            stop: asked after every iteration; one process that says so stops them all.
            report: called after every iteration with what TensorBoard gets.

        Raises:
            UserError: too many worlds are faulty, the engine's capacity is too small, the update has ruined the policy, or
                the last checkpoint cannot be written anywhere.
        """
        cfg = self.env.cfg.ppo
        log = RunLog(self.run_dir, self.samples, self.note) if self.ranks.is_main else None
        while self.iteration < cfg.max_iterations and not self.ranks.any(stop(), self.env.device):
            scalars = self.iterate()
            if log:
                log.add(self.iteration, self.samples, scalars)
            if self.iteration % cfg.save_interval == 0:
                self.save()
            report(scalars)
        self._save_finally()
        if log:
            log.close()

    def iterate(self) -> dict[str, float]:
        """Collect and learn once; return what TensorBoard gets.

        Raises:
            UserError: see `learn`.
        """
        env, learner, cfg = self.env, self.learner, self.env.cfg.ppo
        start = time.perf_counter()
        env.set_progress(self.samples)
        learner.get_policy().distribution.std_range[0] = min_std(cfg, self.samples)  # type: ignore[union-attr]
        learner.train_mode()
        with torch.inference_mode():
            obs, log_sums = self.collect(self.view.get_observations())
            sums = dict(zip(env.log_names, log_sums.tolist(), strict=True))
            collected = time.perf_counter()
            counts = {key: value for key, value in sums.items() if key.startswith("fault/")}
            self._check_faults(dict(counts))
            learner.compute_returns(obs)
        losses = learner.update()
        self._check_weights(losses)
        learned = time.perf_counter()

        self.iteration += 1
        batch = env.num_envs * cfg.num_steps_per_env * self.ranks.size
        self.samples += batch
        means = {key: value / cfg.num_steps_per_env for key, value in sums.items() if key not in counts}
        episode_return, episode_length = self._episodes.recent()
        return {
            **means,
            **counts,
            "train/episode_return": episode_return,
            "train/episode_length": episode_length,
            "train/action_std": learner.get_policy().output_std.mean().item(),
            "train/learning_rate": learner.learning_rate,
            **{f"loss/{key}": value for key, value in losses.items()},
            "speed/samples_per_s": batch / (learned - start),
            "speed/collect_s": collected - start,
            "speed/learn_s": learned - collected,
        }

    def collect(self, obs: TensorDict) -> tuple[TensorDict, Tensor]:
        """Act from `obs` for `ppo.num_steps_per_env` steps and store them.

        Returns:
            What is seen last, and the sums of what the environment logs, in the order of `env.log_names`.
        """
        logs = torch.zeros(len(self.env.log_names), device=self.env.device)
        for _ in range(self.env.cfg.ppo.num_steps_per_env):
            obs, rewards, dones, extras = self.view.step(self.learner.act(obs))
            self.learner.process_env_step(obs, rewards, dones, extras)
            self._episodes.add(rewards, dones)
            logs += torch.stack(list(extras["log"].values()))
        return obs, logs

    def save(self) -> bool:
        """Write `model_<iteration>.pt`, to go on from, and `policy.pt`, the actor alone; the first process does.

        Returns:
            Whether that worked, the same in every process. Where the disk is full, say, `note` tells, and what was there stays.
        """
        training, failed = self.ranks.gather(self._training_state()), False
        if self.ranks.is_main:
            try:
                self._write(self.run_dir, training)
                prune_checkpoints(self.run_dir, self.env.cfg.ppo.keep_checkpoints)
            except OSError as error:
                failed = True
                self.note(f"cannot save to '{self.run_dir}': {error.strerror or error}; training goes on and will try again")
        if self.ranks.any(failed, self.env.device):
            return False
        self._saved = self.iteration
        return True

    def checkpoint_bytes(self) -> int:
        """Return about how large a checkpoint is: the networks, twice as much for Adam, and the worlds."""
        parameters = sum(p.numel() * p.element_size() for group in self.learner.optimizer.param_groups for p in group["params"])
        env = self.env.state_dict()
        worlds = sum(value.numel() * value.element_size() for part in ("sim", "model", "mdp") for value in env[part].values())
        return 3 * parameters + worlds * self.ranks.size

    def _save_finally(self) -> None:
        """Save what must not be lost: to the run's folder or, where that fails, to the system's folder for temporary files."""
        if self._saved == self.iteration or self.save():
            return
        spare, training = Path(tempfile.gettempdir()), self.ranks.gather(self._training_state())
        try:
            if self.ranks.is_main:
                spare = Path(tempfile.mkdtemp(prefix=f"telebip_{self.run_dir.name}_"))
                self._write(spare, training)
        except OSError as error:
            raise UserError(f"cannot save to '{self.run_dir}' nor to '{spare}': {error.strerror or error}") from error
        raise UserError(f"could not save to '{self.run_dir}'; the checkpoint is in '{spare}': move it there to go on")

    def _write(self, folder: Path, training: list[dict[str, Any]]) -> None:
        state = self.learner.save()
        actor = {"actor_state_dict": state["actor_state_dict"]}
        about = (self.task, self.env.cfg, self.iteration, self.samples)
        robot = robot_properties(self.env.robot)
        save_checkpoint(folder / f"model_{self.iteration}.pt", *about, state, training, robot)
        save_checkpoint(folder / "policy.pt", *about, actor, robot=robot)

    def _training_state(self) -> dict[str, Any]:
        """Return what this process needs, besides the learner's state, to go on bit for bit."""
        return {"env": self.env.state_dict(), "episodes": self._episodes.state_dict(), **random_state(self.env.device)}

    def _load_training(self, state: dict[str, Any]) -> None:
        self.env.load_state_dict(state["env"])
        self._episodes.load_state_dict(state["episodes"])
        set_random_state(state, self.env.device)

    def _check_faults(self, counts: dict[str, float]) -> None:
        """Dump the first fault of each kind; stop, with a checkpoint, where there are too many or the engine is too small.

        Called before the update, so that the checkpoint has the policy that met the faults.
        """
        for kind, record in self.env.take_faults().items():
            said = self.env.sim.advice.get(kind, "")
            if not self.ranks.is_main:
                continue  # the first process alone writes
            file = fault_file(self.run_dir, kind)
            try:
                dumped = f"not dumped, as {file} holds an earlier one"
                if not file.exists():
                    dumped = f"dumped to {save_fault(self.run_dir, kind, record, self.task, self.env)}, for play --replay"
            except OSError as error:
                dumped = f"cannot be dumped: {error.strerror or error}"
            self.note(f"fault: {kind}, {describe(record)}{f' ({said})' if said else ''}; {dumped}")
        env, cfg = self.env, self.env.cfg.ppo
        rate = counts.pop("fault/worlds") / (env.num_envs * cfg.num_steps_per_env)
        full = counts["fault/capacity"] > 0.0
        if not self.ranks.any(full or rate > cfg.max_fault_rate, env.device):
            return
        self._save_finally()
        found = ", ".join(f"{int(count)} {key.removeprefix('fault/')}" for key, count in counts.items() if count)
        if full:
            raise UserError(
                f"iteration {self.iteration + 1}: contacts or constraints did not fit, {int(counts['fault/capacity'])} times; "
                f"{env.sim.advice['capacity']}, then go on with --resume {self.run_dir}"
            )
        raise UserError(
            f"iteration {self.iteration + 1}: {rate:.2g} faulty worlds per environment step ({found}), more than "
            f"ppo.max_fault_rate={cfg.max_fault_rate:g}; saved {self.run_dir}, see its faults folder"
        )

    def _check_weights(self, losses: dict[str, float]) -> None:
        """Stop where the update has made the networks non-finite: the last checkpoint is from before it."""
        parameters = [p for network in (self.learner.actor, self.learner.critic) for p in network.parameters()]
        finite = torch.stack([p.isfinite().all() for p in parameters]).all()
        if not finite or not all(math.isfinite(loss) for loss in losses.values()):
            advice = "start again with a lower ppo.learning_rate"
            if any(self.run_dir.glob("model_*.pt")):
                advice = f"go on from the last checkpoint with a lower ppo.learning_rate: --resume {self.run_dir}"
            raise UserError(
                f"the update of iteration {self.iteration + 1} made the networks non-finite (losses {losses}); {advice}"
            )

    def _rsl_rl_cfg(self) -> dict:
        env, ppo = self.env, self.env.cfg.ppo
        algorithm = (
            "num_learning_epochs num_mini_batches learning_rate schedule desired_kl gamma lam clip_param value_loss_coef "
            "entropy_coef max_grad_norm"
        )
        return {
            "num_steps_per_env": ppo.num_steps_per_env,
            "obs_groups": OBS_GROUPS,
            "multi_gpu": self.ranks.multi_gpu_cfg,
            "algorithm": {
                "class_name": FastPPO,
                **{name: getattr(ppo, name) for name in algorithm.split()},
                "use_mixed_precision": uses_bfloat16(ppo.mixed_precision, env.device),
            },
            "actor": {"class_name": "MLPModel", **actor_cfg(ppo)},
            "critic": {"class_name": "MLPModel", **critic_cfg(ppo)},
        }


def random_state(device: torch.device) -> dict[str, Tensor]:
    """Return the states of torch's own generators, of the processor and of `device`."""
    cuda = {"cuda_generator": torch.cuda.get_rng_state(device)} if device.type == "cuda" else {}
    return {"generator": torch.get_rng_state(), **cuda}


def set_random_state(state: Mapping[str, Any], device: torch.device) -> None:
    """Go on from a `random_state`, of which another kind of device has less."""
    torch.set_rng_state(state["generator"])
    if device.type == "cuda" and "cuda_generator" in state:
        torch.cuda.set_rng_state(state["cuda_generator"], device)


def min_std(cfg: PpoConfig, samples: int) -> float:
    """Return the floor of the action's standard deviation after `samples`: from `min_std` to `final_min_std`, geometrically."""
    return cfg.min_std * (cfg.final_min_std / cfg.min_std) ** ramp(samples, cfg.min_std_ramp)


def uses_bfloat16(mixed_precision: str, device: torch.device) -> bool:
    """Whether the update runs in bfloat16; `auto` asks the device whether it has instructions for it."""
    if mixed_precision != "auto":
        return mixed_precision == "always"
    if device.type == "cuda":
        with torch.cuda.device(device):
            return torch.cuda.is_bf16_supported(including_emulation=False)
    capabilities = torch.cpu.get_capabilities() if hasattr(torch.cpu, "get_capabilities") else {}
    return bool(capabilities.get("avx512_bf16") or capabilities.get("amx_bf16"))

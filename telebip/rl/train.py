"""The training loop around rsl-rl's PPO.

rsl-rl's `OnPolicyRunner` prints a page per iteration, waits for the device at every environment step to log, and loads
checkpoints as pickles; this loop uses its algorithm, networks and storage and does these three differently.
"""

import contextlib
import io
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter

from telebip.config import PpoConfig
from telebip.env import TelebipEnv
from telebip.errors import UserError
from telebip.mdp.curriculum import ramp
from telebip.rl.checkpoint import Checkpoint, save_checkpoint
from telebip.rl.curve import CurveWriter
from telebip.rl.distributed import Ranks
from telebip.rl.policy import OBS_GROUPS, actor_cfg, critic_cfg
from telebip.rl.ppo import FastPPO
from telebip.rl.symmetry import SymmetricEnv


class Trainer:
    """Trains one policy in one run folder."""

    def __init__(self, env: TelebipEnv, task: str, run_dir: Path, ranks: Ranks | None = None) -> None:
        """Build the learner for `env`, the same in every process of `ranks`; nothing is written before `learn`."""
        self.env, self.task, self.run_dir, self.ranks = env, task, run_dir, ranks or Ranks()
        self.iteration = self.samples = 0
        ppo = env.cfg.ppo
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

    def resume(self, checkpoint: Checkpoint) -> None:
        """Continue from a checkpoint of the same task."""
        try:
            self.learner.load(checkpoint.learner, load_cfg=None, strict=True)
        except (RuntimeError, KeyError, ValueError) as error:
            raise UserError(
                f"checkpoint '{checkpoint.path}' cannot be resumed: {' '.join(str(error).split())[:120]}"
            ) from error
        self.iteration, self.samples = checkpoint.iteration, checkpoint.samples

    def learn(self, stop: Callable[[], bool], report: Callable[[dict[str, float]], None]) -> None:
        """Train up to the configured total of iterations, or until `stop()` holds, and save a checkpoint at the end.

        Args:
            stop: asked after every iteration; one process that says so stops them all.
            report: called after every iteration with what TensorBoard gets.
        """
        env, learner, cfg = self.env, self.learner, self.env.cfg.ppo
        log = RunLog(self.run_dir, self.samples) if self.ranks.is_main else None
        # Spread the time-outs over the iterations.
        ages = torch.randint(env.max_episode_length, (env.num_envs,), generator=env.generator, device=env.device)
        env.episode_length_buf = ages
        learner.train_mode()
        obs = self.view.get_observations()
        while self.iteration < cfg.max_iterations and not self.ranks.any(stop(), env.device):
            start = time.perf_counter()
            env.set_progress(self.samples)
            learner.get_policy().distribution.std_range[0] = min_std(cfg, self.samples)  # type: ignore[union-attr]
            with torch.inference_mode():
                obs, logs = self.collect(obs)
                collected = time.perf_counter()
                learner.compute_returns(obs)
            losses = learner.update()
            learned = time.perf_counter()

            self.iteration += 1
            batch = env.num_envs * cfg.num_steps_per_env * self.ranks.size
            self.samples += batch
            counts = {key: value.item() for key, value in logs.items() if key.startswith("fault/")}
            means = {key: value.item() / cfg.num_steps_per_env for key, value in logs.items() if key not in counts}
            episode_return, episode_length = self._episodes.recent()
            scalars = {
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
            if log:
                log.add(self.iteration, self.samples, scalars)
            if self.iteration % cfg.save_interval == 0:
                self.save()
            report(scalars)
        self.save()
        if log:
            log.close()

    def collect(self, obs: TensorDict) -> tuple[TensorDict, dict[str, Tensor]]:
        """Act from `obs` for `ppo.num_steps_per_env` steps and store them; return what is seen last, and the logs' sums."""
        logs: dict[str, Tensor] = {}
        for _ in range(self.env.cfg.ppo.num_steps_per_env):
            obs, rewards, dones, extras = self.view.step(self.learner.act(obs))
            self.learner.process_env_step(obs, rewards, dones, extras)
            self._episodes.add(rewards, dones)
            logs = {key: logs.get(key, 0) + value for key, value in extras["log"].items()}
        return obs, logs

    def save(self) -> None:
        """Write `model_<iteration>.pt`, to go on from, and `policy.pt`, the actor alone; the first process does."""
        if not self.ranks.is_main:
            return
        state = self.learner.save()
        actor = {"actor_state_dict": state["actor_state_dict"]}
        for name, part in ((f"model_{self.iteration}.pt", state), ("policy.pt", actor)):
            save_checkpoint(self.run_dir / name, self.task, self.env.cfg, self.iteration, self.samples, part)

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


class RunLog:
    """A run folder's numbers: TensorBoard's files and `learning.csv`."""

    def __init__(self, run_dir: Path, samples: int) -> None:
        """Open them at `samples` environment steps; what lies beyond is dropped."""
        self._writer = SummaryWriter(str(run_dir), purge_step=samples + 1)
        self._curve = CurveWriter(run_dir, samples)

    def add(self, iteration: int, samples: int, scalars: dict[str, float]) -> None:
        """Append one iteration's scalars."""
        for key, value in scalars.items():
            self._writer.add_scalar(key, value, samples)
        self._curve.add({"iteration": iteration, "samples": samples, **scalars})

    def close(self) -> None:
        """Write what TensorBoard's writer still holds."""
        self._writer.close()


class EpisodeStatistics:
    """Mean return and length of the episodes that ended lately, kept on the device until asked."""

    def __init__(self, num_envs: int, device: torch.device, min_episodes: int = 100) -> None:
        """Average over as many of the latest iterations as it takes to see `min_episodes` end."""
        self._return, self._length = torch.zeros(num_envs, device=device), torch.zeros(num_envs, device=device)
        self._sums = torch.zeros(3, device=device)  # of finished episodes: returns, lengths, number
        self._history: deque[tuple[float, float, float]] = deque()
        self._min_episodes = min_episodes

    def add(self, rewards: Tensor, dones: Tensor) -> None:
        """Account for one environment step: rewards (num_envs,) and dones (num_envs,) bool."""
        self._return += rewards
        self._length += 1.0
        done = dones.float()
        self._sums += torch.stack([self._return @ done, self._length @ done, done.sum()])
        self._return.masked_fill_(dones, 0.0)
        self._length.masked_fill_(dones, 0.0)

    def recent(self) -> tuple[float, float]:
        """Return (mean return, mean length in policy steps), NaN before any episode has ended; call once per iteration."""
        returns, lengths, number = self._sums.tolist()
        self._history.append((returns, lengths, number))
        self._sums.zero_()
        while sum(n for *_, n in self._history) - self._history[0][2] >= self._min_episodes:
            self._history.popleft()
        total = [sum(column) for column in zip(*self._history, strict=True)]
        return (total[0] / total[2], total[1] / total[2]) if total[2] else (float("nan"), float("nan"))


def min_std(cfg: PpoConfig, samples: int) -> float:
    """Return the floor of the action's standard deviation after `samples`: from `min_std` to `final_min_std`, geometrically."""
    return cfg.min_std * (cfg.final_min_std / cfg.min_std) ** ramp(samples, cfg.min_std_ramp)


def uses_bfloat16(mixed_precision: str, device: torch.device) -> bool:
    """Whether the update runs in bfloat16; `auto` asks the device whether it has instructions for it."""
    if mixed_precision != "auto":
        return mixed_precision == "always"
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    capabilities = torch.cpu.get_capabilities() if hasattr(torch.cpu, "get_capabilities") else {}
    return bool(capabilities.get("avx512_bf16") or capabilities.get("amx_bf16"))

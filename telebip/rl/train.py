"""The training loop around rsl-rl's PPO.

rsl-rl's `OnPolicyRunner` prints a page per iteration, waits for the device at every environment step to log, and loads
checkpoints as pickles; this loop uses its algorithm, networks and storage and does these three differently.
"""

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from telebip.env import TelebipEnv
from telebip.errors import UserError
from telebip.rl.averaging import Average
from telebip.rl.checkpoint import Checkpoint
from telebip.rl.distributed import Ranks
from telebip.rl.faults import dump_new_faults, ruined_networks, too_many_faults
from telebip.rl.layout import obs_groups, seen
from telebip.rl.learner import make_learner, set_min_std
from telebip.rl.log import EpisodeStatistics, RunLog
from telebip.rl.networks import arithmetic
from telebip.rl.process import random_state, set_random_state, threads_for
from telebip.rl.resume import load_learner, require_complete, require_same
from telebip.rl.saving import Saver
from telebip.rl.symmetry import SymmetricEnv, joint_mirror
from telebip.robot_record import describe_robot


class Trainer:
    """Trains one policy in one run folder."""

    def __init__(
        self,
        env: TelebipEnv,
        task: str,
        run_dir: Path,
        ranks: Ranks | None = None,
        note: Callable[[str], None] = lambda line: print(line, file=sys.stderr),
        algorithm: str | None = None,
    ) -> None:
        """Build the learner for `env`, the same in every process of `ranks`; nothing is written before `learn`.

        `note` is told, in a line each, what a user should know though the training goes on. `algorithm` is one of
        `telebip.rl.learner.ALGORITHMS`, the task's if not given.

        Raises:
            UserError: an iteration has too few samples, or the task asks for a symmetry that it has not.
        """
        self.env, self.task, self.run_dir, self.ranks, self.note = env, task, run_dir, ranks or Ranks(), note
        self.iteration = self.samples = 0
        ppo = env.cfg.ppo
        self.view = SymmetricEnv(env) if ppo.symmetry == "phase" else env
        torch.manual_seed(env.cfg.seed)
        self.learner = make_learner(self.view, ppo, obs_groups(env.layout()), self.ranks, algorithm)
        self._average = Average(ppo.averaging, self.learner.get_policy().state_dict())
        self._saver = Saver(self.ranks, env.device, ppo.keep_checkpoints, note)
        self._episodes = EpisodeStatistics(env.num_envs, env.device)
        self._robot = describe_robot(env.robot, env.cfg.sim.decimation)
        # Spread the time-outs over the iterations.
        ages = torch.randint(env.max_episode_length, (env.num_envs,), generator=env.generator, device=env.device)
        env.episode_length_buf.copy_(ages)

    @property
    def arithmetic(self) -> str:
        """What the networks compute in: bfloat16 or float32."""
        return arithmetic(self.env.cfg.ppo.mixed_precision, self.env.device)

    def resume(self, checkpoint: Checkpoint, allow_robot_change: bool = False) -> str:
        """Go on from a checkpoint of the same task and robot, bit for bit as if nothing had happened in between.

        Returns:
            Why the worlds start new episodes instead; empty if they do not. They do where the checkpoint has none, or others,
            or those of another robot, which is refused unless `allow_robot_change`.

        Raises:
            UserError: the checkpoint is of a policy alone, or of terms that are not there; or the networks, what they see or
                the robot are not the checkpoint's.
        """
        require_complete(checkpoint)
        robot_changes = require_same(checkpoint, self.env, allow_robot_change)
        load_learner(self.learner, checkpoint, self.env.cfg.ppo)
        self._average.load(checkpoint.policy_weights)
        self.iteration, self.samples = checkpoint.iteration, checkpoint.samples
        if robot_changes:
            return "the checkpoint's worlds are of another robot"
        if len(checkpoint.training) != self.ranks.size:
            return f"the checkpoint has worlds of {len(checkpoint.training)} processes, this run has {self.ranks.size}"
        state = checkpoint.training[self.ranks.rank]
        try:
            self.env.load_state_dict(state["env"])
        except ValueError as error:
            return f"the checkpoint's worlds are others: {error}"
        self._episodes.load_state_dict(state["episodes"])
        set_random_state(state, self.env.device)
        return ""

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
                self._saver.save(self.run_dir, self._snapshot)
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
        env.set_samples(self.samples)
        set_min_std(learner, cfg, self.samples)
        learner.train_mode()
        with torch.inference_mode():
            obs, log_sums = self.collect(self.view.get_observations())
            sums = dict(zip(env.log_names, log_sums.tolist(), strict=True))
            collected = time.perf_counter()
            counts = {key: value for key, value in sums.items() if key.startswith("fault/")}
            self._judge_faults(counts)
            learner.compute_returns(obs)
        losses = learner.update()
        if reason := ruined_networks(learner, losses, self.run_dir):
            raise UserError(f"the update of iteration {self.iteration + 1} {reason}")
        learned = time.perf_counter()

        self.iteration += 1
        self._average.add(learner.get_policy().state_dict(), self.iteration)
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
        with threads_for(self.env.num_envs, self.env.device):
            for _ in range(self.env.cfg.ppo.num_steps_per_env):
                obs, rewards, dones, extras = self.view.step(self.learner.act(obs))
                self.learner.process_env_step(obs, rewards, dones, extras)
                self._episodes.add(rewards, dones)
                logs += torch.stack(list(extras["log"].values()))
        return obs, logs

    def policy(self) -> Checkpoint:
        """Return the policy as it is now, on the CPU: what `policy.pt` would hold."""
        weights = {name: value.cpu().clone() for name, value in self._average.weights.items()}
        return self._checkpoint({"actor_state_dict": weights}, [])

    def checkpoint_bytes(self) -> int:
        """Return about how large a checkpoint is: the networks, twice as much for Adam, and the worlds."""
        parameters = sum(p.numel() * p.element_size() for group in self.learner.optimizer.param_groups for p in group["params"])
        env = self.env.state_dict()
        worlds = sum(value.numel() * value.element_size() for part in ("sim", "model", "env") for value in env[part].values())
        return 3 * parameters + worlds * self.ranks.size

    def _judge_faults(self, counts: dict[str, float]) -> None:
        """Dump new faults; stop, with a checkpoint, where there are too many in any process.

        Called before the update, so that the checkpoint has the policy that met the faults.
        """
        if self.ranks.is_main:  # it alone writes
            dump_new_faults(self.env, self.task, self.run_dir, self.note)
        reason = too_many_faults(self.env, counts, self.run_dir)
        if self.ranks.any(bool(reason), self.env.device):
            self._save_finally()
            raise UserError(f"iteration {self.iteration + 1}: {reason or 'another process has too many faulty worlds'}")

    def _save_finally(self) -> None:
        self._saver.save_finally(self.run_dir, self._snapshot, self.iteration)

    def _snapshot(self) -> Checkpoint:
        """Return all that it takes to go on bit for bit; every process has to call it."""
        own = {"env": self.env.state_dict(), "episodes": self._episodes.state_dict(), **random_state(self.env.device)}
        average = {"average_state_dict": self._average.weights} if self.env.cfg.ppo.averaging else {}
        return self._checkpoint({**self.learner.save(), **average}, self.ranks.gather(own))

    def _checkpoint(self, learner: dict[str, Any], training: list[dict[str, Any]]) -> Checkpoint:
        env = self.env
        return Checkpoint(
            path=self.run_dir,
            task=self.task,
            config=env.cfg,
            iteration=self.iteration,
            samples=self.samples,
            observations={name: list(parts) for name, parts in seen(env.layout()).items()},
            joint_names=list(env.robot.joint_names),
            joint_mirror=joint_mirror(env.robot),
            learner=learner,
            training=training,
            robot=self._robot,
        )

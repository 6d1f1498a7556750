"""`play.py`: walk a policy, measure it, and record it."""

import argparse
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

from telebip.cli.common import (
    CONTROLLERS,
    Parser,
    check_connect,
    check_listen,
    checked_robot,
    open_policy,
    policy_of,
    resolve_device,
)
from telebip.cli.evaluate import progress_bar, speed
from telebip.config import TaskConfig, load_task
from telebip.control.config import split_overrides
from telebip.errors import UserError
from telebip.eval.conditions import as_evaluated
from telebip.viz.opengl import choose_opengl

AGENTS = ("zero", "random")
VIEWERS = ("none", "rerun", "mujoco", "browser")
SUFFIXES = (".rrd", ".mp4", ".gif", ".png")
EXAMPLES = """\
  play.py --checkpoint assets/policies/telebip_efficient --viewer rerun
  play.py --checkpoint assets/policies/telebip_efficient --record walk.rrd      (then: rerun walk.rrd)
  play.py --checkpoint runs/telebip_flat/2026-01-31_12-00-00 --command 0.7 0 0
  play.py --checkpoint assets/policies/telebip_efficient --viewer mujoco                (steer it: arrow keys, Enter pushes)
  play.py --checkpoint assets/policies/telebip_efficient --viewer browser               (steer it, here or over ssh)
  play.py --checkpoint assets/policies/telebip_efficient --num-envs 64 --duration 20
  play.py --controller alip --command 0.7 0 0 control.swing_height=0.05    (a model-based walker)
  play.py --checkpoint assets/policies/telebip_efficient --beside alip dcm --record both.mp4
  play.py --replay runs/telebip_flat/2026-01-31_12-00-00/faults/non_finite_state.pt
  play.py --agent zero --task telebip_flat --duration 3                    (what the robot does without a policy)
"""


def main(argv: Sequence[str] | None = None) -> None:
    """Parse arguments, walk, and print what was measured."""
    options = _parse(argv)
    choose_opengl()
    if options.replay:
        _replay(options)
    else:
        _play(options)


def _play(options: argparse.Namespace) -> None:
    """Walk everyone asked for, one after the other, say how it went, and show it as asked."""
    checkpoint = open_policy(options.checkpoint) if options.checkpoint else None
    task = checkpoint.task if checkpoint else Path(options.task).stem
    overrides = [*([] if options.seed is None else [f"seed={options.seed}"]), *options.overrides]
    config = checkpoint.config if checkpoint else load_task(options.task)
    config = as_evaluated(config, options.num_envs, options.duration, overrides, disturbed=options.disturb)
    command = options.command or [0.5 * (low + high) for low, high in config.commands.ranges]

    from telebip.cli.console import Console

    console = Console()
    with console.status("loading torch and the physics engine"):
        from telebip.control.factory import with_estimate
        from telebip.env import TelebipEnv
        from telebip.eval.walk import summarise
        from telebip.rollout import roll_out

    if options.viewer == "rerun":
        from telebip.viz.rerun import require_viewer

        require_viewer(options.connect)
    device = resolve_device(options.device)
    is_other = options.allow_robot_change
    robot = checked_robot(config, checkpoint, is_other)
    if options.viewer == "rerun" or (options.record and Path(options.record).suffix == ".rrd"):
        from telebip.viz.rerun import drawable

        drawable(robot)
    if checkpoint:
        _warn_untrained(console, command, checkpoint.config)
    if options.viewer == "browser":
        return _steer_in_browser(console, options, robot, checkpoint, overrides, command)
    rollouts = []
    for name in ["RL" if checkpoint else options.controller or options.agent, *options.beside]:
        env = TelebipEnv(with_estimate(config) if name in CONTROLLERS else config, robot, device, options.backend)
        env.set_command(*command)
        own = options.control_overrides if name == options.controller else []
        policy = policy_of(checkpoint, env, is_other) if checkpoint and name == "RL" else _policy(name, env, own)
        if options.viewer == "mujoco":
            from telebip.viz.viewer import steer

            return steer(env, policy)
        steps = max(1, round(options.duration / env.step_dt))
        with progress_bar(console) as show:
            rollout = roll_out(env, policy, steps, partial(show, f"{name} walks", total=steps))
        rollouts.append((name.upper() if name in CONTROLLERS else name, rollout))
        summary = summarise(rollout, skip=min(5.0, 0.25 * options.duration))
        who = checkpoint.path if checkpoint and name == "RL" else f"{'agent' if name in AGENTS else 'controller'} '{name}'"
        console.print(f"{who}:")
        console.print(_lines(task, summary))
    _show(console, options, rollouts, env.robot)


def _steer_in_browser(console, options: argparse.Namespace, robot, checkpoint, overrides, command: Sequence[float]) -> None:
    """Serve the robots until Ctrl-C."""
    from telebip.cli.browser import Walkers
    from telebip.viz.browser.server import serving
    from telebip.viz.browser.session import Session

    walkers = Walkers(options, checkpoint, overrides, command, _policy)
    with serving(options.listen, f"telebip: {walkers.chosen}") as (server, address):
        session = Session(server, robot, walkers.find, walkers.chosen, options.beside)
        for line in (*address.advice(), "press Ctrl-C to end"):
            console.print(line)
        with suppress(KeyboardInterrupt):
            session.run()


def _replay(options: argparse.Namespace) -> None:
    """Repeat the step of a dumped fault, say what happens at which physics step, and show it as asked."""
    from telebip.cli.console import Console
    from telebip.replay import describe, load_fault, replay

    console, fault = Console(), load_fault(options.replay)
    fault = replace(fault, config=load_task(fault.config, options.overrides))
    backend = fault.backend if options.backend == "auto" else options.backend
    done = replay(fault, backend)
    console.print(f"{options.replay}: {fault.kind}, {describe(fault.record)}, on {fault.backend}; repeated on {backend}")
    for line in done.robot_changes:
        print(f"note: '{fault.config.sim.robot}' is not the robot of '{options.replay}': {line}")
    console.print(f"  {'physics step':>12}{'hip height [m]':>16}{'max |qvel|':>12}{'max force':>12}  faults")
    for step, (state, faults) in enumerate(zip(done.states, done.faults, strict=True)):
        row = f"{state['qpos'][0, 2]:16.4f}{state['qvel'].abs().max():12.4g}{state['joint_force'].abs().max():12.4g}"
        console.print(f"  {step if step else 'before':>12}{row}  {', '.join(sorted(faults)) or '-'}")
    action, push = fault.record["action"].tolist(), fault.record["wrench_w"].tolist()
    console.print(f"  action        {' '.join(f'{a:.4g}' for a in action)}")
    console.print(f"  push          {' '.join(f'{p:.4g}' for p in push[:3])} N")
    if "reward_terms" in fault.record:
        terms = zip(fault.config.rewards, fault.record["reward_terms"].tolist(), strict=False)
        console.print(f"  rewards       {' '.join(f'{name} {value:.4g}' for name, value in terms)}")
    if fault.kind == "non_finite_reward":  # the physics is repeated, its terms are not
        console.print("the physics was right; a reward was not finite")
    else:
        console.print("reproduced" if done.reproduces(fault.kind) else f"not reproduced on {backend}")
    _show(console, options, [(fault.kind, done.rollout())], done.robot)


def _show(console, options: argparse.Namespace, rollouts, robot) -> None:
    """Record, film, draw, and open the rerun viewer, as asked."""
    from telebip.viz.scene import LANE, line_up

    actors = line_up(rollouts, worlds=options.show, lane=0.0 if robot.terrain else LANE)
    file = Path(options.record) if options.record else None
    if file and file.suffix == ".rrd":
        from telebip.viz.rerun import record

        record(actors, robot, file)
        console.print(f"recorded {file}; look at it with: rerun {file}")
    elif file and file.suffix == ".png":
        from telebip.viz.picture import strobe

        strobe(actors[0], robot, file)
        console.print(f"drew {file}")
    elif file:
        from telebip.viz.video import film

        with progress_bar(console) as show_progress:
            film(actors, robot, file, progress=partial(show_progress, "filming"))
        console.print(f"filmed {file}")
    if options.viewer == "rerun":
        from telebip.viz.rerun import show

        show(actors, robot, options.connect)
        console.print("shown in the rerun viewer")


def _policy(who: str, env, overrides: Sequence[str]):
    """Return a controller or an agent: `zero` holds the nominal pose, `random` draws standard normal actions."""
    import torch

    from telebip.control.factory import make_controller
    from telebip.control.policy import Stateless

    if who in CONTROLLERS:
        return make_controller(who, env, overrides)
    shape = (env.num_envs, env.num_actions)
    if who == "zero":
        return Stateless(lambda obs: torch.zeros(shape, device=env.device))
    return Stateless(lambda obs: torch.randn(shape, generator=env.generator, device=env.device))


def _lines(task: str, s) -> str:
    """Return what was measured, in lines that are whole on 60 columns."""
    rows = (
        ("task", f"{task}, {s.worlds} world{'s' if s.worlds > 1 else ''} x {s.duration:g} s"),
        ("command", f"{s.command[0]:.2f} m/s forward, {s.command[1]:.2f} left, {s.command[2]:.2f} rad/s"),
        ("mean speed", f"{s.speed[0]:.3f} m/s forward, {s.speed[1]:.3f} left"),
        *([("spread", f"{s.speed_spread:.3f} m/s, of the worlds' mean speeds")] if s.worlds > 1 else ()),
        ("tracking error", f"{s.lin_vel_error:.3f} m/s, mean of ||v_cmd - v||"),
        ("yaw rate", f"{s.yaw_rate:+.3f} rad/s"),
        ("heading drift", f"{s.yaw_drift_deg:.1f} deg at the end"),
        ("cost of transport", f"{s.cost_of_transport:.3f} mechanical, {s.cost_of_transport_article:.3f} as the article's"),
        ("gait period", f"{s.gait_period:.3f} s"),
        ("falls", f"{s.falls}; all else after the first {s.skipped:g} s"),
    )
    return "\n".join(f"  {name:18}{value}" for name, value in rows)


def _warn_untrained(console, command: Sequence[float], trained: TaskConfig) -> None:
    """Say so if the policy never saw such a command in training."""
    names = ("forward speed", "leftward speed", "yaw rate")
    slack = (0.0, 0.0, trained.commands.heading_limit if trained.commands.heading_gain > 0 else 0.0)
    for name, value, (low, high), extra in zip(names, command, trained.commands.ranges, slack, strict=True):
        if not low - extra <= value <= high + extra:
            console.print(f"note: {name} {value:g} lies outside what this policy was trained on, [{low:g}, {high:g}]")


def _check_replay(parser: Parser, options: argparse.Namespace) -> None:
    """Refuse what cannot change the step of a dumped fault."""
    if options.viewer in ("mujoco", "browser"):
        raise UserError("a --replay is five poses; look at them with --viewer rerun or --record")
    for name in ("beside", "command", "disturb", "duration", "num_envs", "seed", "task"):
        if getattr(options, name) != parser.get_default(name):
            raise UserError(f"a --replay repeats the step as it was; leave out --{name.replace('_', '-')}")
    for override in options.overrides:
        if not override.startswith("sim.robot="):
            raise UserError(f"a --replay repeats the step as it was; of overrides it takes sim.robot=FILE, not '{override}'")


def _parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser("Walk a policy at a given command, measure it, and record it for the rerun viewer.", EXAMPLES)
    who = parser.add_mutually_exclusive_group()
    who.add_argument("--checkpoint", metavar="PATH_OR_RUN", help="a checkpoint file, or a run folder for its newest")
    who.add_argument("--controller", choices=CONTROLLERS, help="a model-based walker, see configs/control/")
    who.add_argument("--replay", metavar="FAULT", help="repeat the step that a training dumped as runs/.../faults/<kind>.pt")
    who.add_argument("--agent", choices=AGENTS, help="no policy: nominal joint targets, or Gaussian actions")
    of_whom = "of an --agent or --controller (default: telebip_flat)"
    parser.add_argument("--task", metavar="NAME", default="telebip_flat", help=of_whom)
    everyone, others = CONTROLLERS + AGENTS, "who else walks, on lanes of their own"
    parser.add_argument("--beside", choices=everyone, nargs="+", default=[], metavar="WHO", help=others)
    middle = "m/s forward, m/s left, rad/s (default: the middle of the task's ranges)"
    parser.add_argument("--command", nargs=3, type=speed, metavar=("VX", "VY", "WZ"), help=middle)
    parser.add_argument("--duration", type=float, default=20.0, metavar="S", help="seconds to walk (default: 20)")
    parser.add_argument("--num-envs", type=int, default=1, metavar="N", help="worlds; they differ in their start (default: 1)")
    parser.add_argument("--disturb", action="store_true", help="keep the task's pushes, friction and observation noise on")
    parser.add_argument(
        "--viewer", choices=VIEWERS, default="none", help="see it at once; steer it in mujoco and browser (default: none)"
    )
    parser.add_argument("--listen", metavar="HOST:PORT", help="of --viewer browser (default: 127.0.0.1:8080)")
    parser.add_argument("--connect", metavar="HOST:PORT", help="a running rerun viewer (default: start one here)")
    parser.add_argument("--record", metavar="FILE", help="write FILE.rrd for the rerun viewer, FILE.mp4, FILE.gif, or FILE.png")
    parser.add_argument("--show", type=int, default=4, metavar="N", help="at most so many worlds, side by side (default: 4)")
    parser.add_argument("--seed", metavar="S", help="of the initial states (default: the task's)")
    parser.add_engine()
    parser.add_allow_robot_change()
    parser.add_overrides("override any field of the task, or control.key of a --controller; of a --replay, sim.robot alone")
    options = parser.parse(argv)
    if not (options.checkpoint or options.controller or options.agent or options.replay):
        raise UserError(
            "what should walk? --checkpoint PATH_OR_RUN (try assets/policies/telebip_efficient), --controller alip|dcm, "
            "or --agent zero|random"
        )
    options.control_overrides = []
    if options.controller:
        options.overrides, options.control_overrides = split_overrides(options.overrides)
    if not 0.0 < options.duration <= 3600.0:
        raise UserError(f"--duration must be between 0 and 3600 s, got {options.duration:g}")
    if options.record and Path(options.record).suffix not in SUFFIXES:
        raise UserError(f"--record writes one of FILE{', FILE'.join(SUFFIXES)}, got '{options.record}'")
    for name in ("num_envs", "show"):
        if getattr(options, name) < 1:
            raise UserError(f"--{name.replace('_', '-')} must be at least 1, got {getattr(options, name)}")
    if options.replay:
        _check_replay(parser, options)
    for viewer, name in (("mujoco", "record"), ("mujoco", "beside"), ("browser", "record")):
        if options.viewer == viewer and getattr(options, name):
            raise UserError(f"--viewer {viewer} leaves no room for --{name}; leave it out")
    check_connect(options)
    check_listen(options)
    return options

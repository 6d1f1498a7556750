"""`export.py`: export a policy to ONNX."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from telebip.cli.common import Parser, checked_robot, open_checkpoint
from telebip.config import load_task
from telebip.errors import UserError

EXAMPLES = """\
  export.py --checkpoint assets/policies/telebip_flat --out policy.onnx
  play.py --checkpoint policy.onnx --command 0.7 0 0                       (what was exported, through onnxruntime)
  python examples/deploy_mujoco.py policy.onnx assets/telebip.xml          (without telebip and without torch)
"""

SAMPLES = 10_000


def main(argv: Sequence[str] | None = None) -> None:
    """Parse arguments, export, and say how far the exported policy is from the original."""
    parser = Parser("Export a policy to one ONNX file: its network, observation normalisation and description.", EXAMPLES)
    parser.add_argument(
        "--checkpoint", metavar="PATH_OR_RUN", required=True, help="a checkpoint, or a run folder for its newest"
    )
    parser.add_argument("--out", metavar="FILE.onnx", default="policy.onnx", help="file to write (default: policy.onnx)")
    parser.add_allow_robot_change()
    parser.add_overrides("override any field of the task, as sim.robot")
    options = parser.parse(argv)
    for override in options.overrides:
        if override.startswith("ppo."):
            raise UserError(f"override '{override}': a network is exported as it was trained; ppo.* is a part of it")
    out = Path(options.out)
    if out.suffix != ".onnx":
        raise UserError(f"--out writes FILE.onnx, got '{out}'")

    from telebip.cli.console import Console

    console = Console()
    with console.status("loading torch"):
        from telebip.rl.export import export
    checkpoint = open_checkpoint(options.checkpoint)
    config = load_task(checkpoint.config, options.overrides)
    robot = checked_robot(config, checkpoint, options.allow_robot_change)
    checkpoint = dataclasses.replace(checkpoint, config=config, joint_names=list(robot.joint_names))
    with console.status("exporting"):
        difference = export(checkpoint, out, SAMPLES)
    console.print(f"wrote {out}: the policy of {checkpoint.path}, after {checkpoint.iteration} iterations of {checkpoint.task}")
    console.print(f"actions differ from torch's by {difference:.1e} at most, on {SAMPLES} random observations")

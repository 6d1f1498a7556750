"""`train.py --check`: what a second of standing tells of a robot, as a table."""

from pathlib import Path

from telebip.cli.common import refuse_wrong
from telebip.config import TaskConfig


def check(task: str, config: TaskConfig, picture: Path | None) -> None:
    """Let a task's robot stand, and print all that was looked at; draw it where a `picture` is asked for.

    Raises:
        UserError: the robot is not fit for the task.
    """
    from telebip.cli.console import Console

    console = Console()
    with console.status("loading torch and the physics engine"):
        from telebip.eval.standing import let_stand, standing_test
        from telebip.robot import load_robot
    robot = load_robot(config.sim.robot)
    findings = standing_test(config, robot)
    rate = 1.0 / robot.physics_dt
    console.print(
        f"{task}: {robot.path}, {len(robot.joint_names)} joints, {robot.weight:.0f} N, physics at {rate:g} Hz, "
        f"policy at {rate / config.sim.decimation:g} Hz"
    )
    width = max(len(finding.check) for finding in findings)
    for finding in findings:
        remedy = f"; {finding.remedy}" if finding.remedy else ""
        console.print(f"  {finding.verdict:9}{finding.check:{width}}  {finding.found}{remedy}")
    if picture:
        from telebip.viz.picture import side_by_side

        stand = let_stand(robot)
        last = stand.qpos[-1] if len(stand.qpos) else robot.home_qpos
        side_by_side([robot.home_qpos, last], robot, picture)
        console.print(f"drew {picture}: at home, and as it stands at last")
    refuse_wrong(findings, robot)
    doubts = sum(finding.verdict == "warning" for finding in findings)
    console.print(f"fit to be trained{f', with {doubts} warnings' if doubts > 1 else ', with one warning' if doubts else ''}")

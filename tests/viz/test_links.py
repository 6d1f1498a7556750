# pyright: reportAttributeAccessIssue=false, reportOptionalMemberAccess=false
"""Links are drawn where MuJoCo has them, in the shapes and colours of the URDF."""

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from telebip.errors import UserError
from telebip.robot import Robot
from telebip.viz.urdf import joint_transforms, link_mesh, link_paths, link_poses, load_urdf


def beside(robot: Robot, urdf: Path) -> Robot:
    """Return the robot with another URDF beside its MJCF."""
    return replace(robot, path=urdf.with_suffix(".xml"))


def at(robot: Robot, joints: list[float]) -> np.ndarray:
    """Return the home pose with other joint positions, (1, nq)."""
    return np.array([[*robot.home_qpos[:7], *joints]])


@pytest.mark.parametrize("name", ["robot", "four_joints"])
def test_links_stand_where_mujoco_has_them(name: str, request: pytest.FixtureRequest) -> None:
    robot: Robot = request.getfixturevalue(name)
    random = np.random.default_rng(0)
    low, high = robot.model.jnt_range[1:].T  # of all joints, actuated or not
    qpos = np.concatenate(
        [random.uniform(-2.0, 2.0, (20, 3)), random.normal(size=(20, 4)), random.uniform(low, high, (20, len(low)))], axis=1
    )
    qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
    poses = link_poses(load_urdf(robot), robot, qpos)
    data = mujoco.MjData(robot.model)
    for step, row in enumerate(qpos):
        data.qpos[:] = row
        mujoco.mj_kinematics(robot.model, data)
        for link, pose in poses.items():
            body = data.body(link)
            np.testing.assert_allclose(pose[step, :3, 3], body.xpos, atol=1e-6, err_msg=link)
            np.testing.assert_allclose(pose[step, :3, :3], body.xmat.reshape(3, 3), atol=1e-6, err_msg=link)


def test_transforms_compose_along_the_paths(robot: Robot) -> None:
    urdf = load_urdf(robot)
    paths = link_paths(urdf)
    assert paths["trunk"] == "trunk"
    assert paths["left_foot"] == "trunk/left_hip/left_thigh/left_shank/left_foot"
    qpos = np.array([[0.0, 0.0, 0.7, 1.0, 0.0, 0.0, 0.0, 0.1, -0.2, 0.05, -0.1, 0.3, 0.0]])
    relative = joint_transforms(urdf, robot, qpos)
    product = np.eye(4)
    for link in paths["left_foot"].split("/")[1:]:
        product = product @ relative[link][0]
    foot = link_poses(urdf, robot, qpos)["left_foot"][0]
    np.testing.assert_allclose(product[:3, 3] + [0.0, 0.0, 0.7], foot[:3, 3], atol=1e-12)


def test_an_origin_that_is_turned_turns_the_axis_with_it(robot: Robot, urdf: Path, tmp_path: Path) -> None:
    turned = tmp_path / "turned.urdf"
    turned.write_text(
        urdf.read_text().replace('<origin xyz="0 0 -0.67"/>', '<origin xyz="0 0 -0.67" rpy="0 1.5707963268 0"/>', 1)
    )
    qpos = at(robot, [0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    knee = joint_transforms(load_urdf(beside(robot, turned)), robot, qpos)["right_shank"][0]
    np.testing.assert_allclose(knee[:3, 3], [0.1, 0.0, -0.67], atol=1e-9)  # the slide's z axis points along x


def test_a_link_is_one_mesh_in_its_colours(robot: Robot) -> None:
    urdf = load_urdf(robot)
    foot, thigh = link_mesh(urdf, "right_foot"), link_mesh(urdf, "right_thigh")
    assert foot is not None and thigh is not None
    np.testing.assert_allclose(np.linalg.norm(foot.vertices, axis=1), 0.03, atol=1e-9)
    assert {tuple(color) for color in foot.visual.vertex_colors.tolist()} == {(20, 20, 23, 255)}
    np.testing.assert_allclose(thigh.vertices[:, 2].min(), -0.364, atol=1e-9)  # the collar's lower end
    assert len({tuple(color) for color in thigh.visual.vertex_colors.tolist()}) == 2  # tube and housing
    assert thigh.faces.max() == len(thigh.vertices) - 1


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('name="left_knee"', 'name="left_slide"', "no joint named 'left_knee'"),
        ('<axis xyz="0 0 1"/>', '<axis xyz="up"/>', "is not a valid URDF"),
    ],
)
def test_a_urdf_that_is_not_this_robot_is_one_line(
    robot: Robot, urdf: Path, tmp_path: Path, old: str, new: str, message: str
) -> None:
    other = tmp_path / "other.urdf"
    other.write_text(urdf.read_text().replace(old, new))
    with pytest.raises(UserError, match=message) as error:
        load_urdf(beside(robot, other))
    assert "\n" not in str(error.value)
    with pytest.raises(UserError, match="does not exist"):
        load_urdf(beside(robot, tmp_path / "nowhere.urdf"))


def test_a_mesh_file_is_refused(robot: Robot, urdf: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.urdf"
    other.write_text(urdf.read_text().replace('<sphere radius="0.03"/>', '<mesh filename="foot.stl"/>'))
    with pytest.raises(UserError, match="box, cylinder and sphere"):
        link_mesh(load_urdf(beside(robot, other)), "right_foot")

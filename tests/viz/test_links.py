# pyright: reportAttributeAccessIssue=false, reportOptionalMemberAccess=false
"""Links are drawn where MuJoCo has them, in the shapes and colours of the URDF."""

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh

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
    foot, thigh = (link_mesh(urdf, link, robot.path.with_suffix(".urdf")) for link in ("right_foot", "right_thigh"))
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


def with_a_mesh(urdf: Path, folder: Path, mesh: str) -> Path:
    """Write the shipped URDF with the feet's spheres replaced."""
    other = folder / "other.urdf"
    other.write_text(urdf.read_text().replace('<sphere radius="0.03"/>', mesh))
    return other


@pytest.mark.parametrize("name", ["foot.stl", "foot.obj", "foot.ply"])
def test_a_mesh_is_drawn_at_its_scale(robot: Robot, urdf: Path, tmp_path: Path, name: str) -> None:
    trimesh.creation.box(extents=(0.1, 0.2, 0.3)).export(tmp_path / name)
    other = with_a_mesh(urdf, tmp_path, f'<mesh filename="{name}" scale="2 1 1"/>')
    foot = link_mesh(load_urdf(beside(robot, other)), "right_foot", other)
    assert foot is not None
    np.testing.assert_allclose(foot.extents, [0.2, 0.2, 0.3], atol=1e-6)
    assert {tuple(color) for color in foot.visual.vertex_colors.tolist()} == {(20, 20, 23, 255)}  # the URDF's, not the file's


def test_a_mesh_of_a_package_is_found_beside_the_urdf(robot: Robot, urdf: Path, tmp_path: Path) -> None:
    (tmp_path / "meshes").mkdir()
    trimesh.creation.icosphere(radius=0.05).export(tmp_path / "meshes" / "ball.stl")
    other = with_a_mesh(urdf, tmp_path, '<mesh filename="package://mine/meshes/ball.stl"/>')
    foot = link_mesh(load_urdf(beside(robot, other)), "left_foot", other)
    assert foot is not None and foot.extents.max() == pytest.approx(0.1, rel=0.01)


@pytest.mark.parametrize(
    ("mesh", "content", "said"),
    [
        ('<mesh filename="gone.stl"/>', b"", "mesh 'gone.stl' does not exist"),
        ('<mesh filename="broken.stl"/>', b"solid nothing", "no finite shape"),
        ('<mesh filename="broken.stl"/>', b"\x00" * 200, ""),
        ('<mesh filename="broken.xyz9"/>', b"1 2 3", "mesh"),
        ("<mesh/>", b"", ""),
        ('<sphere radius="nan"/>', b"", "no finite shape"),
    ],
)
def test_a_shape_that_cannot_be_drawn_is_named(
    robot: Robot, urdf: Path, tmp_path: Path, mesh: str, content: bytes, said: str
) -> None:
    for name in ("broken.stl", "broken.xyz9"):
        (tmp_path / name).write_bytes(content)
    other = with_a_mesh(urdf, tmp_path, mesh)
    with pytest.raises(UserError) as error:
        link_mesh(load_urdf(beside(robot, other)), "right_foot", other)
    message = str(error.value)
    assert message.startswith(f"{other}: link 'right_foot' cannot be drawn") and said in message


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (
            '<child link="left_foot"/>',
            '<child link="right_foot"/>',
            "moves link 'right_foot', which another joint moves already",
        ),
        ('<parent link="left_shank"/>', '<parent link="left_shin"/>', "names the link 'left_shin', which is not there"),
        ('<parent link="left_shank"/>', '<parent link="left_foot"/>', "does not hang on link 'trunk'"),
        (
            '<parent link="trunk"/>\n    <child link="left_hip"/>',
            '<parent link="left_hip"/>\n    <child link="trunk"/>',
            "root",
        ),
    ],
)
def test_links_that_form_no_tree_are_named(robot: Robot, urdf: Path, tmp_path: Path, old: str, new: str, said: str) -> None:
    assert old in urdf.read_text()
    other = tmp_path / "other.urdf"
    other.write_text(urdf.read_text().replace(old, new))
    with pytest.raises(UserError, match=said):
        load_urdf(beside(robot, other))

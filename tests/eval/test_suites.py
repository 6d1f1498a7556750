"""The whole evaluator on a few worlds, its results and its report."""

import dataclasses
import json
import math
import re
from pathlib import Path
from typing import Any

import pytest
import torch

from telebip import ROOT
from telebip.cli.evaluate import checkpoint_candidate, controller_candidate, references
from telebip.config import load_task
from telebip.control.policy import Stateless
from telebip.errors import UserError
from telebip.eval import plots
from telebip.eval.learning import learning_curve, samples_to
from telebip.eval.omni import OmniProtocol
from telebip.eval.push import PushProtocol
from telebip.eval.report import can_be_shown, read_results, write_report, write_results
from telebip.eval.suites import SUITES, Candidate, Protocol, check_suites, commands_of, evaluate, is_current, make_env
from telebip.eval.terrain import LEVELS, TYPES, TerrainProtocol
from telebip.eval.transfer import TransferProtocol
from telebip.robot import Robot, load_robot

POLICY = "assets/policies/telebip_flat"
OMNI = OmniProtocol(
    lin_vel_x=(0.5, 0.7), lin_vel_y=(0.0,), ang_vel_z=(-0.1, 0.0), changes=2, worlds=2, duration=6.0, change_at=2.0, skip=2.0
)
PROTOCOL = Protocol(
    worlds=4,
    duration=8.0,
    skip=3.0,
    push=PushProtocol(max_force=10.0, worlds=1, limit_worlds=2, warmup=1.0, horizons=(1.0, 2.0), num_envs=8),
    omni=OMNI,
    terrain=TerrainProtocol(worlds=1),
    transfer=TransferProtocol(worlds=2, points=2, sweep_worlds=2, duration=1.0, skip=0.2),
)


@pytest.fixture(scope="module")
def candidate() -> Candidate:
    return checkpoint_candidate(POLICY, "flat")


@pytest.fixture(scope="module")
def results(candidate: Candidate, robot: Robot) -> dict[str, Any]:
    return evaluate(candidate, robot, SUITES, PROTOCOL)


def test_tracking_measures_every_trained_command(results: dict[str, Any]) -> None:
    rows = results["tracking"]
    assert results["engine"] == "native"
    assert [row["command_mps"] for row in rows] == [0.5, 0.7, 1.0]  # backward was not trained
    for row in rows:
        assert row["mean_speed_mps"] == pytest.approx(row["command_mps"], rel=0.06)
        assert (row["falls"], row["worlds"]) == (0, 4)
        assert row["cot_mechanical"] < row["cot_article"] < row["cot_mechanical"] + 0.01
        assert 0.0 < row["cot_positive"] < row["cot_mechanical"]
        assert sum(row["cot_joints"].values()) == pytest.approx(row["cot_mechanical"], abs=1e-4)
        assert sum(part["positive"] for part in row["energy"]) == pytest.approx(row["cot_positive"], abs=2e-4)
        assert sum(part["positive"] + part["negative"] for part in row["energy"]) == pytest.approx(
            row["cot_mechanical"], abs=2e-4
        )


def test_gait_and_pushes(results: dict[str, Any]) -> None:
    assert results["gait"]["period_s"] == pytest.approx(0.5, rel=0.02)
    assert 0.8 < results["gait"]["symmetry"] <= 1.0
    push = results["push"]["1s"]
    assert push["tried"] == {direction: [[10.0, 2, 0]] for direction in ("forward", "backward", "left", "right")}
    assert push["shares"]["left"] == {"share": 1.0, "share_low": 0.3424, "share_high": 1.0, "worlds": 2}
    assert {name: value for name, value in push.items() if name not in ("tried", "shares")} == {
        **dict.fromkeys(("forward_n", "backward_n", "lateral_n", "forward_95_n", "backward_95_n", "lateral_95_n"), 10.0),
        **dict.fromkeys(("forward_ns", "backward_ns", "lateral_ns"), 1.0),
        **dict.fromkeys(("forward_bw", "backward_bw", "lateral_bw"), round(10.0 / (13.6 * 9.81), 4)),
    }
    assert results["push"]["world_steps"] % 8 == 0


def test_all_directions(results: dict[str, Any]) -> None:
    omni = results["omni"]
    assert [row["command"] for row in omni["grid"]] == [[0.5, 0.0, -0.1], [0.5, 0.0, 0.0], [0.7, 0.0, -0.1], [0.7, 0.0, 0.0]]
    for row in omni["grid"]:
        assert row["mean"] == pytest.approx(row["command"], abs=0.06)
        assert row["lin_vel_error_mps"] <= omni["worst"]["lin_vel_error_mps"] < 0.06
        assert row["yaw_rate_error_radps"] <= omni["worst"]["yaw_rate_error_radps"] < 0.05
        assert (row["falls"], row["worlds"]) == (0, 2)
    tracked = {row["command_mps"]: row["cot_mechanical"] for row in results["tracking"]}
    for row in omni["straight"]:
        assert row["cot_mechanical"] == pytest.approx(tracked[row["command"][0]], rel=0.15)
    for row in omni["changes"]:  # the means are those of the second command
        assert row["before"] != row["command"]
        assert row["mean"] == pytest.approx(row["command"], abs=0.1)
    assert omni["worst"]["falls"] == omni["worst"]["change_falls"] == 0
    assert omni["limits"]["left_mps"] < 0.5  # it has not learned to walk sideways


def test_terrain(results: dict[str, Any]) -> None:
    terrain = results["terrain"]
    assert [row["type"] for row in terrain["levels"]] == [name for name in TYPES for _ in range(LEVELS)]
    easiest, hardest = ({row["type"]: row for row in terrain["levels"][at::LEVELS]} for at in (0, LEVELS - 1))
    assert [easiest["waves"][key] for key in ("size", "unit", "worlds", "success")] == [0.02, "m", 1, 1.0]
    assert hardest["slope_up"]["size"] == pytest.approx(math.radians(30.0), abs=1e-4)
    assert easiest["waves"]["speed_mps"] == pytest.approx(0.5, abs=0.15)
    assert easiest["waves"]["cot"] > 0.3
    # It was trained on the flat, and shuffles: stairs of 24 cm are too much.
    assert hardest["stairs_up"]["success"] == 0.0
    assert hardest["stairs_up"]["cot"] is None or math.isnan(hardest["stairs_up"]["cot"])
    assert terrain["limits"]["stairs_up"] < 0.24


def test_the_same_seed_gives_the_same_results(candidate: Candidate, robot: Robot) -> None:
    protocol = dataclasses.replace(PROTOCOL, duration=3.0, skip=1.0)
    a, b = (evaluate(candidate, robot, ("tracking", "gait"), protocol) for _ in range(2))
    assert a["gait"]["period_s"] > 0.0
    assert a | {"date": ""} == b | {"date": ""}


def test_every_field_of_the_results_is_described(results: dict[str, Any]) -> None:
    text = (ROOT / "docs" / "evaluation.md").read_text(encoding="utf-8")
    described = set(re.findall(r"`(\w+)`", text))

    def names(node: Any) -> set[str]:
        if isinstance(node, dict):
            keys = {key for key in node if not re.fullmatch(r"[-\d.]+s?|(right|left)_(hip_roll|hip_pitch|knee)", key)}
            keys -= set(TYPES)
            return keys.union(*(names(value) for value in node.values()))
        return set().union(*map(names, node)) if isinstance(node, list) else set()

    assert names(results) - described == set()


def test_results_are_json_and_come_back(results: dict[str, Any], tmp_path: Path) -> None:
    write_results(results | {"nothing": float("nan"), "far": [float("inf")]}, tmp_path)
    json.loads((tmp_path / "results.json").read_text(), parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    back = read_results(tmp_path / "results.json")
    assert (back["nothing"], back["far"]) == (None, [None])
    assert back["tracking"] == results["tracking"]


def test_results_are_current_for_the_same_candidate_measured_in_the_same_way(
    results: dict[str, Any], candidate: Candidate, tmp_path: Path
) -> None:
    write_results(results, tmp_path)
    back = read_results(tmp_path / "results.json")
    assert is_current(back, candidate, SUITES, PROTOCOL)
    assert not is_current(back, candidate, SUITES, dataclasses.replace(PROTOCOL, worlds=5))
    assert not is_current(back, candidate, SUITES, dataclasses.replace(PROTOCOL, push=PushProtocol()))
    assert not is_current(back, candidate, SUITES, dataclasses.replace(PROTOCOL, omni=OmniProtocol()))
    assert not is_current(back, candidate, SUITES, dataclasses.replace(PROTOCOL, terrain=TerrainProtocol()))
    assert not is_current(back, candidate, SUITES, dataclasses.replace(PROTOCOL, transfer=TransferProtocol()))
    assert not is_current(back, dataclasses.replace(candidate, fingerprint="of another"), SUITES, PROTOCOL)
    assert not is_current({key: value for key, value in back.items() if key != "gait"}, candidate, SUITES, PROTOCOL)


def test_results_that_lack_something_are_not_current(results: dict[str, Any], candidate: Candidate) -> None:
    for lacking in ({"push": None}, {"push": {}}, {"gait": None}, {"tracking": []}, {"protocol": None}):
        assert not is_current(results | lacking, candidate, SUITES, PROTOCOL)
    assert not is_current({key: value for key, value in results.items() if key != "fingerprint"}, candidate, SUITES, PROTOCOL)


def test_results_that_lack_something_cannot_be_shown(results: dict[str, Any]) -> None:
    assert can_be_shown(results)
    lacks: list[dict[str, Any]] = [{"tracking": [{"command_mps": 0.5}]}, {"tracking": None}, {"series": {}}, {"gait": 1.0}]
    for lacking in (*lacks, {"push": {"10s": {}}}, {"learning": {"samples": []}}):
        assert not can_be_shown(results | lacking)


def test_robots_are_drawn_from_the_ranges_of_any_task(candidate: Candidate, robot: Robot) -> None:
    transfer = TransferProtocol(task="telebip_flat", worlds=1, sweep_worlds=1, points=2, duration=0.1, skip=0.0)
    found = evaluate(candidate, robot, ("transfer",), dataclasses.replace(PROTOCOL, transfer=transfer))["transfer"]
    assert found["protocol"]["task"] == "telebip_flat"
    ends = {factor["name"]: [row["value"] for row in factor["points"]] for factor in found["factors"]}
    events = load_task("telebip_flat").events
    assert ends == {
        "push.force": [0.0, events["push"]["force"]],
        "friction.range": list(events["friction"]["range"]),
        "observations.noise": [0.0, 1.0],
    }
    assert "one factor of telebip_flat at a time" in plots.transfer({"label": "flat", "transfer": found}).get_suptitle()


def test_a_controller_is_told_by_its_parameters() -> None:
    own, same, other = (controller_candidate("dcm", None, overrides) for overrides in ((), (), ("control.step_time=0.3",)))
    assert own.fingerprint == same.fingerprint != other.fingerprint


def test_the_report_takes_any_number_of_commands_and_a_single_world(results: dict[str, Any], tmp_path: Path) -> None:
    speed = results["series"]["speed"]
    many = {"time_s": speed["time_s"], **{f"{0.05 * i:g}": speed["0.7"] for i in range(12)}}
    alone = [row | {"ci95_mps": float("nan")} for row in results["tracking"]]
    write_report([[results | {"series": results["series"] | {"speed": many}, "tracking": alone}]], tmp_path, "Many")
    assert "nan" not in (tmp_path / "report.md").read_text()


def test_a_walk_has_a_step_at_least(candidate: Candidate, robot: Robot) -> None:
    config = load_task(candidate.config, ["sim.decimation=1000"])
    slow = Candidate("slow", config, lambda env: Stateless(lambda obs: torch.zeros(env.num_envs, env.num_actions)))
    rows = evaluate(slow, robot, ("tracking",), dataclasses.replace(PROTOCOL, worlds=1, duration=1.0, skip=0.0))["tracking"]
    assert len(rows) == 3


def test_the_report_shows_the_numbers_beside_the_articles_in_one_file(results: dict[str, Any], tmp_path: Path) -> None:
    write_report([[results]], tmp_path, "How <it> walks", "First, by `<name>.py`.\n\nSecond.", references())
    markdown, page = ((tmp_path / f"report.{suffix}").read_text() for suffix in ("md", "html"))
    speed = f"{results['tracking'][1]['mean_speed_mps']:.3f}"
    for text in (markdown, page):
        assert speed in text
        assert "0.693" in text  # the article's mean speed at 0.7 m/s
        assert "angular momentum" in text
    assert (
        page.count("<svg") == 9
    )  # cost, energy, omni, terrain, transfer, speed, feet, joints, energy by speed; no push of ten seconds
    assert "How &lt;it&gt; walks" in page and "<p>First, by <code>&lt;name&gt;.py</code>.</p>" in page
    assert not re.search(r"(src|href)=\"http", page)  # complete in itself
    assert re.findall(r"!\[.*\]\((.*)\)", markdown) == [
        "cost_of_transport.svg",
        "energy.svg",
        "omni.svg",
        "terrain.svg",
        "transfer.svg",
    ]
    assert (tmp_path / "cost_of_transport.svg").read_text().startswith("<svg")


def test_who_falls_has_no_bar_in_the_cost_of_transport(results: dict[str, Any]) -> None:
    fallen = results | {"label": "falls", "tracking": [row | {"falls": row["worlds"]} for row in results["tracking"]]}
    figure = plots.cost_of_transport([[results], [fallen]])
    assert [text.get_text() for text in figure.axes[0].get_yticklabels()] == [results["label"]]


def test_a_walker_s_energy_is_split_into_shares_of_its_own_cost(results: dict[str, Any]) -> None:
    axes = plots.energy([results, results]).axes[0]
    cost = results["tracking"][1]["cot_mechanical"]  # at 0.7 m/s
    assert axes.get_yticklabels()[0].get_text() == f"{results['label']}, 0.7 m/s, COT {cost:.3f}"
    bars = [patch.get_width() for patch in axes.patches]  # pyright: ignore[reportAttributeAccessIssue]
    assert sum(map(abs, bars)) == pytest.approx(200.0)  # per cent of two walkers


def test_a_label_is_shown_as_it_is_written(results: dict[str, Any]) -> None:
    odd = [results | {"label": label} for label in ("cost $a_$", "_hidden", "$_^{", "5 $")]
    figure = plots.cost_of_transport([[one] for one in odd])
    assert [text.get_text() for text in figure.axes[0].get_yticklabels()] == [r"cost \$a_\$", " _hidden", r"\$_^{", r"5 \$"]
    assert plots.svg(figure).startswith("<svg")
    for one in odd:
        for draw in (plots.speed, plots.feet, plots.joints, plots.energy_by_speed):
            assert plots.svg(draw(one)).startswith("<svg")


def test_the_same_numbers_give_the_same_picture(results: dict[str, Any]) -> None:
    assert plots.svg(plots.cost_of_transport([[results]])) == plots.svg(plots.cost_of_transport([[results]]))


def test_broken_results_are_named(tmp_path: Path) -> None:
    file = tmp_path / "results.json"
    for content in ("{", "[]", '{"schema": "other"}'):
        file.write_text(content)
        with pytest.raises(UserError, match=r"results\.json"):
            read_results(file)


def test_suites_are_checked_and_ordered() -> None:
    assert check_suites(["gait", "tracking"]) == ("tracking", "gait")
    with pytest.raises(UserError, match=r"unknown suite 'trakcing'; did you mean 'tracking'\?"):
        check_suites(["trakcing"])


def test_overrides_hold_in_the_worlds_that_are_measured(robot: Robot) -> None:
    overrides = ("events.friction.range=[0.05,0.06]", "events.start_pose.heading=3")
    slippery = make_env(checkpoint_candidate(POLICY, None, overrides), robot, PROTOCOL, num_envs=2, duration=1.0)
    floor = slippery.sim.model.geom("floor").id
    assert (slippery.sim.model_fields["geom_friction"][:, floor, 0] < 0.07).all()
    assert slippery.cfg.events["start_pose"]["heading"] == 3.0
    assert "push" not in slippery.cfg.events
    pushed = controller_candidate("dcm", None, ("events.push.force=20", "control.step_time=0.3"))
    config = make_env(pushed, robot, PROTOCOL, num_envs=2, duration=1.0).cfg
    assert config.events["push"]["force"] == 20.0
    assert [*config.observations] == ["policy", "estimate"]
    never = checkpoint_candidate(POLICY, None, ("events.push=null", "gait.period=0.6"))
    assert "push" not in make_env(never, robot, PROTOCOL, num_envs=2, duration=1.0).cfg.events
    assert (never.task.gait.period, never.config.gait.period) == (0.6, 0.5)


@pytest.mark.parametrize(("name", "has_prismatic_knees"), [("four_joints", True), ("ten_joints", False)])
def test_a_robot_with_other_joints_is_measured_too(name: str, has_prismatic_knees: bool, tmp_path: Path) -> None:
    task = load_task(f"tests/robots/{name}.yaml")
    robot = load_robot(task.sim.robot)
    stands = Candidate(name, task, lambda env: Stateless(lambda obs: torch.zeros(env.num_envs, env.num_actions)))
    protocol = dataclasses.replace(PROTOCOL, worlds=2, duration=2.0, skip=0.5)
    results = evaluate(stands, robot, ("tracking", "push", "gait"), protocol)
    for row in results["tracking"]:
        assert tuple(row["cot_joints"]) == robot.joint_names
    assert (results["gait"]["knee_stroke_m"] >= 0.0) == has_prismatic_knees  # else it is NaN
    write_results(results, tmp_path)
    write_report([[results]], tmp_path, name)
    assert can_be_shown(read_results(tmp_path / "results.json"))


def test_commands_keep_to_what_was_trained(candidate: Candidate) -> None:
    everything = Candidate("any", candidate.config, lambda env: Stateless(lambda obs: torch.zeros(1, 6)), is_model_based=True)
    assert commands_of(everything, PROTOCOL) == (0.5, 0.7, 1.0, -0.3)
    assert commands_of(candidate, PROTOCOL) == (0.5, 0.7, 1.0)
    assert commands_of(candidate, dataclasses.replace(PROTOCOL, commands=(0.2,))) == (0.2,)


def test_a_damaged_learning_curve_is_named_first(candidate: Candidate, robot: Robot, tmp_path: Path) -> None:
    (tmp_path / "learning.csv").write_text("nothing\n")
    steps: list[int] = []
    damaged = dataclasses.replace(candidate, run_dir=tmp_path)
    with pytest.raises(UserError, match=r"learning\.csv is damaged"):
        evaluate(damaged, robot, SUITES, PROTOCOL, lambda name, step, total: steps.append(step))
    assert steps == []


def test_samples_to_a_share_of_the_final_value() -> None:
    samples = [float(i) for i in range(1, 31)]
    curve = [min(i / 10, 1.0) * 500.0 for i in range(30)]
    assert samples_to(samples, curve) == 11.0  # 0.95 x 500 is first reached by the eleventh row
    assert samples_to([], []) is None
    assert samples_to([1.0], [-3.0]) is None


def test_a_learning_curve_is_thinned_and_a_damaged_one_named(tmp_path: Path) -> None:
    assert learning_curve(tmp_path) is None
    columns = "samples,train/episode_length,train/episode_return,error/lin_vel_mps,walk/cost_of_transport,"
    columns += "walk/falls_per_minute,train/action_std"
    rows = [f"{i * 1000},{min(i, 50) * 10},{i},0.5,1.0,0,0.5" for i in range(1, 101)]
    (tmp_path / "learning.csv").write_text("\n".join([columns, *rows]) + "\n")
    curve = learning_curve(tmp_path, points=20)
    assert curve is not None
    assert len(curve["samples"]) == 20
    assert curve["samples_to_95_length"] == 48_000.0
    for points in (1, 3, 20, 99, 200):
        curve = learning_curve(tmp_path, points)
        assert curve is not None
        assert len(curve["samples"]) <= points
        assert (curve["samples"][-1], curve["episode_return"][-1]) == (100_000.0, 100.0)
    (tmp_path / "learning.csv").write_text("samples,train/episode_length\n1000,many\n")
    with pytest.raises(UserError, match=r"learning\.csv is damaged at line 2: could not convert string to float: 'many'"):
        learning_curve(tmp_path)
    (tmp_path / "learning.csv").write_text(columns + "\n")
    assert learning_curve(tmp_path) is None
    (tmp_path / "learning.csv").write_text("samples,train/episode_length\n1000,500\n")
    with pytest.raises(UserError, match=r"learning\.csv is damaged: it has no column 'train/episode_return'"):
        learning_curve(tmp_path)

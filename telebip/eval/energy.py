"""Where the energy goes: the cost of transport by joint, phase of the joint's leg, and sign of the work."""

from typing import Any

import numpy as np

from telebip.eval.gait import CONTACT
from telebip.eval.walk import cost_of_transport, heading_velocity
from telebip.rollout import Rollout

PHASES = ("stance", "double_support", "swing")
SIDES = ("right", "left")  # in the order of `Rollout.foot_force`


def energy(rollout: Rollout) -> list[dict[str, Any]]:
    r"""Split the mechanical cost of transport of a rollout.

        C(j, phase, +-) = mean_t [ phase(t) P_j^{+-}(t) ] / (m g v),    P^{+-} = (|P| +- P) / 2

    with means over worlds and time; P of each physics step, so that a step of the policy may have both signs. The leg of a
    joint is in stance where its foot alone carries more than `CONTACT` body weights, in double support where both do, and in
    swing where its own does not. Joints of neither side are in swing where no foot carries. The parts add up to
    `cot_mechanical`.

    Returns:
        For each kind of joint (`knee`, of both legs together) and phase: `joint`, `phase`, `positive` and `negative` [-].
    """
    velocity = heading_velocity(rollout.qpos, rollout.qvel)
    down = rollout.foot_force > CONTACT * rollout.weight
    rows: dict[tuple[str, str], dict[str, Any]] = {}
    for i, name in enumerate(rollout.joint_names):
        side, _, kind = name.partition("_")
        kind, legs = (kind, down[..., [SIDES.index(side)]]) if side in SIDES and kind else (name, down)
        own, both = legs.any(-1), down.all(-1)
        absolute, net = rollout.joint_power[..., i], rollout.joint_net_power[..., i]
        for phase, mask in zip(PHASES, (own & ~both, both, ~own), strict=True):
            row = rows.setdefault((kind, phase), {"joint": kind, "phase": phase, "positive": 0.0, "negative": 0.0})
            for sign, power in (("positive", 0.5 * (absolute + net)), ("negative", 0.5 * (absolute - net))):
                row[sign] += cost_of_transport(np.where(mask, power, 0.0), velocity, rollout.weight)
    return [row | {sign: round(row[sign], 5) for sign in ("positive", "negative")} for row in rows.values()]

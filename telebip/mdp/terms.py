"""All of telebip's own terms: importing this module enters them in `telebip.mdp.term.TERMS`."""

from telebip.mdp import events, observations, rewards, terminations

__all__ = ["events", "observations", "rewards", "terminations"]

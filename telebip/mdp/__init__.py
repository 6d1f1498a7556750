"""The MDP, one function per term: see `telebip.mdp.term`; `telebip.env` calls them in the order of one step."""

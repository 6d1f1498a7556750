"""The MDP as pure functions of batched tensors; `telebip.env` calls them in the order of one step."""

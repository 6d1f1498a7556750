"""What can walk a robot, behind the one `Policy` interface of `telebip.control.policy`."""

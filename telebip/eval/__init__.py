"""Measuring how a policy walks."""

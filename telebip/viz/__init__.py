"""Seeing a robot walk."""

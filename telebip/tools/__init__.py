"""Measuring and drawing: what makes telebip and its documentation, and no part of the product."""

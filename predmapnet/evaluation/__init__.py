"""Metrics of the field and of the global map."""

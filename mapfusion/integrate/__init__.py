"""Tracked polylines of single frames into one global map."""

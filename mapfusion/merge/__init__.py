"""Merging of the maps of many drives into one map."""

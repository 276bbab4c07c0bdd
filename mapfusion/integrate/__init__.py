"""Integration of the maps of single frames into one global map."""

"""Procedural towns and a camera renderer, written to disk as a genuine nuScenes data set."""

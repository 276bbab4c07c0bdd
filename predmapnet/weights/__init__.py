"""Weights files: the shipped checkpoint, reading, writing, and import from MapTracker."""

"""Readers of data sets: one file per source of driving logs, ground truth included."""

"""Vectorised ground truth exactly as the field's official code forms it, from the data sets' own maps."""

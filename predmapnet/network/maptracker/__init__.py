"""The parts of MapTracker's network."""

"""The parts of the small network (`lite`)."""

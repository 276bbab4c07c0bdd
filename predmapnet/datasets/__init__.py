"""Where driving logs come from: one file per source behind one protocol, ground truth included."""

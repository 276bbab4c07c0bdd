"""Writers and readers of global maps, one file per format."""

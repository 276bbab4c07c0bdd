"""Map files: one file per format."""

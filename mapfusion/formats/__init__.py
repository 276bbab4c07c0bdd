"""Map files, one module per format."""

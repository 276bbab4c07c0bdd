"""Fast arithmetic that knows nothing of maps."""

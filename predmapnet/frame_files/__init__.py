"""Files of per-frame results and poses: readers and writers."""

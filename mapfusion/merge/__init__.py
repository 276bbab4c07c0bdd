"""Maps of many drives into one map."""

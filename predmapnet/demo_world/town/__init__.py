"""Towns: plan, roads, junctions and the drives through them."""

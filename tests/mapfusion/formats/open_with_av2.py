"""Opens a map archive with the official av2 package and prints what it saw."""

import json
import sys
from pathlib import Path

import numpy as np
from av2.map.map_api import ArgoverseStaticMap

found = ArgoverseStaticMap.from_map_dir(Path(sys.argv[1]), build_raster=False)
segments = found.get_nearby_lane_segments(np.array([10.0, 5.0]), 50.0)
crossings = found.get_scenario_ped_crossings()
print(
    json.dumps(
        {
            "segments": [segment.left_lane_boundary.xyz.tolist() for segment in segments],
            "marks": sorted(segment.left_mark_type for segment in segments),
            "crossing": crossings[0].polygon.tolist(),
        }
    )
)

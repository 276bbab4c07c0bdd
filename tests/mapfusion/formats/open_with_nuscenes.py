"""Opens a map expansion with the official nuscenes-devkit and prints what it saw."""

import json
import sys

from nuscenes.map_expansion.map_api import NuScenesMap

found = NuScenesMap(dataroot=sys.argv[1], map_name="boston-seaport")
patch = (-100, -100, 100, 100)
near = found.get_records_in_patch(patch, ["ped_crossing", "lane_divider"], mode="intersect")
masks = found.get_map_mask((10, 5, 60, 60), 0.0, ["ped_crossing", "lane_divider"], (600, 600))
divider = found.extract_line(found.get("lane_divider", near["lane_divider"][0])["line_token"])
crossing = found.extract_polygon(found.get("ped_crossing", near["ped_crossing"][0])["polygon_token"])
print(
    json.dumps(
        {
            "crossings": len(near["ped_crossing"]),
            "dividers": len(near["lane_divider"]),
            "divider": list(divider.coords),
            "area": crossing.area,
            "pixels": [int(mask.sum()) for mask in masks],
        }
    )
)

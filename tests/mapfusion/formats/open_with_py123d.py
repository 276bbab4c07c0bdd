"""Opens a map with py123d's own API and prints what it saw."""

import json
import sys

from py123d.api.map.arrow.arrow_map_api import ArrowMapAPI
from py123d.datatypes import MapLayer

found = ArrowMapAPI(sys.argv[1])
lines = {
    layer.name: [item.polyline.array.tolist() for item in found.get_all_map_objects_in_layer(layer)]
    for layer in (MapLayer.ROAD_LINE, MapLayer.ROAD_EDGE)
}
(crosswalk,) = found.get_all_map_objects_in_layer(MapLayer.CROSSWALK)
metadata = found.get_map_metadata()
print(
    json.dumps(
        lines
        | {
            "layers": sorted(layer.name for layer in found.get_available_map_layers()),
            "outline": crosswalk.outline.array.tolist(),
            "area": crosswalk.shapely_polygon.area,
            "location": metadata.location,
            "has_z": metadata.map_has_z,
        }
    )
)

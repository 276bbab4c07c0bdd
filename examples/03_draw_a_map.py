"""Draw a map as an SVG picture, without any plotting library.

python examples/03_draw_a_map.py map.geojson map.svg
"""

import sys
from pathlib import Path

import numpy as np

from mapfusion import GlobalMap
from mapfusion.colours import BACKGROUND, KIND_COLOURS, web_colour
from mapfusion.formats.geojson import read_geojson

PIXELS_PER_METRE = 4.0
MARGIN_METRES = 10.0


def draw(global_map: GlobalMap) -> str:
    points = np.concatenate([element.points for element in global_map])
    low, high = points.min(axis=0) - MARGIN_METRES, points.max(axis=0) + MARGIN_METRES
    width, height = (high - low) * PIXELS_PER_METRE
    lines = []
    for element in global_map:
        # SVG's y points down, the map's north.
        pixels = (element.points - [low[0], high[1]]) * [PIXELS_PER_METRE, -PIXELS_PER_METRE]
        corners = " ".join(f"{x:.1f},{y:.1f}" for x, y in pixels)
        style = (
            f'stroke="{web_colour(KIND_COLOURS[element.kind])}" stroke-opacity="{0.3 + 0.7 * element.confidence:.2f}"'
        )
        lines.append(f'<polyline points="{corners}" fill="none" stroke-width="2" {style}/>')
    size = f'width="{width:.0f}" height="{height:.0f}"'
    background = f'<rect width="100%" height="100%" fill="{web_colour(BACKGROUND)}"/>'
    return "\n".join([f'<svg xmlns="http://www.w3.org/2000/svg" {size}>', background, *lines, "</svg>\n"])


if __name__ == "__main__":
    Path(sys.argv[2]).write_text(draw(read_geojson(Path(sys.argv[1]))))

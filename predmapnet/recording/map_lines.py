"""Elements of maps as lines of a recording: colours that fade with doubt, and what a pointer on them is told."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr

from mapfusion.arrays import Float
from mapfusion.colours import KIND_COLOURS, Colour, darker
from mapfusion.elements import GlobalMap, MapElement
from mapfusion.georeference import Georeference

MOST_DOUBT = 0.6
"""Share of black in the colour of an element of confidence 0."""

WORLD_COORDINATES = rr.ViewCoordinates.RIGHT_HAND_Z_UP


def lifted(points: Float, height: float) -> Float:
    """Return ``(n, 3)`` of ``(n, 2)`` points, all at one height, metres."""
    return np.column_stack([points, np.full(len(points), height)])


def element_colour(element: MapElement) -> Colour:
    """Return the colour of the element's kind, the darker the less confident."""
    return darker(KIND_COLOURS[element.kind], MOST_DOUBT * (1.0 - element.confidence))


def element_label(element: MapElement) -> str:
    """Return what a pointer on an element is told: kind, name, confidence, evidence, length and deviation."""
    told = [
        " ".join(word for word in (element.paint, element.kind.noun, element.name) if word),
        f"confidence {element.confidence:.2f}",
        f"{element.observations} observations",
        f"{element.length:.0f} m",
    ]
    if element.deviation is not None:
        told.append(f"deviation {np.median(element.deviation):.2f} m")
    return ", ".join(told)


def map_lines(
    elements: Sequence[MapElement], origin: Float, width: float, height: float = 0.0, shade: float = 0.0
) -> rr.LineStrips3D:
    """Return elements as lines of one entity.

    The viewer shows at the pointer what differs between the elements, but only up to three components: places, colours
    and labels. So all that is told stands in the labels.

    Args:
        elements: metres.
        origin: ``(2,)``, where the recording begins.
        width: of the lines, points of the screen.
        height: of the lines, metres.
        shade: share of black, for what stands behind something else.
    """
    return rr.LineStrips3D(
        [lifted(element.points - origin, height) for element in elements],
        colors=[darker(element_colour(element), shade) for element in elements],
        radii=rr.Radius.ui_points(width),
        labels=[element_label(element) for element in elements],
        show_labels=False,
    )


def log_on_earth(recording: rr.RecordingStream, entity: str, global_map: GlobalMap, place: Georeference) -> None:
    """Log a map in longitude and latitude, for the geographic view; one entity an element, which bears its name."""
    for number, element in enumerate(global_map):
        strings = rr.GeoLineStrings(
            lat_lon=[place.to_wgs84(element.points)[:, ::-1]],
            colors=[element_colour(element)],
            radii=rr.Radius.ui_points(2.0),
        )
        name = element.name or str(number)
        told = rr.AnyValues(element=element_label(element))
        recording.log(f"{entity}/{element.kind.label}/{name}", strings, told, static=True)

"""Elements of maps as lines of a recording: colours that fade with doubt, and what a pointer on them is told."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import rerun as rr

from mapfusion.arrays import Float
from mapfusion.colours import KIND_COLOURS, Colour, darker
from mapfusion.elements import GlobalMap, MapElement
from mapfusion.formats.foreign_values import format_timestamp
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


def element_values(elements: Sequence[MapElement]) -> rr.AnyValues:
    """Return the properties of elements that a selection shows, one value an element."""
    told = [0.0 if element.deviation is None else float(np.median(element.deviation)) for element in elements]
    return rr.AnyValues(
        kind=[element.kind.noun for element in elements],
        name=[element.name for element in elements],
        confidence=[round(element.confidence, 4) for element in elements],
        observations=[element.observations for element in elements],
        length_m=[round(element.length, 2) for element in elements],
        deviation_m=[round(value, 3) for value in told],
        first_seen=[format_timestamp(element.first_seen) for element in elements],
        last_seen=[format_timestamp(element.last_seen) for element in elements],
        tracks=[", ".join(map(str, element.track_ids)) for element in elements],
        sources=[", ".join(element.sources) for element in elements],
    )


def map_lines(
    elements: Sequence[MapElement], origin: Float, width: float, height: float = 0.0, shade: float = 0.0
) -> tuple[Any, ...]:
    """Return the components of elements as lines of one entity.

    Args:
        elements: metres.
        origin: ``(2,)``, where the recording begins.
        width: of the lines, points of the screen.
        height: of the lines, metres.
        shade: share of black, for what stands behind something else.
    """
    lines = rr.LineStrips3D(
        [lifted(element.points - origin, height) for element in elements],
        colors=[darker(element_colour(element), shade) for element in elements],
        radii=rr.Radius.ui_points(width),
        labels=[element_label(element) for element in elements],
        show_labels=False,
    )
    return (lines, element_values(elements)) if elements else (lines,)


def log_on_earth(recording: rr.RecordingStream, entity: str, global_map: GlobalMap, place: Georeference) -> None:
    """Log a map in longitude and latitude, for the geographic view; one entity an element, which bears its name."""
    for number, element in enumerate(global_map):
        strings = rr.GeoLineStrings(
            lat_lon=[place.to_wgs84(element.points)[:, ::-1]],
            colors=[element_colour(element)],
            radii=rr.Radius.ui_points(2.0),
        )
        name = element.name or str(number)
        recording.log(f"{entity}/{element.kind.label}/{name}", strings, element_values([element]), static=True)

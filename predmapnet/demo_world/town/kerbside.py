"""Openings of the kerb, yards behind them, and lay-bys."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import shapely
from numpy.random import Generator
from shapely import Polygon

from predmapnet.demo_world.town.cross_sections import CrossSection, Use
from predmapnet.demo_world.town.reference_line import ReferenceLine


class Kerbside(NamedTuple):
    """Ground along one kerb: pieces of pavement to be added, and places where cars are parked."""

    paved: list[Polygon]
    parking: list[Polygon]


def build_openings(
    random: Generator,
    line: ReferenceLine,
    section: CrossSection,
    start: float,
    end: float,
    rate: float,
    taken: shapely.Geometry,
) -> list[Polygon]:
    """Return driveways, and entrances of yards with the yards, along both kerbs between two stations of a street.

    They are paved pieces that overlap the street a little, ``rate`` openings per metre of kerb, and keep clear of the
    prepared geometry ``taken`` (other streets).
    """
    found: list[Polygon] = []
    for side in (1, -1):
        station = start + float(random.exponential(1.0 / rate))
        while station < end:
            pieces = _opening(random, line, section, station, side, end - start)
            if not any(piece.intersects(taken) or piece.intersects(other) for piece in pieces for other in found):
                found += pieces
            station += 9.0 + float(random.exponential(1.0 / rate))
    return found


def _opening(
    random: Generator, line: ReferenceLine, section: CrossSection, station: float, side: int, room: float
) -> list[Polygon]:
    width = float(random.choice([random.uniform(2.6, 4.5), random.uniform(4.5, 9.0)], p=[0.6, 0.4]))
    depth = float(random.choice([random.uniform(2.0, 6.0), random.uniform(6.0, 18.0)], p=[0.6, 0.4]))
    flare = float(random.choice([0.05, random.uniform(0.4, 2.5)], p=[0.35, 0.65]))
    kerb = section.edges(np.array([station]))[0 if side == 1 else -1, 0]
    lean = float(random.normal(0.0, 0.12))
    half = width / 2
    along = [-half - flare - 0.5, -half - flare, -half - 0.35 * flare, -half, -half, half, half, half + 0.35 * flare]
    along += [half + flare, half + flare + 0.5]
    out = [-0.6, 0.0, 0.35 * flare, flare, depth, depth, flare, 0.35 * flare, 0.0, -0.6]
    away = np.array(out)
    stations = station + np.array(along) + lean * np.maximum(away, 0.0)
    piece = Polygon(line.locate(stations, kerb + side * away))
    pieces = [piece]
    if depth > 5.0 and random.random() < 0.45:
        wide, deep = float(random.uniform(10.0, 40.0)), float(random.uniform(9.0, 30.0))
        begin = station + lean * depth - wide * float(random.uniform(0.15, 0.85))
        yard = shapely.box(begin, depth - 0.3, begin + wide, depth + deep)
        corners = shapely.get_coordinates(yard)
        pieces.append(Polygon(line.locate(corners[:, 0], kerb + side * corners[:, 1])))
    return [piece for piece in pieces if piece.is_valid] if piece.is_valid else []


def build_lay_bys(random: Generator, line: ReferenceLine, section: CrossSection, start: float, end: float) -> Kerbside:
    """Sometimes a lay-by for parked cars or buses, along either kerb between two stations."""
    paved: list[Polygon] = []
    parking: list[Polygon] = []
    for side in (1, -1):
        room = end - start
        outer = section.strips[0 if side == 1 else -1]
        if room < 26.0 or outer.use is Use.PARKING or outer.parked or random.random() > 0.16:
            continue
        is_bus_bay = random.random() < 0.35
        depth, taper = (
            (float(random.uniform(2.6, 3.1)), float(random.uniform(5.0, 12.0)))
            if is_bus_bay
            else (float(random.uniform(1.9, 2.5)), 1.3)
        )
        length = float(random.uniform(18.0, max(19.0, 0.9 * room)))
        begin = start + float(random.random()) * (room - length)
        stations = np.union1d(
            np.arange(begin, begin + length, 2.0), [begin + taper, begin + length - taper, begin + length]
        )
        kerb = section.edges(stations)[0 if side == 1 else -1]
        added = depth * np.interp(
            stations, [begin, begin + taper, begin + length - taper, begin + length], [0.0, 1.0, 1.0, 0.0]
        )
        inner, rim = kerb - side * 0.4, kerb + side * added
        paved.append(line.band(stations, inner, rim) if side == 1 else line.band(stations, rim, inner))
        if not is_bus_bay:
            flat = stations[(stations >= begin + taper) & (stations <= begin + length - taper)]
            edge = np.interp(flat, stations, kerb)
            parking.append(
                line.band(flat, np.minimum(edge, edge + side * depth), np.maximum(edge, edge + side * depth))
            )
    return Kerbside(paved, parking)

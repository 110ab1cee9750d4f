"""Degrees put on true metres: a coordinate system whose metres are those of WGS 84 around one latitude."""

from __future__ import annotations

import math


def metres_per_degree(latitude_deg: float) -> tuple[float, float]:
    """Metres in one degree of latitude and of longitude on WGS 84, to the millimetre."""
    phi = math.radians(latitude_deg)
    lat = 111132.954 - 559.822 * math.cos(2 * phi) + 1.175 * math.cos(4 * phi)
    lon = 111412.84 * math.cos(phi) - 93.5 * math.cos(3 * phi)
    return round(lat, 3), round(lon, 3)


def equidistant(latitude_deg: float, longitude_deg: float) -> str:
    """A system in metres with `metres_per_degree` of a latitude; x is 0 at a longitude, y at the equator.

    PROJ's equidistant cylindrical projection knows spheres only. On that of WGS 84's equator its y is 0.3 % too
    long: metres are, and metres of the ellipsoid taken for such y lie kilometres off. So it gets the sphere that is
    as curved as the ellipsoid is there.
    """
    per_lat, per_lon = metres_per_degree(latitude_deg)
    # The standard parallel at which a degree of longitude on this sphere is as long as on the ellipsoid.
    parallel = math.degrees(math.acos(min(per_lon / per_lat, 1.0)))
    radius = per_lat * 180 / math.pi
    return f"+proj=eqc +lat_ts={parallel:.9f} +lon_0={longitude_deg:.9f} +R={radius:.4f} +units=m +no_defs"

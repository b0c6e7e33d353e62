"""A reader for SOFA files (AES69), variable by variable, each with its own Type and Units.

Published files differ from the defaults of their convention, and from its spelling.

Axes as in the standard: x ahead, y left, z up; azimuth counter-clockwise from +x, elevation from the horizontal plane.
`sofar` takes a third of a second to import, so it is imported only where a file is read.
"""

import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from server.core.errors import NafirError

_Floats = npt.NDArray[np.float64]

SLOWEST_RATE_HZ, FASTEST_RATE_HZ = 4_000.0, 768_000.0
"""Real responses are measured at rates in this range; a file with another rate has its unit wrong."""
MOST_BYTES = 8 * 2**30
"""The maximum size of a file's variables, unpacked to 64 bits."""

ONE_AT_A_TIME = threading.Lock()
"""HDF5's C library keeps global state without a lock of its own (unless it is built thread-safe, which netCDF4's wheels
are not): two threads in it at once sometimes crash the process."""

_LENGTHS_M = {
    **dict.fromkeys(("metre", "metres", "meter", "meters", "m"), 1.0),
    **dict.fromkeys(("centimetre", "centimetres", "centimeter", "centimeters", "cm"), 0.01),
    **dict.fromkeys(("millimetre", "millimetres", "millimeter", "millimeters", "mm"), 0.001),
}
_ANGLES_RAD = {
    **dict.fromkeys(("degree", "degrees", "deg", "\N{DEGREE SIGN}"), np.pi / 180),
    **dict.fromkeys(("radian", "radians", "rad"), 1.0),
}
_RATES_HZ = {
    **dict.fromkeys(("hertz", "hz", "samples per second"), 1.0),
    **dict.fromkeys(("kilohertz", "khz"), 1_000.0),
}
_BLANKS = " \t\r\n\0"  # some writers pad with zeros
_HIGHEST_RAD = np.radians(90.5)
_FARTHEST_ROUND_RAD = 4 * np.pi + 0.01


class SofaError(NafirError):
    """A file that cannot be read as SOFA; names the variable and what is wrong with it."""

    def __init__(self, path: Path, variable: str, problem: str) -> None:
        super().__init__(f"{path}: {variable}: {problem}")
        self.path = path
        self.variable = variable
        self.problem = problem


@dataclass(frozen=True)
class SofaFile:
    """The variables of a file as stored. Every method raises SofaError, which names the variable."""

    path: Path
    content: Any

    @classmethod
    def open(cls, path: Path) -> "SofaFile":
        """Open a file; only one thread at a time does so, and others wait."""
        if path.suffix != ".sofa":  # sofar replaces any other suffix, and would open another file
            raise SofaError(path, "file", "a SOFA file's name ends in .sofa")
        if not path.is_file():
            raise SofaError(path, "file", "no such file")
        with ONE_AT_A_TIME:
            return cls._read(path)

    @classmethod
    def _read(cls, path: Path) -> "SofaFile":
        import netCDF4
        import sofar

        try:
            with netCDF4.Dataset(path) as file:
                claimed = sum(8 * int(variable.size) for variable in file.variables.values())
            if claimed > MOST_BYTES:
                raise SofaError(path, "file", f"its variables claim {claimed / 1e9:.1f} GB; split the file")
            # Read it as stored: sofar's check of a whole file refuses harmless faults that are common in published
            # files.
            return cls(path, sofar.read_sofa_as_netcdf(str(path)))
        except (OSError, ValueError, RuntimeError) as exc:  # netCDF's own errors are RuntimeErrors
            raise SofaError(path, "file", f"not a readable SOFA file ({exc})") from exc

    def has(self, name: str) -> bool:
        return hasattr(self.content, name)

    def text(self, name: str) -> str:
        """A text attribute without surrounding blanks; empty if it is missing."""
        return str(getattr(self.content, name, "")).strip(_BLANKS)

    def numbers(self, name: str, default: npt.ArrayLike | None = None) -> _Floats:
        value = getattr(self.content, name, default)
        self.require(name, value is not None, "is missing")
        try:
            # Values that a file leaves out are masked when read.
            return np.ma.filled(np.ma.asarray(value, dtype=np.float64), np.nan)
        except (TypeError, ValueError) as exc:
            raise SofaError(self.path, _dotted(name), f"is not of numbers ({exc})") from exc

    def sampling_rate_hz(self) -> float:
        """`Data.SamplingRate` in Hz, converted from its Units; it must be the same for all measurements."""
        name = "Data_SamplingRate"
        units = self.text(f"{name}_Units").lower() or "hertz"
        self.require(name, units in _RATES_HZ, f"Units are {units!r}, not hertz or kilohertz")
        rates = np.unique(self.numbers(name) * _RATES_HZ[units])
        self.require(name, rates.size == 1, f"is {rates} Hz, not one rate for all")
        rate = float(rates[0])
        hint = "; is it in kilohertz, and its Units in hertz?" if 4 <= rate < 1_000 else ""
        self.require(
            name,
            SLOWEST_RATE_HZ <= rate <= FASTEST_RATE_HZ,
            f"is {rate:g} Hz, and responses are measured at {SLOWEST_RATE_HZ:g} to {FASTEST_RATE_HZ:g} Hz{hint}",
        )
        return rate

    def cartesian(
        self,
        name: str,
        values: _Floats,
        *,
        described_by: str | None = None,
        default: str | None = None,
        unknown_radius_m: float | None = None,
    ) -> _Floats:
        """Convert values to (..., 3) metres by the Type and Units of the variable `described_by`, or of the variable
        `name` itself.

        A missing Type is inferred from the Units, or else is `default`; missing Units are those of the standard.
        Spherical coordinates with radius 0 are placed `unknown_radius_m` away, if that is given.
        """
        owner = described_by or name
        stored = self.text(f"{owner}_Units").lower()
        units = [unit.strip(_BLANKS) for unit in stored.replace(";", ",").split(",") if unit.strip(_BLANKS)]
        if len(units) == 1 and units[0] not in _LENGTHS_M | _ANGLES_RAD:
            units = units[0].split()  # without commas
        kind = self._kind(name, owner, units, default)
        if kind == "cartesian":
            self.require(name, set(units) <= _LENGTHS_M.keys(), f"Units are {stored!r}, not metres, and Type is {kind}")
            scale = [_LENGTHS_M[unit] for unit in units] or [1.0]
            self.require(name, len(scale) in {1, 3}, f"Units are {stored!r}, not one or three")
            return values if set(scale) == {1.0} else values * np.array(scale)
        return self._from_angles(name, stored, units, values, unknown_radius_m)

    def _kind(self, name: str, owner: str, units: list[str], default: str | None) -> str:
        kind = self.text(f"{owner}_Type").lower()
        if not kind and units:
            kind = "spherical" if units[0] in _ANGLES_RAD else "cartesian"
        kind = kind or default or ""
        self.require(name, bool(kind), "Type is missing, and Units do not tell whether it is cartesian or spherical")
        self.require(name, kind in {"cartesian", "spherical"}, f"Type is {kind!r}, neither cartesian nor spherical")
        return kind

    def _from_angles(
        self, name: str, stored: str, units: list[str], values: _Floats, unknown_radius_m: float | None
    ) -> _Floats:
        units = units or ["degree", "degree", "metre"]
        # Some files repeat one unit, or leave out the last.
        angles = units[:2] if len(units) >= 2 else units * 2
        last = units[2] if len(units) == 3 else "metre"
        known = all(unit in _ANGLES_RAD for unit in angles) and last in _LENGTHS_M | _ANGLES_RAD and len(units) <= 3
        self.require(name, known, f"Units are {stored!r}, not degrees or radians, and Type is spherical")
        azimuth, elevation = values[..., 0] * _ANGLES_RAD[angles[0]], values[..., 1] * _ANGLES_RAD[angles[1]]
        for axis, angle, most in (("azimuths", azimuth, _FARTHEST_ROUND_RAD), ("elevations", elevation, _HIGHEST_RAD)):
            largest = float(np.nanmax(np.abs(angle), initial=0.0))
            self.require(
                name,
                largest <= most,
                f"has {axis} of up to {np.degrees(largest):g} degrees by Units {stored or 'degree'!r}; "
                "are the units right, and the coordinates spherical?",
            )
        radius = values[..., 2] * _LENGTHS_M.get(last, 1.0)
        if unknown_radius_m is not None:
            radius = np.where(radius > 0, radius, unknown_radius_m)
        towards = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
        return np.asarray(radius[..., np.newaxis] * np.stack(towards, axis=-1))

    def points(
        self,
        name: str,
        measurements: int,
        *,
        fallback: npt.ArrayLike | None = None,
        default: str | None = None,
        unknown_radius_m: float | None = None,
    ) -> _Floats:
        """Points (measurement, 3) of a variable that is stored once or per measurement; `fallback` if the file has
        none. The other parameters are those of `cartesian`."""
        values = np.atleast_2d(self.numbers(name, fallback))
        self.require(name, values.shape in {(1, 3), (measurements, 3)}, f"has shape {values.shape}")
        places = self.cartesian(name, values, default=default, unknown_radius_m=unknown_radius_m)
        return np.broadcast_to(places, (measurements, 3))

    def parts(self, name: str, count: int, measurements: int) -> _Floats:
        """Positions (measurement, part, 3) of receivers or emitters, stored as (part, 3), (part, 3, 1) or (part, 3,
        measurement)."""
        values = self.numbers(name)
        if values.ndim == 2:
            values = values[..., np.newaxis]
        fits = values.ndim == 3 and values.shape[0] in {1, count} and values.shape[1] == 3
        self.require(name, fits and values.shape[2] in {1, measurements}, f"has shape {values.shape}")
        return np.broadcast_to(self.cartesian(name, np.moveaxis(values, -1, 0)), (measurements, count, 3))

    def frames(self, owner: str, measurements: int) -> _Floats:
        """Axes (measurement, xyz, axis) of a listener or source in the room's frame; the columns point ahead, left and
        up."""
        view, up = f"{owner}View", f"{owner}Up"
        if not self.has(view):
            return np.broadcast_to(np.eye(3), (measurements, 3, 3))
        ahead = self._directions(view, measurements, view)
        ahead /= np.linalg.norm(ahead, axis=-1, keepdims=True)
        # In published files, Up has the Type of View but does not state it.
        says_type = bool(self.text(f"{up}_Type") or self.text(f"{up}_Units"))
        upward = self._directions(up, measurements, up if says_type else view)
        left = np.cross(upward, ahead)
        length = np.linalg.norm(left, axis=-1, keepdims=True)
        self.require(up, bool((length > 1e-6).all()), f"is parallel to {view}, or not finite")
        left /= length
        return np.stack([ahead, left, np.cross(ahead, left)], axis=-1)

    def _directions(self, name: str, measurements: int, described_by: str) -> _Floats:
        if not self.has(name):
            return np.tile([0.0, 0.0, 1.0], (measurements, 1))
        values = np.atleast_2d(self.numbers(name))
        self.require(name, values.shape in {(1, 3), (measurements, 3)}, f"has shape {values.shape}")
        directions = self.cartesian(name, values, described_by=described_by, default="cartesian")
        self.require(name, bool((np.linalg.norm(directions, axis=-1) > 1e-6).all()), "is no direction")
        return np.broadcast_to(directions, (measurements, 3)).copy()

    def require(self, name: str, condition: bool, problem: str) -> None:
        if not condition:
            raise SofaError(self.path, _dotted(name), problem)


def _dotted(name: str) -> str:
    """The standard's spelling of a variable's name, such as Data.IR; sofar writes Data_IR."""
    return name.replace("_", ".")


def delay_rows(responses: _Floats, delays: _Floats, most: float) -> _Floats:
    """Shift rows (..., sample) by delays (...) of 0 to `most` in samples; the rows become `most` samples longer."""
    samples = responses.shape[-1] + int(np.ceil(most))
    n_fft = 2 * samples
    shift = np.exp(-2j * np.pi * np.fft.rfftfreq(n_fft) * delays[..., np.newaxis])
    return np.asarray(np.fft.irfft(np.fft.rfft(responses, n_fft) * shift, n_fft)[..., :samples])

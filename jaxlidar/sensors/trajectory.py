r"""Trajectories: where a platform is, and how it is turned, as functions of time.

The body frame of the platform has the axes forward, to the right and down. With the yaw psi (heading,
clockwise from north), the pitch theta (nose up) and the roll phi (right wing down), a vector b in that frame
has the components (north, east, down)

    Rz(psi) Ry(theta) Rx(phi) b,

    Rz = [[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]],  Ry = [[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]],
    Rx = [[1, 0, 0], [0, cos, -sin], [0, sin, cos]]:

turned first by the roll, then by the pitch, then by the yaw (aerospace sequence, ARINC 705). The mounting
angles of a scanner turn its own frame into that of the body in the same way. With the position q of the
trajectory, the lever arm l in the body frame, and the direction d of the beam in the frame of the scanner,
the sensor stands at q + R l, and the beam travels along R M d.

Source: Baeumker and Heimes (2001), Proc. OEEPE Workshop Integrated Sensor Orientation, Hannover, sections 2
and 3; Skaloud and Lichti (2006), ISPRS J. Photogramm. Remote Sens. 61, 47, equation 1.
"""

from typing import Any, final

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxlidar._fields.checks import Numbers, UnitWarning, as_numpy, check_range, checked_array, warn_user
from jaxlidar._fields.crs import crs_name
from jaxlidar._text import number_text

# Courses of two positions that are nearer to one another than this, m, are not defined.
_LEAST_STEP = 1e-6
# Roll and pitch, rad, of an aircraft are below the first, headings within the second.
_MAX_TILT, _FULL_TURN = 0.6, 6.3


@final
class Trajectory(eqx.Module):
    """Position and attitude of a platform over time: an aircraft, a drone, a vehicle, a tripod.

    Numbers are kept in double precision. `jaxlidar.io.read_trajectory` reads one from a file, and
    `Survey.fly` makes a survey of it.

    **Arguments:**

    - `time`: (n,) s, strictly increasing; one number or more.
    - `position`: (n, 3) x (east), y (north) and z (up) in m.
    - `roll`: degrees, positive where the right wing is down; one number or (n,). Default 0.
    - `pitch`: degrees in [-90, 90], positive where the nose is up; one number or (n,). Default 0.
    - `yaw`: heading in degrees clockwise from north (+y); one number or (n,). Default None: the course, in
      which the positions advance; north for a platform that does not move.
    - `crs`: coordinate reference system of `position`, in metres, such as "EPSG:32633", or its EPSG number.
      Default None: not known.

    **Raises:** ValueError for arrays of other shapes, values that are not finite or outside their ranges, and
    times that do not increase strictly; TypeError for what is not numbers.

    **Warns:** `UnitWarning` for angles that look like radians: roll and pitch below 0.6, yaw below 6.3.

    **Example:**

    >>> import jaxlidar as jl
    >>> flight = jl.Trajectory(time=[0.0, 10.0], position=[(0, 0, 800), (600, 0, 800)], roll=[0.0, 4.0])
    >>> middle = flight.at([5.0])
    >>> middle.position.tolist(), middle.roll.tolist(), middle.yaw.tolist()
    ([[300.0, 0.0, 800.0]], [2.0], [90.0])
    """

    time: Float[np.ndarray, " n"]
    position: Float[np.ndarray, "n 3"]
    roll: Float[np.ndarray, " n"]
    pitch: Float[np.ndarray, " n"]
    yaw: Float[np.ndarray, " n"]
    crs: str | None = eqx.field(static=True)

    def __init__(
        self,
        time: Numbers,
        position: Numbers,
        roll: Numbers = 0.0,
        pitch: Numbers = 0.0,
        yaw: Numbers | None = None,
        crs: str | int | None = None,
    ):
        self.crs = crs_name(crs)
        times = checked_array("time", time, (None,), one_for_all=True)
        n = times.size
        falls = np.flatnonzero(np.diff(times) <= 0)
        if falls.size:
            i = int(falls[0])
            raise ValueError(
                f"time = {times[i + 1]:.9g} follows {times[i]:.9g}; admissible are times that rise strictly"
            )
        self.time, self.position = times, checked_array("position", position, (n, 3))
        self.roll = checked_array("roll", roll, (n,), -360.0, 360.0, one_for_all=True)
        self.pitch = checked_array("pitch", pitch, (n,), -90.0, 90.0, one_for_all=True)
        if yaw is None:
            self.yaw = _course(self.position)
        else:
            self.yaw = checked_array("yaw", yaw, (n,), -360.0, 360.0, one_for_all=True)
            self._warn_radians()

    def __len__(self) -> int:
        return self.time.size

    def __str__(self) -> str:
        columns = [("time", self.time, "s"), *zip("xyz", self.position.T, "mmm")]
        columns += [(name, getattr(self, name), "degrees") for name in ("roll", "pitch", "yaw")]
        spans = ", ".join(
            f"{name} {number_text(a.min())} to {number_text(a.max())} {unit}" for name, a, unit in columns
        )
        return f"Trajectory of {len(self):,} time{'s' * (len(self) != 1)}: {spans}"

    def at(self, time: Numbers) -> "Trajectory":
        """Return the trajectory at other times, between its own: linear in position and in each angle.

        **Arguments:** `time`: (shots,) s, strictly increasing, from the first to the last of the trajectory.

        **Returns:** a `Trajectory`.

        **Raises:** ValueError for times outside those of the trajectory.
        """
        times = np.atleast_1d(as_numpy(time, "time"))
        check_range("time", times, float(self.time[0]), float(self.time[-1]))
        # Headings pass from 360 degrees to 0: unwrapped, neighbours are less than half a turn apart.
        columns = [*self.position.T, *(np.unwrap(a, period=360.0) for a in (self.roll, self.pitch, self.yaw))]
        x, y, z, roll, pitch, yaw = (np.interp(times, self.time, column) for column in columns)
        # Unwrapped angles may exceed a turn, as 361 degrees after a heading of 359.
        roll, yaw = np.fmod(roll, 360.0), np.fmod(yaw, 360.0)
        fields = (times, np.stack([x, y, z], axis=-1), roll, pitch, yaw)
        # Not by the constructor, which would warn again of radians.
        return eqx.tree_at(lambda t: (t.time, t.position, t.roll, t.pitch, t.yaw), self, fields)

    def _warn_radians(self) -> None:
        """Warn of angles that look like radians: headings within a turn of them, and a small attitude."""
        tilt = max(np.abs(self.roll).max(), np.abs(self.pitch).max())
        turn = np.abs(self.yaw).max()
        if 0.0 < tilt < _MAX_TILT and 0.0 < turn < _FULL_TURN:
            warn_user(
                f"roll, pitch and yaw are at most {turn:.3g} degrees. Are they given in rad? Then use "
                "numpy.rad2deg",
                UnitWarning,
            )

    @property
    def rotation(self) -> Float[np.ndarray, "n 3 3"]:
        """Matrices (n, 3, 3) that turn (forward, right, down) of the body into (east, north, up)."""
        return body_rotation(self.roll, self.pitch, self.yaw)


def body_rotation(roll: Any, pitch: Any, yaw: Any) -> Float[np.ndarray, "*angles 3 3"]:
    """Return the matrices that turn (forward, right, down) of the body into (east, north, up)."""
    north, east, down = np.moveaxis(rotation_matrix(roll, pitch, yaw), -2, 0)
    return np.stack([east, north, -down], axis=-2)


def rotation_matrix(roll: Any, pitch: Any, yaw: Any) -> Float[np.ndarray, "*angles 3 3"]:
    """Return the matrices Rz(yaw) Ry(pitch) Rx(roll) of angles in degrees."""
    (cr, sr), (cp, sp), (cy, sy) = (
        (np.cos(angle), np.sin(angle)) for angle in (np.deg2rad(a) for a in (roll, pitch, yaw))
    )
    rows = (
        (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        (-sp, cp * sr, cp * cr),
    )
    return np.stack([np.stack(np.broadcast_arrays(*row), axis=-1) for row in rows], axis=-2)


def _course(position: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Return the azimuth in which positions advance; where they stay, that of the step before."""
    if len(position) == 1:
        return np.zeros(1)
    # Central differences, one-sided at the ends.
    east, north = np.gradient(position[:, :2], axis=0).T
    moves = np.hypot(east, north) > _LEAST_STEP
    if not moves.any():
        return np.zeros(len(position))
    course = np.rad2deg(np.arctan2(east, north)) % 360.0
    # The index of the last step that moves; before the first one, that one.
    last = np.maximum.accumulate(np.where(moves, np.arange(len(position)), -1))
    return course[np.where(last >= 0, last, int(np.argmax(moves)))]

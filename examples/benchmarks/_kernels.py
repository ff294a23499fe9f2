"""Kernels written by hand in numba, at first order: for one beam and for many narrow shots."""

import math

import numba
import numpy as np

from jaxlidar import SPEED_OF_LIGHT

f4 = np.float32
LIGHT = f4(SPEED_OF_LIGHT)


@numba.njit(parallel=True, fastmath=True)
def march_beam(
    x, w, excess, energy, k, size, origin, start, width, count, row, max_step, ground, factor, threads
):
    """Return the first-order response (2, bins) per unit reflectance of leaf and ground."""
    nx, ny, nz = k.shape
    rays = x.shape[0]
    padded = count + 2 * row
    metres = f4(0.5) * LIGHT * width
    spread = np.zeros((threads, padded), f4)
    instant = np.zeros((threads, padded), f4)
    for t in numba.prange(threads):
        leaf, soil = spread[t], instant[t]
        for r in range(t * rays // threads, (t + 1) * rays // threads):
            enter, leave = f4(0), f4(1e30)
            for a in range(3):
                low = origin[a] - x[r, a]
                high = low + size[a] * k.shape[a]
                if abs(w[r, a]) < 1e-12:
                    if low > 0 or high < 0:
                        leave = f4(0)
                else:
                    inverse = f4(1) / w[r, a]
                    enter = max(enter, min(low * inverse, high * inverse))
                    leave = min(leave, max(low * inverse, high * inverse))
            stop = (ground - x[r, 2]) / w[r, 2] if w[r, 2] < 0 else f4(1e30)
            end = min(leave, stop)
            depth = f4(0)
            if enter < end:
                # For numbers above zero, truncation is the floor; rounding below the first face is clipped.
                vx = min(max(int((x[r, 0] + w[r, 0] * enter - origin[0]) / size[0]), 0), nx - 1)
                vy = min(max(int((x[r, 1] + w[r, 1] * enter - origin[1]) / size[1]), 0), ny - 1)
                vz = min(max(int((x[r, 2] + w[r, 2] * enter - origin[2]) / size[2]), 0), nz - 1)
                sx = 1 if w[r, 0] > 0 else -1
                sy = 1 if w[r, 1] > 0 else -1
                sz = 1 if w[r, 2] > 0 else -1
                gx = gy = gz = tx = ty = tz = f4(1e30)
                if abs(w[r, 0]) >= 1e-12:
                    gx = size[0] / abs(w[r, 0])
                    tx = (origin[0] + size[0] * (vx + (sx > 0)) - x[r, 0]) / w[r, 0]
                if abs(w[r, 1]) >= 1e-12:
                    gy = size[1] / abs(w[r, 1])
                    ty = (origin[1] + size[1] * (vy + (sy > 0)) - x[r, 1]) / w[r, 1]
                if abs(w[r, 2]) >= 1e-12:
                    gz = size[2] / abs(w[r, 2])
                    tz = (origin[2] + size[2] * (vz + (sz > 0)) - x[r, 2]) / w[r, 2]
                distance = enter
                clear = energy[r] * factor * f4(0.5)
                while distance < end:
                    face = min(tx, min(ty, tz))
                    segment_end = max(min(min(face, end), distance + max_step), distance)
                    extinction = k[vx, vy, vz]
                    if extinction > 0:
                        now = (f4(2) * (excess[r] + distance) / LIGHT - start) / width
                        last = now + (segment_end - distance) / metres
                        centre = math.floor(now + f4(0.5))
                        j = int(centre) + row
                        rate = -f4(2) * extinction * metres
                        while now < last:
                            edge = min(centre + f4(0.5), last)
                            remaining = clear * math.exp(rate * (edge - now))
                            leaf[min(max(j, 0), padded - 1)] += clear - remaining
                            clear = remaining
                            now = edge
                            centre += f4(1)
                            j += 1
                        depth += extinction * (segment_end - distance)
                    if segment_end >= face:
                        if tx <= ty and tx <= tz:
                            vx += sx
                            tx += gx
                            if vx < 0 or vx >= nx:
                                break
                        elif ty <= tz:
                            vy += sy
                            ty += gy
                            if vy < 0 or vy >= ny:
                                break
                        else:
                            vz += sz
                            tz += gz
                            if vz < 0 or vz >= nz:
                                break
                    distance = segment_end
            if stop < f4(1e30):
                bin_position = (f4(2) * (excess[r] + stop) / LIGHT - start) / width
                centre = math.floor(bin_position + f4(0.5))
                q = bin_position - centre
                j = min(max(int(centre) + row, 1), padded - 2)
                value = energy[r] * math.exp(-f4(2) * depth) * -w[r, 2]
                soil[j - 1] += value * f4(0.5) * (f4(0.5) - q) ** 2
                soil[j] += value * (f4(0.75) - q * q)
                soil[j + 1] += value * f4(0.5) * (f4(0.5) + q) ** 2
    out = np.zeros((2, count), f4)
    for t in range(threads):
        for b in range(count):
            j = b + row
            out[0, b] += (spread[t, j - 1] + f4(10) * spread[t, j] + spread[t, j + 1]) / f4(12)
            out[1, b] += instant[t, j]
    return out


@numba.njit(fastmath=True)
def height_at(heights, corner, x, y):
    """Return the height of the terrain, bilinear between nodes 1 m apart."""
    u, v = x - corner[0], y - corner[1]
    i, j = min(max(int(u), 0), heights.shape[0] - 2), min(max(int(v), 0), heights.shape[1] - 2)
    u, v = u - f4(i), v - f4(j)
    low = heights[i, j] * (f4(1) - u) + heights[i + 1, j] * u
    high = heights[i, j + 1] * (f4(1) - u) + heights[i + 1, j + 1] * u
    return low * (f4(1) - v) + high * v


@numba.njit(parallel=True, fastmath=True)
def march_shots(aims, directions, across, k, origin, heights, corner, first_bin, width, count):
    """Return the first-order response (shots, 2, bins) per unit reflectance of leaf and ground.

    Voxels are 1 m wide. The rays of a shot are parallel, at the points `across` its beam.
    """
    shots, rays = len(aims), len(across)
    nx, ny, nz = k.shape
    metres, energy = f4(0.5) * LIGHT * width, f4(1.0 / rays)
    response = np.zeros((shots, 2, count), f4)
    for s in numba.prange(shots):
        wx, wy, wz = directions[s]
        for r in range(rays):
            ax, ay = aims[s, 0] + across[r, 0], aims[s, 1] + across[r, 1]
            # Distances count from the plane of height zero. Slopes are gentle and beams steep: a few rounds.
            end = f4(0)
            for _ in range(4):
                end = height_at(heights, corner, ax + wx * end, ay + wy * end) / wz
            distance = (origin[2] + f4(nz)) / wz
            x, y = ax + wx * distance - origin[0], ay + wy * distance - origin[1]
            vx, vy, vz = math.floor(x), math.floor(y), nz - 1
            sx, sy = (1 if wx > 0 else -1), (1 if wy > 0 else -1)
            gx = f4(1) / max(abs(wx), f4(1e-9))
            gy, gz = f4(1) / max(abs(wy), f4(1e-9)), f4(1) / abs(wz)
            tx = distance + gx * (f4(vx + 1) - x if sx > 0 else x - f4(vx))
            ty = distance + gy * (f4(vy + 1) - y if sy > 0 else y - f4(vy))
            tz = distance + gz
            clear, depth = energy * f4(1.0 / 3.0), f4(0)
            while distance < end and vz >= 0:
                face = min(tx, min(ty, tz))
                to = min(face, end)
                extinction = k[vx, vy, vz] if 0 <= vx < nx and 0 <= vy < ny else f4(0)
                if extinction > 0:
                    now = (f4(2) * distance / LIGHT - first_bin) / width
                    last = now + (to - distance) / metres
                    centre = math.floor(now + f4(0.5))
                    j = int(centre)
                    rate = -f4(2) * extinction * metres
                    while now < last:
                        edge = min(centre + f4(0.5), last)
                        remaining = clear * math.exp(rate * (edge - now))
                        response[s, 0, min(max(j, 0), count - 1)] += clear - remaining
                        clear = remaining
                        now = edge
                        centre += f4(1)
                        j += 1
                    depth += extinction * (to - distance)
                if to >= face:
                    if tx <= ty and tx <= tz:
                        vx += sx
                        tx += gx
                    elif ty <= tz:
                        vy += sy
                        ty += gy
                    else:
                        vz -= 1
                        tz += gz
                distance = to
            position = (f4(2) * end / LIGHT - first_bin) / width
            centre = math.floor(position + f4(0.5))
            q, j = position - centre, min(max(int(centre), 1), count - 2)
            value = energy * math.exp(-f4(2) * depth) * -wz
            response[s, 1, j - 1] += value * f4(0.5) * (f4(0.5) - q) ** 2
            response[s, 1, j] += value * (f4(0.75) - q * q)
            response[s, 1, j + 1] += value * f4(0.5) * (f4(0.5) + q) ** 2
    return response

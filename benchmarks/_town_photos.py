"""Photos of a town of boxes and trees, made by ray casting with colours, shading and shadows.

Coordinates are in metres, and z points up. A box is a row of ten numbers: x, y, half width, half
depth, bottom, top, cosine and sine of its rotation, height of its middle, radius of its bounding
sphere. A tree is an ellipsoid: x, y, z, horizontal and vertical radius. Patterns are procedural and
have details from 3 cm to several metres. Overviews and close-ups of a wall therefore both contain
details.
"""

import math
from typing import TypeAlias

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]
Vector: TypeAlias = tuple[float, float, float]

FAR = 900.0
_NEAR = 1e-4
SKY, GROUND, BOX, TREE = -1, 0, 1, 2
STOREY = 3.1

kernel = njit(error_model="numpy")


@kernel
def _lot(x: int, y: int, z: int) -> float:
    """Return a pseudo-random number in [0, 1), a hash of three integers."""
    h = (x * 374761393 + y * 668265263 + z * 2147483647 + 1013904223) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0xFFFFFFFF
    h = ((h ^ (h >> 16)) * 2246822519) & 0xFFFFFFFF
    return ((h ^ (h >> 15)) & 0xFFFFFF) / 16777216.0


@kernel
def _noise(x: float, y: float, k: int) -> float:
    """Return smooth noise in [0, 1] with a period of about 1."""
    i, j = math.floor(x), math.floor(y)
    a, b = x - i, y - j
    a, b = a * a * (3 - 2 * a), b * b * (3 - 2 * b)
    i, j = int(i), int(j)
    low = _lot(i, j, k) * (1 - a) + _lot(i + 1, j, k) * a
    high = _lot(i, j + 1, k) * (1 - a) + _lot(i + 1, j + 1, k) * a
    return low * (1 - b) + high * b


@kernel
def _grain(x: float, y: float, k: int, finest: float) -> float:
    """Return a sum of noise with periods from 4 m to `finest`, with mean 0."""
    total, frequency, weight = 0.0, 0.25, 0.5
    while frequency * finest <= 1:
        total += weight * (_noise(x * frequency + 17.3 * k, y * frequency + 5.1 * k, k) - 0.5)
        frequency *= 2.13
        weight *= 0.72
        k += 1
    return total


@kernel
def _part(x: float, size: float) -> tuple[int, float]:
    """Return the index of the interval of length `size` that contains x, and the position in it."""
    whole = math.floor(x / size)
    return int(whole), x / size - whole


@kernel
def _window(k: int, column: int, row: int, across: float, up: float) -> Vector:
    if across < 0.29 or across > 0.71 or up < 0.98 or up > 2.32 or abs(across - 0.5) < 0.015:
        return 0.85, 0.85, 0.85
    lot = _lot(column, row, k)
    if lot > 0.6 and up > 1.5:
        return 0.7, 0.66, 0.55
    return 0.1 + 0.3 * lot, 0.12 + 0.3 * lot, 0.16 + 0.35 * lot


@kernel
def _wall(u: float, v: float, k: int) -> Vector:
    """Return the colour of a wall with shops and windows.

    The position is u along the wall and v above the ground.
    """
    red, green = 0.35 + 0.5 * _lot(k, 1, 7), 0.32 + 0.42 * _lot(k, 2, 7)
    blue = 0.28 + 0.4 * _lot(k, 3, 7)
    tone = 1 + 0.55 * _grain(u, v, k, 0.03)
    if _lot(k, 4, 7) < 0.5:
        row, up = _part(v, 0.24)
        brick, across = _part(u + 0.25 * (row & 1), 0.5)
        tone *= 0.8 + 0.4 * _lot(brick, row, k)
        if up < 0.13 or across < 0.07:
            red, green, blue = 0.55, 0.53, 0.5
    column, across = _part(u, 2.2 + 1.6 * _lot(k, 5, 7))
    floor, up = _part(v, STOREY)
    up *= STOREY
    if floor == 0:
        if 0.12 < across < 0.88 and 0.5 < up < 2.5:
            red, green = 0.2 + 0.7 * _lot(column, 91, k), 0.2 + 0.7 * _lot(column, 92, k)
            blue = 0.25 + 0.6 * _lot(column, 93, k)
            tone *= 0.7 + 0.6 * _noise(u * 3.1, v * 3.1, k + 5)
    elif 0.25 < across < 0.75 and 0.9 < up < 2.4:
        red, green, blue = _window(k, column, floor, across, up)
    return red * tone, green * tone, blue * tone


@kernel
def _roof(x: float, y: float, k: int) -> Vector:
    tone, kind = 1 + 0.6 * _grain(x, y, k + 31, 0.06), _lot(k, 6, 7)
    column, across = _part(x, 2.7)
    row, along = _part(y, 3.3)
    if _lot(column, row, k) > 0.8 and 0.3 < across < 0.7 and 0.3 < along < 0.6:
        return 0.8, 0.85, 0.9
    if kind < 0.4:
        tone *= 0.75 + 0.5 * _part(x, 0.33)[1]
        return 0.6 * tone, 0.33 * tone, 0.25 * tone
    if kind < 0.7:
        seam = abs(_part(x, 3.0)[1] - 0.5) < 0.017
        return (0.25, 0.25, 0.25) if seam else (0.5 * tone, 0.5 * tone, 0.5 * tone)
    return 0.33 * tone, 0.36 * tone, 0.38 * tone


@kernel
def _road(a: float, b: float, along: float, road: float, tone: float) -> Vector:
    """Return the colour of asphalt; a and b are the distances to the middles of two roads."""
    near, far = min(a, b), max(a, b)
    line = near < 0.09 and _part(along, 4.0)[1] < 0.5
    crossing = road / 2 + 0.5 < far < road / 2 + 3 and abs(_part(near, 0.6)[1] - 0.5) < 0.22
    grey = 0.85 if line or crossing else 0.3 * tone
    return grey, grey, grey * 1.03


@kernel
def _ground(x: float, y: float, k: int, pitch: float, road: float) -> Vector:
    """Return the colour of the ground: roads every `pitch` metres, pavements, and grass."""
    grain = _grain(x, y, k + 57, 0.03)
    a = abs(x - pitch * math.floor(x / pitch + 0.5))
    b = abs(y - pitch * math.floor(y / pitch + 0.5))
    if max(abs(x), abs(y)) <= 2.1 * pitch:
        if min(a, b) < road / 2:
            return _road(a, b, y if a < b else x, road, 1 + 0.9 * grain)
        if min(a, b) < road / 2 + 2.5:
            column, across = _part(x, 0.6)
            row, along = _part(y, 0.6)
            tone = 0.5 * (0.85 + 0.3 * _lot(column, row, k)) * (1 + 0.5 * grain)
            tone *= 0.7 if across < 0.05 or along < 0.05 else 1.0
            return tone * 1.05, tone, tone * 0.95
    large, tone = _noise(x / 9, y / 9, k + 3), 1 + 1.1 * grain
    return (0.25 + 0.25 * large) * tone, (0.36 + 0.12 * large) * tone, 0.18 * tone


@kernel
def _sky(way: Vector, k: int) -> Vector:
    turn, up = math.atan2(way[1], way[0]), max(way[2], 0.0)
    cloud = _noise(turn * 3, up * 7, k) + 0.5 * _noise(turn * 9, up * 23, k + 1)
    cloud = max(0.0, cloud - 0.7)
    return 0.55 - 0.2 * up + cloud, 0.68 - 0.12 * up + 0.8 * cloud, 0.86 + 0.4 * cloud


@kernel
def _hit_box(eye: Vector, way: Vector, box: Array, best: float) -> tuple[float, int]:
    """Return distance and face of a box if it is nearer than `best`, else `best` and -1."""
    x, y, z = eye[0] - box[0], eye[1] - box[1], eye[2] - box[8]
    along = x * way[0] + y * way[1] + z * way[2]
    if along > box[9] or x * x + y * y + z * z - along * along > box[9] * box[9]:
        return best, -1
    c, s = box[6], box[7]
    begin = c * x + s * y, c * y - s * x, eye[2]
    ahead = c * way[0] + s * way[1], c * way[1] - s * way[0], way[2]
    least, most = (-box[2], -box[3], box[4]), (box[2], box[3], box[5])
    entry, exit_, face = _NEAR, best, -1
    for axis in range(3):
        # A ray parallel to a face divides by 0. Comparisons with the infinite result are still
        # correct.
        first = (least[axis] - begin[axis]) / ahead[axis]
        second = (most[axis] - begin[axis]) / ahead[axis]
        if min(first, second) > entry:
            entry, face = min(first, second), axis
        exit_ = min(exit_, max(first, second))
    return (entry, face) if entry < exit_ else (best, -1)


@kernel
def _hit_tree(eye: Vector, way: Vector, tree: Array, best: float) -> float:
    r, h = tree[3], tree[4]
    x, y, z = (eye[0] - tree[0]) / r, (eye[1] - tree[1]) / r, (eye[2] - tree[2]) / h
    p, q, t = way[0] / r, way[1] / r, way[2] / h
    a, b = p * p + q * q + t * t, x * p + y * q + z * t
    square = b * b - a * (x * x + y * y + z * z - 1)
    if square <= 0:
        return best
    distance = (-b - math.sqrt(square)) / a
    return distance if _NEAR < distance < best else best


@kernel
def first_hit(
    eye: Vector, way: Vector, boxes: Array, trees: Array, any_hit: bool
) -> tuple[float, int, int, int]:
    """Return the first object that a ray hits.

    Args:
        eye: Start of the ray.
        way: Direction of the ray, a unit vector.
        boxes: [B, 10].
        trees: [T, 5].
        any_hit: True to stop at any object, which need not be the first.

    Returns:
        Distance, kind and index of the object, and the axis of the hit face of a box.
    """
    best, kind, number, face = FAR, SKY, -1, 0
    if way[2] < 0 and -eye[2] / way[2] < best:
        best, kind = -eye[2] / way[2], GROUND
    for n in range(boxes.shape[0]):
        if any_hit and kind != SKY:
            break
        distance, axis = _hit_box(eye, way, boxes[n], best)
        if axis >= 0:
            best, kind, number, face = distance, BOX, n, axis
    for n in range(trees.shape[0]):
        if any_hit and kind != SKY:
            break
        distance = _hit_tree(eye, way, trees[n], best)
        if distance < best:
            best, kind, number = distance, TREE, n
    return best, kind, number, face


@kernel
def _of_box(at: Vector, box: Array, face: int, k: int) -> tuple[Vector, Vector]:
    """Return colour and normal of a box."""
    c, s, x, y = box[6], box[7], at[0] - box[0], at[1] - box[1]
    p, q = c * x + s * y, c * y - s * x
    if face == 2:
        return _roof(p, q, k), (0.0, 0.0, 1.0)
    if face == 0:
        side = 1.0 if p > 0 else -1.0
        return _wall(q + 50, at[2], k), (side * c, side * s, 0.0)
    side = 1.0 if q > 0 else -1.0
    return _wall(p + 50, at[2], k + 3), (-side * s, side * c, 0.0)


@kernel
def _of_tree(at: Vector, tree: Array, k: int) -> tuple[Vector, Vector]:
    """Return colour and normal of a tree."""
    x, y = (at[0] - tree[0]) / tree[3] ** 2, (at[1] - tree[1]) / tree[3] ** 2
    z = (at[2] - tree[2]) / tree[4] ** 2
    norm = math.sqrt(x * x + y * y + z * z)
    tone = 1 + 1.8 * _grain(at[0] * 1.7 + at[2], at[1] * 1.7 - at[2], k, 0.05)
    leaves = 0.22 * tone, (0.36 + 0.1 * _lot(3, k, 1)) * tone, 0.14 * tone
    return leaves, (x / norm, y / norm, z / norm)


@kernel
def _seen(
    eye: Vector, way: Vector, boxes: Array, trees: Array, sun: Vector, town: Array
) -> tuple[float, Vector]:
    """Return distance (FAR for the sky) and colour of the first object that a ray hits."""
    seed, pitch, road = int(town[0]), town[1], town[2]
    distance, kind, number, face = first_hit(eye, way, boxes, trees, False)
    if kind == SKY:
        return FAR, _sky(way, seed)
    x, y, z = (
        eye[0] + distance * way[0],
        eye[1] + distance * way[1],
        eye[2] + distance * way[2],
    )
    paint, normal = (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)
    if kind == GROUND:
        paint = _ground(x, y, seed, pitch, road)
    elif kind == BOX:
        paint, normal = _of_box((x, y, z), boxes[number], face, seed + 13 * number)
    else:
        paint, normal = _of_tree((x, y, z), trees[number], seed + 7 * number)
    light = 0.35 + 0.15 * normal[2]
    shine = normal[0] * sun[0] + normal[1] * sun[1] + normal[2] * sun[2]
    if shine > 0:
        off = x + 2e-3 * normal[0], y + 2e-3 * normal[1], z + 2e-3 * normal[2]
        if first_hit(off, sun, boxes, trees, True)[1] == SKY:
            light += 0.75 * shine
    return distance, (paint[0] * light, paint[1] * light, paint[2] * light)


@njit(parallel=True, error_model="numpy")
def photograph(
    camera: tuple[Array, Array, float],
    things: tuple[Array, Array, Vector, Array],
    size: tuple[int, int],
    rays: int,
) -> tuple[Array, Array]:
    """Return a photo, and the depth at the centres of its pixels.

    Args:
        camera: [3] centre, [3, 3] axes to the right, down and ahead, and focal length in pixels.
            The principal point is the middle of the photo.
        things: [B, 10] boxes, [T, 5] trees, unit vector towards the sun, and [3] seed of the
            patterns, distance of roads in metres, width of a road.
        size: Width and height.
        rays: Each pixel averages `rays` x `rays` rays; one more ray gives its depth.

    Returns:
        [height, width, 3] colours in [0, 1], and [height, width] depths along the camera's axis, 0
        for the sky.
    """
    (eye, axes, focal), (boxes, trees, sun, town), (width, height) = camera, things, size
    image, depth = np.zeros((height, width, 3)), np.zeros((height, width))
    centre = eye[0], eye[1], eye[2]
    for j in prange(height):
        for i in range(width):
            for ray in range(rays * rays + 1):
                a, b = (ray % rays + 0.5) / rays, (ray // rays + 0.5) / rays
                if ray == rays * rays:
                    a, b = 0.5, 0.5
                u, v = (i + a - width / 2) / focal, (j + b - height / 2) / focal
                norm = math.sqrt(u * u + v * v + 1)
                way = (
                    (axes[0, 0] * u + axes[1, 0] * v + axes[2, 0]) / norm,
                    (axes[0, 1] * u + axes[1, 1] * v + axes[2, 1]) / norm,
                    (axes[0, 2] * u + axes[1, 2] * v + axes[2, 2]) / norm,
                )
                if ray == rays * rays:
                    distance = first_hit(centre, way, boxes, trees, False)[0]
                    depth[j, i] = distance / norm if distance < FAR else 0.0
                    continue
                paint = _seen(centre, way, boxes, trees, sun, town)[1]
                for c in range(3):
                    image[j, i, c] += min(max(paint[c], 0.0), 1.0) / (rays * rays)
    return image, depth

"""Compiled loops of ray casting and shading."""

import math

import numpy as np
from numba import types

from cpusplat.compiled import compiled
from hilsplat_world.texture_kernels import albedo, grains, hash01

LANES = 16  # number of rays in a packet
_COHERENT = 1 << 16  # from Embree's rtcore_common.h

# Rows of Embree's RTCRayHit16: 12 for the rays and 9 for the hits.
_DIRECTION, _FAR, _MASK, _U, _V, _TRIANGLE, _GEOMETRY = 4, 8, 9, 15, 16, 17, 18
_RAY_ROWS, _ROWS = 12, 21

_call = types.void(types.intp, types.intp, types.intp, types.intp)  # valid lanes, scene, packet, arguments
_intersect = types.ExternalFunction("rtcIntersect16", _call)
_occluded = types.ExternalFunction("rtcOccluded16", _call)


@compiled
def _aligned(rows):
    """Return an uninitialised packet aligned to 64 bytes, as Embree requires."""
    space = np.empty((rows + 1) * LANES, np.float32)
    skipped = (-space.ctypes.data // 4) % LANES
    return space[skipped : skipped + rows * LANES].reshape(rows, LANES)


@compiled
def _new_packet(rows):
    """Return a packet of rays that start at distance 0, its lane mask, and arguments for coherent rays."""
    packet, valid, arguments = _aligned(rows), _aligned(1), np.zeros(8, np.int64)
    packet[:] = 0
    packet.view(np.int32)[_MASK] = -1
    if rows > _RAY_ROWS:
        packet.view(np.int32)[_TRIANGLE:] = -1
    arguments.view(np.int32)[0], arguments.view(np.int32)[1] = _COHERENT, -1  # all features
    return packet, valid.view(np.int32)[0], arguments


@compiled(forceinline=True)
def _load(packet, valid, origins, directions, first):
    """Load the next rays into a packet and return their number."""
    step = 1 if len(origins) > 1 else 0
    count = min(LANES, len(directions) - first)
    for lane in range(count):
        row = first + lane
        for axis in range(3):
            packet[axis, lane] = origins[row * step, axis]
            packet[_DIRECTION + axis, lane] = directions[row, axis]
    for lane in range(LANES):
        valid[lane] = -1 if lane < count else 0
    return count


@compiled
def nearest_hits(scene, origins, directions, triangle, u, v, distance):
    packet, valid, arguments = _new_packet(_ROWS)
    ids = packet.view(np.int32)
    for first in range(0, len(directions), LANES):
        count = _load(packet, valid, origins, directions, first)
        packet[_FAR] = np.inf
        ids[_TRIANGLE] = -1
        ids[_GEOMETRY] = -1
        _intersect(valid.ctypes.data, scene, packet.ctypes.data, arguments.ctypes.data)
        for lane in range(count):
            triangle[first + lane] = ids[_TRIANGLE, lane]
            u[first + lane], v[first + lane] = packet[_U, lane], packet[_V, lane]
            distance[first + lane] = packet[_FAR, lane]


@compiled
def blocked_rays(scene, origins, directions, reach, is_blocked):
    packet, valid, arguments = _new_packet(_RAY_ROWS)
    for first in range(0, len(directions), LANES):
        count = _load(packet, valid, origins, directions, first)
        for lane in range(count):
            packet[_FAR, lane] = reach[first + lane]
        _occluded(valid.ctypes.data, scene, packet.ctypes.data, arguments.ctypes.data)
        for lane in range(count):
            is_blocked[first + lane] = packet[_FAR, lane] < 0  # Embree marks a hit with -inf


@compiled
def surfaces(prim, u, v, directions, mesh, surface):
    """Compute the surface at each hit: position, facet normal, shading normal, colour and highlight."""
    triangles, normals, coords, material_ids, materials = mesh
    points, facets, shading, colours, gloss = surface
    places = np.zeros((3, len(prim)))  # in the solid texture, scene units
    for i in range(len(prim)):
        f = prim[i]
        if f < 0:
            continue
        w0, w1, w2 = 1.0 - u[i] - v[i], u[i], v[i]
        a = triangles[f]
        ex, ey, ez = a[1, 0] - a[0, 0], a[1, 1] - a[0, 1], a[1, 2] - a[0, 2]
        gx, gy, gz = a[2, 0] - a[0, 0], a[2, 1] - a[0, 1], a[2, 2] - a[0, 2]
        nx, ny, nz = ey * gz - ez * gy, ez * gx - ex * gz, ex * gy - ey * gx
        length = math.sqrt(nx * nx + ny * ny + nz * nz)
        if nx * directions[i, 0] + ny * directions[i, 1] + nz * directions[i, 2] > 0:
            length = -length  # seen from behind: make both normals face the viewer
        facets[i, 0], facets[i, 1], facets[i, 2] = nx / length, ny / length, nz / length
        side = 1.0 if length > 0 else -1.0
        total = 0.0
        for c in range(3):
            points[i, c] = w0 * a[0, c] + w1 * a[1, c] + w2 * a[2, c]
            s = side * (w0 * normals[f, 0, c] + w1 * normals[f, 1, c] + w2 * normals[f, 2, c])
            shading[i, c] = s
            total += s * s
        total = math.sqrt(max(total, 1e-12))
        for c in range(3):
            shading[i, c] /= total
        material = materials[material_ids[f]]
        for c in range(3):
            w = w0 * coords[f, 0, c] + w1 * coords[f, 1, c] + w2 * coords[f, 2, c]
            places[c, i] = w + material[11 + c]
        gloss[i, 0], gloss[i, 1] = material[8], material[9]
    grain = grains(places[0], places[1], places[2])
    for i in range(len(prim)):
        if prim[i] >= 0:
            material = materials[material_ids[prim[i]]]
            red, green, blue = albedo(material, places[0, i], places[1, i], places[2, i], grain[i])
            colours[i, 0], colours[i, 1], colours[i, 2] = red, green, blue


@compiled
def _to_light(points, facets, shading, i, light):
    """Return the light's direction and distance from point i, and the cosine of incidence (0 from behind)."""
    lx, ly, lz = light[0] - points[i, 0], light[1] - points[i, 1], light[2] - points[i, 2]
    distance = math.sqrt(lx * lx + ly * ly + lz * lz)
    lx, ly, lz = lx / distance, ly / distance, lz / distance
    diffuse = max(0.0, shading[i, 0] * lx + shading[i, 1] * ly + shading[i, 2] * lz)
    if facets[i, 0] * lx + facets[i, 1] * ly + facets[i, 2] * lz <= 0:
        diffuse = 0.0
    return lx, ly, lz, distance, diffuse


@compiled
def receivers(prim, surface, light, samples):
    """Return the rows lit by the sky (hits on non-luminous surfaces), and the rows that face the light.

    Sky rows are ordered by sub-sample: rays cast together should be nearly parallel, and neighbouring pixels
    use similar directions for the same sub-sample.
    """
    points, facets, shading, _, gloss = surface
    under_sky, lit = np.empty(len(prim), np.int64), np.empty(len(prim), np.int64)
    skies = lights = 0
    for sample in range(samples * samples):
        for i in range(sample, len(prim), samples * samples):
            if prim[i] >= 0 and gloss[i, 1] > 0:
                under_sky[skies] = i
                skies += 1
    for i in range(len(prim)):
        if prim[i] >= 0 and gloss[i, 1] > 0 and _to_light(points, facets, shading, i, light)[4] > 0:
            lit[lights] = i
            lights += 1
    return under_sky[:skies], lit[:lights]


@compiled
def _cell(points, i, cells, salt):
    """Return a hash in [0, 1) of the small cell of space that contains point i."""
    x, y, z = points[i, 0] * cells, points[i, 1] * cells, points[i, 2] * cells
    return hash01(math.floor(x), math.floor(y), math.floor(z), salt)


@compiled
def light_rays(
    rows, points, facets, lift, samples, ray, rays_each, cells, light, shadow_reach, starts, toward, reach
):
    """Compute each row's ray (start, direction, reach) to its stratum of the flat, round light."""
    per_pixel = samples * samples
    strata = per_pixel * rays_each
    for n, i in enumerate(rows):
        stratum = (i % per_pixel) * rays_each + ray
        # A sunflower arrangement has strata of equal area in all directions, for any number of strata.
        radius = light[3] * math.sqrt((stratum + 0.15 + 0.7 * _cell(points, i, cells, 301)) / strata)
        angle = 2.399963 * stratum + 0.9 * (_cell(points, i, cells, 302) - 0.5)
        for c in range(3):
            starts[n, c] = points[i, c] + lift * facets[i, c]
        dx = light[0] + radius * math.cos(angle) - starts[n, 0]
        dy = light[1] + radius * math.sin(angle) - starts[n, 1]
        dz = light[2] - starts[n, 2]
        distance = math.sqrt(dx * dx + dy * dy + dz * dz)
        toward[n, 0], toward[n, 1], toward[n, 2] = dx / distance, dy / distance, dz / distance
        reach[n] = min(distance, shadow_reach)


@compiled
def sky_rays(rows, points, facets, lift, samples, ray, rays_each, cells, sky_reach, starts, toward, reach):
    """Compute each row's ray in a cosine-weighted direction, from its stratum of the hemisphere."""
    per_pixel = samples * samples
    strata = per_pixel * rays_each
    for n, i in enumerate(rows):
        stratum = (i % per_pixel) * rays_each + ray
        share = (stratum + 0.15 + 0.7 * _cell(points, i, cells, 303)) / strata
        angle = 2.399963 * stratum + 0.9 * (_cell(points, i, cells, 304) - 0.5)
        radius, up = math.sqrt(share), math.sqrt(max(0.0, 1.0 - share))
        nx, ny, nz = facets[i, 0], facets[i, 1], facets[i, 2]
        # Frame around the normal (Duff et al. 2017, "Building an Orthonormal Basis, Revisited").
        sign = 1.0 if nz >= 0 else -1.0
        a = -1.0 / (sign + nz)
        b = nx * ny * a
        c, s = radius * math.cos(angle), radius * math.sin(angle)
        toward[n, 0] = c * (1.0 + sign * nx * nx * a) + s * b + up * nx
        toward[n, 1] = c * sign * b + s * (sign + ny * ny * a) + up * ny
        toward[n, 2] = -c * sign * nx - s * ny + up * nz
        for axis in range(3):
            starts[n, axis] = points[i, axis] + lift * facets[i, axis]
        reach[n] = sky_reach


@compiled
def shade(prim, directions, surface, lit, open_sky, light, lights, exposure, samples, image):
    """Average all sub-samples' reflected light into pixels (linear light, compressed highlights)."""
    points, facets, shading, colours, gloss = surface
    per_pixel = samples * samples
    for i in range(len(prim)):
        pixel = i // per_pixel
        if prim[i] < 0:
            for c in range(3):
                image[pixel, c] += 0.8 * lights[1, c] / per_pixel
            continue
        if gloss[i, 1] <= 0:  # self-luminous: the sky, a lit lamp
            for c in range(3):
                image[pixel, c] += colours[i, c] / per_pixel
            continue
        lx, ly, lz, distance, diffuse = _to_light(points, facets, shading, i, light)
        falloff = 13.0 / (distance * distance)
        nx, ny, nz = shading[i, 0], shading[i, 1], shading[i, 2]
        hx, hy, hz = lx - directions[i, 0], ly - directions[i, 1], lz - directions[i, 2]
        length = math.sqrt(hx * hx + hy * hy + hz * hz)
        facing = max(0.0, (nx * hx + ny * hy + nz * hz) / length)
        highlight = gloss[i, 0] * math.pow(facing, gloss[i, 1]) if diffuse > 0 else 0.0
        up = 0.5 + 0.5 * nz
        for c in range(3):
            sun = lights[0, c] * falloff * lit[i]
            sky = (lights[1, c] * up + lights[2, c] * (1 - up)) * (0.25 + 0.75 * open_sky[i])
            value = exposure * (colours[i, c] * (1.1 * sun * diffuse + 0.85 * sky) + 0.35 * sun * highlight)
            # Linear up to 0.7, then compressed towards 1, so that highlights do not clip.
            if value > 0.7:
                value = 1.0 - 0.3 * math.exp(-(value - 0.7) / 0.3)
            image[pixel, c] += value / per_pixel

"""Images and exact label images of a scene, rendered by ray casting (Embree) and a compiled shader.

Soft shadows and ambient occlusion use fixed directions: sub-sample k of every pixel samples stratum k of the
light and of the hemisphere, jittered by a hash of the surface point. A point therefore looks the same in
every view. Random rays would add noise that differs between views and blurs the Gaussians.
"""

import math
from collections.abc import Callable

import numpy as np
from jaxtyping import Float32, Int32, UInt8

from cpusplat.compiled import compiled
from hilsplat.scene.cameras import Camera
from hilsplat_world.paints import srgb_from_linear
from hilsplat_world.rays import Hits
from hilsplat_world.scenes.scene import WorldScene
from hilsplat_world.textures import albedo, grains, hash01

RAYS_PER_PIXEL = 9
"""Minimum number of shadow rays and of occlusion rays per pixel, divided among the sub-samples."""

OCCLUSION_REACH = 0.55
"""Maximum distance at which a surface occludes another, scene units at `Style.scale` 1."""

BAND_RAYS = 1 << 15
"""Number of camera rays that are shaded at once; each takes 120 bytes of working memory."""

_LIFT = 2e-3  # offset of a ray's start from the surface, scene units at scale 1
_HASH_CELLS = 160.0  # cells per unit, at scale 1, of the ray-jitter hash: about one per pixel at 384 px


def label_view(scene: WorldScene, camera: Camera) -> Int32[np.ndarray, "3 H W"]:
    """Return the node id per level and pixel (-1: none), from one ray through each pixel's centre."""
    return _labels(scene, scene.caster.nearest(*_rays(camera, 1)).triangle, camera.size_hw)


def render_view(scene: WorldScene, camera: Camera, samples: int) -> UInt8[np.ndarray, "H W 3"]:
    """Render a view with soft shadows, ambient occlusion, highlights and solid textures.

    Args:
        samples: sub-samples per pixel side; use 3 for clean edges, 1 for previews.
    """
    return _rendered(scene, camera, samples)[0]


def render_and_label(
    scene: WorldScene, camera: Camera, samples: int
) -> tuple[UInt8[np.ndarray, "H W 3"], Int32[np.ndarray, "3 H W"]]:
    """Render and label a view; if `samples` is odd, the labels reuse the middle sub-samples' hits."""
    image, middle = _rendered(scene, camera, samples)
    return image, _labels(scene, middle, camera.size_hw) if samples % 2 else label_view(scene, camera)


def _labels(scene: WorldScene, prim: np.ndarray, size_hw: tuple[int, int]) -> Int32[np.ndarray, "3 H W"]:
    ids = np.where((prim >= 0)[:, None], scene.node_ids[prim], -1)
    return np.ascontiguousarray(ids.T.reshape(3, *size_hw)).astype(np.int32)


def _rendered(
    scene: WorldScene, camera: Camera, samples: int
) -> tuple[UInt8[np.ndarray, "H W 3"], Int32[np.ndarray, " P"]]:
    """Return a view, and the triangle that the middle sub-sample of each pixel hits (-1: none).

    Rows are rendered in bands whose rays fit in the processor's cache.
    """
    height, width = camera.size_hw
    band = max(1, BAND_RAYS // (width * samples**2))
    image, middle = np.empty((height * width, 3), np.float32), np.empty(height * width, np.int32)
    for top in range(0, height, band):
        rows = range(top, min(top + band, height))
        origin, directions = _rays(camera, samples, rows)
        hits = scene.caster.nearest(origin, directions)
        pixels = slice(rows.start * width, rows.stop * width)
        image[pixels] = _reflected(scene, hits, directions, samples)
        middle[pixels] = hits.triangle[samples**2 // 2 :: samples**2]
    srgb = srgb_from_linear(np.clip(image, 0, 1))
    return (srgb * 255 + 0.5).astype(np.uint8).reshape(height, width, 3), middle


def _reflected(
    scene: WorldScene, hits: Hits, directions: np.ndarray, samples: int
) -> Float32[np.ndarray, "P 3"]:
    """Return the linear light of pixels, from the hits and directions of the sub-samples."""
    prim, style = hits.triangle, scene.style
    count = len(prim)
    points, facets, shading, colours = (np.empty((count, 3), np.float32) for _ in range(4))
    surface = (points, facets, shading, colours, np.empty((count, 2), np.float32))
    mesh = (scene.triangles, scene.normals, scene.coords, scene.material_ids, scene.materials)
    _surfaces(prim, hits.u, hits.v, directions, mesh, surface)
    rays_each = math.ceil(RAYS_PER_PIXEL / samples**2)
    light = np.array([*style.light_position, style.light_radius], np.float32)
    cells, lift = _HASH_CELLS / style.scale, np.float32(_LIFT * style.scale)

    def free(rows: np.ndarray, rays: Callable[..., None], *given: object) -> np.ndarray:
        """Return the share of each sub-sample's rays that hit nothing; 0 for sub-samples outside `rows`."""
        share = np.zeros(count, np.float32)
        starts, toward = (np.empty((len(rows), 3), np.float32) for _ in range(2))
        reach = np.empty(len(rows), np.float32)
        for ray in range(rays_each):
            rays(rows, points, facets, lift, samples, ray, rays_each, cells, *given, starts, toward, reach)
            share[rows] += ~scene.caster.blocked(starts, toward, reach)
        return share / np.float32(rays_each)

    under_sky, lit = _receivers(prim, surface, light, samples)
    free_light = free(lit, _light_rays, light, np.float32(style.shadow_reach))
    free_sky = free(under_sky, _sky_rays, np.float32(OCCLUSION_REACH * style.scale))
    lights = np.array([style.light_colour, style.sky_colour, style.ground_colour], np.float32)
    image = np.zeros((count // samples**2, 3), np.float32)
    exposure = np.float32(style.exposure)
    _shade(prim, directions, surface, free_light, free_sky, light, lights, exposure, samples, image)
    return image


def _rays(camera: Camera, samples: int, rows: range | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return the origin and all sub-samples' unit directions, pixel by pixel, for `rows` (None: all)."""
    height, width = camera.size_hw
    rows = rows or range(height)
    step = (np.arange(samples) + 0.5) / samples
    x = (np.arange(width)[:, None] + step).reshape(-1)
    y = (np.arange(rows.start, rows.stop)[:, None] + step).reshape(-1)
    directions = np.empty((len(rows) * width * samples**2, 3), np.float32)
    _directions(
        (x - camera.K[0, 2]) / camera.K[0, 0],
        (y - camera.K[1, 2]) / camera.K[1, 1],
        np.ascontiguousarray(camera.cam_from_world[:3, :3]),
        samples,
        directions,
    )
    return camera.centre.astype(np.float32)[None], directions


@compiled
def _directions(x_cam, y_cam, rotation, samples, directions):
    """Compute the unit directions of the rays through a grid of points at depth 1, pixel by pixel."""
    i = 0
    for row in range(0, len(y_cam), samples):
        for column in range(0, len(x_cam), samples):
            for y in y_cam[row : row + samples]:
                for x in x_cam[column : column + samples]:
                    dx = x * rotation[0, 0] + y * rotation[1, 0] + rotation[2, 0]
                    dy = x * rotation[0, 1] + y * rotation[1, 1] + rotation[2, 1]
                    dz = x * rotation[0, 2] + y * rotation[1, 2] + rotation[2, 2]
                    length = math.sqrt(dx * dx + dy * dy + dz * dz)
                    directions[i, 0] = dx / length
                    directions[i, 1] = dy / length
                    directions[i, 2] = dz / length
                    i += 1


@compiled
def _surfaces(prim, u, v, directions, mesh, surface):
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
def _receivers(prim, surface, light, samples):
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
def _light_rays(
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
def _sky_rays(rows, points, facets, lift, samples, ray, rays_each, cells, sky_reach, starts, toward, reach):
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
def _shade(prim, directions, surface, lit, open_sky, light, lights, exposure, samples, image):
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

"""Images and exact label images of a scene, by casting rays (Embree) and a compiled shader.

Soft shadows and ambient occlusion take fixed directions: sub-sample k of every pixel looks at
stratum k of the light and of the hemisphere, moved a little by a hash of the surface point. A point
therefore looks the same in every view; random rays would put grain into the shadows that differs
from view to view, and the Gaussians would average it to a blur.
"""

import math
from typing import no_type_check

import numpy as np
from jaxtyping import Int32, UInt8

from hilsplat.base.compiled import compiled
from hilsplat.scene.cameras import Camera
from hilsplat.world.paints import srgb_from_linear
from hilsplat.world.scenes.scene import Style, WorldScene
from hilsplat.world.textures import albedo, hash01

RAYS_PER_PIXEL = 9
"""Shadow rays and occlusion rays per pixel, at least; with fewer sub-samples each casts more."""

OCCLUSION_REACH = 0.55
"""Farther things do not darken a surface, scene units at `Style.scale` 1."""

_LIFT = 2e-3  # rays start this far off the surface, scene units at scale 1
_HASH_CELLS = 160.0  # cells per unit, at scale 1, of the hash that moves rays: about a pixel at 384 px


def label_view(scene: WorldScene, camera: Camera) -> Int32[np.ndarray, "3 H W"]:
    """True node id per level and pixel, from one ray through each pixel's centre.

    Returns:
        Levels whole, part, subpart along the first axis; -1 where the level has no node.
    """
    origins, directions = _rays(camera, 1)
    hit = _cast(scene, origins, directions)["primID"]
    ids = np.where((hit >= 0)[:, None], scene.node_ids[hit], -1)
    return np.ascontiguousarray(ids.T.reshape(3, *camera.size_hw)).astype(np.int32)


def render_view(
    scene: WorldScene, camera: Camera, samples: int, style: Style | None = None
) -> UInt8[np.ndarray, "H W 3"]:
    """Render a view: area light with soft shadow, sky light with occlusion, highlight, solid textures.

    Args:
        scene: what to render.
        camera: from where.
        samples: sub-samples per pixel side; 3 gives clean edges, 1 is for previews.
        style: light and exposure; None takes the scene's own.
    """
    style = style or scene.style
    origins, directions = _rays(camera, samples)
    hit = _cast(scene, origins, directions)
    prim = hit["primID"]
    count = len(prim)
    points, facets, shading = (np.empty((count, 3), np.float32) for _ in range(3))
    colours = np.empty((count, 3), np.float32)
    gloss = np.empty((count, 2), np.float32)
    _surfaces(
        prim,
        hit["u"],
        hit["v"],
        directions,
        scene.triangles,
        scene.normals,
        scene.coords,
        scene.material_ids,
        scene.materials,
        points,
        facets,
        shading,
        colours,
        gloss,
    )
    rays_each = math.ceil(RAYS_PER_PIXEL / samples**2)
    lit, open_sky = np.zeros(count, np.float32), np.zeros(count, np.float32)
    starts = points + np.float32(_LIFT * style.scale) * facets
    toward = np.empty((count, 3), np.float32)
    reach = np.empty(count, np.float32)
    light = np.array([*style.light_position, style.light_radius], np.float32)
    cells = _HASH_CELLS / style.scale
    for ray in range(rays_each):
        _light_rays(points, starts, light, samples, ray, rays_each, cells, toward, reach)
        np.minimum(reach, np.float32(style.shadow_reach), out=reach)
        lit += _cast(scene, starts, toward, reach) < 0
        _sky_rays(points, facets, samples, ray, rays_each, cells, toward)
        reach.fill(OCCLUSION_REACH * style.scale)
        open_sky += _cast(scene, starts, toward, reach) < 0
    image = np.zeros((camera.size_hw[0] * camera.size_hw[1], 3), np.float32)
    _shade(
        prim,
        directions,
        points,
        facets,
        shading,
        colours,
        gloss,
        lit / np.float32(rays_each),
        open_sky / np.float32(rays_each),
        light,
        np.array([style.light_colour, style.sky_colour, style.ground_colour], np.float32),
        np.float32(style.exposure),
        samples,
        image,
    )
    return (srgb_from_linear(np.clip(image, 0, 1)) * 255 + 0.5).astype(np.uint8).reshape(*camera.size_hw, 3)


def _cast(scene: WorldScene, origins: np.ndarray, directions: np.ndarray, reach: np.ndarray | None = None):
    """Nearest hits, or with `reach` whether something is nearer than that (-1 where free)."""
    if reach is None:
        return scene.embree.run(origins, directions, query="INTERSECT", output=True)
    return scene.embree.run(origins, directions, dists=reach, query="OCCLUDED")


def _rays(camera: Camera, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Rays of all sub-samples, pixel by pixel: origins and unit directions, (H*W*samples^2, 3)."""
    height, width = camera.size_hw
    step = (np.arange(samples) + 0.5) / samples
    x = (np.arange(width)[:, None] + step).reshape(-1)
    y = (np.arange(height)[:, None] + step).reshape(-1)
    x_cam = (x - camera.K[0, 2]) / camera.K[0, 0]
    y_cam = (y - camera.K[1, 2]) / camera.K[1, 1]
    grid = np.ones((height, samples, width, samples, 3))
    grid[..., 0] = x_cam.reshape(1, 1, width, samples)
    grid[..., 1] = y_cam.reshape(height, samples, 1, 1)
    directions = grid.transpose(0, 2, 1, 3, 4).reshape(-1, 3) @ camera.cam_from_world[:3, :3]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = np.broadcast_to(camera.centre.astype(np.float32), directions.shape)
    return np.ascontiguousarray(origins), np.ascontiguousarray(directions, dtype=np.float32)


@compiled
@no_type_check  # the shape checks of the test-suite cannot be compiled
def _surfaces(
    prim,
    u,
    v,
    directions,
    triangles,
    normals,
    coords,
    material_ids,
    materials,
    points,
    facets,
    shading,
    colours,
    gloss,
):
    """Position, facet normal, shading normal, colour and highlight at each hit."""
    for i in range(len(prim)):
        f = prim[i]
        if f < 0:
            for c in range(3):
                points[i, c] = 0.0
                facets[i, c] = 0.0
                shading[i, c] = 0.0
                colours[i, c] = 0.0
            facets[i, 2] = 1.0
            gloss[i, 0] = 0.0
            gloss[i, 1] = 1.0
            continue
        w0, w1, w2 = 1.0 - u[i] - v[i], u[i], v[i]
        a = triangles[f]
        ex, ey, ez = a[1, 0] - a[0, 0], a[1, 1] - a[0, 1], a[1, 2] - a[0, 2]
        gx, gy, gz = a[2, 0] - a[0, 0], a[2, 1] - a[0, 1], a[2, 2] - a[0, 2]
        nx, ny, nz = ey * gz - ez * gy, ez * gx - ex * gz, ex * gy - ey * gx
        length = math.sqrt(nx * nx + ny * ny + nz * nz)
        if nx * directions[i, 0] + ny * directions[i, 1] + nz * directions[i, 2] > 0:
            length = -length  # seen from behind: both normals face the viewer
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
        x = w0 * coords[f, 0, 0] + w1 * coords[f, 1, 0] + w2 * coords[f, 2, 0]
        y = w0 * coords[f, 0, 1] + w1 * coords[f, 1, 1] + w2 * coords[f, 2, 1]
        z = w0 * coords[f, 0, 2] + w1 * coords[f, 1, 2] + w2 * coords[f, 2, 2]
        material = materials[material_ids[f]]
        red, green, blue = albedo(material, x, y, z)
        colours[i, 0], colours[i, 1], colours[i, 2] = red, green, blue
        gloss[i, 0], gloss[i, 1] = material[8], material[9]


@compiled
@no_type_check  # the shape checks of the test-suite cannot be compiled
def _cell(point, cells, salt):
    """Hash in [0, 1) of the small cell of space that a point lies in."""
    return hash01(
        math.floor(point[0] * cells),
        math.floor(point[1] * cells),
        math.floor(point[2] * cells),
        salt,
    )


@compiled
@no_type_check  # the shape checks of the test-suite cannot be compiled
def _light_rays(points, starts, light, samples, ray, rays_each, cells, toward, reach):
    """Direction and distance from each point to its stratum of the (horizontal, round) light."""
    per_pixel = samples * samples
    strata = per_pixel * rays_each
    for i in range(len(points)):
        stratum = (i % per_pixel) * rays_each + ray
        # Sunflower arrangement: equal areas, all directions, for any number of strata.
        radius = light[3] * math.sqrt((stratum + 0.15 + 0.7 * _cell(points[i], cells, 301)) / strata)
        angle = 2.399963 * stratum + 0.9 * (_cell(points[i], cells, 302) - 0.5)
        dx = light[0] + radius * math.cos(angle) - starts[i, 0]
        dy = light[1] + radius * math.sin(angle) - starts[i, 1]
        dz = light[2] - starts[i, 2]
        distance = math.sqrt(dx * dx + dy * dy + dz * dz)
        toward[i, 0], toward[i, 1], toward[i, 2] = dx / distance, dy / distance, dz / distance
        reach[i] = distance


@compiled
@no_type_check  # the shape checks of the test-suite cannot be compiled
def _sky_rays(points, facets, samples, ray, rays_each, cells, toward):
    """A cosine-weighted direction of the hemisphere above each point, by stratum."""
    per_pixel = samples * samples
    strata = per_pixel * rays_each
    for i in range(len(points)):
        stratum = (i % per_pixel) * rays_each + ray
        share = (stratum + 0.15 + 0.7 * _cell(points[i], cells, 303)) / strata
        angle = 2.399963 * stratum + 0.9 * (_cell(points[i], cells, 304) - 0.5)
        radius, up = math.sqrt(share), math.sqrt(max(0.0, 1.0 - share))
        nx, ny, nz = facets[i, 0], facets[i, 1], facets[i, 2]
        # Frame around the normal (Duff et al. 2017, "Building an Orthonormal Basis, Revisited").
        sign = 1.0 if nz >= 0 else -1.0
        a = -1.0 / (sign + nz)
        b = nx * ny * a
        c, s = radius * math.cos(angle), radius * math.sin(angle)
        toward[i, 0] = c * (1.0 + sign * nx * nx * a) + s * b + up * nx
        toward[i, 1] = c * sign * b + s * (sign + ny * ny * a) + up * ny
        toward[i, 2] = -c * sign * nx - s * ny + up * nz


@compiled
@no_type_check  # the shape checks of the test-suite cannot be compiled
def _shade(
    prim,
    directions,
    points,
    facets,
    shading,
    colours,
    gloss,
    lit,
    open_sky,
    light,
    lights,
    exposure,
    samples,
    image,
):
    """Reflected light of every sub-sample, averaged into pixels (linear light, compressed highlights)."""
    per_pixel = samples * samples
    for i in range(len(prim)):
        pixel = i // per_pixel
        if prim[i] < 0:
            for c in range(3):
                image[pixel, c] += 0.8 * lights[1, c] / per_pixel
            continue
        if gloss[i, 1] <= 0:  # shines by itself: the sky, a lit lamp
            for c in range(3):
                image[pixel, c] += colours[i, c] / per_pixel
            continue
        lx, ly, lz = light[0] - points[i, 0], light[1] - points[i, 1], light[2] - points[i, 2]
        distance = math.sqrt(lx * lx + ly * ly + lz * lz)
        lx, ly, lz = lx / distance, ly / distance, lz / distance
        falloff = 13.0 / (distance * distance)
        nx, ny, nz = shading[i, 0], shading[i, 1], shading[i, 2]
        diffuse = max(0.0, nx * lx + ny * ly + nz * lz)
        if facets[i, 0] * lx + facets[i, 1] * ly + facets[i, 2] * lz <= 0:
            diffuse = 0.0
        hx, hy, hz = lx - directions[i, 0], ly - directions[i, 1], lz - directions[i, 2]
        length = math.sqrt(hx * hx + hy * hy + hz * hz)
        facing = max(0.0, (nx * hx + ny * hy + nz * hz) / length)
        highlight = gloss[i, 0] * math.pow(facing, gloss[i, 1]) if diffuse > 0 else 0.0
        up = 0.5 + 0.5 * nz
        for c in range(3):
            sun = lights[0, c] * falloff * lit[i]
            sky = (lights[1, c] * up + lights[2, c] * (1 - up)) * (0.25 + 0.75 * open_sky[i])
            value = exposure * (colours[i, c] * (1.1 * sun * diffuse + 0.85 * sky) + 0.35 * sun * highlight)
            # Linear up to 0.7, then bent towards 1: no burnt-out patches.
            if value > 0.7:
                value = 1.0 - 0.3 * math.exp(-(value - 0.7) / 0.3)
            image[pixel, c] += value / per_pixel

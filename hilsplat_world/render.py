"""Images and exact label images of a scene, rendered by ray casting (Embree) and a compiled shader.

Soft shadows and ambient occlusion use fixed directions: sub-sample k of every pixel samples stratum k of the
light and of the hemisphere, jittered by a hash of the surface point. A point therefore looks the same in
every view. Random rays would add noise that differs between views and blurs the Gaussians.
"""

import math
from collections.abc import Callable

import numpy as np
from jaxtyping import Float32, Int32, UInt8

from hilsplat.scene.cameras import Camera
from hilsplat_world.kernels import light_rays, receivers, shade, sky_rays, surfaces
from hilsplat_world.paints import srgb_from_linear
from hilsplat_world.rays import Hits
from hilsplat_world.scenes.scene import WorldScene

RAYS_PER_PIXEL = 9
"""Minimum number of shadow rays and of occlusion rays per pixel, divided among the sub-samples."""

OCCLUSION_REACH = 0.55  # maximum distance at which a surface occludes another, scene units at `Style.scale` 1
BAND_RAYS = 1 << 15  # number of camera rays that are shaded at once; each takes 120 bytes of working memory
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
    surfaces(prim, hits.u, hits.v, directions, mesh, surface)
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

    under_sky, lit = receivers(prim, surface, light, samples)
    free_light = free(lit, light_rays, light, np.float32(style.shadow_reach))
    free_sky = free(under_sky, sky_rays, np.float32(OCCLUSION_REACH * style.scale))
    lights = np.array([style.light_colour, style.sky_colour, style.ground_colour], np.float32)
    image = np.zeros((count // samples**2, 3), np.float32)
    exposure = np.float32(style.exposure)
    shade(prim, directions, surface, free_light, free_sky, light, lights, exposure, samples, image)
    return image


def _rays(camera: Camera, samples: int, rows: range | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return the origin and all sub-samples' unit directions, pixel by pixel, for `rows` (None: all)."""
    height, width = camera.size_hw
    rows = rows or range(height)
    step = (np.arange(samples) + 0.5) / samples
    x = (np.arange(width)[:, None] + step - camera.K[0, 2]) / camera.K[0, 0]
    y = (np.arange(rows.start, rows.stop)[:, None] + step - camera.K[1, 2]) / camera.K[1, 1]
    directions = np.empty((len(rows), width, samples, samples, 3), np.float32)
    dx, dy, dz = (x[:, None] * a + y[:, None, :, None] * b + c for a, b, c in camera.cam_from_world[:3, :3].T)
    length = np.sqrt(dx * dx + dy * dy + dz * dz)
    for axis, along in enumerate((dx, dy, dz)):
        directions[..., axis] = along / length
    return camera.centre.astype(np.float32)[None], directions.reshape(-1, 3)

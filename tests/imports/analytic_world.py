"""An analytic world, a patterned plane and a ball, so that the right picture of any lens is known ray by ray.

Axes are OpenCV's, and the centre of the first pixel is (0.5, 0.5). Nothing here uses the package or COLMAP.
"""

import json
from pathlib import Path

import numpy as np
from PIL import Image

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
BALL, RADIUS = np.array([0.1, 0.0, 0.4]), 0.4
SAMPLES = 2  # rays per side of a pixel


def cameras(count=9, distance=2.4):
    """World-from-camera matrices on a spiral around the ball; the camera's x axis is horizontal."""
    poses = []
    for angle in np.arange(count) * 2 * np.pi / count:
        eye = np.array([distance * np.cos(angle), distance * np.sin(angle), 1.3 + 0.2 * np.cos(2 * angle)])
        ahead = np.array([0.0, 0.1, 0.2]) - eye
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3] = np.column_stack([right, np.cross(ahead, right), ahead, eye])
        poses.append(pose)
    return poses


def pattern(points):
    """Smooth colours of points, in [0, 1]."""
    phases = points @ np.array([[3.1, -1.2, 2.2], [1.7, 3.3, -0.9], [2.4, 0.8, 3.0]])
    return 0.5 + 0.22 * np.sin(phases) + 0.18 * np.sin(1.9 * phases[:, [1, 2, 0]] + 1)


def colours(eye, directions):
    """Colours along rays: the ball before the plane z = 0 before a grey sky."""
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    found = np.full((len(directions), 3), 0.2)
    with np.errstate(divide="ignore"):
        depth = -eye[2] / directions[:, 2]
    plane = (depth > 0) & (depth < 30)
    found[plane] = 0.8 * pattern(eye + directions[plane] * depth[plane, None])
    towards = directions @ (BALL - eye)
    gap = towards**2 - ((BALL - eye) @ (BALL - eye) - RADIUS**2)
    ball = (gap > 0) & (towards > 0)
    hits = eye + directions[ball] * (towards[ball] - np.sqrt(gap[ball]))[:, None]
    found[ball] = pattern(2.3 * hits + 1.5)
    return found


def picture(rays_of, width, height, pose):
    """Render a picture; `rays_of` maps pixels (N 2) to rays in camera axes (N 3), NaN if it sees nothing."""
    steps = (np.arange(SAMPLES) + 0.5) / SAMPLES
    x, y = ((np.arange(side)[:, None] + steps).ravel() for side in (width, height))
    rays = rays_of(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
    sees = np.isfinite(rays).all(axis=1)
    seen = np.zeros((len(rays), 3))
    seen[sees] = colours(pose[:3, 3], rays[sees] @ pose[:3, :3].T)
    seen = seen.reshape(height, SAMPLES, width, SAMPLES, 3).mean(axis=(1, 3))
    return (255 * seen + 0.5).astype(np.uint8)


def pinhole(fx, fy, cx, cy):
    return lambda xy: np.column_stack([(xy - [cx, cy]) / [fx, fy], np.ones(len(xy))])


def bent(project, fx, fy, cx, cy):
    """Invert a lens, `project` (N 2 normalised, undistorted -> distorted), by Newton steps without bounds."""

    def rays(xy):
        wanted = (xy - [cx, cy]) / [fx, fy]
        plain, step = wanted.copy(), 1e-6
        for _ in range(8):
            miss = project(plain) - wanted
            columns = [(project(plain + step * axis) - project(plain)) / step for axis in np.eye(2)]
            jacobian = np.stack(columns, axis=-1)
            plain = plain - np.linalg.solve(jacobian, miss[..., None])[..., 0]
        return np.column_stack([plain, np.ones(len(plain))])

    return rays


def brown(k1=0.0, k2=0.0, p1=0.0, p2=0.0, k3=0.0):
    """OpenCV's distortion of normalised coordinates."""

    def project(xy):
        x, y = xy.T
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        return np.column_stack(
            [
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
            ]
        )

    return project


def fisheye(fx, fy, cx, cy, k1=0.0, k2=0.0, k3=0.0, k4=0.0):
    """OpenCV's fisheye lens: theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)."""

    def rays(xy):
        wanted = (xy - [cx, cy]) / [fx, fy]
        length = np.linalg.norm(wanted, axis=1)
        theta = length.copy()
        powers = np.array([1.0, k1, k2, k3, k4])
        for _ in range(12):
            even = theta[:, None] ** (2 * np.arange(5))
            theta = theta - (theta * (even @ powers) - length) / (even @ (powers * (2 * np.arange(5) + 1)))
        across = np.where(length > 1e-12, np.sin(theta) / np.maximum(length, 1e-12), 1.0)
        return np.column_stack([wanted * across[:, None], np.cos(theta)])

    return rays


def psnr(picture, other):
    assert np.shape(picture) == np.shape(other)
    error = np.mean((np.asarray(picture, float) - np.asarray(other, float)) ** 2)
    return 99.0 if error == 0 else 10 * np.log10(255**2 / error)


def require_right(views, poses, least_psnr_db):
    """Compare imported views (`PosedView`) with the right poses, and their images with the exact pictures.

    `poses` maps view names to world-from-camera matrices. The exact picture is that of a pinhole camera with
    the imported K.
    """
    found = {view.view: view for view in views}
    assert set(found) == set(poses)
    for name, pose in poses.items():
        view, K = found[name], found[name].camera.calibration_matrix()
        np.testing.assert_allclose(view.cam_from_source, np.linalg.inv(pose), atol=1e-6)
        lens = pinhole(K[0, 0], K[1, 1], K[0, 2], K[1, 2])
        exact = picture(lens, view.camera.width, view.camera.height, pose)
        db = psnr(Image.open(view.image).convert("RGB"), exact)
        assert db >= least_psnr_db, f"{name}: {db:.1f} dB"


def save(folder, pictures, suffix=".png", **options):
    folder.mkdir(parents=True, exist_ok=True)
    for name, pixels in pictures.items():
        place = folder / f"{name}{suffix}"
        place.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(pixels).save(place, **options)


def quaternion(rotation):
    """Return wxyz of a rotation matrix: the quaternion q that maximises the sum of q's matrix times it."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    table = [
        [a + e + i, h - f, c - g, d - b],
        [h - f, a - e - i, b + d, c + g],
        [c - g, b + d, e - a - i, f + h],
        [d - b, c + g, f + h, i - a - e],
    ]
    return np.linalg.eigh(np.array(table))[1][:, -1]


def write_colmap(folder, lens, size, images, points=((0.0, 0.0, 0.0, 9, 8, 7),)):
    """Write a COLMAP text model: lens as "MODEL p1 p2 ...", size (width, height), images {name: pose}."""
    folder.mkdir(parents=True, exist_ok=True)
    model, *params = lens.split()
    (folder / "cameras.txt").write_text(f"1 {model} {size[0]} {size[1]} {' '.join(params)}\n")
    lines = []
    for number, (name, pose) in enumerate(images.items(), 1):
        cam_from_world = np.linalg.inv(pose)
        numbers = [*quaternion(cam_from_world[:3, :3]), *cam_from_world[:3, 3]]
        lines += [f"{number} {' '.join(map(repr, map(float, numbers)))} 1 {name}", ""]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    rows = [f"{number} {' '.join(map(str, point))} 0.5" for number, point in enumerate(points, 1)]
    (folder / "points3D.txt").write_text("\n".join(rows) + "\n")


def write_transforms(path: Path, head, poses, frame=lambda name: {}):
    frames = [
        {"file_path": name, "transform_matrix": (pose @ OPENGL).tolist(), **frame(name)}
        for name, pose in poses.items()
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({**head, "frames": frames}))

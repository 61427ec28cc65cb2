"""The true surface of a synthetic scene, read from its truth folder, and its exact depth."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float32
from plyfile import PlyData, PlyParseError

from hilsplat.base.errors import ArtifactError
from hilsplat.scene.cameras import Camera
from hilsplat.world.rays import RayCaster


@dataclass(frozen=True, eq=False)
class TrueMesh:
    """Triangles of a scene, in the frame of its true cameras; corner positions are in scene units."""

    triangles: Float32[np.ndarray, "F 3 3"]

    @staticmethod
    def load(path: Path) -> "TrueMesh":
        """Read `truth/mesh.ply`; raise `ArtifactError` if it is missing or not a mesh."""
        try:
            # plyfile memory-maps lists of a known length instead of parsing them one by one.
            record = PlyData.read(path, known_list_len={"face": {"vertex_indices": 3}})
            vertices, faces = record["vertex"], record["face"]["vertex_indices"]
        except FileNotFoundError as error:
            raise ArtifactError(f"{path} is missing", fix="run the world stage") from error
        except (PlyParseError, KeyError, ValueError) as error:
            raise ArtifactError(
                f"{path} cannot be read: {error}", fix="delete the truth folder and run the world stage again"
            ) from error
        corners = np.stack([vertices[axis] for axis in "xyz"], axis=1).astype(np.float32)
        return TrueMesh(corners[faces])

    @cached_property
    def caster(self) -> RayCaster:
        """Ray caster over the triangles; built on first use."""
        return RayCaster(self.triangles)

    def depth(self, camera: Camera) -> Float32[np.ndarray, "H W"]:
        """Return the depth along the optical axis at pixel centres, scene units; inf if nothing is hit."""
        height, width = camera.size_hw
        y, x = np.mgrid[:height, :width] + 0.5
        pixels = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
        rotation = camera.cam_from_world[:3, :3]
        # directions of depth 1, so the distance is the depth
        directions = (pixels @ np.linalg.inv(camera.K).T @ rotation).astype(np.float32)
        hits = self.caster.nearest(camera.centre.astype(np.float32)[None], directions)
        return hits.distance.reshape(height, width)

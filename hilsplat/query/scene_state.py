"""What a run has computed for a scene."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hilsplat.base.artifacts import INDEX, RECORD, read_index, read_json
from hilsplat.base.files import files_below, stats_of
from hilsplat.scene.finished import KEY_VIEWS
from hilsplat.segment.origin import masks_label


@dataclass(frozen=True)
class SceneState:
    """What a run has computed for a scene.

    Attributes:
        poses: the registration report; empty if there are no poses.
        views: number of views by split.
        fit: the report of the Gaussians; empty if there are none.
        nodes: number of nodes by level; empty if there is no tree.
        state: the artifacts that users can see or query, such as "tree, field".
        models: the models, or other origins, of the masks and their vectors.
        num_bytes: size of the scene's folder.
        date: local time at which its newest artifact was written, or an empty string.
    """

    poses: dict[str, Any]
    views: dict[str, int]
    fit: dict[str, Any]
    nodes: dict[str, int]
    state: str
    models: str
    num_bytes: int
    date: str

    @staticmethod
    def read(folder: Path) -> "SceneState":
        """Read the state of the variant `default`, or of the key views until `default` accepts queries.

        Raises:
            ArtifactError: an artifact is damaged.
        """
        full, early = folder / "default", folder / KEY_VIEWS
        used = full if (full / "clip" / INDEX).is_file() or not (early / "clip" / INDEX).is_file() else early
        has_poses, has_tree, has_clip = (
            (path / INDEX).is_file() for path in (folder / "scene", used / "semantic_tree", used / "clip")
        )
        views, registration = {"train": 0, "test": 0}, folder / "scene/registration.json"
        for view in read_index(folder / "scene")["views"].values() if has_poses else ():
            views[view["split"]] += 1
        report = folder / "gaussians/report.json"
        if has_tree and has_clip:
            field = full / "field.safetensors"
            state = "tree of key views" if used == early else "tree, field" if field.is_file() else "tree"
        else:
            state = "Gaussians" if report.is_file() else "poses" if has_poses else "no poses"
        models = [masks_label(used / "masks")] if (used / "masks" / INDEX).is_file() else []
        models += [Path(read_index(used / "clip", "model")["model"]).name] if has_clip else []
        stats = stats_of(files_below(folder))
        times = [stat.st_mtime for path, stat in stats.items() if path.name.endswith(RECORD)]
        return SceneState(
            poses=read_json(registration) if has_poses and registration.is_file() else {},
            views=views,
            fit=read_json(report) if report.is_file() else {},
            nodes=read_index(used / "semantic_tree", "nodes")["nodes"] if has_tree else {},
            state=state,
            models=", ".join(models),
            num_bytes=sum(stat.st_size for stat in stats.values()),
            date=time.strftime("%Y-%m-%d %H:%M", time.localtime(max(times))) if times else "",
        )

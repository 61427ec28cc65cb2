"""Labels of your own scenes, in the format of `hi.py` (written by `hilsplat annotate`) or of LERF-OVS.

The photographs are the scene's own undistorted ones (`results/<dataset>/<scene>/scene/images`), so only label
files are stored here; evaluation compares their size with the scene's cameras.
"""

from pathlib import Path

from hilsplat.datasets.dataset import Dataset
from hilsplat.datasets.images.hi import regions_of
from hilsplat.datasets.images.isat import read_isat
from hilsplat.datasets.images.lerf_ovs import label_files, merged_regions
from hilsplat.datasets.labelled import LabelledRegion, LabelledScene


def open_scene(root: Path, scene: str) -> LabelledScene:
    """Read the annotations of a scene, such as "photos/desk": one region per drawn or accepted object.

    Files whose objects have no level are read like LERF-OVS: one region per text.

    Raises:
        SceneError: there are none, or a label file cannot be used.
    """
    DATASET.require(root, scene)
    warnings: list[str] = []
    views: dict[str, tuple[LabelledRegion, ...]] = {}
    for view, path in label_files(root / scene).items():
        labels = read_isat(path)
        warnings += labels.warnings
        has_levels = any("level" in thing.keys for thing in labels.objects)
        views[view] = regions_of(labels, warnings) if has_levels else merged_regions(labels)
    return LabelledScene("annotated", scene, {}, None, views, tuple(warnings))


class Annotated(Dataset):
    """A data set without published scenes: its scenes are those that have been annotated."""

    def found(self, root: Path) -> tuple[str, ...]:
        """Return the scenes that have a label file below the folder."""
        files = root.glob("*/*/*.json")
        return tuple(sorted({f"{path.parent.parent.name}/{path.parent.name}" for path in files}))


DATASET = Annotated(
    name="annotated",
    title="Own annotations",
    labels="images",
    folder="annotated",
    scenes=(),
    licence="yours; the photographs keep theirs",
    terms="Draw them with: hilsplat annotate SCENE",
    citation="none",
    layout="""annotated/
  <dataset>/<scene>/DSC_0001.json ...   our format (docs/datasets.md), a file per annotated photograph""",
    required=lambda scene: (scene,),
    open=open_scene,
    label_places=lambda scene: (f"{scene}/*.json",),
)

"""What is true in the views of a scene, read when their turn comes."""

import logging
from collections.abc import Callable
from pathlib import Path

from hilsplat.datasets.labelled import LabelledScene, check_label_size
from hilsplat.datasets.synthetic.hierarchy import HierarchyAnnotations
from hilsplat.evaluate.protocols.view_truth import ViewTruth
from hilsplat.scene.scene import Scene
from hilsplat.settings import EvaluateSettings

logger = logging.getLogger(__name__)

SHAPE_TOLERANCE = 0.01
"""Views whose sides were rounded by undistortion or shrinking still fit their labels."""


def annotated_truths(
    truth: Path, posed: Scene, settings: EvaluateSettings
) -> dict[str, Callable[[], ViewTruth]]:
    """What is true in each annotated test view, read when its turn comes."""
    annotations = HierarchyAnnotations.load(truth)
    return {
        view: lambda view=view: ViewTruth.of(
            annotations, view, posed.cameras[view].size_hw, settings.min_region_px
        )
        for view in posed.views("test")
        if annotations.views.get(view)
    }


def labelled_truths(labels: LabelledScene, posed: Scene) -> dict[str, Callable[[], ViewTruth]]:
    """What is true in each labelled view of a published data set, read when its turn comes.

    Raises:
        SceneError: a labelled view has no pose, or its labels are of another shape.
    """
    for sentence in labels.warnings:
        logger.warning("%s/%s: %s", labels.dataset, labels.scene, sentence)
    truths: dict[str, Callable[[], ViewTruth]] = {}
    labels.check_posed(posed.cameras.names)
    for view, regions in labels.views.items():
        size_hw = posed.cameras[view].size_hw
        for label_hw in sorted({region.size_hw for region in regions}):
            sentence = check_label_size(f"a label of view {view}", label_hw, size_hw, SHAPE_TOLERANCE)
            if sentence:
                logger.warning("%s/%s: %s", labels.dataset, labels.scene, sentence)
        truths[view] = lambda regions=regions, size_hw=size_hw: ViewTruth.of_regions(regions, size_hw)
    return truths

"""True regions in the views of a scene, loaded on demand."""

import logging
from collections.abc import Callable
from functools import partial
from pathlib import Path

from hilsplat.datasets.labelled import LabelledScene, check_label_size
from hilsplat.datasets.synthetic.hierarchy import HierarchyAnnotations
from hilsplat.evaluate.protocols.view_truth import ViewTruth
from hilsplat.scene.scene import Scene

logger = logging.getLogger(__name__)

SHAPE_TOLERANCE = 0.01
"""Tolerated relative difference in shape between labels and view: undistortion and shrinking round sides."""


def annotated_truths(truth: Path, posed: Scene, min_region_px: int) -> dict[str, Callable[[], ViewTruth]]:
    """Return the true regions in each annotated test view, loaded on demand."""
    annotations = HierarchyAnnotations.load(truth)
    return {
        view: partial(ViewTruth.of, annotations, view, posed.cameras[view].size_hw, min_region_px)
        for view in posed.views("test")
        if annotations.views.get(view)
    }


def labelled_truths(labels: LabelledScene, posed: Scene) -> dict[str, Callable[[], ViewTruth]]:
    """Return the true regions in each labelled view of a published data set, loaded on demand.

    Raises:
        SceneError: a labelled view has no pose, or its labels differ in shape.
    """
    for sentence in labels.warnings:
        logger.warning("%s/%s: %s", labels.dataset, labels.scene, sentence)
    truths: dict[str, Callable[[], ViewTruth]] = {}
    labels.check_posed(posed.cameras.names)
    for view, regions in labels.views.items():
        size_hw = posed.cameras[view].size_hw
        for label_hw in sorted({region.size_hw for region in regions}):
            departure = check_label_size(f"a label of view {view}", label_hw, size_hw, SHAPE_TOLERANCE)
            if departure:
                logger.warning("%s/%s: %s", labels.dataset, labels.scene, departure)
        truths[view] = partial(ViewTruth.of_regions, regions, size_hw)
    return truths

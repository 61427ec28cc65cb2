"""The evaluate stage: a finished scene and its annotations in, `scores.csv` out."""

import logging
from collections.abc import Callable
from pathlib import Path

from hilsplat.base.artifacts import read_index
from hilsplat.base.progress import stage_log, track
from hilsplat.datasets.hierarchy import HierarchyAnnotations
from hilsplat.datasets.labelled import LabelledScene, check_label_size
from hilsplat.evaluate.protocols.answers import Selections
from hilsplat.evaluate.protocols.view_truth import ViewTruth
from hilsplat.evaluate.protocols.views import measure_view
from hilsplat.evaluate.scores import Score, write_scores
from hilsplat.language.query import LanguageScene
from hilsplat.scene.scene import Scene
from hilsplat.settings import EvaluateSettings

logger = logging.getLogger(__name__)

SHAPE_TOLERANCE = 0.01
"""Views whose sides were rounded by undistortion or shrinking still fit their labels."""


def run_evaluate(
    scene_folder: Path,
    truth: Path | None,
    gaussians: Path,
    semantic_tree: Path,
    language: Path,
    autoencoder: Path,
    clip_folder: Path,
    masks_folder: Path,
    out: Path,
    settings: EvaluateSettings,
    dataset: str,
    scene: str,
    variant: str,
    threads: int,
    labels: LabelledScene | None = None,
) -> None:
    """Score every annotated query in every annotated test view (see `protocols`).

    With the labels of a published data set every labelled view is scored, held out or not: most of them
    train on all views.

    Args:
        scene_folder: scene artifact; its test views were held out of every stage before.
        truth: annotations in the hierarchy format; None gives a file with a header only.
        gaussians: 3DGS PLY.
        semantic_tree: semantic tree artifact.
        language: language field.
        autoencoder: autoencoder artifact.
        clip_folder: mask embeddings; their index names the CLIP model, which embeds the texts.
        masks_folder: masks artifact; its index says what made the masks.
        out: `scores.csv`.
        settings: queries and protocols.
        dataset: written into every row, as are `scene` and `variant`.
        scene: scene name.
        variant: named set of settings.
        threads: threads for rendering.
        labels: labels of a published data set, in place of annotations.

    Raises:
        MisalignedArtifactError: label images are of another size than the cameras.
        SceneError: a labelled view has no pose, or labels are of another shape than their view.
    """
    scores: list[Score] = []
    label = masks_label(masks_folder)
    with stage_log("evaluate", f"{dataset}/{scene}/{variant}") as counts:
        if truth is None and labels is None:
            logger.info("%s/%s has no annotations: nothing to score", dataset, scene)
        else:
            posed = Scene.load(scene_folder)
            truths = labelled_truths(labels, posed) if labels else annotated_truths(truth, posed, settings)
            if not truths:
                logger.warning("no view of %s/%s is annotated: nothing to score", dataset, scene)
            answers = LanguageScene.open(
                scene_folder,
                gaussians,
                semantic_tree,
                language,
                autoencoder,
                Path(read_index(clip_folder)["model"]),
                canonical=settings.canonical,
                relevancy_scale=settings.relevancy_scale,
                threads=threads,
            )
            selections = Selections(answers, settings.node_select)
            for view in track(list(truths), "views scored"):
                size_hw = posed.cameras[view].size_hw
                for measured in measure_view(answers, selections, truths[view](), view, size_hw, settings):
                    scores.append(
                        Score(
                            dataset=dataset,
                            scene=scene,
                            variant=variant,
                            masks=label,
                            view=view,
                            **vars(measured),
                        )
                    )
            counts["views"] = len(truths)
        counts["rows"] = len(scores)
        write_scores(out, scores)


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
    for stem, view in labels.posed_views(posed.cameras.names).items():
        size_hw, regions = posed.cameras[view].size_hw, labels.views[stem]
        for label_hw in sorted({region.size_hw for region in regions}):
            sentence = check_label_size(f"a label of view {view}", label_hw, size_hw, SHAPE_TOLERANCE)
            if sentence:
                logger.warning("%s/%s: %s", labels.dataset, labels.scene, sentence)
        truths[view] = lambda regions=regions, size_hw=size_hw: ViewTruth.of_regions(regions, size_hw)
    return truths


def masks_label(masks_folder: Path) -> str:
    """What made the masks, as rows name it.

    The model folder's name, or the segmenter without one; masks made from true labels bring a label that
    also tells their faults.
    """
    index = read_index(masks_folder)
    if "label" in index:
        return str(index["label"])
    return Path(index["model"]).name if index["model"] else index["segmenter"]

"""The evaluate stage: a finished scene and its annotations in, `scores.csv` out."""

import logging
from pathlib import Path

from hilsplat.base.artifacts import read_index
from hilsplat.base.progress import stage_log, track
from hilsplat.datasets.hierarchy import HierarchyAnnotations
from hilsplat.evaluate.protocols.answers import Selections
from hilsplat.evaluate.protocols.view_truth import ViewTruth
from hilsplat.evaluate.protocols.views import measure_view
from hilsplat.evaluate.scores import Score, write_scores
from hilsplat.language.query import LanguageScene
from hilsplat.scene.scene import Scene
from hilsplat.settings import EvaluateSettings

logger = logging.getLogger(__name__)


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
) -> None:
    """Score every annotated query in every annotated test view (see `protocols`).

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

    Raises:
        MisalignedArtifactError: label images are of another size than the cameras.
    """
    scores: list[Score] = []
    label = masks_label(masks_folder)
    with stage_log("evaluate", f"{dataset}/{scene}/{variant}") as counts:
        if truth is None:
            logger.info("%s/%s has no annotations: nothing to score", dataset, scene)
        else:
            annotations = HierarchyAnnotations.load(truth)
            posed = Scene.load(scene_folder)
            views = [view for view in posed.views("test") if annotations.views.get(view)]
            if not views:
                logger.warning(
                    "none of the %d test views of %s/%s is annotated: nothing to score",
                    len(posed.views("test")),
                    dataset,
                    scene,
                )
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
            for view in track(views, "views scored"):
                size_hw = posed.cameras[view].size_hw
                regions = ViewTruth.of(annotations, view, size_hw, settings.min_region_px)
                for measured in measure_view(answers, selections, regions, view, size_hw, settings):
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
            counts["views"] = len(views)
        counts["rows"] = len(scores)
        write_scores(out, scores)


def masks_label(masks_folder: Path) -> str:
    """What made the masks, as rows name it.

    The model folder's name, or the segmenter without one; masks made from true labels bring a label that
    also tells their faults.
    """
    index = read_index(masks_folder)
    if "label" in index:
        return str(index["label"])
    return Path(index["model"]).name if index["model"] else index["segmenter"]

"""Protocols: the name, the version and everything else that determines a number measured under each.

The same model scores 51.4 under `lerf/langsplat` and 9.66 under `lerf/opengaussian`, so each row of
`scores.csv` has the full name, such as `lerf/langsplat@2`, then non-default settings in brackets. A change to
a card that affects its numbers requires a new version; a test checks this.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Literal

from hilsplat.base.errors import ArtifactError
from hilsplat.base.levels import Level
from hilsplat.evaluate.metrics.relevancy_rule import RelevancyRule

CANONICAL: tuple[str, ...] = ("object", "things", "stuff", "texture")
"""Canonical phrases of every protocol that uses relevancy (LERF, LangSplat)."""

RELEVANCY_SCALE = 10.0
"""Scale of the cosine in the relevancy (LERF, LangSplat)."""

NODE_SELECT = 0.95
"""`evaluate.node_select`; the selection of `TREE_NODES` states the rule."""

ANCESTORS = 0.2
"""Fraction of the ancestors' mean margin that is added to a node's own margin, except on paths."""

Averaging = Literal["pairs", "classes", "levels", "views", "scenes", "pooled"]
"""How rows are averaged into one number of a table.

pairs: mean over the (view, query) pairs of a scene, then over scenes.
classes: mean over the views of a query, then over the queries of a scene, then over scenes.
levels: like `pairs` for each level; Avg is the mean of the levels.
views: mean over the views of a scene, then over scenes.
scenes: one number per scene, mean over scenes.
pooled: counts of all scenes are summed first, so each scene is weighted by its number of points.
"""


@dataclass(frozen=True)
class ProtocolCard:
    """One protocol."""

    full_name: str  # `benchmark/variant@version`; a change below that affects the numbers needs a new version
    metrics: tuple[str, ...]
    averaging: Averaging
    selection: str  # how a prediction is chosen (threshold, level), in words
    source: str  # source code and departures from it; begins with "none" if no code is public
    rule: RelevancyRule | None = None  # how relevancy maps become masks, if they do
    missing: Literal["zero", "left out"] = "zero"  # pairs without a prediction; omitting them inflates scores
    classes: str = ""  # name of the queried `ClassSet`, if it is fixed
    # `labels`: the region that the data set defines; `any grey`: all non-black pixels of its mask file
    truth: Literal["labels", "any grey"] = "labels"
    united: tuple[tuple[str, str], ...] = ()  # (text, other): the answer to a text is the union of both masks
    # Public function with the same results up to rounding, except for the departures in `source`:
    # `owner/repository@commit file`, with `:function` where the file has several; "" if there is none.
    public: str = ""

    @property
    def name(self) -> str:
        return self.full_name.partition("@")[0]

    def labelled(self, departures: Iterable[str] = ()) -> str:
        """Return the name used in rows: the full name and any non-default settings."""
        words = ", ".join(departures)
        return f"{self.full_name} ({words})" if words else self.full_name


MASK = ("iou", "boundary_iou")
LOCALIZATION = ("localization_box", "localization_mask")
CONSISTENCY = ("hc_containment", "hc_literal", "hc_anchored")
PER_CLASS = ("class_iou", "class_accuracy")
MEAN_LEVEL: dict[str, Any] = {"mix": False, "majority": False, "level_rule": "mean_in_mask"}
"""Map rule of LangSplat's text on 3D-OVS, except for the threshold."""

OPENGAUSSIAN = "yanmin-wu/OpenGaussian@b70dcc6 scripts/eval_scannet.py"
GAUSSIAN_GROUPING = "lkeab/gaussian-grouping@c93f24b script/eval_lerf_mask.py"
ARGMAX = "argmax of the cosine over the classes, no canonical phrases"
PAPER = "none: Hi-LSplat, implementation details"
OURS = "none: ours"
LANGSPLAT_V2 = "LangSplatV2, as in its copy xuexutao/Lang_GS"

LERF_LANGSPLAT = ProtocolCard(
    "lerf/langsplat@2",
    MASK + LOCALIZATION,
    "pairs",
    "min-max relevancy above 0.7 after a mean filter of 30 px at a height of 730, scaled; level of the "
    "highest value",
    "LangSplat, except that its 30 px filter is scaled with the image height",
    RelevancyRule(),
    public="minghanqin/LangSplat@26ed214 eval/evaluate_iou_loc.py:activate_stream",
)
TREE_NODES = ProtocolCard(
    "lerf/tree-nodes@5",
    MASK + LOCALIZATION,
    "pairs",
    "3D nodes visible in the view whose cosine margin (plus a fifth of their ancestors' mean) is below the "
    "best by at most 0.05 of the level's range, or 0.15 if their cosine with the best node is at least 0.9, "
    "rendered; level chosen by the tree",
    OURS,
)
LEVEL_GIVEN = ProtocolCard(
    "hierarchy/level-given@5",
    (*MASK, *LOCALIZATION, "best_threshold_iou", *CONSISTENCY),
    "levels",
    "as lerf/langsplat for maps and lerf/tree-nodes for nodes, at the level of the annotation",
    "none: Hi-LERF and Hi-3DOVS have columns l1, l2, l3",
    RelevancyRule(),
)
LEVEL_AUTO = ProtocolCard(
    "hierarchy/level-auto@6",
    (*MASK, *LOCALIZATION, *CONSISTENCY),
    "levels",
    "as lerf/langsplat for maps and lerf/tree-nodes for nodes, level chosen by the method",
    PAPER,
    RelevancyRule(),
)
PATH = ProtocolCard(
    "hierarchy/path@3",
    (*MASK, *LOCALIZATION, *CONSISTENCY),
    "levels",
    "3D nodes, visible in the view, that match the chain of texts from the whole down, each with its "
    "ancestors; uses more text than the paper",
    OURS,
)
SCENE_WIDE = ProtocolCard(
    "hierarchy/scene-wide@2",
    (*MASK, *CONSISTENCY),
    "levels",
    "like hierarchy/level-given, but all nodes of the scene compete: one answer for all views",
    OURS,
)
ANNOTATIONS = ProtocolCard(
    "hierarchy/annotations@1", CONSISTENCY, "views", "the annotations, to score perfect masks", OURS
)
VIEW_CONSISTENCY = ProtocolCard(
    "world/view-consistency@2",
    ("view_consistency",),
    "levels",
    "like hierarchy/level-given, in a view and its nearest neighbour; IoU over points visible in both",
    f"{OURS}; exact geometry of the synthetic world",
)
LERF_OPENGAUSSIAN = ProtocolCard(
    "lerf/opengaussian@1",
    ("iou", "acc_25", "acc_50"),
    "pairs",
    "Gaussians selected in 3D by cosine, rendered, silhouette above 0.7; not the task of lerf/langsplat",
    "OpenGaussian",
    public="yanmin-wu/OpenGaussian@b70dcc6 scripts/compute_lerf_iou.py",
)
LERF_MASK = ProtocolCard(
    "lerf-mask/gaussian-grouping@1",
    MASK,
    "classes",
    "the method's own masks, one per prompt",
    "Gaussian Grouping, except that a missing prediction and two empty masks count as 0 (there, NaN)",
    public=GAUSSIAN_GROUPING,
)
LERF_MASK_SKIPPING = replace(
    LERF_MASK,
    full_name="lerf-mask/gaussian-grouping-skipping@1",
    source="Gaussian Grouping, except that missing predictions are skipped and two empty masks count as 0 "
    "(there, NaN)",
    missing="left out",
)
OVS_NODES = ProtocolCard(
    "3d-ovs/tree-nodes@1",
    MASK,
    "pairs",
    "as lerf/tree-nodes: a tree answers with nodes, to which rules for maps do not apply",
    OURS,
)
OVS_ARGMAX = ProtocolCard(
    "3d-ovs/argmax@3",
    ("iou", "pixel_accuracy"),
    "pairs",
    f"{ARGMAX} and over the levels, at an eighth of the image's size",
    "3D-OVS, except that three levels compete (there, one) and a pixel without a cosine is a miss. "
    "Up to version 2, texts not visible in the view did not compete",
    public="Kunhao-Liu/3D-OVS@80e512c renderer.py:evaluation_segmentation_test",
)
INSTANCES = ProtocolCard(
    "scannet200/instances@1",
    ("ap", "ap50", "ap25", "ap_head", "ap_common", "ap_tail"),
    "pooled",
    "predicted instances with class and confidence; those with fewer than 100 points are ignored",
    "OpenMask3D's copy of ScanNet's script, except that confidence is the cosine (there, 1). Predictions "
    "are matched in the order given; ScanNet's own script uses a dict's order, which is undefined",
    classes="scannet200-instances",
    public="OpenMask3D/openmask3d@6488748 openmask3d/evaluation/eval_semantic_instance.py:evaluate_matches",
)
OVS_LANGSPLAT_V2 = ProtocolCard(
    "3d-ovs/langsplat-v2@3",
    MASK,
    "pairs",
    "min-max of the smoothed relevancy above 0.625, 7 x 7 majority; whole or part, by the highest mean in "
    "its mask, an empty mask first; ground truth: any non-zero grey; wood wall includes wood table's mask",
    f"{LANGSPLAT_V2}, with its shell script's threshold, except that a text without ground-truth pixels is "
    "not queried. Up to version 2, a mask with only greys of 1 to 127 was empty",
    RelevancyRule(
        filter_px=29,
        threshold=0.25,
        level_rule="mean_in_mask",
        border="inside",
        levels=(Level.WHOLE, Level.PART),
        empty_wins=True,
    ),
    truth="any grey",
    united=(("wood wall", "wood table"),),
    public="xuexutao/Lang_GS@b808dfb eval_3d_ovs.py:segmentation_process_cuda_room",
)


def _maps(
    name: str, source: str, selection: str, metrics: tuple[str, ...], public: str = "", **rule
) -> ProtocolCard:
    """Return a protocol that differs from LangSplat's protocol only in its map rule."""
    return ProtocolCard(
        f"{name}@2", metrics, "pairs", selection, source, RelevancyRule(**rule), public=public
    )


def _points(
    name: str,
    classes: str,
    source: str,
    metrics: tuple[str, ...] = (*PER_CLASS, "miou_present", "macc_present"),
    averaging: Averaging = "scenes",
    public: str = "",
) -> ProtocolCard:
    """Return a protocol that scores points."""
    return ProtocolCard(f"{name}@1", metrics, averaging, ARGMAX, source, classes=classes, public=public)


CARDS: tuple[ProtocolCard, ...] = (
    LERF_LANGSPLAT,
    TREE_NODES,
    _maps(
        "lerf/langsplat-v2",
        LANGSPLAT_V2,
        "as lerf/langsplat with windows of 29 and 7 px that are clipped at the border",
        MASK + LOCALIZATION,
        public="xuexutao/Lang_GS@b808dfb eval_lerf.py",
        filter_px=29,
        border="inside",
    ),
    _maps(
        "lerf/paper-filter",
        f"{PAPER}: first passage (LangSplat's text on LERF)",
        "as lerf/langsplat with a filter of 20 px",
        MASK + LOCALIZATION,
        filter_px=20,
    ),
    _maps(
        "lerf/paper-mean",
        f"{PAPER}: second passage (LangSplat's text on 3D-OVS)",
        "relevancy above 0.4; level of the highest mean in its mask",
        MASK + LOCALIZATION,
        filter_px=20,
        threshold_on="raw",
        **MEAN_LEVEL,
    ),
    LERF_OPENGAUSSIAN,
    LERF_MASK,
    LERF_MASK_SKIPPING,
    OVS_ARGMAX,
    _maps(
        "3d-ovs/langsplat",
        "none: LangSplat's supplement; the scale of the threshold is our reading",
        "min-max relevancy above 0.7, unfiltered; level of the highest mean in its mask",
        MASK,
        **MEAN_LEVEL,
    ),
    _maps(
        "3d-ovs/langsplat-raw",
        "none: LangSplat's supplement, taken literally",
        "relevancy above 0.4, unfiltered; level of the highest mean in its mask",
        MASK,
        threshold_on="raw",
        **MEAN_LEVEL,
    ),
    OVS_LANGSPLAT_V2,
    OVS_NODES,
    _points("scannet/opengaussian-19", "scannet-19", "OpenGaussian", public=OPENGAUSSIAN),
    _points("scannet/opengaussian-15", "scannet-15", "OpenGaussian", public=OPENGAUSSIAN),
    _points("scannet/opengaussian-10", "scannet-10", "OpenGaussian", public=OPENGAUSSIAN),
    _points("scannet200/opengaussian", "scannet200", "OpenGaussian, with 200 classes", public=OPENGAUSSIAN),
    _points(
        "scannet200/benchmark",
        "scannet200",
        "none: ScanNet/ScanNet has only classes and splits (BenchmarkScripts/ScanNet200); counts as in its "
        "script for 20 classes",
        (*PER_CLASS, "miou_occurring", "miou_head", "miou_common", "miou_tail"),
        "pooled",
    ),
    INSTANCES,
    _points("replica/per-scene", "replica-48", f"{OURS}; the paper names no code"),
    _points(
        "replica/opennerf",
        "replica-51",
        "OpenNeRF, except that a class without ground-truth points counts as 0 (there, NaN if it is "
        "predicted; otherwise, the script stops)",
        (*PER_CLASS, "miou_all", "macc_all"),
        "pooled",
        public="opennerf/opennerf@343fa06 scripts/train_eval_replica_semantics.py:get_iou",
    ),
    _points(
        "replica/conceptgraphs",
        "replica-51",
        "ConceptGraphs' means, except that mesh vertices are scored and all 51 names compete (there, only "
        "the classes in the scene)",
        (*PER_CLASS, "macc_present", "frequency_weighted_iou"),
        public="concept-graphs/concept-graphs@3f97d78 conceptgraph/utils/eval.py:compute_metrics",
    ),
    _points(
        "waymo/segmentation",
        "waymo-22",
        "Waymo; miou_present omits the absent classes, which Waymo counts as 1",
        (*PER_CLASS, "miou_absent_as_one", "miou_present"),
        "pooled",
        public="waymo-research/waymo-open-dataset@2a7359b waymo_open_dataset/metrics/segmentation_metrics.cc",
    ),
    LEVEL_GIVEN,
    LEVEL_AUTO,
    PATH,
    SCENE_WIDE,
    ANNOTATIONS,
    VIEW_CONSISTENCY,
)

BY_NAME: dict[str, ProtocolCard] = {name: card for card in CARDS for name in (card.name, card.full_name)}


def card_of(label: str) -> ProtocolCard:
    """Return the protocol with a name, with or without its version; settings in brackets are ignored.

    Raises:
        ArtifactError: no protocol has that name and version.
    """
    name = label.split(" (")[0]
    if name not in BY_NAME:
        raise ArtifactError(
            f"there is no protocol {name!r}",
            expected=f"one of {', '.join(card.full_name for card in CARDS)}",
            fix="delete the score file that names it and run evaluate again" if "@" in name else None,
        )
    return BY_NAME[name]

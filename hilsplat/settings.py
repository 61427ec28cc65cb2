"""Every knob: its one default, unit, range and origin.

The configuration files hold choices; this module holds what may be chosen. A section is what one
stage (or family of stages) depends on, so a changed knob reruns exactly the stages whose sections
hold it. `hilsplat settings --schema` makes the JSON schema for editors from here.
"""

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field


def knob(default: Any, what: str, *, unit: str = "", origin: str = "ours", **limits: Any) -> Any:
    """A field with description, unit, range (ge, gt, le, lt) and where the default comes from."""
    return Field(default, description=what, json_schema_extra={"unit": unit, "origin": origin}, **limits)


class Section(BaseModel):
    """Settings of one stage; frozen, and unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    @property
    def is_random(self) -> bool:
        """Whether the stage's result depends on a variant's seed."""
        return False


Probability = Annotated[float, Field(ge=0, le=1)]


class WorldSettings(Section):
    """How a synthetic scene is rendered. What is in it follows from kind and seed (scene sheet)."""

    views: int = knob(40, "number of views", unit="views", ge=3, le=1000)
    image_px: int = knob(256, "height and width of a view", unit="px", ge=32, le=4096)
    arc_deg: float = knob(360.0, "azimuth covered by the cameras; a ring is 360", unit="degree", gt=0, le=360)
    objects: int = knob(
        6, "objects asked for; placement reports how many fitted", unit="objects", ge=1, le=30
    )
    samples: int = knob(3, "sub-samples per pixel side", ge=1, le=8)
    min_area_px: int = knob(
        60, "wholes and parts with a smaller visible region are not scored", unit="px", ge=1
    )


class PosesSettings(Section):
    """Camera poses by structure from motion, or imported."""

    max_side_px: int = knob(
        1600, "images are shrunk to this longer side", unit="px", ge=64, origin="3DGS: 1600"
    )
    camera_model: Literal["auto", "simple_pinhole", "simple_radial", "opencv"] = knob(
        "auto", "lens model; auto takes simple_radial for photographs and simple_pinhole for renders"
    )
    single_camera: Literal["auto", "yes", "no"] = knob(
        "auto",
        "whether photographs share one camera; auto: those of equal size and EXIF focal length do",
        origin="COLMAP",
    )
    matcher: Literal["auto", "exhaustive", "sequential"] = knob(
        "auto", "pairs to match; auto: exhaustive up to 200 views, else sequential", origin="COLMAP"
    )
    mapper: Literal["incremental", "global"] = knob(
        "incremental", "structure-from-motion algorithm", origin="COLMAP"
    )
    max_features: int = knob(4096, "SIFT features per image", ge=100, le=32768, origin="COLMAP: 8192")
    min_registered_share: float = knob(
        0.7,
        "the stage fails if the largest model holds a smaller share of the views",
        unit="share",
        gt=0,
        le=1,
    )
    several_models: Literal["largest", "stop"] = knob(
        "largest", "what to do if the photographs fall into several models"
    )
    test_every: int = knob(
        8, "every n-th view is held out for testing; 0: none", unit="views", ge=0, origin="3DGS"
    )


class GaussiansSettings(Section):
    """Base 3D Gaussian Splatting fit."""

    iterations: int = knob(3000, "optimisation steps, one view each", ge=1, origin="3DGS: 30000")
    max_gaussians: int = knob(50_000, "most Gaussians at any step", ge=100)
    image_scale: float = knob(1.0, "images are shrunk by this factor for the fit", gt=0, le=1)
    sh_degree: int = knob(2, "degree of the colour's spherical harmonics", ge=0, le=3, origin="3DGS: 3")
    ssim_weight: float = knob(0.2, "weight of D-SSIM against L1", ge=0, le=1, origin="3DGS")
    # A tenth of the published steps must go as far: with the published step sizes, development
    # scenes lose up to 1 dB (docs/splat.md). config/paper.yaml, with all steps, takes the published ones.
    means_rate: float = knob(
        1e-3, "first step size of the means", unit="extent of the cameras", gt=0, origin="3DGS: 1.6e-4"
    )
    means_rate_last: float = knob(
        1e-5, "last step size of the means", unit="extent of the cameras", gt=0, origin="3DGS: 1.6e-6"
    )
    scales_rate: float = knob(0.01, "step size of the log scales", gt=0, origin="3DGS: 5e-3")
    quats_rate: float = knob(0.004, "step size of the quaternions", gt=0, origin="3DGS: 1e-3")
    densify_from: float = knob(
        0.06, "densify from this share of the iterations", ge=0, le=1, origin="3DGS: 500 / 30000"
    )
    densify_until: float = knob(
        0.6, "densify until this share of the iterations", ge=0, le=1, origin="3DGS: 0.5"
    )
    densify_every: int = knob(100, "steps between densifications", ge=1, origin="3DGS")
    densify_gradient: float = knob(
        4e-4, "screen-space gradient above which a Gaussian is cloned or split", gt=0, origin="3DGS: 2e-4"
    )
    opacity_reset_every: int = knob(3000, "steps between opacity resets", ge=1, origin="3DGS")
    min_opacity: float = knob(0.005, "Gaussians of lower opacity are pruned", gt=0, lt=1, origin="3DGS")
    background: Literal["black", "white", "random"] = knob(
        "black", "colour behind the Gaussians", origin="3DGS"
    )
    strategy: Literal["default", "mcmc"] = knob(
        "default",
        "density control: default clones, splits and prunes (3DGS); mcmc relocates, with noise",
        origin="3DGS",
    )
    mcmc_growth: float = knob(
        0.05, "mcmc: growth per densification, up to max_gaussians", unit="share", ge=0, le=1, origin="MCMC"
    )
    mcmc_noise: float = knob(5e5, "mcmc: weight of the noise on the means", ge=0, origin="MCMC")
    mcmc_opacity_weight: float = knob(0.01, "mcmc: weight of the mean opacity", ge=0, origin="MCMC")
    mcmc_scale_weight: float = knob(
        0.01, "mcmc: weight of the mean scale, in units of the cameras' extent", ge=0, origin="MCMC"
    )
    initial: Literal["points", "random", "frozen"] = knob(
        "points",
        "first Gaussians: at the sparse points, or at random points that cameras see; frozen: one at each "
        "sparse point, which stays there, and no others (with evaluate.points: frozen)",
        origin="OpenGaussian on ScanNet: frozen",
    )
    checkpoint_every: int = knob(1000, "steps between checkpoints", ge=1)
    device: Literal["auto", "cpu", "cuda"] = knob(
        "auto", "what rasterises; auto: cuda if torch finds a device and gsplat is installed, else cpu"
    )


class MasksSettings(Section):
    """Masks of each view at three levels."""

    segmenter: Literal["sam", "graph", "truth-perturbed"] = knob(
        "sam",
        "sam: a SAM model folder; graph: OpenCV graph segmentation, no weights, for photographs; "
        "truth-perturbed: a diagnostic, the true masks of a synthetic scene with the faults of perturb",
    )
    model: str = knob("models/sam-tiny", "folder of a SAM in the Hugging Face ONNX export layout")
    points_per_side: int = knob(32, "prompts per image side", ge=1, le=128, origin="LangSplat: 32")
    points_per_batch: int = knob(64, "prompts per decoder call", ge=1, le=4096, origin="LangSplat: 64")
    crop_layers: int = knob(0, "layers of overlapping crops", ge=0, le=2, origin="LangSplat: 1")
    predicted_iou_min: float = knob(
        0.35, "masks with a lower predicted IoU are dropped", ge=0, le=1, origin="SAM: 0.88, LangSplat: 0.7"
    )
    stability_min: float = knob(
        0.5, "less stable masks are dropped", ge=0, le=1, origin="SAM: 0.95, LangSplat: 0.85"
    )
    stability_offset: float = knob(1.0, "logit offset of the stability test", gt=0, origin="SAM")
    box_nms_iou: float = knob(0.7, "box IoU above which the worse mask is dropped", gt=0, le=1, origin="SAM")
    min_area_px: int = knob(
        16, "smaller masks, islands and holes are dropped", unit="px", ge=1, origin="LangSplat: 100"
    )
    nms_iou: float = knob(
        0.8, "mask IoU above which the worse mask is dropped", gt=0, le=1, origin="LangSplat"
    )
    nms_score: float = knob(
        0.0, "masks with a lower predicted IoU x stability are dropped", ge=0, le=1, origin="LangSplat: 0.7"
    )
    nms_inner: float = knob(0.5, "inner-mask suppression threshold", ge=0, le=1, origin="LangSplat")
    graph_scales: tuple[float, float, float] = knob(
        (0.12, 0.04, 0.015),
        "least segment size at whole, part, subpart as a share of the image side; graph only",
    )


class PerturbSettings(Section):
    """Faults put into true masks; read by masks.segmenter: truth-perturbed alone.

    The defaults are a guess at what a good SAM does to a clean picture of some 256 px: a little more
    consistent from view to view than the embedded one (`hilsplat world inconsistency`). With every fault
    at 0 the masks are the truth. A scene has few wholes, so systematic faults weigh more or less from
    seed to seed: take several.
    """

    seed: int = knob(0, "seed of the faults; the run's seed does not touch them", ge=0)
    background: bool = knob(True, "mask the surroundings (table, floor, walls) too, as SAM does")
    boundary_px: float = knob(
        0.6, "standard deviation of the boundary's displacement along its normal", unit="px", ge=0, le=64
    )
    boundary_smooth_px: float = knob(
        6.0, "length over which the displacement changes", unit="px", ge=1, le=256
    )
    merge: float = knob(
        0.02, "probability per node and view of being merged with a touching sibling", ge=0, le=1
    )
    split: float = knob(0.02, "probability per mask of being cut in two", ge=0, le=1)
    missing: tuple[Probability, Probability, Probability] = knob(
        (0.01, 0.04, 0.1), "probability that a mask is missing, at whole, part, subpart"
    )
    missing_level: tuple[Probability, Probability, Probability] = knob(
        (0.0, 0.0, 0.0), "probability that a view lacks the level altogether: whole, part, subpart"
    )
    wrong_level: float = knob(0.02, "probability that a mask is one level off", ge=0, le=1)
    dropped_views: float = knob(0.0, "probability that a view has no masks at all", ge=0, le=1)
    systematic_merge: float = knob(
        0.02, "probability per node, drawn once per scene, of the same wrong merge in most views", ge=0, le=1
    )
    systematic_missing: float = knob(
        0.02, "probability per node, drawn once per scene, of having no mask in most views", ge=0, le=1
    )
    systematic_share: float = knob(0.9, "probability that a systematic fault happens in a view", ge=0, le=1)
    score_noise: float = knob(
        0.05, "standard deviation of predicted IoU and stability about their true values", ge=0, le=1
    )


class CoverageTreeSettings(Section):
    """Coverage tree of each view."""

    theta: float = knob(0.9, "coverage threshold", unit="share", gt=0.5, lt=1, origin="paper: 0.9")


class ClipSettings(Section):
    """One CLIP vector per mask."""

    model: str = knob("models/clip-tiny", "folder of a CLIP in the Hugging Face ONNX export layout")
    background: Literal["black", "keep"] = knob(
        "black", "pixels of the crop outside the mask", origin="LangSplat: black"
    )
    batch: int = knob(64, "crops per network call", ge=1, le=4096)


class ContributionsSettings(Section):
    """The frozen-geometry matrices."""

    min_weight: float = knob(1 / 255, "lower weights of a Gaussian at a pixel are dropped", ge=0, lt=1)
    keep: Literal["auto", "gram", "weights"] = knob(
        "auto",
        "gram: pairs of Gaussians; weights: pixel weights of all views; auto: the one with fewer non-zeros",
    )
    device: Literal["auto", "cpu", "cuda"] = knob(
        "auto", "what rasterises; auto: cuda if torch finds a device and gsplat is installed, else cpu"
    )


class SemanticTreeSettings(Section):
    """3D semantic tree: masks linked across views by the Gaussians they share."""

    link_threshold: float = knob(
        0.3, "pooled average IoU above which clusters of masks are joined", gt=0, lt=1
    )
    min_views: int = knob(3, "a node is seen in at least this many views", ge=1)
    parent_coverage: float = knob(
        0.5, "share of a node inside a coarser one that makes it a child", gt=0, lt=1
    )
    device: Literal["cpu", "cuda"] = knob(
        "cpu", "what computes the evidence; cuda: torch, equal up to rounding"
    )


class AutoencoderSettings(Section):
    """Scene autoencoder of CLIP vectors."""

    code: Literal["network", "pca"] = knob(
        "pca", "network: trained; pca: mean and principal directions", origin="paper: network"
    )
    latent: int = knob(16, "latent numbers d", ge=1, le=64, origin="paper, LangSplat: 3")
    targets: Literal["node", "mask"] = knob(
        "node",
        "node: the view-averaged vector of the mask's node, if it fits one; mask: its own",
        origin="paper: mask",
    )
    epochs: int = knob(100, "passes over all vectors", ge=1, origin="LangSplat: 100")
    min_steps: int = knob(2000, "least number of steps, however few vectors there are", ge=1)
    batch: int = knob(64, "vectors per step", ge=2, origin="LangSplat: 64")
    learning_rate: float = knob(2e-3, "first Adam step, cosine-decayed", gt=0, origin="LangSplat: 7e-4")
    cosine_weight: float = knob(
        1e-3, "weight of 1 - cosine beside the squared error", ge=0, origin="LangSplat: 1e-3"
    )

    @property
    def is_random(self) -> bool:
        """A network has random first weights; principal directions hold nothing random."""
        return self.code == "network"


class FieldSettings(Section):
    """Language field: per Gaussian one latent for each level."""

    weight_language: float = knob(
        1.0, "weight of the regression to the latents", ge=0, origin="paper: not stated"
    )
    weight_clustering: float = knob(0.0, "weight of L_h (Eq. 2)", ge=0, origin="paper: 1")
    weight_instance: float = knob(0.0, "weight of L_ins (Eq. 3), lambda_1", ge=0, origin="paper: e-6")
    weight_part: float = knob(0.01, "weight of L_part (Eq. 5), lambda_2", ge=0, origin="paper: e-5")
    instance_mode: Literal["literal", "coverage_tree"] = knob(
        "coverage_tree", "reading of L_ins", origin="paper: literal"
    )
    part_mode: Literal["literal", "disentangle"] = knob(
        "disentangle", "reading of L_part", origin="paper: literal"
    )
    omega: float = knob(10.0, "similarity degree Omega", gt=1, origin="paper: 10")
    tau: float = knob(0.1, "temperature of L_part", gt=0, origin="paper: not given; VCH: 0.1")
    start: Literal["average", "median"] = knob(
        "average", "lift of the mask latents to Gaussians: average, or geometric median (robust, like L1)"
    )
    ridge: float = knob(0.1, "pull towards the lift, in units of the visible mass", ge=0)
    min_labelled_share: float = knob(
        0.3,
        "Gaussians with a smaller share of their weight in masks of a level get no latent there; 0: all do",
        ge=0,
        lt=1,
        origin="paper, LangSplat: 0",
    )
    cg_steps: int = knob(10, "conjugate-gradient steps of the quadratic part", ge=0)
    lbfgs_steps: int = knob(10, "L-BFGS steps if L_ins or L_part is on", ge=0)
    min_mask_px: int = knob(50, "smaller masks stay out of L_ins and L_part", unit="px", ge=1)
    prune_cosine: float = knob(
        1.0,
        "L_ins and L_part drop a mask whose mean has a higher cosine than this with that of a larger one of "
        "its view and level; 1: keep all",
        ge=0,
        le=1,
        origin="paper: pruning, no number",
    )
    device: Literal["cpu", "cuda"] = knob(
        "cpu", "what multiplies matrices; cuda: torch, equal up to rounding"
    )


class ReferenceSettings(Section):
    """The reference trainer of the field: renders one random view per step, as LangSplat does."""

    steps: int = knob(30_000, "steps, one view each", ge=1, origin="LangSplat, paper")
    rate: float = knob(0.0025, "step size of Adam", gt=0, origin="LangSplat")
    loss: Literal["l1", "squared"] = knob(
        "l1", "l1: LangSplat's masked L1; squared: the language loss of the fast solver", origin="LangSplat"
    )


class MethodSettings(Section):
    """Who writes the field: the method of this repository, or a baseline (hilsplat/methods)."""

    name: str = knob("hilsplat", "hilsplat, or a name of hilsplat/methods/registry.py")
    steps: int = knob(1800, "langsplat: steps per level, one view each", ge=1, origin="LangSplat: 30000")
    rate: float = knob(0.0025, "langsplat: step size of Adam", gt=0, origin="LangSplat")
    pixel_step: int = knob(
        2, "langsplat: every so many pixels of rows and columns are compared", ge=1, origin="LangSplat: 1"
    )

    @property
    def is_random(self) -> bool:
        """Our solver and plain averaging hold nothing random; another method may."""
        return self.name not in ("hilsplat", "lifted")


class EvaluateSettings(Section):
    """Queries and protocols."""

    canonical: tuple[str, ...] = knob(
        ("object", "things", "stuff", "texture"),
        "canonical phrases of the relevancy",
        origin="LERF, LangSplat",
    )
    template: str = knob(
        "{}",
        "sentence that every text and canonical phrase is put into at {}, such as 'a photo of a {}'",
        origin="LERF, LangSplat: {}",
        pattern=r"^[^{}]*\{\}[^{}]*$",
    )
    relevancy_scale: float = knob(10.0, "scale of the cosine in the relevancy", gt=0, origin="LangSplat")
    filter_px: int = knob(
        0,
        "side of the mean filter; 0: 30 px at a height of 730, scaled",
        unit="px",
        ge=0,
        origin="LangSplat: 30, paper: 20",
    )
    mix: bool = knob(True, "average the filtered relevancy with the relevancy itself", origin="LangSplat")
    relevancy_threshold: float = knob(
        0.4, "a map's mask is the pixels above it", ge=0, lt=1, origin="LangSplat, paper"
    )
    threshold_on: Literal["normalised_pm1", "raw"] = knob(
        "normalised_pm1",
        "scale of the threshold; normalised_pm1: 0.4 means min-max above 0.7",
        origin="LangSplat's code",
    )
    majority: bool = knob(True, "smooth a map's mask by the majority of 7 x 7 px", origin="LangSplat's code")
    level_rule: Literal["max", "mean_in_mask"] = knob(
        "max",
        "level of a map if none is given: highest value, or highest mean in its mask",
        origin="LangSplat: max",
    )
    node_select: float = knob(
        0.95,
        "how close to the best node others must come to be selected too: their cosine margin may be lower by "
        "1 minus this share of the range of margins at their level, three times that if they look like it",
        ge=0,
        le=1,
    )
    ancestors: float = knob(
        0.2,
        "share of the mean margin of a node's ancestors that is added to its own margin when nodes compete",
        ge=0,
    )
    min_region_px: int = knob(60, "smaller true regions are not scored", unit="px", ge=1)
    methods: tuple[Literal["tree", "tree-path", "field"], ...] = knob(
        ("tree", "tree-path", "field"), "what answers the queries; each becomes a row of the tables"
    )
    points: Literal["nearest", "vote", "density", "frozen"] = knob(
        "nearest",
        "how labelled points get what Gaussians know: the nearest opaque one, a vote of 5 within 10 cm, the "
        "densest 8, or each its own (gaussians.initial: frozen, or brought Gaussians that are the points)",
        origin="OpenGaussian: frozen",
    )


class FiguresSettings(Section):
    """Panels per scene."""

    queries_per_level: int = knob(2, "queries shown per level", ge=1, le=10)
    views: int = knob(1, "views shown per scene", ge=1, le=10)


class TrainingSettings(Section):
    """Training of the small models. Off the default path: the embedded ones are committed."""

    scenes: int = knob(700, "training scenes, of all kinds", ge=1)
    views: int = knob(3, "views of each", ge=1)
    validation_scenes: int = knob(40, "further scenes, on which nothing is trained", ge=1)
    sam_minutes: float = knob(60.0, "minutes of training of the segmenter; 0: no limit", unit="min", ge=0)
    sam_steps: int = knob(
        0, "the same in steps, so that a second run gives the same bytes; 0: no limit", ge=0
    )
    clip_minutes: float = knob(20.0, "training of CLIP; 0: no limit", unit="min", ge=0)
    clip_steps: int = knob(0, "the same in steps; 0: no limit", ge=0)
    segmented_views: int = knob(
        600,
        "training views that the finished segmenter segments, so that CLIP meets masks as it draws them",
        ge=0,
    )
    device: Literal["cpu", "cuda"] = knob("cpu", "device of torch")

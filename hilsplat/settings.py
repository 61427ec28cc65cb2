"""The settings of the pipeline, each defined once with its default, unit, range and origin.

Baselines and plugins define their own in the same way (`baselines.py`, docs/extending.md).
Configuration files choose values; this module defines the valid values. A section contains the settings of
one stage or of related stages, so a changed setting reruns exactly the stages that read its section.
`hilsplat settings` prints all settings, `hilsplat settings --schema` their JSON schema for editors.
"""

from typing import Annotated, Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, field_validator

LARGEST = 2_000_000_000
"""Maximum of an integer setting: libraries use 32-bit integers, and a run adds up to 10 to its seed."""


def knob(default: Any, what: str, *, unit: str = "", origin: str = "ours", **limits: Any) -> Any:
    """Define a setting with its description, unit, range (ge, gt, le, lt) and the origin of its default."""
    if type(default) is int and not {"le", "lt"} & limits.keys():
        limits["le"] = LARGEST
    return Field(default, description=what, json_schema_extra={"unit": unit, "origin": origin}, **limits)


class Section(BaseModel):
    """Frozen settings of one stage. Unknown keys and non-finite numbers are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, defer_build=True)

    @field_validator("*", mode="before")
    @classmethod
    def _no_truth_value(cls, value: Any, info: Any) -> Any:
        """Refuse booleans where a number or a word is expected, because YAML reads yes and no as booleans."""
        if isinstance(value, bool) and not _takes(cls.model_fields[info.field_name].annotation, bool):
            raise ValueError(
                "expected a number or word; YAML reads yes, no, on and off as booleans unless quoted"
            )
        return value

    @property
    def is_random(self) -> bool:
        """Whether the stage's result depends on a variant's seed."""
        return False

    @property
    def uses_model(self) -> bool:
        """Whether the stage runs the model in the setting `model`."""
        return "model" in type(self).model_fields

    @property
    def uses_card(self) -> bool:
        """Whether the stage uses an NVIDIA card if there is one that works."""
        return getattr(self, "device", "cpu") != "cpu"


def _takes(annotation: Any, kind: type) -> bool:
    """Return whether a type or a part of it is `kind` or `Any`."""
    return annotation in (kind, Any) or any(_takes(part, kind) for part in get_args(annotation))


Share = Annotated[float, Field(ge=0, le=1)]
Size = Annotated[int, Field(ge=1, le=1000)]
Suffix = Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]*$")]
Auto = Literal["auto"]
Device = Literal["auto", "cpu", "cuda"]

NETWORKS = "device of the networks; auto: cuda if torch finds one with enough free memory, else cpu"


class PosesSettings(Section):
    """Camera poses, from structure from motion or imported."""

    max_side_px: int = knob(
        1600, "longest side of an image; larger images are shrunk", unit="px", ge=64, origin="3DGS: 1600"
    )
    camera_model: Literal["auto", "simple_pinhole", "simple_radial", "opencv"] = knob(
        "auto", "lens model; auto: simple_radial, or simple_pinhole for renders"
    )
    single_camera: Literal["auto", "yes", "no"] = knob(
        "auto",
        "one lens per image size (yes), per size and EXIF focal length (auto), or per image (no)",
        origin="COLMAP",
    )
    matcher: Literal["auto", "exhaustive", "retrieval"] = knob(
        "auto",
        "pairs of views to match; retrieval: by appearance and time; auto: exhaustive up to 100 views",
        origin="COLMAP",
    )
    mapper: Literal["incremental", "global"] = knob("incremental", "structure from motion", origin="COLMAP")
    max_features: int = knob(4096, "SIFT features per image", ge=100, le=32768, origin="COLMAP: 8192")
    min_registered_share: float = knob(
        0.7, "minimum share of the views in the largest model; below it, poses fail", unit="share", gt=0, le=1
    )
    test_every: int = knob(8, "every n-th view is a test view; 0: none", unit="views", ge=0, origin="3DGS")


class GaussiansSettings(Section):
    """Fit of the 3D Gaussians."""

    iterations: int = knob(3000, "maximum number of steps, each on one view", ge=1, origin="3DGS: 30000")
    steps_per_view: int = knob(
        60, "steps per training view: at least 1500 in total, and at most `iterations`", ge=1
    )
    max_gaussians: int = knob(50_000, "maximum number of Gaussians at any step", ge=100)
    image_scale: float = knob(1.0, "scale of the images in the fit; 0.5 halves their sides", gt=0, le=1)
    quarter_until: Share = knob(0.15, "share of iterations that use quarter-size images", origin="3DGS: 0")
    half_until: Share = knob(0.75, "share of iterations that use images below full size", origin="3DGS: 0")
    sh_degree: int = knob(2, "degree of the spherical harmonics of the colours", ge=0, le=3, origin="3DGS: 3")
    ssim_weight: Share = knob(0.2, "D-SSIM's share of the loss; the rest is L1", origin="3DGS")
    # A fit takes at most a tenth of the published number of steps, so each step is larger (docs/splat.md).
    # config/paper.yaml uses the published number and sizes of steps.
    means_rate: float = knob(
        1.5e-3, "initial step size of the means", unit="camera extent", gt=0, origin="3DGS: 1.6e-4"
    )
    means_rate_last: float = knob(
        1.5e-5, "final step size of the means", unit="camera extent", gt=0, origin="3DGS: 1.6e-6"
    )
    scales_rate: float = knob(0.01, "step size of the log scales", gt=0, origin="3DGS: 5e-3")
    quats_rate: float = knob(0.004, "step size of the quaternions", gt=0, origin="3DGS: 1e-3")
    sh_rate: float = knob(
        4e-3, "step size of the constant harmonics; the others use 1/20 of it", gt=0, origin="3DGS: 2.5e-3"
    )
    densify_from: Share = knob(
        0.06, "start of densification, as a share of iterations", origin="3DGS: 500 / 30000"
    )
    densify_until: Share = knob(0.6, "end of densification, as a share of iterations", origin="3DGS: 0.5")
    densify_every: int = knob(100, "steps between densifications", ge=1, origin="3DGS")
    densify_gradient: float = knob(
        4e-4, "screen-space gradient above which a Gaussian is cloned or split", gt=0, origin="3DGS: 2e-4"
    )
    opacity_reset_every: int = knob(3000, "steps between opacity resets", ge=1, origin="3DGS")
    min_opacity: float = knob(0.005, "Gaussians with a lower opacity are pruned", gt=0, lt=1, origin="3DGS")
    background: Literal["black", "white", "random"] = knob("black", "background colour", origin="3DGS")
    strategy: Literal["default", "mcmc"] = knob(
        "default", "default: clone, split and prune (3DGS); mcmc: relocate, and add noise", origin="3DGS"
    )
    mcmc_growth: Share = knob(
        0.05, "mcmc: growth per densification, up to max_gaussians", unit="share", origin="MCMC"
    )
    mcmc_noise: float = knob(5e5, "mcmc: weight of the noise on the means", ge=0, origin="MCMC")
    mcmc_opacity_weight: float = knob(0.01, "mcmc: weight of the mean opacity", ge=0, origin="MCMC")
    mcmc_scale_weight: float = knob(
        0.01, "mcmc: weight of the mean scale, in units of the camera extent", ge=0, origin="MCMC"
    )
    initial: Literal["points", "random", "frozen"] = knob(
        "points",
        "initial Gaussians; points: at the sparse points; random: at random points in view of cameras; "
        "frozen: exactly one per sparse point, in a fixed position (for evaluate.points: frozen)",
        origin="OpenGaussian on ScanNet: frozen",
    )
    checkpoint_every: int = knob(1000, "steps between checkpoints", ge=1)
    device: Device = knob(
        "auto", "cuda: gsplat and torch; auto: cuda if it works and the card has enough free memory, else cpu"
    )


class MasksSettings(Section):
    """Masks of each view, at three levels."""

    segmenter: Literal["auto", "sam", "graph", "truth-perturbed"] = knob(
        "sam",
        "sam: the SAM model in `model`; graph: OpenCV's graph segmentation (no weights); auto: sam if "
        "pretrained, else graph; truth-perturbed (diagnostic): ground-truth masks of a synthetic scene with "
        "the faults set in perturb",
    )
    model: str = knob(
        "models/sam-tiny", "SAM folder (Hugging Face ONNX); auto: best pretrained SAM, else sam-tiny"
    )
    variant: Suffix = knob("", "suffix of the network files, such as fp16 for vision_encoder_fp16.onnx")
    precision: Literal["auto", "fp32", "int8"] = knob(
        "auto",
        "auto: int8 on a CPU, fp16 on CUDA, if it agrees with fp32 on the scene; embedded models: fp32",
    )
    device: Device = knob("auto", NETWORKS)
    key_views: float = knob(
        1.0, "share of training views to segment; below 1: together they show the most Gaussians", gt=0, le=1
    )
    prompts: Literal["grid", "guided"] = knob(
        "grid",
        "prompts in all but the key views; guided: nodes of the key views, and grid points that no "
        "node covers",
        origin="SAM, LangSplat: grid",
    )
    levels: Literal["head", "tree"] = knob(
        "head",
        "source of levels; head: SAM's output head; tree: depth in the tree of all masks of the view, which "
        "is computed with theta",
        origin="paper: three levels by theta; LangSplat: head",
    )
    theta: float | None = knob(None, "theta for levels: tree; default: coverage_tree.theta", gt=0.5, lt=1)
    points_per_side: int = knob(32, "point prompts per image side", ge=1, le=128, origin="LangSplat: 32")
    points_per_batch: Annotated[int, Field(ge=1, le=4096)] | Auto = knob(
        "auto",
        "prompts per call of an exported decoder on a CPU; auto: the model's, else 8 (60 MB each)",
        origin="LangSplat: 64",
    )
    crop_layers: int = knob(0, "layers of crops to segment", ge=0, le=2, origin="LangSplat: 1")
    predicted_iou_min: Annotated[float, Field(ge=0, le=2)] | Auto = knob(
        "auto",
        "predicted IoU that a mask must exceed (may be above 1); 0: keep all; auto: the model folder's "
        "value, else 0.7",
        origin="SAM: 0.88, LangSplat: 0.7",
    )
    stability_min: Share | Auto = knob(
        "auto",
        "minimum stability of a mask; auto: the model folder's value, else 0.85",
        origin="SAM: 0.95, LangSplat: 0.85",
    )
    stability: Literal["estimate", "full"] = knob(
        "estimate",
        "masks used to measure stability; estimate: the network's small masks; full: full-size masks",
        origin="SAM: full",
    )
    generator: Literal["hilsplat", "official"] = knob(
        "hilsplat",
        "official: every rule of SAM's generator as published, with stability: full (docs/segment.md)",
        origin="SAM, LangSplat: official",
    )
    stability_offset: float = knob(1.0, "shift of the logits in the stability test", gt=0, origin="SAM")
    box_nms_iou: float = knob(
        0.7,
        "box IoU above which the worse mask is dropped; at 0.95 or more, every prompt is decoded",
        gt=0,
        le=1,
        origin="SAM",
    )
    min_area_px: int = knob(16, "minimum mask, island or hole area", unit="px", ge=1, origin="LangSplat: 100")
    nms_iou: float = knob(0.8, "IoU above which the worse mask is dropped", gt=0, le=1, origin="LangSplat")
    nms_score: Annotated[float, Field(ge=0, le=2)] | Auto = knob(
        "auto",
        "minimum of predicted IoU x stability; 0: keep all; auto: the model folder's value, else 0.7",
        origin="LangSplat: 0.7",
    )
    nms_inner: Share = knob(0.5, "threshold for suppressing inner masks", origin="LangSplat")
    graph_scales: tuple[float, float, float] = knob(
        (0.12, 0.04, 0.015), "graph: minimum segment size at each level, as a share of the image side"
    )

    @property
    def uses_model(self) -> bool:
        return self.segmenter == "sam"

    @property
    def uses_card(self) -> bool:
        return self.uses_model and super().uses_card


class CoverageTreeSettings(Section):
    """Coverage tree of each view."""

    theta: float = knob(
        0.9,
        "mask A is a child of mask B if B covers more than this share of A",
        unit="share",
        gt=0.5,
        lt=1,
        origin="paper: 0.9",
    )


class ClipSettings(Section):
    """CLIP vectors of masks and nodes."""

    precision: Literal["auto", "fp32", "int8"] = knob(
        "auto", "auto: int8 on a CPU, fp16 on CUDA, if it agrees with fp32 on crops; embedded models: fp32"
    )
    device: Device = knob("auto", NETWORKS)
    crops: Literal["auto", "nodes", "masks"] = knob(
        "auto",
        "masks to embed; nodes: those showing each node best; masks: all; auto: set by autoencoder.targets",
        origin="paper, LangSplat: masks",
    )
    crops_per_node: int = knob(5, "nodes: maximum number of crops averaged per node", ge=1, le=32)

    model: str = knob(
        "models/clip-tiny", "CLIP folder (Hugging Face ONNX); auto: best pretrained CLIP, else clip-tiny"
    )
    variant: Suffix = knob("", "suffix of the network files, such as fp16 for vision_model_fp16.onnx")
    crop: Literal["box", "langsplat"] = knob(
        "box",
        "box: a mask's entire box, area filter; langsplat: no last row and column, bilinear filter",
        origin="LangSplat",
    )
    background: Literal["black", "keep"] = knob(
        "black", "pixels of a crop outside its mask: painted black, or kept", origin="LangSplat: black"
    )
    batch: int = knob(1, "crops per network call on a CPU, where more are no faster", ge=1, le=4096)


class ContributionsSettings(Section):
    """Weights of the Gaussians in each mask, with frozen geometry."""

    min_weight: float = knob(1 / 255, "weights below this (of a Gaussian at a pixel) are dropped", ge=0, lt=1)
    keep: Literal["auto", "gram", "weights", "none"] = knob(
        "auto",
        "gram: store pairs of Gaussians; weights: store pixel weights of all views; auto: the one with fewer "
        "non-zeros; none: neither, which suffices for a semantic tree, and for fields of other methods",
    )
    device: Device = knob(
        "auto",
        "cuda: gsplat and torch compute the weights; auto: cpu, which was as fast (docs/benchmarks.md)",
    )

    @property
    def rasteriser(self) -> Device:
        """Value of `device`; on the CPU for `auto`."""
        return "cpu" if self.device == "auto" else self.device

    @property
    def uses_card(self) -> bool:
        return self.rasteriser != "cpu"


class SemanticTreeSettings(Section):
    """3D semantic tree: masks linked across views by shared Gaussians."""

    evidence: Literal["masks", "features"] = knob(
        "masks",
        "masks: linked across views; features: Gaussians clustered by features, which are trained with only "
        "the loss L, as set in section field",
        origin="paper: features",
    )
    feature_size: int = knob(6, "features: number of dimensions", ge=2, le=64, origin="OpenGaussian: 6")
    link_threshold: float = knob(0.3, "minimum pooled IoU to join mask clusters", gt=0, lt=1)
    min_views: int = knob(3, "minimum number of views with masks of a node", ge=1)
    parent_coverage: float = knob(
        0.5, "node A is a child of a coarser node B if B contains more than this share of A", gt=0, lt=1
    )
    whole_side: float = knob(
        0.35, "graph: regions that touch in 3D form wholes of up to about this share of a view's side", gt=0
    )

    @property
    def is_random(self) -> bool:
        """Whether the tree depends on the seed: features start at random; linking is deterministic."""
        return self.evidence == "features"


class AutoencoderSettings(Section):
    """Compression of the scene's CLIP vectors to codes."""

    code: Literal["network", "pca"] = knob(
        "pca", "network: a trained autoencoder; pca: mean and principal directions", origin="paper: network"
    )
    latent: int = knob(16, "size d of a latent", ge=1, le=64, origin="paper, LangSplat: 3")
    targets: Literal["node", "mask"] = knob(
        "node", "vector of a mask; node: that of its best-fitting node; mask: its own", origin="paper: mask"
    )
    epochs: int = knob(100, "network: passes over all vectors", ge=1, origin="LangSplat: 100")
    min_steps: int = knob(2000, "network: minimum number of steps, regardless of the number of vectors", ge=1)
    batch: int = knob(64, "network: vectors per step", ge=2, origin="LangSplat: 64")
    learning_rate: float = knob(
        2e-3, "network: initial Adam step size; cosine decay", gt=0, origin="LangSplat: 7e-4"
    )
    cosine_weight: float = knob(1e-3, "network: loss weight of 1 - cosine", ge=0, origin="LangSplat: 1e-3")

    @property
    def is_random(self) -> bool:
        """Whether the code depends on the seed: a network starts from random weights, PCA does not."""
        return self.code == "network"


class HierarchyLosses(Section):
    """Weights and readings of the paper's losses L_h, L_ins and L_part (Eq. 2 to 6)."""

    weight_clustering: float = knob(0.0, "weight of L_h (Eq. 2)", ge=0, origin="paper: 1")
    weight_instance: float = knob(0.0, "weight of L_ins (Eq. 3), lambda_1", ge=0, origin="paper: e-6")
    weight_part: float = knob(0.01, "weight of L_part (Eq. 5), lambda_2", ge=0, origin="paper: e-5")
    instance_mode: Literal["literal", "coverage_tree"] = knob(
        "coverage_tree",
        "literal: Eq. 3 as printed; coverage_tree: by depth in the coverage tree",
        origin="paper: literal",
    )
    part_mode: Literal["literal", "disentangle"] = knob(
        "disentangle",
        "literal: Eq. 5 as printed; disentangle: parts repel each other, as the paper's text states",
        origin="paper: literal",
    )
    omega: float = knob(10.0, "similarity degree Omega: base of distances in L_ins", gt=1, origin="paper: 10")
    tau: float = knob(0.1, "temperature of L_part", gt=0, origin="paper: not given; VCH: 0.1")
    min_mask_px: int = knob(50, "minimum area of masks in L_ins and L_part", unit="px", ge=1)
    prune_cosine: Share = knob(
        1.0,
        "L_ins and L_part omit a mask if the cosine between its mean initial feature (hi_lsplat: its code) "
        "and that of a larger, unrelated mask of the same view and level exceeds this; 1: keep all",
        origin="paper: pruning, no value given",
    )


class FieldSettings(HierarchyLosses):
    """Language field: one latent per Gaussian and level."""

    weight_language: float = knob(1.0, "weight of the latent regression", ge=0, origin="paper: not stated")
    start: Literal["average", "random", "langsplat"] = knob(
        "average",
        "initial features; average: of the latents of masks that contain a Gaussian; random: in [-1, 1); "
        "langsplat: from a variant with method.name langsplat and the same autoencoder",
    )
    ridge: float = knob(0.1, "weight of the pull towards the initial features, per visible mass", ge=0)
    min_labelled_share: float = knob(
        0.3,
        "a Gaussian gets a latent at a level if masks of that level contain this share of its weight; 0: all",
        ge=0,
        lt=1,
        origin="paper, LangSplat: 0",
    )
    cg_steps: int = knob(6, "conjugate-gradient steps on the quadratic losses", ge=0)
    lbfgs_steps: int = knob(6, "L-BFGS steps, if the weight of L_ins or L_part is not 0", ge=0)
    block_gaussians: int = knob(
        2**20,
        "largest number of Gaussians that are solved together; a scene with more is solved in blocks, each "
        "with the others fixed, and a block takes about 4 kB of memory per Gaussian (16 channels)",
        ge=1,
    )

    @property
    def is_random(self) -> bool:
        """Whether the field depends on the seed: some starts are random."""
        return self.start in ("random", "langsplat")


class EvaluateSettings(Section):
    """Queries and evaluation protocols."""

    canonical: tuple[Annotated[str, Field(pattern=r"\S")], ...] = knob(
        ("object", "things", "stuff", "texture"),
        "canonical phrases for relevancy",
        origin="LERF, LangSplat",
        min_length=1,
    )
    template: str = knob(
        "{}",
        "prompt template for queries and canonical phrases, such as 'a photo of a {}'",
        origin="LERF, LangSplat: {}",
        pattern=r"^[^{}]*\{\}[^{}]*$",
    )
    relevancy_scale: float = knob(10.0, "scale of the cosines in the relevancy", gt=0, origin="LangSplat")
    filter_px: int = knob(
        0,
        "side of the mean filter on relevancy maps; 0: scaled with the image height (30 px at 730)",
        unit="px",
        ge=0,
        origin="LangSplat: 30, paper: 20",
    )
    mix: bool = knob(True, "average filtered and unfiltered relevancy", origin="LangSplat")
    relevancy_threshold: float = knob(0.4, "map threshold for masks", ge=0, lt=1, origin="LangSplat, paper")
    threshold_on: Literal["normalised_pm1", "raw"] = knob(
        "normalised_pm1",
        "scale of the threshold; normalised_pm1: maps stretched to [-1, 1], so 0.4 is 70 % of the range",
        origin="LangSplat's code",
    )
    majority: bool = knob(True, "smooth a map's mask by a 7 x 7 px majority vote", origin="LangSplat's code")
    level_rule: Literal["max", "mean_in_mask"] = knob(
        "max",
        "level if none is given; max: the one with the highest value; mean_in_mask: highest mean in its mask",
        origin="LangSplat: max",
    )
    node_select: float = knob(
        0.95,
        "a node is also selected if its cosine margin is below the best by at most (1 - node_select) times "
        "the level's range of margins, or three times that if it looks like the best",
        ge=0,
        le=1,
    )
    ancestors: float = knob(0.2, "share of the ancestors' mean margin added to a node's margin", ge=0)
    min_region_px: int = knob(60, "minimum area of scored regions", unit="px", ge=1)
    methods: tuple[Literal["tree", "tree-path", "field"], ...] = knob(
        ("tree", "tree-path", "field"), "methods that answer queries; each has its own table rows"
    )
    view_consistency: bool = knob(
        True, "score whether answers agree in neighbouring views (synthetic scenes)"
    )
    points: Literal["nearest", "frozen"] = knob(
        "nearest",
        "Gaussian used for a labelled point; nearest: the nearest opaque one; frozen: the one at the point "
        "(gaussians.initial: frozen, or your own PLY with one Gaussian per point)",
        origin="OpenGaussian: frozen",
    )


class QuerySettings(Section):
    """Vocabulary for node names and for detecting doubtful answers."""

    vocabulary: str = knob(
        "auto", "text file of node names; auto: the CLIP model's vocabulary.txt, else 1,400 common words"
    )


class FiguresSettings(Section):
    """Figures of each scene."""

    queries_per_level: int = knob(2, "queries shown per level", ge=1, le=10)
    views: int = knob(1, "views shown per scene", ge=1, le=10)
